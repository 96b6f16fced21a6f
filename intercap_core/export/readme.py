"""The text that goes with an export: frame, units and direction of every number."""

from __future__ import annotations

from collections.abc import Sequence

from intercap_core.export.about import About
from intercap_core.export.motion import Motion
from intercap_core.metrics.verdict_figures import StatedError
from intercap_core.rigid.mesh import ObjectMesh

_HEAD = """\
{sequence}: subject {subject} ({gender} body file), object {object}, {frames} frames at {fps:g} fps
Frame numbers count from 0 and are the frame sets of the recording.
Bodies are parameters in SMPL-X's order for the file they were fitted with: {body}.
Another mesh moved by them is another person.
An object pose maps the mesh as it is stored: x = R v + t, R 3x3 applied on the left.
Object mesh: {mesh_vertices} vertices, metres.
"""

_INTERCAP = """
intercap/res.pkl    pickle of numpy arrays and lists, keys and shapes as the InterCap release
  beside them "about": the body file, flags, contact and stated errors
intercap/res.npz    the same as arrays, with every frame's contact by region
  frame: {master}
  global_orient, transl (T,3), body_pose (1,63T), betas and expression (T,10), jaw/leye/reye (T,3)
  left_hand_pose, right_hand_pose (T,12): PCA coefficients over the mean hand
    (flat_hand_mean=False), the nearest to the fitted pose
  *_hand_pose_axis_angle (T,45): the fitted poses themselves, mean included
  ob_pose, ob_trans: lists of T (3,) rotation vectors (radians) and translations (metres),
    master camera from object
  pose_embedding is left out: it is VPoser's, which was not used
"""

_AMASS = """
amass/body.npz      AMASS keys (SMPL-X): poses (T,165) = root, body, jaw, eyes, hands; trans; betas
  beside them: the body file, flags, contact by region, stated errors, frame and units
amass/object.npz    rotation (T,3,3), translation (T,3): frame from object, metres
  frame: {viewed}
  SMPL-X turns the body about its pelvis joint, not the origin; trans allows for that
"""

_BOP = """
bop/                one scene folder a camera, in the order of lenses.json; lengths in millimetres
  images are numbered by frame set and show the moment that they were exposed: a camera may have
    slipped by whole sets or expose some milliseconds later; images of no frame are left out
  scene_gt.json: cam_R_m2c, cam_t_m2c = colour camera from model, row by row
  scene_camera.json: world = {master}
  cam_K is a pinhole; images, masks and boxes are of the images as recorded, which are distorted,
    see lenses.json (OpenCV's rational model); camera.json is the first camera's
  mask/ all of the object, mask_visib/ without what the fitted body hides; no furniture is known
  test_targets_bop19.json: images that show a tenth of the object or more
  about.json: flags, contact and stated errors
  models/: the mesh in millimetres, with its symmetries
"""

_COCO = """
coco/annotations.json  person and object in every image: masks as seen, boxes, COCO's 17 keypoints
  images are named <camera>/<frame set>.jpg and are those recorded, distortion included
  keypoints: visibility 2 = seen, 1 = hidden by body or object, 0 = outside of the image
"""

_GLB = """
glb/*.glb           skinned body (55 joints) and object, animated; metres, y up as glTF wants
  under the node "world": {viewed}
  four weights a vertex, first frame's expression, no pose correctives
  asset.extras: the body file, flags, contact and stated errors
"""

_CONTACT = """
contact/contact.tsv           by frame and body region: probability that it touches the object, as
  the joint stage states it; annotated = 1 touching, 0 not, empty = not annotated
contact/annotation_draft.yaml the same as intervals, in the format of an annotation file
"""


# Of the text above, what is said instead where there is no object.
_WITHOUT_OBJECT = {
    "object {object}, ": "{no_object}, ",
    "An object pose maps the mesh as it is stored: x = R v + t, R 3x3 applied on the left.\n": "",
    "Object mesh: {mesh_vertices} vertices, metres.\n": "",
    """\
  ob_pose, ob_trans: lists of T (3,) rotation vectors (radians) and translations (metres),
    master camera from object
""": "  ob_pose, ob_trans are left out: there is no object\n",
    """\
amass/object.npz    rotation (T,3,3), translation (T,3): frame from object, metres
""": "",
    "(55 joints) and object, animated": "(55 joints), animated",
}

_LEFT_OUT = """
{name} is left out, though export.formats names it: it holds {holds}, and there is no object.
"""
_HOLDS = {"bop": "poses of an object", "contact": "what touches an object"}


def _stated(errors: Sequence[StatedError]) -> str:
    """What is known of the errors without truth, in words; empty where nobody asked."""
    if not errors:
        return ""
    said = [
        f"{e.part} {e.stated:.1f} mm ({e.stated / e.factor:.1f} to {e.stated * e.factor:.1f})"
        for e in errors
        if not e.silent
    ]
    silent = [f"of the {e.part} nothing is stated: {e.silent}" for e in errors if e.silent]
    words = [f"mean {', '.join(said)}"] if said else []
    return f"Stated errors, by cameras held out: {'; '.join([*words, *silent])}.\n"


def _body(about: About) -> str:
    body = about.body
    which = f"{body.path.name}, digest {body.told()['body_file_digest']}"
    if body.is_open:
        return f"the open body ({which}), which is in body/; it is not SMPL-X"
    return f"a licensed SMPL-X file ({which}), which is not part of this"


def needs_object(name: str) -> bool:
    """Whether a format is of an object and says nothing without one."""
    return name in _HOLDS


def readme(
    motion: Motion,
    viewed: Motion,
    mesh: ObjectMesh | None,
    formats: Sequence[str],
    about: About,
) -> str:
    """README.txt for these formats; ``viewed`` is the motion in the frame of amass and glb,
    ``about`` says which body it is and what is stated of the errors.

    Without a ``mesh`` there is no object, and the formats that need one are left out.
    """
    parts = {
        "intercap": _INTERCAP,
        "amass": _AMASS,
        "bop": _BOP,
        "coco": _COCO,
        "glb": _GLB,
        "contact": _CONTACT,
    }
    if mesh is None:
        parts |= {n: _LEFT_OUT.format(name=n, holds=holds) for n, holds in _HOLDS.items()}
    text = _HEAD + _stated(about.stated) + "".join(parts[name] for name in formats)
    for said, instead in _WITHOUT_OBJECT.items() if mesh is None else ():
        text = text.replace(said, instead)
    return text.format(
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
    )
