"""Contents of every artefact: names, shapes, types, units and coordinate frames.

Axes: T frame sets, C cameras, J=55 joints, K=135 keypoints, R contact regions, V body vertices,
Vo object vertices. "master" is the frame of the master colour camera (x right, y down, z forward).
A rotation or transform ``a_from_b`` maps coordinates in b to coordinates in a.

A change of a schema's meaning increases its version. Files of an older version are then refused
with the name of the stage to re-run.

``betas`` has shape (T, S) after body_fit and (S,) after joint. ``numpy.atleast_2d(betas)`` has
shape (T, S) or (1, S) and broadcasts over the frames. ``intercap_core.body.artefact.read_parameters``
reads both; ``intercap_core.posed.open_sequence`` returns vertices and joints.
"""

from __future__ import annotations

from intercap_core.artefact_schema import Field, Schema

CONTACT_M = 0.0045  # distance of contact; the paper's threshold, "Contact Heatmaps"
CONTACT_REGIONS = (
    "left_hand", "right_hand", "left_foot", "right_foot", "left_thigh", "right_thigh", "seat",
    "back", "chest", "left_forearm", "right_forearm", "mouth", "left_shoulder", "right_shoulder",
)  # fmt: skip
METRIC_REGIONS = CONTACT_REGIONS[:12]  # regions compared with the truth: axes of length 12
BODY_PARTS = (
    "trunk", "left_arm", "right_arm", "left_leg", "right_leg", "left_hand", "right_hand", "face",
)  # fmt: skip
# A body with a larger mean vertex error is bad, metres: its frame should be flagged
# (docs/evaluation.md).
BAD_BODY_M = 0.040

# Axes that the header does not name belong to one file or to the group of one camera: B bytes, N or D
# images or other items, M = T * C images, P people, parts or pairs of cameras, X expression
# coefficients, E energy terms, G coverings, U unknowns, W thresholds, F features or faces. "NAME+1" are offsets.
_CAMERA_MODELS = {
    "camera_names": Field(("C",), "str", "camera names, in the order of all C axes"),
    "colour_size": Field(("C", "2"), "int32", "width and height of the colour image", "px"),
    "colour_intrinsics": Field(("C", "4"), "float64", "fx, fy, cx, cy; pixel centres at integers", "px"),
    "colour_distortion": Field(("C", "8"), "float64", "OpenCV k1 k2 p1 p2 k3 k4 k5 k6"),
    "colour_metric_radius": Field(("C",), "float64", "largest sqrt(x^2 + y^2) at z = 1 at which the lens model is valid"),
    "depth_size": Field(("C", "2"), "int32", "width and height of the depth image, 0 without depth", "px"),
    "depth_intrinsics": Field(("C", "4"), "float64", "fx, fy, cx, cy; NaN without depth", "px"),
    "depth_distortion": Field(("C", "8"), "float64", "OpenCV k1 k2 p1 p2 k3 k4 k5 k6"),
    "depth_metric_radius": Field(("C",), "float64", "colour_metric_radius of the depth camera; NaN without depth"),
    "depth_noise": Field(("C",), "float64", "standard deviation of depth over squared distance, of stereo cameras; 0 = time of flight; absent if all are 0", "1/m", optional=True),
    "colour_from_depth": Field(("C", "4", "4"), "float64", "depth camera to colour camera; NaN without depth", "m", "colour camera"),
}  # fmt: skip

_CAMERA_COVARIANCE = {
    "camera_covariance": Field(("C", "7", "C", "7"), "float64", "covariance of each camera's rotation about its centre, translation and depth bias; 0 for the master's pose", "rad, m", "master"),
}  # fmt: skip
_FLAGS = {
    "flagged": Field(("T", "4"), "bool", "body, hands, object and contact of this frame are not reliable"),
    "flag_reason": Field(("T",), "str", "parts and reasons, such as 'object, contact: object lost; hands: occluded'; empty = no part is flagged"),
}  # fmt: skip
_OBJECT_POSE = {
    "rotation": Field(("T", "3", "3"), "float64", "rotation of master_from_object; NaN in all frames = no object", "1", "master"),
    "translation": Field(("T", "3"), "float64", "translation of master_from_object (position of the mesh's origin)", "m", "master"),
}  # fmt: skip

FRAMES = Schema(
    name="frames",
    version=1,
    stage="frames",
    frame="each camera's own images",
    attributes={
        "sequence": "sequence name",
        "master": "name of the master camera",
        "fps": "nominal frame sets per second",
    },
    fields={
        **_CAMERA_MODELS,
        "master_from_colour": Field(("C", "4", "4"), "float64", "extrinsics as given, unrefined", "m", "master"),
        "gravity": Field(("C", "3"), "float64", "mean accelerometer direction (down); NaN without accelerometer", "1", "colour camera"),
        "stated_up": Field(("3",), "float64", "unit up direction, from calibration_up of the table of sequences", "1", "master", optional=True),
        "stated_floor": Field(("3",), "float64", "point on the floor, from calibration_floor of the table of sequences", "m", "master", optional=True),
        "present": Field(("C",), "bool", "the recording could be read"),
        "truncated": Field(("C",), "bool", "the recording ends early or the file is truncated"),
        "note": Field(("C",), "str", "degradations of this camera, in words"),
        "sound_start": Field(("C",), "float64", "time of each camera's first image from the sound common to the recordings, on a clock with arbitrary origin; NaN = no common sound", "s", optional=True),
        "sound_start_sigma": Field(("C",), "float64", "standard deviation of sound_start; mostly the delay between sound and images of a device", "s", optional=True),
        "times": Field(("T",), "float64", "time of each frame set since the first one, master clock", "s"),
        "dropped": Field(("T",), "bool", "dropped by annotation and treated as not recorded"),
        "colour_index": Field(("T", "C"), "int32", "index in cameras/<c>/colour of the set's image, -1 = none"),
        "depth_index": Field(("T", "C"), "int32", "index in cameras/<c>/depth of the set's image, -1 = none"),
        "skew": Field(("T", "C"), "float32", "device time minus the set's time; NaN = no image", "s"),
        "cameras/{camera}/colour": Field(("B",), "uint8", "JPEG or PNG files as recorded, concatenated; no set refers to a damaged one", codec="none"),
        "cameras/{camera}/colour_offsets": Field(("N+1",), "int64", "offset of each file, and the end"),
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
        "segmentation_model": "name and SHA-256 of the segmentation model, which ran on images without candidates",
        "keypoint_model": "name and SHA-256 of the keypoint model, which ran on images without keypoints",
    },
    fields={
        "camera_names": Field(("C",), "str", "camera names"),
        "colour_size": Field(("C", "2"), "int32", "width and height of the colour image", "px"),
        "note": Field(("C",), "str", "degradations of this camera's detections, in words"),
        "keypoints_found": Field(("T", "C"), "bool", "the image was searched for people, possibly with none found"),
        "candidates_found": Field(("T", "C"), "bool", "the image was segmented, possibly without candidates"),
        "cameras/{camera}/people_offsets": Field(("T+1",), "int64", "index of the first person of each set, and the end"),
        "cameras/{camera}/people": Field(("P", "135", "3"), "float32", "x, y and confidence of the 135 keypoints", "px", "colour image"),
        "cameras/{camera}/candidate_offsets": Field(("T+1",), "int64", "index of the first candidate of each set, and the end"),
        "cameras/{camera}/candidate_labels": Field(("N",), "str", "label by the detector"),
        "cameras/{camera}/candidate_scores": Field(("N",), "float32", "the detector's score"),
        "cameras/{camera}/candidate_boxes": Field(("N", "4"), "float32", "x, y, width, height", "px", "colour image"),
        "cameras/{camera}/rle_offsets": Field(("N+1",), "int64", "offset of each candidate's RLE, and the end"),
        "cameras/{camera}/rle": Field(("B",), "uint8", "concatenated COCO compressed RLE strings at the size of the colour image"),
    },
)  # fmt: skip

SCENE = Schema(
    name="scene",
    version=3,
    stage="scene",
    attributes={
        "sequence": "sequence name",
        "master": "name of the master camera",
        "fps": "nominal frame sets per second",
        "extrinsics_refined": "the refined extrinsics fit held-out points better and were kept",
        "extrinsics_converged": "the last step moved no point by a millimetre",
        "verdict": "result of the refinement of the extrinsics, in words",
        "ground_found": "a floor is known from depth, annotation, standing feet or the calibration",
        "ground_source": "source of the floor: 'fitted' to depth, 'annotated', 'feet' (standing feet), 'stated' with the calibration, or 'none'",
        "ground_rms": "RMS distance of the floor's inliers to the plane, metres",
        "ground_inliers": "number of floor points, or of sets with a standing foot, that support the plane",
    },
    optional_attributes={
        "ground_note": "doubts about the floor or the stated up direction, in words; absent without doubts",
        "up_source": "source of the up direction: the normal of a measured or annotated 'floor', 'stated' with the calibration, or those that were combined, joined by ', ': 'gravity' sensors, 'cameras' (taken to be level), 'feet' on one plane, 'balance' of the standing person",
        "up_deviation_deg": "standard deviation of the angle between the estimated and the true up direction, degrees",
    },
    fields={
        **_CAMERA_MODELS,
        "present": Field(("C",), "bool", "the camera has images"),
        "times": Field(("T",), "float64", "time of each frame set since the first one", "s"),
        "master_from_colour": Field(("C", "4", "4"), "float64", "refined extrinsics", "m", "master"),
        "master_from_colour_start": Field(("C", "4", "4"), "float64", "extrinsics as given", "m", "master"),
        "depth_bias": Field(("C",), "float64", "bias to subtract from each camera's depth", "m"),
        **_CAMERA_COVARIANCE,
        "camera_refined": Field(("C",), "bool", "the camera's pose was refined from its own evidence; otherwise it is the given one", optional=True),
        "camera_verdict": Field(("C",), "str", "reason in words: held-out errors of the refined and the given pose, and the standard deviation of the pose", optional=True),
        "camera_slide": Field(("C", "3"), "float64", "least determined direction of the camera's pose: displacement of the rig's centre by one standard deviation", "m", "master", optional=True),
        "note": Field(("C",), "str", "degradations of this camera's pose or timing, in words"),
        "pairs": Field(("P", "2"), "int32", "camera indices of each overlapping pair"),
        "pair_points": Field(("P",), "int64", "number of held-out correspondences of the pair's backgrounds"),
        "pair_residual_before": Field(("P",), "float32", "median point-to-plane distance of held-out points with the given extrinsics; NaN = no overlap", "m"),
        "pair_residual_after": Field(("P",), "float32", "the same after refinement", "m"),
        "pair_moving_points": Field(("P",), "int64", "number of held-out correspondences on moving surfaces"),
        "pair_moving_before": Field(("P",), "float32", "median distance on moving surfaces with the given extrinsics; NaN = no overlap", "m"),
        "pair_moving_after": Field(("P",), "float32", "the same after refinement", "m"),
        "pair_weak": Field(("P",), "bool", "few points, or residuals well above those of the other pairs"),
        "time_offset": Field(("C",), "float64", "exposure time minus the set's time", "s"),
        "time_offset_sigma": Field(("C",), "float64", "standard deviation of time_offset; NaN = not estimated", "s"),
        "slip": Field(("T", "C"), "int32", "whole frames by which the image is older than its device time"),
        "image_of": Field(("T", "C"), "int32", "index of the set whose image of this camera was exposed at this set's time, -1 = none"),
        "ground_point": Field(("3",), "float64", "point on the floor; NaN = no floor", "m", "master"),
        "ground_normal": Field(("3",), "float64", "unit normal of the floor, up; NaN = no floor", "1", "master"),
        "zup_from_master": Field(("4", "4"), "float64", "transform to z up with the floor at z = 0; without a floor, up by up_source and the master at z = 0", "m", "z-up"),
        "cameras/{camera}/background": Field(("H", "W"), "uint16", "background depth, 0 = unknown", "mm", "depth camera"),
    },
)  # fmt: skip

PERSON = Schema(
    name="person",
    version=6,
    stage="person",
    attributes={
        "sequence": "sequence name",
        "images_alone": "candidates of the foreground segmentation replace the detector's",
        "chosen_by": "criterion of the subject's choice: 'alone' (only one person), 'named' (annotated), 'handling' (handles the object), 'middle' (seen most, near the centre of the rig)",
        "doubts": "doubts about the choice of the subject, in words; empty = none",
    },
    fields={
        "camera_names": Field(("C",), "str", "camera names"),
        "person": Field(("T", "C"), "int32", "index of the subject among the people of the image (scene's image_of), -1 = not seen"),
        "others": Field(("T",), "int32", "number of other people that were triangulated"),
        "keypoints": Field(("T", "C", "135", "3"), "float32", "the subject's x, y and confidence in the image (scene's image_of), at its exposure time (scene's time_offset); 0 = not seen", "px", "colour image"),
        "joints": Field(("T", "135", "3"), "float32", "3D keypoints at the set's time, triangulated, or from one view's depth if few views see them; neck and mid hip may be midpoints of shoulders and hips; NaN = unknown", "m", "master"),
        "joint_views": Field(("T", "135"), "int8", "number of inlier views of the point; 1 = from depth"),
        "joint_error": Field(("T", "135"), "float32", "RMS reprojection error in the inlier views; NaN = not triangulated", "px"),
        "inlier": Field(("T", "C", "135"), "bool", "the view is an inlier of the point"),
        "missing": Field(("T",), "bool", "fewer than two views see the subject, and depth does not locate it"),
        "mask_offsets": Field(("M+1",), "int64", "offset of each mask's RLE, in the order of (T, C)"),
        "mask_rle": Field(("B",), "uint8", "COCO compressed RLE of the person in the image (scene's image_of); empty = no mask"),
        "beside_offsets": Field(("M+1",), "int64", "offset of each image's RLE in beside_rle; absent if nothing but the person was detected", optional=True),
        "beside_rle": Field(("B2",), "uint8", "COCO compressed RLE of pixels at which the mask's border may not be the person's outline: other detections of the image, or pixels that a colour segmentation assumed; empty = none", optional=True),
        "mask_source": Field(("T", "C"), "int8", "source of the person mask: 0 none, 1 detector, 2 foreground segmentation"),
        "candidate_offsets": Field(("M+1",), "int64", "index of the first candidate of each image, and the end, in the order of (T, C); candidates of the foreground segmentation, absent if there are none", optional=True),
        "candidate_scores": Field(("N",), "float32", "probability that the candidate is an object", optional=True),
        "candidate_extents": Field(("N",), "float32", "diagonal of the candidate's points in all views; NaN = unknown", "m", optional=True),
        "candidate_things": Field(("N",), "int32", "identifier that candidates of the same object share across the views of a frame, -1 = unknown", optional=True),
        "candidate_rle_offsets": Field(("N+1",), "int64", "offset of each candidate's RLE, and the end", optional=True),
        "candidate_rle": Field(("R",), "uint8", "COCO compressed RLE in the image (scene's image_of)", optional=True),
    },
)  # fmt: skip

OBJECT_TRACK = Schema(
    name="object_track",
    version=5,
    stage="object_track",
    attributes={
        "sequence": "sequence name",
        "object": "object name; empty = recording without an object",
        "seed_frame": "frame from which the track started, -1 = none",
        "seed_source": "source of the first pose: 'annotated', 'annotated against the images' (the images contradict it), 'search', or 'none' (no object, every frame is lost)",
        "doubts": "doubts about the mesh, its labels or the track, or why there is no track, in words; empty = none",
    },
    fields={
        "camera_names": Field(("C",), "str", "camera names"),
        **_OBJECT_POSE,
        "candidate": Field(("T", "C"), "int32", "index of the candidate used in each view (scene's image_of), -1 = none"),
        "overlap": Field(("T", "C"), "float32", "IoU of the used candidate and the visible part of the rendered object; NaN = none"),
        "depth_residual": Field(("T", "C"), "float32", "median absolute depth residual; NaN = none", "m"),
        "silhouette_residual": Field(("T", "C"), "float32", "median contour distance; NaN = none", "px"),
        "views": Field(("T",), "int8", "number of views whose images are evidence for the pose"),
        "covariance": Field(("T", "6", "6"), "float64", "covariance of (rotation vector, translation), rotation applied on the left", "rad, m", "master"),
        "spread": Field(("T", "6", "6"), "float64", "part of covariance that comes from rival hypotheses; covariance - spread is that of the images near this pose", "rad, m", "master"),
        "lost": Field(("T",), "bool", "the tracker rejects the pose"),
        "gone": Field(("T",), "bool", "lost for so long that the object has probably left the room"),
        "recovered": Field(("T",), "bool", "first frame that is not lost after lost frames"),
        "probability": Field(("T",), "float32", "posterior probability of the pose among all hypotheses, given all frames"),
        "ambiguous": Field(("T",), "bool", "a distinctly different pose has considerable posterior probability"),
        "resting": Field(("T",), "bool", "the object does not move"),
        "free_axis": Field(("T", "3"), "float64", "unit axis through the object's origin about which the observations do not determine the rotation; 0 = none", "1", "master"),
        "carried": Field(("T",), "bool", "the images do not show the object, and its pose is annotated in this frame or extrapolated from annotated frames, within covariance; absent without annotated poses", optional=True),
    },
)  # fmt: skip


def _body(*, one_shape: bool) -> dict[str, Field]:
    """Body parameters and residuals; ``one_shape``: one shape of the sequence, not per frame."""
    rotation = ("rad", "parent joint")
    return {
        "betas": Field(("S",) if one_shape else ("T", "S"), "float32", "shape coefficients"),
        "expression": Field(("T", "X"), "float32", "expression coefficients"),
        "global_orient": Field(("T", "3"), "float32", "rotation vector of the pelvis", "rad", "master"),
        "transl": Field(("T", "3"), "float32", "translation", "m", "master"),
        "body_pose": Field(("T", "63"), "float32", "rotation vectors of joints 1-21", *rotation),
        "jaw_pose": Field(("T", "3"), "float32", "rotation vector", *rotation),
        "leye_pose": Field(("T", "3"), "float32", "rotation vector", *rotation),
        "reye_pose": Field(("T", "3"), "float32", "rotation vector", *rotation),
        "left_hand_pose": Field(("T", "45"), "float32", "rotation vectors including the mean pose", *rotation),
        "right_hand_pose": Field(("T", "45"), "float32", "rotation vectors including the mean pose", *rotation),
        "joints": Field(("T", "55", "3"), "float32", "posed joints", "m", "master"),
        "keypoint_residual": Field(("T", "C"), "float32", "median reprojection error; NaN = not seen", "px"),
        "cloud_residual": Field(("T",), "float32", "median distance of the person's points to the mesh; NaN = no points", "m"),
    }  # fmt: skip


BODY_FIT = Schema(
    name="body_fit",
    version=6,
    stage="body_fit",
    attributes={
        "sequence": "sequence name",
        "subject": "subject name",
        "gender": "gender of the body file",
        "body_model": "digest of the body file",
    },
    optional_attributes={
        "shape_note": "why the shape of the sequence in shape_from was not used; absent if it was, or if none is named",
    },
    fields={
        **_body(one_shape=False),
        "joint_sigma": Field(("T", "55"), "float32", "standard deviation of each joint", "m"),
        "joint_covariance": Field(("T", "55", "3", "3"), "float32", "covariance of each joint; joint_sigma is the square root of a third of its trace", "m^2", "master"),
        "failed": Field(("T",), "bool", "no plausible fit in this frame"),
        "bridged": Field(("T",), "bool", "interpolated from neighbouring frames"),
        "uncertain": Field(("T",), "bool", "fitted, but the observations do not determine the body; see undetermined"),
        "part_names": Field(("P",), "str", "names of the body parts of the axis P"),
        "undetermined": Field(("T", "P"), "bool", "the observations do not determine this part, or most of them disagree with the fit"),
        "keypoint_offsets": Field(("25", "3"), "float32", "offset of the detector's keypoint from the body's joint, in the frame of its bone", "m", "bone"),
        "keypoint_sigma": Field(("135",), "float32", "standard deviation of a keypoint at typical confidence, after the offsets", "m"),
        "keypoint_doubt": Field(("135",), "float32", "exponent by which keypoint_sigma grows as confidence decreases"),
        "covering": Field(("G",), "float32", "logarithm of the ratio of each covering's thickness (clothes, hair, shoes) to its prior mean"),
        "shared_covariance": Field(("U", "U"), "float64", "covariance of the subject's unknowns, whatever keypoint_offsets are: betas (unless each frame has its own), covering"),
        "covering_noise": Field(("G",), "float32", "standard deviation of the point clouds about each covering", "m"),
        "cloud_offsets": Field(("T+1",), "int64", "frame t has the points cloud_offsets[t] to cloud_offsets[t + 1]"),
        "cloud_points": Field(("N", "3"), "float32", "depth points of the person, with the cameras of the scene", "m", "master", codec="none"),
        "cloud_normals": Field(("N", "3"), "float32", "unit normals of the points", "1", "master", codec="none"),
        "cloud_edge": Field(("N",), "bool", "the point is at an edge of the depth image"),
        "cloud_view": Field(("N",), "uint8", "camera of the point"),
        "cloud_window": Field(("T", "C", "4"), "int32", "first row, first column, height and width of the depth image around the person; 0 = no points", "px"),
        "rim_offsets": Field(("T+1",), "int64", "frame t has the rays rim_offsets[t] to rim_offsets[t + 1]"),
        "rim_rays": Field(("R", "3"), "float32", "unit rays through the rims of the person's masks", "1", "colour camera", codec="none"),
        "rim_normals": Field(("R", "3"), "float32", "outward unit normals of the planes that touch the person along the rays", "1", "colour camera", codec="none"),
        "rim_view": Field(("R",), "uint8", "camera of the ray"),
    },
)  # fmt: skip

JOINT = Schema(
    name="joint",
    version=5,
    stage="joint",
    attributes={
        "sequence": "sequence name",
        "subject": "subject name",
        "object": "object name; empty = recording without an object",
        "gender": "gender of the body file",
        "body_model": "digest of the body file",
        "iterations": "accepted Gauss-Newton steps",
        "refused": "rejected steps, which would not have decreased the energy",
        "converged": "the last steps changed little, including contact and cameras",
        "cameras_corrected": "the cameras were refined; otherwise they are those of the scene",
    },
    optional_attributes={
        "last_step_mm": "displacement of body or object by the last step, 95th percentile over frames",
        "last_decrease": "decrease of the energy by the last step, as a share of the energy",
        "made_by": "name of the other program that made these results; absent for this program's",
    },
    fields={
        **_body(one_shape=True),
        **_OBJECT_POSE,
        "region_names": Field(("R",), "str", "contact regions of the body"),
        "contact_probability": Field(("T", "R"), "float32", "probability that the region touches the object; NaN = no object"),
        "contact_annotated": Field(("T", "R"), "int8", "annotation: 1 contact, 0 no contact, -1 not annotated"),
        "time_offset": Field(("C",), "float64", "exposure time minus the set's time, as in scene.h5", "s"),
        "time_offset_sigma": Field(("C",), "float64", "standard deviation of time_offset; NaN = not estimated", "s"),
        "camera_names": Field(("C",), "str", "camera names"),
        "master_from_colour": Field(("C", "4", "4"), "float64", "extrinsics refined by body and object", "m", "master"),
        "depth_bias": Field(("C",), "float64", "bias to subtract from each camera's depth, refined by body and object", "m"),
        **_CAMERA_COVARIANCE,
        "energy_names": Field(("E",), "str", "terms of the energy"),
        "energy_before": Field(("E",), "float64", "weighted energy of each term at the start"),
        "energy_after": Field(("E",), "float64", "weighted energy of each term at the end"),
        "hand_undetermined": Field(("T", "2"), "bool", "left and right hand: the deviation of its finger joints is above 13 mm, also with the frames around"),
        **_FLAGS,
        "surface_distance": Field(("T", "2"), "float64", "imported results with another body mesh: mean and 95th percentile of the distance between the fitted skin and the imported one; NaN = no body in the frame", "m", optional=True),
    },
)  # fmt: skip

TRUTH = Schema(
    name="truth",
    version=1,
    stage="studio",
    attributes={
        "sequence": "sequence name",
        "interaction": "script of the interaction",
        "subject": "studio subject",
        "object": "object name; empty = recording without an object, whose object datasets are absent",
        "ground_offset": "d of the floor plane n . x + d = 0, metres",
        "fps": "frame sets per second",
    },
    optional_attributes={
        "room": "'furnished', 'sparse' (floor and two low pieces) or 'bare' (only a floor)",
        "passer_by": "studio subject of the second person; absent without one",
        "sole_m": "height of the shoes' soles below the bare feet, metres; absent without heavy shoes",
        "faults": "simulated faults by camera; empty = none",
    },
    fields={
        "times": Field(("T",), "float64", "time of each frame set since the first one", "s"),
        "body_vertices": Field(("T", "Vt", "3"), "float32", "vertices of the skin without clothing, of the studio's own mesh", "m", "master"),
        "body_faces": Field(("Ft", "3"), "int32", "faces of the studio's own mesh"),
        "correspondence_face": Field(("V",), "int32", "face of the studio's mesh below each vertex of the open body's mesh, rest pose"),
        "correspondence_weights": Field(("V", "3"), "float32", "barycentric coordinates in correspondence_face"),
        "joints": Field(("T", "55", "3"), "float32", "true joints", "m", "master"),
        "fingertips": Field(("T", "10", "3"), "float32", "left thumb to little finger, then right", "m", "master"),
        "object_vertices": Field(("Vo", "3"), "float32", "vertices of the true object's mesh", "m", "object", optional=True),
        "object_faces": Field(("Fo", "3"), "int32", "faces of the true object's mesh", optional=True),
        "rotation": Field(("T", "3", "3"), "float64", "master_from_object", "1", "master", optional=True),
        "translation": Field(("T", "3"), "float64", "master_from_object", "m", "master", optional=True),
        "object_views": Field(("T",), "int8", "number of views in which the object is visible", optional=True),
        "region_names": Field(("R",), "str", "contact regions"),
        "region_contact": Field(("T", "R"), "bool", "the region has a vertex within 4.5 mm of the object"),
        "camera_names": Field(("C",), "str", "camera names"),
        "master_from_colour": Field(("C", "4", "4"), "float64", "true extrinsics", "m", "master"),
        "time_offset": Field(("C",), "float64", "true exposure time minus the set's time", "s"),
        "slip": Field(("T", "C"), "int32", "whole frames by which the image is older than its device time"),
        "recorded": Field(("T", "C"), "bool", "the camera recorded an image with the set's device time", optional=True),
        "depth_bias": Field(("C",), "float64", "true bias of each camera's depth (positive = too far)", "m", optional=True),
        "depth_recorded": Field(("T", "C"), "bool", "the camera recorded non-empty depth with the set's device time", optional=True),
        "ground_normal": Field(("3",), "float64", "true floor normal, up", "1", "master"),
        "support_height": Field(("T", "2"), "float64", "height above the floor of the highest surface below the left and the right sole; only for scripts with feet on furniture", "m", optional=True),
        "body_visible": Field(("T", "Vt"), "bool", "the vertex of the clothed body is visible in a camera"),
        "object_visible": Field(("T", "Vo"), "bool", "the vertex is visible in a camera", optional=True),
    },
)  # fmt: skip

HAND_HELD_TRUTH = Schema(
    name="hand_held_truth",
    version=1,
    stage="studio",
    frame="object",
    attributes={
        "sequence": "sequence name",
        "interaction": "script whose object stands in the room",
        "object": "object name",
    },
    fields={
        "times": Field(("T",), "float64", "time of each frame set since the first one", "s"),
        "object_vertices": Field(("Vo", "3"), "float32", "vertices of the true object's mesh", "m", "object"),
        "object_faces": Field(("Fo", "3"), "int32", "faces of the true object's mesh"),
        "object_from_colour": Field(("T", "4", "4"), "float64", "true pose of the camera that is carried around the object", "m", "object"),
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
        ("joint_normalised", ("T", "22"), "float32", "error divided by its stated standard deviation (median 1 if calibrated)", "1"),
        ("object_translation", ("T",), "float32", "error at the centre of mass", "m"),
        ("object_rotation", ("T",), "float32", "rotation error, minimum over the symmetry group", "deg"),
        ("object_normalised", ("T",), "float32", "translation error divided by its stated standard deviation (median 1 if calibrated)", "1"),
        ("object_centre", ("T", "3"), "float64", "centre of mass of the fitted object", "m"),
        ("object_turn", ("T",), "float32", "error of the rotation since the previous frame, minimum over the symmetry group; NaN in the first frame", "deg"),
        ("object_flagged", ("T",), "bool", "the stage flags the object's pose", "1"),
        ("acceleration_body", ("T",), "float32", "error of second differences at 30 fps, mean over 22 joints", "m/frame^2"),
        ("acceleration_hands", ("T",), "float32", "the same over 30 finger joints", "m/frame^2"),
        ("acceleration_feet", ("T",), "float32", "the same over ankles and balls of the feet", "m/frame^2"),
        ("acceleration_object", ("T",), "float32", "the same at the object's centre", "m/frame^2"),
        ("joint_offset", ("T", "22", "3"), "float32", "fitted minus true position of each body joint", "m"),
        ("fingertips", ("T", "2"), "float32", "mean error of five fingertips, left and right", "m"),
        ("slip", ("T",), "float32", "error of the sliding speed over the next 0.2 s of vertices in true contact, in the object's frame; NaN = no contact; body_fit with the tracked object", "m/s"),
        ("planted_speed", ("T", "2"), "float32", "horizontal speed since the previous frame of the vertices on which the left and the right foot truly stand; NaN = not standing", "m/s"),
        ("planted_height", ("T", "2"), "float32", "mean error of the height of the vertices of planted_speed", "m"),
        ("foot_swing", ("T", "2"), "float32", "mean error of the sole's vertices of a foot that does not stand; NaN = standing", "m"),
        ("foot_centre", ("T", "2", "3"), "float32", "centre of each sole's vertices", "m"),
        ("region_contact", ("T", "12"), "bool", "the fitted region is within 4.5 mm of the fitted object; body_fit with the tracked object", "1"),
        ("contact_frame", ("T",), "bool", "a fitted vertex is within 4.5 mm of the fitted object", "1"),
        ("vertex_contact_counts", ("T", "W", "4"), "int32", "true positives, false positives, false negatives and true negatives at each threshold of sweep", "1"),
    )
}  # fmt: skip

# Object and contact datasets are absent in recordings without an object.
METRICS = Schema(
    name="metrics",
    version=6,
    stage="metrics",
    attributes={
        "sequence": "sequence name",
        "subject": "subject name",
        "object": "object name; empty = recording without an object",
        "fps": "frame sets per second",
        "has_truth": "truth/ holds errors against the truth",
    },
    optional_attributes={
        "made_by": "name of the other program that made the measured results; absent for this program's",
        "physics_note": "what the physics of the object does not judge, and why; empty = all is judged; absent without an object",
    },
    fields={
        "body_to_object": Field(("T", "V"), "float32", "signed distance of each body vertex to the object's surface, negative inside, capped at 0.10, inside at -0.25", "m", optional=True),
        "object_sample_points": Field(("N", "3"), "float64", "points distributed evenly over the object's surface", "m", "object", optional=True),
        "object_sample_contact": Field(("N",), "int32", "number of frames in which the point faces the body within 4.5 mm", optional=True),
        "object_to_body": Field(("T", "Vo"), "float32", "signed distance of each object vertex to the body's surface, negative inside, capped at 0.10, inside at -0.25", "m", optional=True),
        "body_contact_distance": Field(("T", "V"), "float32", "signed distance of each body vertex to the part of the object's surface that it faces with nothing between, negative inside; 0.10 = its nearest point within 30 mm is not faced, nor another within 10 mm", "m", optional=True),
        "object_contact_distance": Field(("T", "Vo"), "float32", "signed distance of each object vertex to the part of the body's surface that it faces with nothing between, negative inside; 0.10 = faces none within 4.5 mm", "m", optional=True),
        "contact_frame": Field(("T",), "bool", "a body vertex with a contact distance of at most 4.5 mm", optional=True),
        "region_names": Field(("R",), "str", "contact regions", optional=True),
        "region_contact": Field(("T", "R"), "bool", "the region has a vertex with a contact distance of at most 4.5 mm", optional=True),
        "contact_probability": Field(("T", "R"), "float32", "contact probability of the joint stage", optional=True),
        "penetration_mean": Field(("T",), "float32", "mean depth of body vertices inside the object; 0 = none", "m", optional=True),
        "penetration_median": Field(("T",), "float32", "median depth of body vertices inside the object", "m", optional=True),
        "penetration_max": Field(("T",), "float32", "largest depth of body vertices inside the object", "m", optional=True),
        "penetration_object": Field(("T",), "float32", "mean depth of object points inside the body", "m", optional=True),
        "ground_penetration": Field(("T",), "float32", "largest depth of body or object below the floor; NaN = no floor", "m"),
        "body_to_cloud": Field(("T",), "float32", "mean distance of all body vertices to the point cloud, as in the paper; NaN = no points", "m"),
        "object_to_cloud": Field(("T",), "float32", "mean distance of all object vertices to the point cloud; NaN = no points", "m", optional=True),
        "body_visible_to_cloud": Field(("T",), "float32", "area-sampled, over what cameras can see", "m"),
        "object_visible_to_cloud": Field(("T",), "float32", "area-sampled, over what cameras can see", "m", optional=True),
        "cloud_to_body": Field(("T",), "float32", "mean distance of the person's points to the body, each capped at 0.25", "m"),
        "acceleration_body": Field(("T",), "float32", "norm of second differences at 30 fps, mean over 22 joints", "m/frame^2"),
        "acceleration_object": Field(("T",), "float32", "the same at the object's centre", "m/frame^2", optional=True),
        **_FLAGS,
        "verdict/part_names": Field(("P",), "str", "parts whose error is estimated without truth", optional=True),
        "verdict/error": Field(("P",), "float64", "estimated error of each part; NaN = not estimated", "m", optional=True),
        "verdict/error_factor": Field(("P",), "float64", "factor around verdict/error that contains four of five true errors", optional=True),
        "verdict/error_frame": Field(("P", "T"), "float64", "estimated error by frame; NaN = not estimated", "m", optional=True),
        "verdict/silent": Field(("P",), "str", "why no error is estimated; empty = it is estimated", optional=True),
        "verdict/feature_names": Field(("F",), "str", "names of the features from which the error is estimated", optional=True),
        "verdict/features": Field(("P", "F"), "float64", "values of the features", "m", optional=True),
        "verdict/camera_names": Field(("C",), "str", "camera names", optional=True),
        "verdict/held_camera": Field(("T",), "int64", "index of the camera held out for this frame", optional=True),
        "verdict/shift": Field(("P", "C", "T"), "float64", "displacement of the part in a fit without the camera; NaN = not held out", "m", optional=True),
        "verdict/repeated": Field(("P", "T"), "float64", "displacement of the part in a fit that observes only the neighbouring frames", "m", optional=True),
        "verdict/keypoint_px": Field(("T", "C"), "float64", "median reprojection error of the body's keypoints; NaN = none seen", "px", optional=True),
        "verdict/keypoint_px_held_out": Field(("T", "C"), "float64", "the same in the held-out camera, with a body fitted without it", "px", optional=True),
        "verdict/person_m": Field(("T", "C"), "float64", "median distance of the person's points from the skin, less the thickness of clothes", "m", optional=True),
        "verdict/person_m_held_out": Field(("T", "C"), "float64", "the same in the held-out camera, with a body fitted without it", "m", optional=True),
        "verdict/overlap": Field(("T", "C"), "float64", "IoU of the object's mask and the rendered object", optional=True),
        "verdict/overlap_held_out": Field(("T", "C"), "float64", "the same in the held-out camera, with an object fitted without it", optional=True),
        "verdict/object_depth_m": Field(("T", "C"), "float64", "median residual of the object's depth", "m", optional=True),
        "verdict/object_depth_m_held_out": Field(("T", "C"), "float64", "the same in the held-out camera, with an object fitted without it", "m", optional=True),
        "physics/carrier": Field(("T",), "str", "what carries the object: 'body', 'floor', 'furniture', 'free fall', 'unsupported', 'held by something unknown' or 'not determined'", optional=True),
        "physics/support_acceleration": Field(("T",), "float32", "upward acceleration that a support gives the object's centre of mass; 9.81 at rest, 0 in free fall; NaN = unknown", "m/s^2", optional=True),
        "physics/support_acceleration_sigma": Field(("T",), "float32", "its standard deviation", "m/s^2", optional=True),
        "physics/penetration": Field(("T",), "float32", "depth of the object's collision shape below the floor, or at rest below its support; NaN = no floor", "m", optional=True),
        "physics/release_frame": Field(("Nr",), "int32", "frames in which the resting object was released and simulated", optional=True),
        "physics/release_displacement": Field(("Nr",), "float64", "displacement of its centre of mass after 35 frames", "m", optional=True),
        "physics/release_support": Field(("Nr",), "str", "surface on which it was released: 'floor' or 'furniture'", optional=True),
        "physics/bad": Field(("T",), "bool", "physics contradicts the object's pose: it is unsupported, or does not stay when released", optional=True),
        **_PER_STAGE_TRUTH,
        "truth/sweep": Field(("W",), "float64", "distance thresholds of vertex_contact_counts", "m", optional=True),
        "truth/contact_region": Field(("T", "12"), "bool", "true contact by region", optional=True),
        "truth/region_distance": Field(("T", "12"), "float32", "smallest true distance of each region's vertices to the true object, capped at 0.10", "m", optional=True),
        "truth/standing": Field(("T", "2"), "bool", "the left and the right foot truly stand since the previous frame", optional=True),
        "truth/foot_centre": Field(("T", "2", "3"), "float32", "true centre of each sole's vertices", "m", "master", optional=True),
        "truth/contact_frame": Field(("T",), "bool", "a true body vertex within 4.5 mm of the true object", optional=True),
        "truth/penetration_mean": Field(("T",), "float32", "mean penetration of the true body and object", "m", optional=True),
        "truth/body_floor": Field(("T",), "float32", "body_to_cloud with the true body", "m", optional=True),
        "truth/object_floor": Field(("T",), "float32", "object_to_cloud with the true object", "m", optional=True),
        "truth/body_visible_floor": Field(("T",), "float32", "body_visible_to_cloud with the true body", "m", optional=True),
        "truth/object_visible_floor": Field(("T",), "float32", "object_visible_to_cloud with the true object", "m", optional=True),
        "truth/object_views": Field(("T",), "int8", "number of views in which the object is visible", optional=True),
        "truth/object_moving": Field(("T",), "bool", "the true object moves", optional=True),
        "truth/object_centre": Field(("T", "3"), "float64", "true centre of mass", "m", "master", optional=True),
        "truth/extrinsics_before": Field(("C",), "float32", "error of the given extrinsics: RMS displacement over a 2 m cube; NaN for the master and cameras without images", "m", optional=True),
        "truth/extrinsics_after": Field(("C",), "float32", "error of the scene's extrinsics", "m", optional=True),
        "truth/extrinsics_joint": Field(("C",), "float32", "error of the joint fit's extrinsics", "m", optional=True),
    },
)  # fmt: skip

PER_VERTEX_METRICS = frozenset(
    {"body_to_object", "object_to_body", "body_contact_distance", "object_contact_distance"}
)

# Input of the dataset's statistics: the metrics without distances by vertex.
SUMMARY = Schema(
    name="summary",
    version=2,
    stage="summary",
    frame="none: values by frame, and on meshes in rest pose",
    attributes={
        **METRICS.attributes,
        "intent": "instruction to the person; empty = not stated",
        "gender": "gender of the body file",
        "body_model": "digest of the body file",
        "num_betas": "number of shape coefficients",
        "num_expression": "number of expression coefficients",
    },
    optional_attributes=METRICS.optional_attributes,
    fields={
        **{key: declared for key, declared in METRICS.fields.items() if key not in PER_VERTEX_METRICS},
        "body_contact_frames": Field(("V",), "int32", "number of frames in which the body vertex faces the object within 4.5 mm", optional=True),
        "rig/camera_names": Field(("Cr",), "str", "camera names"),
        "rig/images": Field(("Cr",), "int32", "number of frames with a colour image"),
        "rig/time_offset": Field(("Cr",), "float64", "exposure time minus the master's", "s"),
        "rig/time_offset_sigma": Field(("Cr",), "float64", "standard deviation of time_offset; NaN = unknown", "s"),
        "rig/depth_bias": Field(("Cr",), "float64", "bias of the camera's depth (positive = too far)", "m"),
        "rig/moved": Field(("Cr",), "float64", "RMS displacement over a 2 m cube between given and refined extrinsics; NaN for the master and cameras without images", "m"),
        "rig/note": Field(("Cr",), "str", "degradations of the camera, in words"),
        "rig/pairs": Field(("Q", "2"), "int32", "pairs of cameras whose backgrounds overlap"),
        "rig/pair_residual_before": Field(("Q",), "float64", "median distance between the backgrounds with the given extrinsics; NaN = too few points", "m"),
        "rig/pair_residual_after": Field(("Q",), "float64", "the same after refinement", "m"),
        "made_by/stages": Field(("S",), "str", "stages whose artefacts the result is made from"),
        "made_by/versions": Field(("S",), "int32", "schema version of each artefact"),
        "made_by/settings": Field(("S",), "str", "digest of the settings of each artefact"),
    },
)  # fmt: skip

HEATMAPS = Schema(
    name="heatmaps",
    version=1,
    stage="dataset",
    frame="none: values on meshes in rest pose",
    attributes={
        "dataset": "dataset name",
        "contact_m": "largest distance of contact, metres",
        "body_frames": "number of frames in the body's map",
    },
    fields={
        "body_likelihood": Field(("V",), "float32", "share of frames in which the vertex touches an object"),
        "object_names": Field(("O",), "str", "names of the objects, in the order of object_offsets"),
        "object_frames": Field(("O",), "int64", "number of frames in each object's map"),
        "object_offsets": Field(("O+1",), "int64", "index of the first surface point of each object, and the end"),
        "object_points": Field(("N", "3"), "float64", "points distributed evenly over each object's surface", "m", "object"),
        "object_likelihood": Field(("N",), "float32", "share of frames in which the point touches the body"),
    },
)  # fmt: skip
