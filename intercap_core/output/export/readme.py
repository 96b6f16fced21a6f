"""README.txt of an export: frame, units and meaning of every number."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from intercap_core.body.maps import maps_path
from intercap_core.evaluation.contact import CONTACT_M
from intercap_core.evaluation.verdict.figures import StatedError
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.about import DEVIATIONS_SOURCE, About
from intercap_core.output.export.body_files import WrittenBody
from intercap_core.output.export.motion import Coordinates, Motion

_HEAD = """\
{sequence}: subject {subject} ({gender} body file), object {object}, {frames} frames at {fps:g} fps
Frame numbers count from 0 and are the frame sets of the recording.
Bodies are parameters in SMPL-X's order for the file they were fitted with: {body}.
With another mesh, the same parameters give another person.
An object pose maps the mesh as it is stored: x = R v + t, R 3x3 applied on the left.
Object mesh: {mesh_vertices} vertices, metres.
"""

_INTERCAP = """
intercap/res.pkl    pickle of numpy arrays and lists, keys and shapes as the InterCap release
  plus "about": the body file, and the facts about each frame, below, in "by_frame"
intercap/res.npz    the same as arrays
  frame: {master}; {up_of_master}
  global_orient, transl (T,3), body_pose (1,63T), betas and expression (T,10), jaw/leye/reye (T,3)
  left_hand_pose, right_hand_pose (T,12): PCA coefficients over the mean hand
    (flat_hand_mean=False), the nearest to the fitted pose
  *_hand_pose_axis_angle (T,45): the fitted poses themselves, mean included
  ob_pose, ob_trans: lists of T (3,) rotation vectors (radians) and translations (metres),
    master camera from object
  pose_embedding is omitted: it belongs to VPoser, which was not used
"""

_AMASS = """
amass/body.npz      AMASS keys (SMPL-X): poses (T,165) = root, body, jaw, eyes, hands; trans; betas
  plus the body file, frame and units, and the facts about each frame, below
amass/object.npz    rotation (T,3,3), translation (T,3): frame from object, metres
  frame: {viewed}; {up}
  SMPL-X turns the body about its pelvis joint, not the origin; trans allows for that
"""

_BOP = """
bop/                one scene folder per camera, in the order of lenses.json; lengths in millimetres
  images are numbered by frame set and have poses at the time of their exposure: a camera may have
    slipped by whole sets or expose some milliseconds later; images of no frame are omitted
  scene_gt.json: cam_R_m2c, cam_t_m2c = colour camera from model, row by row
  scene_camera.json: world = {master}; {up_of_master}
  cam_K is a pinhole; images, masks and boxes are of the images as recorded, which are distorted,
    see lenses.json (OpenCV's rational model); camera.json is the first camera's
  mask/ the whole object, mask_visib/ without what the fitted body hides; no furniture is known
  test_targets_bop19.json: images that show a tenth of the object or more
  scene_about.json of a scene: the frame that each image shows, and why it is flagged
  about.json: the body file, and the facts about each frame, below, in "by_frame"
  models/: the mesh in millimetres, with its symmetries
"""

_COCO = """
coco/annotations.json  person and object in every image: visible masks, boxes, COCO's 17 keypoints
  images are named <camera>/<frame set>.jpg and are those recorded, distortion included
  info: the body file, and the facts about each frame, below; "frame" of an image is its frame
  keypoints: visibility 2 = visible, 1 = hidden by body or object, 0 = outside of the image
"""

_GLB = """
glb/*.glb           skinned body (55 joints) and object, animated; metres, y up as glTF requires
  under the node "world": {viewed}; {up}
  four weights per vertex, first frame's expression, no pose correctives
  asset.extras: the body file, and the facts about each frame, below; vertices keep their numbers
"""

_CONTACT = """
contact/contact.tsv           by frame and body region: probability that it touches the object, as
  the joint stage states it; annotated = 1 touching, 0 not, empty = not annotated
contact/contact_vertices.npz  by frame the vertices that touch, by the meshes, as below
contact/annotation_draft.yaml the same as intervals, in the format of an annotation file
"""

_MESHES = """
meshes/Mesh/*_second.{kind}  body of a frame, named by its number; *_second_obj.{kind} the object
  frame: {viewed}; {up}
  vertices in the order of the body file and of the object's mesh{touching}
meshes/about.json   the body file, and the facts about each frame, below
"""

_BY_FRAME = """
Facts about each frame, by these names in the npz files and in "by_frame" of the pickle (the same
in JSON, in millimetres and degrees):
  flagged, flag_reason: why a frame should not be trusted; empty = trusted
{contact}{deviations}{verdict}"""

_CONTACT_BY_FRAME = """\
  contact_probability, contact_annotated (T,R): of each contact_region, by the joint stage
  body_contact_vertices: numbers of the vertices within {threshold:g} mm of the object, or inside
    it, frame after frame: of frame t [body_contact_offsets[t] : body_contact_offsets[t + 1]];
    body_contact_distance (metres) their signed distances; object_contact_* of the object alike
"""

_DEVIATIONS_BY_FRAME = """\
  joint_sigma (T,55): standard deviation of each joint along one coordinate, metres,
    {source}{object_sigma}
"""
_OBJECT_SIGMA = """
  object_position_sigma, object_rotation_sigma (T,): the object's, metres and radians, NaN = lost"""

_VERDICT_BY_FRAME = """\
  stated_error_by_frame_mm: the stated error of each of stated_error_part
verdict.json        the same, and for each camera its measures of the result with and without it
"""

_BODY_FILES = """
body/               the open body, {columns}
  {body_file} is the file that was fitted; the others hold the same numbers where readers of
  SMPL-X files expect the expression: after 10 columns of a short file, after 300 of a full one
  {maps} has the vertices of keypoints, markers and contact regions: SMPL-X's own vertex
  numbers mark other points on this mesh
  poses include the mean hand (flat_hand_mean=True) except for intercap's components
"""

# Replacements in the text above for exports without an object
_WITHOUT_OBJECT = {
    "object {object}, ": "{no_object}, ",
    "An object pose maps the mesh as it is stored: x = R v + t, R 3x3 applied on the left.\n": "",
    "Object mesh: {mesh_vertices} vertices, metres.\n": "",
    """\
  ob_pose, ob_trans: lists of T (3,) rotation vectors (radians) and translations (metres),
    master camera from object
""": "  ob_pose, ob_trans are omitted: there is no object\n",
    """\
amass/object.npz    rotation (T,3,3), translation (T,3): frame from object, metres
""": "",
    "(55 joints) and object, animated": "(55 joints), animated",
    "; *_second_obj.{kind} the object": "",
    " and of the object's mesh{touching}": "",
}

_OMITTED = """
{name} is omitted, although export.formats lists it: it holds {content}, and there is no object.
"""
_NEED_OBJECT = {"bop": "poses of an object", "contact": "contact with an object"}


def needs_object(name: str) -> bool:
    """Return whether a format describes an object only."""
    return name in _NEED_OBJECT


def readme(
    motion: Motion,
    viewed: Motion,
    mesh: ObjectMesh | None,
    formats: Sequence[str],
    about: About,
    files: Sequence[WrittenBody],
    *,
    kind: str,
) -> str:
    """Compose README.txt.

    Args:
        motion: the motion in the master camera's frame.
        viewed: the motion in the frame of amass, glb and meshes.
        mesh: None without an object; the formats that need one are then omitted.
        formats: formats that the settings list.
        files: written body files.
        kind: file format of meshes.
    """
    parts = {
        "intercap": _INTERCAP,
        "amass": _AMASS,
        "bop": _BOP,
        "coco": _COCO,
        "glb": _GLB,
        "contact": _CONTACT,
        "meshes": _MESHES,
    }
    if mesh is None:
        parts |= {
            n: _OMITTED.format(name=n, content=content) for n, content in _NEED_OBJECT.items()
        }
    text = _HEAD + _stated_errors(about.verdict.stated) + "".join(parts[name] for name in formats)
    for old, new in _WITHOUT_OBJECT.items() if mesh is None else ():
        text = text.replace(old, new)
    has_contact = kind == "ply" and about.touching is not None
    text = text.format(
        sequence=motion.sequence,
        subject=motion.subject,
        gender=motion.gender,
        object=motion.object_,
        frames=len(motion),
        fps=motion.fps,
        body=_body(about),
        no_object=f"object {motion.object_} found in no frame" if motion.object_ else "alone",
        mesh_vertices=0 if mesh is None else len(mesh.vertices),
        master=motion.frame,
        viewed=viewed.frame,
        up=_up(viewed),
        up_of_master=_up(motion),
        kind=kind,
        touching="; contact = 1 where they touch" if has_contact else "",
    )
    return text + _per_frame(about) + _body_files(files)


def _stated_errors(errors: Sequence[StatedError]) -> str:
    """Describe the errors stated without truth; "" if the verdict was not computed."""
    if not errors:
        return ""
    stated = [
        f"{e.part} {e.stated:.1f} mm ({e.stated / e.factor:.1f} to {e.stated * e.factor:.1f})"
        for e in errors
        if not e.silent
    ]
    silent = [f"none is stated of the {e.part}: {e.silent}" for e in errors if e.silent]
    words = [f"mean {', '.join(stated)}"] if stated else []
    return f"Stated errors, by cameras held out: {'; '.join([*words, *silent])}.\n"


def _body(about: About) -> str:
    body = about.body
    file = f"{body.path.name}, digest {body.to_json()['body_file_digest']}"
    if body.is_open:
        return f"the open body ({file}), which is in body/; it is not SMPL-X"
    return f"a licensed SMPL-X file ({file}), which is not included"


def _body_files(files: Sequence[WrittenBody]) -> str:
    """Describe the columns of each body file."""
    if not files:
        return ""
    columns = "".join(
        f"\n  {file.name}, digest {file.digest}: betas {file.betas}, expression {file.expression}"
        for file in files
    )
    first = files[0].name
    return _BODY_FILES.format(
        columns="in columns of shapedirs:" + columns,
        body_file=first,
        maps=maps_path(Path(first)).name,
    )


def _per_frame(about: About) -> str:
    """Describe the facts about each frame and their names."""
    contact = deviations = ""
    if about.touching is not None:
        contact = _CONTACT_BY_FRAME.format(threshold=1e3 * CONTACT_M)
    if about.deviations is not None:
        object_sigma = "" if about.deviations.object_position is None else _OBJECT_SIGMA
        deviations = _DEVIATIONS_BY_FRAME.format(
            source=DEVIATIONS_SOURCE, object_sigma=object_sigma
        )
    verdict = _VERDICT_BY_FRAME if about.verdict.stated else ""
    return _BY_FRAME.format(contact=contact, deviations=deviations, verdict=verdict)


def _up(motion: Motion) -> str:
    return Coordinates.of(motion).header_lines()[1]
