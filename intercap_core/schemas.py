"""What every artefact holds: names, shapes, types, units and frames.

Axes: T frame sets, C cameras, J=55 joints, K=135 keypoints, R contact regions, V body vertices,
Vo object vertices. "master" is the frame of the master colour camera (x right, y down, z forward).
A rotation matrix or transform ``a_from_b`` maps b's coordinates to a's. Change a schema's meaning
and its version goes up: older files are then refused with the stage to re-run.

``betas`` are T x S after body_fit, whose setting ``shape`` may free the shape in every frame, and S
after joint, which has one shape for all. ``numpy.atleast_2d(betas)`` makes (T, S) or (1, S) of them,
which broadcast over the frames alike; ``intercap_core.body.artefact.read_parameters`` reads either
so, and ``intercap_core.posed.open_sequence`` gives vertices and joints of the same shapes of both.
"""

from __future__ import annotations

from intercap_core.artefacts import Field, Schema

CONTACT_REGIONS = (
    "left_hand", "right_hand", "left_foot", "right_foot", "left_thigh", "right_thigh", "seat",
    "back", "chest", "left_forearm", "right_forearm", "mouth", "left_shoulder", "right_shoulder",
)  # fmt: skip
METRIC_REGIONS = CONTACT_REGIONS[:12]
BODY_PARTS = (
    "trunk", "left_arm", "right_arm", "left_leg", "right_leg", "left_hand", "right_hand", "face",
)  # fmt: skip

_CAMERA_MODELS = {
    "camera_names": Field(("C",), "str", "one name a camera, in the order of every C axis"),
    "colour_size": Field(("C", "2"), "int32", "width and height of the colour image", "px"),
    "colour_intrinsics": Field(("C", "4"), "float64", "fx, fy, cx, cy; pixel centres at integers", "px"),
    "colour_distortion": Field(("C", "8"), "float64", "OpenCV k1 k2 p1 p2 k3 k4 k5 k6"),
    "colour_metric_radius": Field(("C",), "float64", "the model holds up to this sqrt(x^2 + y^2) at z = 1"),
    "depth_size": Field(("C", "2"), "int32", "width and height of the depth image, 0 without depth", "px"),
    "depth_intrinsics": Field(("C", "4"), "float64", "fx, fy, cx, cy; NaN without depth", "px"),
    "depth_distortion": Field(("C", "8"), "float64", "OpenCV k1 k2 p1 p2 k3 k4 k5 k6"),
    "depth_metric_radius": Field(("C",), "float64", "the same of the depth camera; NaN without depth"),
    "colour_from_depth": Field(("C", "4", "4"), "float64", "depth camera to colour camera; NaN without depth", "m", "colour camera"),
}  # fmt: skip

FRAMES = Schema(
    name="frames",
    version=1,
    stage="frames",
    frame="each camera's own images",
    attributes={
        "sequence": "sequence name",
        "master": "name of the master camera",
        "fps": "nominal frame sets a second",
    },
    fields={
        **_CAMERA_MODELS,
        "master_from_colour": Field(("C", "4", "4"), "float64", "extrinsics as given, unrefined", "m", "master"),
        "gravity": Field(("C", "3"), "float64", "mean accelerometer direction (down), NaN where none", "1", "colour camera"),
        "stated_up": Field(("3",), "float64", "unit direction up as the table of sequences states it", "1", "master", optional=True),
        "stated_floor": Field(("3",), "float64", "a point of the floor as the table of sequences states it", "m", "master", optional=True),
        "present": Field(("C",), "bool", "the recording could be read"),
        "truncated": Field(("C",), "bool", "the recording ends before its time or is cut"),
        "note": Field(("C",), "str", "what is degraded about this camera, in words"),
        "sound_start": Field(("C",), "float64", "when each camera took its first image by the sound that the recordings share, on a clock of any zero; NaN = it shares none", "s", optional=True),
        "sound_start_sigma": Field(("C",), "float64", "standard deviation of it, in which devices' sound against their images is the most", "s", optional=True),
        "times": Field(("T",), "float64", "time of each set since the first, master clock", "s"),
        "dropped": Field(("T",), "bool", "dropped by annotation: treated as seen by no camera"),
        "colour_index": Field(("T", "C"), "int32", "this set's image in cameras/<c>/colour, -1 = none"),
        "depth_index": Field(("T", "C"), "int32", "this set's image in cameras/<c>/depth, -1 = none"),
        "skew": Field(("T", "C"), "float32", "device time minus the set's time, NaN = none", "s"),
        "cameras/{camera}/colour": Field(("B",), "uint8", "JPEG or PNG files as recorded, end to end", codec="none"),
        "cameras/{camera}/colour_offsets": Field(("N+1",), "int64", "start of each file, and the end"),
        "cameras/{camera}/colour_time": Field(("N",), "int64", "device time of each colour image", "us"),
        "cameras/{camera}/depth": Field(("D", "H", "W"), "uint16", "depth as recorded, 0 = invalid", "mm", "depth camera", codec="depth"),
        "cameras/{camera}/depth_time": Field(("D",), "int64", "device time of each depth image", "us"),
    },
)  # fmt: skip

DETECTIONS = Schema(
    name="detections",
    version=1,
    stage="detections",
    frame="colour image of each camera, pixels",
    attributes={"sequence": "sequence name"},
    optional_attributes={
        "segmentation_model": "name and SHA-256 of the model that saw images without candidates",
        "keypoint_model": "name and SHA-256 of the model that saw images without keypoints",
    },
    fields={
        "camera_names": Field(("C",), "str", "one name a camera"),
        "colour_size": Field(("C", "2"), "int32", "width and height of the colour image", "px"),
        "note": Field(("C",), "str", "what is degraded about this camera's detections, in words"),
        "keypoints_found": Field(("T", "C"), "bool", "keypoints are known for this image (maybe of nobody)"),
        "candidates_found": Field(("T", "C"), "bool", "candidates are known for this image (maybe none)"),
        "cameras/{camera}/people_offsets": Field(("T+1",), "int64", "first person of each set, and the end"),
        "cameras/{camera}/people": Field(("P", "135", "3"), "float32", "x, y, confidence in the 135-point order", "px", "colour image"),
        "cameras/{camera}/candidate_offsets": Field(("T+1",), "int64", "first candidate of each set, and the end"),
        "cameras/{camera}/candidate_labels": Field(("N",), "str", "label as the detector gave it"),
        "cameras/{camera}/candidate_scores": Field(("N",), "float32", "the detector's score"),
        "cameras/{camera}/candidate_boxes": Field(("N", "4"), "float32", "x, y, width, height", "px", "colour image"),
        "cameras/{camera}/rle_offsets": Field(("N+1",), "int64", "start of each candidate's RLE, and the end"),
        "cameras/{camera}/rle": Field(("B",), "uint8", "COCO compressed RLE strings, end to end, at the colour image's size"),
    },
)  # fmt: skip

SCENE = Schema(
    name="scene",
    version=3,
    stage="scene",
    attributes={
        "sequence": "sequence name",
        "master": "name of the master camera",
        "fps": "nominal frame sets a second",
        "extrinsics_refined": "the refined extrinsics are better on held-out points and were kept",
        "extrinsics_converged": "the last step moved no point by a millimetre",
        "verdict": "what became of the extrinsics, in words",
        "ground_found": "a floor was seen, annotated, stood on or stated",
        "ground_source": "'fitted' to depth, 'annotated', 'feet' (where the subject stands), 'stated' with the calibration or 'none'",
        "ground_rms": "RMS distance of the floor's inliers to the plane, metres",
        "ground_inliers": "number of floor points, or of sets with a standing foot, that support the plane",
    },
    optional_attributes={
        "ground_note": "what is odd about the floor or about the stated up, in words; only where something is",
        "up_source": "what turned z up where no floor is known: 'gravity' sensors, 'stated' with the calibration or 'cameras' (their mean up)",
    },
    fields={
        **_CAMERA_MODELS,
        "present": Field(("C",), "bool", "this camera has images"),
        "times": Field(("T",), "float64", "time of each set since the first", "s"),
        "master_from_colour": Field(("C", "4", "4"), "float64", "refined extrinsics", "m", "master"),
        "master_from_colour_start": Field(("C", "4", "4"), "float64", "extrinsics as given", "m", "master"),
        "depth_bias": Field(("C",), "float64", "to subtract from each camera's depth", "m"),
        "camera_covariance": Field(("C", "7", "C", "7"), "float64", "of each camera's rotation about its centre, translation and depth bias, beside the master's pose (0)", "rad, m", "master"),
        "camera_refined": Field(("C",), "bool", "this camera's pose was refined, on its own evidence; else it is as given", optional=True),
        "camera_verdict": Field(("C",), "str", "why, in words: held-out errors of the refined pose against the given one by kind, and what the pose is known to", optional=True),
        "camera_slide": Field(("C", "3"), "float64", "the direction in which this camera's pose is least known: one standard deviation by which it lets the middle of the rig slide", "m", "master", optional=True),
        "note": Field(("C",), "str", "what is degraded about this camera's pose or time, in words"),
        "pairs": Field(("P", "2"), "int32", "camera indices of each overlapping pair"),
        "pair_points": Field(("P",), "int64", "held-out correspondences of the pair's backgrounds"),
        "pair_residual_before": Field(("P",), "float32", "median point-to-plane distance at the start, held-out points; NaN = no overlap", "m"),
        "pair_residual_after": Field(("P",), "float32", "the same after refinement", "m"),
        "pair_moving_points": Field(("P",), "int64", "held-out correspondences of what moves"),
        "pair_moving_before": Field(("P",), "float32", "their median distance at the start; NaN = no overlap", "m"),
        "pair_moving_after": Field(("P",), "float32", "the same after refinement", "m"),
        "pair_weak": Field(("P",), "bool", "few points, or residuals well above the other pairs'"),
        "time_offset": Field(("C",), "float64", "exposure later than the set's time by this much", "s"),
        "time_offset_sigma": Field(("C",), "float64", "stated standard deviation of time_offset; NaN = not estimated", "s"),
        "slip": Field(("T", "C"), "int32", "whole frames by which this set's image is older than its device time says"),
        "image_of": Field(("T", "C"), "int32", "set whose image of this camera shows this set's moment, -1 = none does"),
        "ground_point": Field(("3",), "float64", "a point of the floor; NaN where none", "m", "master"),
        "ground_normal": Field(("3",), "float64", "unit normal, up; NaN where none", "1", "master"),
        "zup_from_master": Field(("4", "4"), "float64", "z up, ground at z = 0; without a floor by up_source, the master at z = 0", "m", "z-up"),
        "cameras/{camera}/background": Field(("H", "W"), "uint16", "background depth, 0 = unknown", "mm", "depth camera"),
    },
)  # fmt: skip

PERSON = Schema(
    name="person",
    version=6,
    stage="person",
    attributes={
        "sequence": "sequence name",
        "images_alone": "whether the candidates of the images alone replace a detector's",
        "chosen_by": "how the subject was told from other people: 'alone' (there were none), 'named' (annotated), 'handling' (who touches the object), 'middle' (who is seen most, near the middle of the cameras)",
        "doubts": "what speaks against the choice of the subject, in words; empty = nothing",
    },
    fields={
        "camera_names": Field(("C",), "str", "one name a camera"),
        "person": Field(("T", "C"), "int32", "index among the people of the image that shows this moment (image_of of the scene), -1 = not seen"),
        "others": Field(("T",), "int32", "how many other people were placed"),
        "keypoints": Field(("T", "C", "135", "3"), "float32", "the subject's x, y, confidence in the image that shows this moment, as exposed (time_offset of the scene later); 0 = not seen", "px", "colour image"),
        "joints": Field(("T", "135", "3"), "float32", "keypoints at the set's time, triangulated, or lifted by one view's depth where few are, neck and mid hip else the middles of shoulders and hips; NaN = not known", "m", "master"),
        "joint_views": Field(("T", "135"), "int8", "views that agree on the point; 1 = lifted by depth"),
        "joint_error": Field(("T", "135"), "float32", "RMS reprojection error of those views; NaN = not triangulated", "px"),
        "inlier": Field(("T", "C", "135"), "bool", "this view agrees on the point"),
        "missing": Field(("T",), "bool", "fewer than two views see the subject, and no depth places it"),
        "mask_offsets": Field(("M+1",), "int64", "start of each mask's RLE, in the order of (T, C)"),
        "mask_rle": Field(("B",), "uint8", "COCO compressed RLE of the person in the image that shows this moment, empty = no mask"),
        "beside_offsets": Field(("M+1",), "int64", "start of each image's RLE in beside_rle; no beside_ datasets: nothing else was detected", optional=True),
        "beside_rle": Field(("B2",), "uint8", "COCO compressed RLE of where the mask's border may not be the person's: all else that a detector found in the image, or what a mask made from colour assumed; empty = nothing", optional=True),
        "mask_source": Field(("T", "C"), "int8", "who segmented the person: 0 nobody, 1 a detector, 2 the images alone"),
        "candidate_offsets": Field(("M+1",), "int64", "first candidate of each image, and the end, in the order of (T, C): what was segmented from the images alone; no candidate_ datasets where nothing was", optional=True),
        "candidate_scores": Field(("N",), "float32", "how likely the candidate is a thing, 0 to 1", optional=True),
        "candidate_extents": Field(("N",), "float32", "diagonal of what all views show of it; NaN = not known", "m", optional=True),
        "candidate_things": Field(("N",), "int32", "the same number in the views of one moment that show the same thing, -1 = not known", optional=True),
        "candidate_rle_offsets": Field(("N+1",), "int64", "start of each candidate's RLE, and the end", optional=True),
        "candidate_rle": Field(("R",), "uint8", "COCO compressed RLE in the image that shows this moment", optional=True),
    },
)  # fmt: skip

OBJECT_TRACK = Schema(
    name="object_track",
    version=5,
    stage="object_track",
    attributes={
        "sequence": "sequence name",
        "object": "object name, empty of a person alone",
        "seed_frame": "frame that the track started from, -1 = none",
        "seed_source": "'annotated', 'annotated against the images', 'search', or 'none': there is no object, every frame is lost",
        "doubts": "what speaks against the mesh, its labels or the track, or why there is none, in words; empty = nothing",
    },
    fields={
        "camera_names": Field(("C",), "str", "one name a camera"),
        "rotation": Field(("T", "3", "3"), "float64", "master_from_object; NaN throughout = no object", "1", "master"),
        "translation": Field(("T", "3"), "float64", "master_from_object, of the mesh's origin", "m", "master"),
        "candidate": Field(("T", "C"), "int32", "candidate kept in the image of each view that shows this moment, -1 = none"),
        "overlap": Field(("T", "C"), "float32", "IoU of the kept candidate and the visible render; NaN = none"),
        "depth_residual": Field(("T", "C"), "float32", "median |depth residual|; NaN = none", "m"),
        "silhouette_residual": Field(("T", "C"), "float32", "median contour distance; NaN = none", "px"),
        "views": Field(("T",), "int8", "views that the pose rests on"),
        "covariance": Field(("T", "6", "6"), "float64", "of (rotation vector, translation), rotation applied on the left", "rad, m", "master"),
        "spread": Field(("T", "6", "6"), "float64", "the part of covariance that other possible poses add: without it, what the images say near this one", "rad, m", "master"),
        "lost": Field(("T",), "bool", "the tracker does not believe its pose"),
        "gone": Field(("T",), "bool", "lost, and for so long that the object seems to have left the room"),
        "recovered": Field(("T",), "bool", "first frame that is not lost after lost ones"),
        "probability": Field(("T",), "float32", "of the pose, among all that were found, given all frames"),
        "ambiguous": Field(("T",), "bool", "a quite different pose may be the true one, by images and motion of all frames"),
        "resting": Field(("T",), "bool", "the object does not move"),
        "free_axis": Field(("T", "3"), "float64", "unit axis through the object's origin about which a turn changes nothing that was seen; 0 = none", "1", "master"),
        "carried": Field(("T",), "bool", "the images show nothing of the object, and its pose follows from annotated ones, in this frame or carried from theirs, as closely as the covariance says; absent: none is annotated", optional=True),
    },
)  # fmt: skip


def _body(*, one_shape: bool) -> dict[str, Field]:
    rotation = ("rad", "parent joint")
    return {
        "betas": Field(("S",) if one_shape else ("T", "S"), "float32", "shape coefficients"),
        "expression": Field(("T", "X"), "float32", "expression coefficients"),
        "global_orient": Field(
            ("T", "3"), "float32", "rotation vector of the pelvis", "rad", "master"
        ),
        "transl": Field(("T", "3"), "float32", "translation", "m", "master"),
        "body_pose": Field(("T", "63"), "float32", "rotation vectors of joints 1-21", *rotation),
        "jaw_pose": Field(("T", "3"), "float32", "rotation vector", *rotation),
        "leye_pose": Field(("T", "3"), "float32", "rotation vector", *rotation),
        "reye_pose": Field(("T", "3"), "float32", "rotation vector", *rotation),
        "left_hand_pose": Field(
            ("T", "45"), "float32", "full rotation vectors, mean included", *rotation
        ),
        "right_hand_pose": Field(
            ("T", "45"), "float32", "full rotation vectors, mean included", *rotation
        ),
        "joints": Field(("T", "55", "3"), "float32", "posed joints", "m", "master"),
        "keypoint_residual": Field(
            ("T", "C"), "float32", "median reprojection error; NaN = not seen", "px"
        ),
        "cloud_residual": Field(
            ("T",), "float32", "median distance of person points to the mesh; NaN = none", "m"
        ),
    }


BODY_FIT = Schema(
    name="body_fit",
    version=3,
    stage="body_fit",
    attributes={
        "sequence": "sequence name",
        "subject": "subject name",
        "gender": "which body file was used",
        "body_model": "digest of the body file",
    },
    fields={
        **_body(one_shape=False),
        "joint_sigma": Field(
            ("T", "55"), "float32", "stated standard deviation of each joint", "m"
        ),
        "joint_covariance": Field(
            ("T", "55", "3", "3"),
            "float32",
            "stated covariance of each joint; a third of its trace is the square of joint_sigma",
            "m^2",
            "master",
        ),
        "failed": Field(("T",), "bool", "no believable fit in this frame"),
        "bridged": Field(("T",), "bool", "filled in from its neighbours"),
        "uncertain": Field(
            ("T",), "bool", "fitted, but what was seen leaves room for a bad body: see part_names"
        ),
        "part_names": Field(("P",), "str", "parts of the body, in the order of the axis P"),
        "undetermined": Field(
            ("T", "P"),
            "bool",
            "what was seen does not determine this part, or most of it disagrees with the fit",
        ),
        "keypoint_offsets": Field(
            ("25", "3"),
            "float32",
            "detector's keypoint minus the body's, in the frame of its bone",
            "m",
            "bone",
        ),
        "keypoint_sigma": Field(
            ("135",), "float32", "what is left of a keypoint's error at usual confidence", "m"
        ),
        "keypoint_doubt": Field(
            ("135",), "float32", "power with which that error grows as confidence falls"
        ),
        "covering": Field(
            ("G",), "float32", "logarithm of each covering's thickness over its usual one"
        ),
        "covering_noise": Field(("G",), "float32", "spread of the clouds about each covering", "m"),
    },
)

JOINT = Schema(
    name="joint",
    version=4,
    stage="joint",
    attributes={
        "sequence": "sequence name",
        "subject": "subject name",
        "object": "object name, empty of a person alone",
        "gender": "which body file was used",
        "body_model": "digest of the body file",
        "iterations": "Gauss-Newton steps taken",
        "refused": "steps that would not have lowered the energy",
        "converged": "the last steps changed little; contact, time offsets and cameras too",
        "cameras_corrected": "the cameras were corrected; else they are the scene's",
    },
    optional_attributes={
        "made_by": "whose results these are, where another program made them; absent of this one's",
    },
    fields={
        **_body(one_shape=True),
        "rotation": Field(
            ("T", "3", "3"),
            "float64",
            "master_from_object; NaN throughout = no object",
            "1",
            "master",
        ),
        "translation": Field(
            ("T", "3"), "float64", "master_from_object, of the mesh's origin", "m", "master"
        ),
        "region_names": Field(("R",), "str", "contact regions of the body"),
        "contact_probability": Field(
            ("T", "R"), "float32", "that the region touches the object; NaN = there is none"
        ),
        "contact_annotated": Field(("T", "R"), "int8", "1 touching, 0 not, -1 not annotated"),
        "time_offset": Field(("C",), "float64", "refined exposure offset of each camera", "s"),
        "time_offset_sigma": Field(("C",), "float64", "stated standard deviation of it", "s"),
        "camera_names": Field(("C",), "str", "one name a camera"),
        "master_from_colour": Field(
            ("C", "4", "4"),
            "float64",
            "the cameras as body and object have settled them",
            "m",
            "master",
        ),
        "depth_bias": Field(
            ("C",), "float64", "to subtract from each camera's depth, settled alike", "m"
        ),
        "camera_covariance": Field(
            ("C", "7", "C", "7"),
            "float64",
            "of each camera's rotation about its centre, translation and depth bias, beside the master's pose (0)",
            "rad, m",
            "master",
        ),
        "energy_names": Field(("E",), "str", "terms of the energy"),
        "energy_before": Field(("E",), "float64", "weighted energy of each term at the start"),
        "energy_after": Field(("E",), "float64", "weighted energy of each term at the end"),
        "hand_undetermined": Field(
            ("T", "2"),
            "bool",
            "left and right hand: what was seen does not determine it, or contradicts it; such a frame is not flagged for that",
        ),
        "flagged": Field(("T",), "bool", "body or object of this frame should not be trusted"),
        "flag_reason": Field(("T",), "str", "why, in words; empty = not flagged"),
        "surface_distance": Field(
            ("T", "2"),
            "float64",
            "mean and 95th percentile of how far the skin is from an imported one of another mesh that it was fitted to; NaN = there is none; absent otherwise",
            "m",
            optional=True,
        ),
    },
)

TRUTH = Schema(
    name="truth",
    version=1,
    stage="studio",
    attributes={
        "sequence": "sequence name",
        "interaction": "script that was played",
        "subject": "studio subject",
        "object": "object name, empty of a person alone: then nothing of an object is in here",
        "ground_offset": "n . x + d = 0 of the floor, metres",
        "fps": "frame sets a second",
    },
    optional_attributes={
        "room": "furnished; sparse: a floor and two low pieces; or bare: a floor and nothing else",
        "passer_by": "studio subject who walks past or stands by; absent where nobody does",
        "sole_m": "how far soles of shoes are below the bare feet, metres; absent where they are not",
        "faults": "what was broken on purpose, camera by camera; empty where nothing was",
    },
    fields={
        "times": Field(("T",), "float64", "time of each set since the first", "s"),
        "body_vertices": Field(("T", "Vt", "3"), "float32", "skin without clothing, the truth's own mesh", "m", "master"),
        "body_faces": Field(("Ft", "3"), "int32", "of the truth's own mesh"),
        "correspondence_face": Field(("V",), "int32", "truth face under each vertex of the open body's mesh, rest pose"),
        "correspondence_weights": Field(("V", "3"), "float32", "barycentric"),
        "joints": Field(("T", "55", "3"), "float32", "true joints", "m", "master"),
        "fingertips": Field(("T", "10", "3"), "float32", "left thumb to little finger, then right", "m", "master"),
        "object_vertices": Field(("Vo", "3"), "float32", "the true object's mesh", "m", "object", optional=True),
        "object_faces": Field(("Fo", "3"), "int32", "of the true object's mesh", optional=True),
        "rotation": Field(("T", "3", "3"), "float64", "master_from_object", "1", "master", optional=True),
        "translation": Field(("T", "3"), "float64", "master_from_object", "m", "master", optional=True),
        "object_views": Field(("T",), "int8", "views that truly see the object", optional=True),
        "region_names": Field(("R",), "str", "contact regions"),
        "region_contact": Field(("T", "R"), "bool", "true distance at most 4.5 mm somewhere in the region"),
        "camera_names": Field(("C",), "str", "one name a camera"),
        "master_from_colour": Field(("C", "4", "4"), "float64", "true extrinsics", "m", "master"),
        "time_offset": Field(("C",), "float64", "true exposure offset", "s"),
        "slip": Field(("T", "C"), "int32", "whole frames late"),
        "recorded": Field(("T", "C"), "bool", "the camera recorded an image whose device time is this set's", optional=True),
        "depth_bias": Field(("C",), "float64", "what each camera's depth is too far by", "m", optional=True),
        "depth_recorded": Field(("T", "C"), "bool", "and depth that is not empty", optional=True),
        "ground_normal": Field(("3",), "float64", "true floor normal, up", "1", "master"),
        "support_height": Field(("T", "2"), "float64", "above the floor, of the highest surface under the left and the right sole, of scripts whose feet stand on furniture", "m", optional=True),
        "body_visible": Field(("T", "Vt"), "bool", "some camera truly sees the vertex (of the clothed body)"),
        "object_visible": Field(("T", "Vo"), "bool", "some camera truly sees the vertex", optional=True),
    },
)  # fmt: skip

_PER_STAGE_TRUTH = {
    f"truth/{stage}/{key}": Field(dims, dtype, doc, units, optional=True)
    for stage in ("object_track", "body_fit", "joint")
    for key, dims, dtype, doc, units in (
        ("body_pve", ("T",), "float32", "mean vertex error", "m"),
        ("body_mpjpe", ("T",), "float32", "mean error of the 22 body joints", "m"),
        ("hand_mpjpe", ("T", "2"), "float32", "mean error of 15 joints and 5 tips, left and right", "m"),
        ("hand_mpjpe_wrist", ("T", "2"), "float32", "the same after aligning the wrist", "m"),
        ("joint_normalised", ("T", "22"), "float32", "error over stated deviation, median 1 if honest", "1"),
        ("object_translation", ("T",), "float32", "error at the centre of mass", "m"),
        ("object_rotation", ("T",), "float32", "angle, the smallest over the symmetry group", "deg"),
        ("object_normalised", ("T",), "float32", "translation error over stated deviation, median 1 if honest", "1"),
        ("object_centre", ("T", "3"), "float64", "centre of mass of the fitted object", "m"),
        ("object_turn", ("T",), "float32", "turn since the frame before, beyond the true one, the smallest over the symmetry group; NaN in the first", "deg"),
        ("object_flagged", ("T",), "bool", "the stage itself does not trust the object's pose", "1"),
        ("acceleration_body", ("T",), "float32", "error of second differences at 30 fps, mean over 22 joints", "m/frame^2"),
        ("acceleration_hands", ("T",), "float32", "the same over 30 finger joints", "m/frame^2"),
        ("acceleration_feet", ("T",), "float32", "the same over ankles and balls of the feet", "m/frame^2"),
        ("acceleration_object", ("T",), "float32", "the same at the object's centre", "m/frame^2"),
        ("joint_offset", ("T", "22", "3"), "float32", "fitted less true place of each body joint", "m"),
        ("fingertips", ("T", "2"), "float32", "mean error of five fingertips, left and right", "m"),
        ("slip", ("T",), "float32", "speed of truly touching skin along the object, in its frame, beyond the true one, over the next 0.2 s; NaN = nothing touches; body_fit with the tracked object", "m/s"),
        ("planted_speed", ("T", "2"), "float32", "speed along the floor, since the frame before, of what truly carries the left and the right foot; NaN = it does not stand", "m/s"),
        ("planted_height", ("T", "2"), "float32", "mean distance of the same vertices from their true height", "m"),
        ("foot_swing", ("T", "2"), "float32", "mean error of the sole's vertices of a foot that does not stand; NaN = it stands", "m"),
        ("foot_centre", ("T", "2", "3"), "float32", "middle of each sole's vertices", "m"),
        ("region_contact", ("T", "12"), "bool", "the fit touches within 4.5 mm; body_fit with the tracked object", "1"),
        ("contact_frame", ("T",), "bool", "some vertex of the fit touches within 4.5 mm", "1"),
        ("vertex_contact_counts", ("T", "W", "4"), "int32", "true and false positives, false and true negatives at each of sweep", "1"),
    )
}  # fmt: skip

# What is of an object or of contact is left out where there is no object.
METRICS = Schema(
    name="metrics",
    version=4,
    stage="metrics",
    attributes={
        "sequence": "sequence name",
        "subject": "subject name",
        "object": "object name, empty of a person alone",
        "fps": "frame sets a second",
        "has_truth": "errors against truth are in truth/",
    },
    optional_attributes={
        "made_by": "another program made the results that are measured; absent of this one's",
    },
    fields={
        "body_to_object": Field(("T", "V"), "float32", "signed distance of each body vertex to the object's surface, negative inside, capped at 0.10, inside at -0.25", "m", optional=True),
        "object_sample_points": Field(("N", "3"), "float64", "points spread evenly over the object's surface", "m", "object", optional=True),
        "object_sample_contact": Field(("N",), "int32", "frames in which the point is within 4.5 mm of the body", optional=True),
        "object_to_body": Field(("T", "Vo"), "float32", "signed distance of each object vertex to the body's surface, negative inside, capped at 0.10, inside at -0.25", "m", optional=True),
        "contact_frame": Field(("T",), "bool", "a body vertex within 4.5 mm of the object", optional=True),
        "region_names": Field(("R",), "str", "contact regions", optional=True),
        "region_contact": Field(("T", "R"), "bool", "the region has a vertex within 4.5 mm", optional=True),
        "contact_probability": Field(("T", "R"), "float32", "that the region touches, as the joint stage says", optional=True),
        "penetration_mean": Field(("T",), "float32", "over body vertices inside the object; 0 = none", "m", optional=True),
        "penetration_median": Field(("T",), "float32", "the same, median", "m", optional=True),
        "penetration_max": Field(("T",), "float32", "the same, deepest", "m", optional=True),
        "penetration_object": Field(("T",), "float32", "mean depth of those object points that are inside the body", "m", optional=True),
        "ground_penetration": Field(("T",), "float32", "deepest vertex of body or object below the floor; NaN = no floor", "m"),
        "body_to_cloud": Field(("T",), "float32", "mean over all body vertices, as the paper; NaN = no cloud", "m"),
        "object_to_cloud": Field(("T",), "float32", "mean over all object vertices; NaN = no cloud", "m", optional=True),
        "body_visible_to_cloud": Field(("T",), "float32", "area-sampled, over what cameras can see", "m"),
        "object_visible_to_cloud": Field(("T",), "float32", "area-sampled, over what cameras can see", "m", optional=True),
        "cloud_to_body": Field(("T",), "float32", "mean over the person's points, each capped at 0.25", "m"),
        "acceleration_body": Field(("T",), "float32", "norm of second differences at 30 fps, mean over 22 joints", "m/frame^2"),
        "acceleration_object": Field(("T",), "float32", "the same at the object's centre", "m/frame^2", optional=True),
        "flagged": Field(("T",), "bool", "some stage does not trust this frame"),
        "flag_reason": Field(("T",), "str", "why; empty = not flagged"),
        "verdict/part_names": Field(("P",), "str", "parts that are judged without truth", optional=True),
        "verdict/error": Field(("P",), "float64", "stated error of each part; NaN = nothing is said", "m", optional=True),
        "verdict/error_factor": Field(("P",), "float64", "four of five true errors are within this factor of the stated one", optional=True),
        "verdict/error_frame": Field(("P", "T"), "float64", "stated error by frame; NaN = nothing is said", "m", optional=True),
        "verdict/silent": Field(("P",), "str", "why nothing is said; empty = it is", optional=True),
        "verdict/feature_names": Field(("F",), "str", "what the stated error is made of", optional=True),
        "verdict/features": Field(("P", "F"), "float64", "their sizes", "m", optional=True),
        "verdict/camera_names": Field(("C",), "str", "one name a camera", optional=True),
        "verdict/held_camera": Field(("T",), "int64", "the camera that was held out of the fit which judges the frame", optional=True),
        "verdict/shift": Field(("P", "C", "T"), "float64", "by how much a part is elsewhere without a camera; NaN = not held out", "m", optional=True),
        "verdict/repeated": Field(("P", "T"), "float64", "by how much a part is elsewhere where only the frames beside it are seen", "m", optional=True),
        "verdict/keypoint_px": Field(("T", "C"), "float64", "median error of the body's keypoints; NaN = none seen", "px", optional=True),
        "verdict/keypoint_px_held_out": Field(("T", "C"), "float64", "the same of the held-out camera and a body fitted without it", "px", optional=True),
        "verdict/person_m": Field(("T", "C"), "float64", "median distance of the person's points from the skin beyond clothes", "m", optional=True),
        "verdict/person_m_held_out": Field(("T", "C"), "float64", "the same of the held-out camera and a body fitted without it", "m", optional=True),
        "verdict/overlap": Field(("T", "C"), "float64", "intersection over union of the object's mask and render", optional=True),
        "verdict/overlap_held_out": Field(("T", "C"), "float64", "the same of the held-out camera and an object fitted without it", optional=True),
        "verdict/object_depth_m": Field(("T", "C"), "float64", "median error of the object's depth", "m", optional=True),
        "verdict/object_depth_m_held_out": Field(("T", "C"), "float64", "the same of the held-out camera and an object fitted without it", "m", optional=True),
        **_PER_STAGE_TRUTH,
        "truth/sweep": Field(("W",), "float64", "contact thresholds of vertex_contact_counts", "m", optional=True),
        "truth/contact_region": Field(("T", "12"), "bool", "true contact by region", optional=True),
        "truth/region_distance": Field(("T", "12"), "float32", "least true distance of each region's vertices to the true object, capped at 0.10", "m", optional=True),
        "truth/standing": Field(("T", "2"), "bool", "the left and the right foot truly stand, since the frame before", optional=True),
        "truth/foot_centre": Field(("T", "2", "3"), "float32", "true middle of each sole's vertices", "m", "master", optional=True),
        "truth/contact_frame": Field(("T",), "bool", "a true body vertex within 4.5 mm of the true object", optional=True),
        "truth/penetration_mean": Field(("T",), "float32", "the truth's own penetration", "m", optional=True),
        "truth/body_floor": Field(("T",), "float32", "body_to_cloud with the true body", "m", optional=True),
        "truth/object_floor": Field(("T",), "float32", "object_to_cloud with the true object", "m", optional=True),
        "truth/body_visible_floor": Field(("T",), "float32", "body_visible_to_cloud with the true body", "m", optional=True),
        "truth/object_visible_floor": Field(("T",), "float32", "object_visible_to_cloud with the true object", "m", optional=True),
        "truth/object_views": Field(("T",), "int8", "views that truly see the object", optional=True),
        "truth/object_moving": Field(("T",), "bool", "the true object moves", optional=True),
        "truth/object_centre": Field(("T", "3"), "float64", "true centre of mass", "m", "master", optional=True),
        "truth/extrinsics_before": Field(("C",), "float32", "RMS displacement over a 2 m cube by each camera's error as given; NaN = the master, or no images", "m", optional=True),
        "truth/extrinsics_after": Field(("C",), "float32", "the same after refinement", "m", optional=True),
        "truth/extrinsics_joint": Field(("C",), "float32", "the same after the joint fit", "m", optional=True),
    },
)  # fmt: skip

PER_VERTEX_METRICS = frozenset({"body_to_object", "object_to_body"})

# What the figures of all sequences together are made from: the metrics without distances by vertex.
SUMMARY = Schema(
    name="summary",
    version=1,
    stage="summary",
    frame="none: values by frame, and on meshes in rest pose",
    attributes={
        **METRICS.attributes,
        "intent": "what the person was asked to do with the object; empty = the table does not say",
        "gender": "which body file was used",
        "body_model": "digest of the body file",
        "num_betas": "numbers of the body's shape",
        "num_expression": "numbers of the face's expression",
    },
    optional_attributes=METRICS.optional_attributes,
    fields={
        **{key: declared for key, declared in METRICS.fields.items() if key not in PER_VERTEX_METRICS},
        "body_contact_frames": Field(("V",), "int32", "frames in which the body vertex is within 4.5 mm of the object", optional=True),
        "rig/camera_names": Field(("Cr",), "str", "one name a camera"),
        "rig/images": Field(("Cr",), "int32", "frames with a colour image of their moment"),
        "rig/time_offset": Field(("Cr",), "float64", "how much later than the master the camera exposed", "s"),
        "rig/time_offset_sigma": Field(("Cr",), "float64", "stated deviation of it; NaN = not known", "s"),
        "rig/depth_bias": Field(("Cr",), "float64", "what the camera's depth is too far by", "m"),
        "rig/moved": Field(("Cr",), "float64", "RMS displacement over a 2 m cube, by which refinement moved the camera; NaN = the master, or no images", "m"),
        "rig/note": Field(("Cr",), "str", "what is degraded about the camera, in words"),
        "rig/pairs": Field(("Q", "2"), "int32", "cameras whose static surfaces overlap"),
        "rig/pair_residual_before": Field(("Q",), "float64", "median distance between them as given; NaN = too few points", "m"),
        "rig/pair_residual_after": Field(("Q",), "float64", "the same after refinement", "m"),
        "made_by/stages": Field(("S",), "str", "stages whose artefacts the sequence's result rests on"),
        "made_by/versions": Field(("S",), "int32", "of each artefact's schema"),
        "made_by/settings": Field(("S",), "str", "digest of the settings that each was made with"),
    },
)  # fmt: skip

HEATMAPS = Schema(
    name="heatmaps",
    version=1,
    stage="dataset",
    frame="none: values on meshes in rest pose",
    attributes={
        "dataset": "dataset name",
        "contact_m": "distance that counts as contact, metres",
        "body_frames": "frames that the body's map counts",
    },
    fields={
        "body_likelihood": Field(("V",), "float32", "share of frames in which the vertex touches an object"),
        "object_names": Field(("O",), "str", "objects in the order of object_offsets"),
        "object_frames": Field(("O",), "int64", "frames that each object's map counts"),
        "object_offsets": Field(("O+1",), "int64", "first surface point of each object, and the end"),
        "object_points": Field(("N", "3"), "float64", "points spread evenly over each object's surface", "m", "object"),
        "object_likelihood": Field(("N",), "float32", "share of frames in which the point touches the body"),
    },
)  # fmt: skip
