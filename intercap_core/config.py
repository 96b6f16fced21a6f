"""Settings, tables and annotations: pydantic models that say what each entry means.

Everything that a user writes is read here and checked before any job starts. Relative paths in a
settings file or a table are relative to the folder of that file. ``config/README.md`` and the
JSON schemas in ``config/schemas/`` are generated from these models.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

from intercap_core.inputs.files import path_fault
from intercap_core.schemas import CONTACT_REGIONS
from intercap_core.stage_list import STAGES

MAX_POSITION_M = 50.0  # a capture volume is some metres wide
MIN_FLOOR_SPREAD_M = 0.02  # floor points this close to one line give no plane
# Of a start that is read off a time code, or off the frame of a clap: of a frame of 1/25 s, which
# is seen as a whole, an even error of 1/25/sqrt(12) = 12 ms, and as much of the clock that is read.
START_SIGMA_S = 0.02


def _metres(value: float) -> float:
    if abs(value) >= MAX_POSITION_M:
        raise ValueError(
            f"positions are in metres, below {MAX_POSITION_M:.0f}; this looks like millimetres"
        )
    return value


def _as_text(name: Any) -> Any:
    """Names that are numbers are written as such: YAML reads them so."""
    return str(name) if isinstance(name, int) and not isinstance(name, bool) else name


def _not_reserved(name: str) -> str:
    if name in RESERVED_SEQUENCES:
        raise ValueError("this name is taken by a folder of the results; choose another one")
    return name


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_-]*$", max_length=80)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
RESERVED_SEQUENCES = ("recordings", "site", "tables")  # folders beside those of the sequences
Vector3 = tuple[float, float, float]
CameraName = Annotated[str, BeforeValidator(_as_text), Field(pattern=r"^[A-Za-z0-9_-]+$")]
Seconds = Annotated[float, Field(strict=True)]
StartSigma = Annotated[float, Field(strict=True, gt=0.0, le=10.0)]
SequenceName = Annotated[Name, AfterValidator(_not_reserved)]
Metres = Annotated[float, AfterValidator(_metres)]
Position = tuple[Metres, Metres, Metres]
FrameNumber = Annotated[int, Field(ge=0, strict=True)]
ANY_REGION = "any"
ContactPart = Literal[(*CONTACT_REGIONS, ANY_REGION)]  # type: ignore[valid-type]
LayoutName = Literal["k4a", "intercap", "behave", "plain"]


class Model(BaseModel):
    """Base of every settings model: unknown keys are mistakes, numbers finite, values fixed, paths
    such as a file system has."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False
    )

    @field_validator("*")
    @classmethod
    def _paths(cls, value: Any) -> Any:
        fault = path_fault(value) if isinstance(value, Path) else None
        if fault is not None:
            raise ValueError(fault)
        return value


# --- settings by stage -----------------------------------------------------------------------


class FramesSettings(Model):
    """Recordings to synchronised frame sets."""

    max_skew_ms: Positive = 8.0
    """An image belongs to a set when its device time is within this many milliseconds of it."""
    cameras: tuple[str, ...] = ()
    """Cameras to use, by name; empty = all. The others count as not recorded."""
    depth: bool = True
    """Use depth; without, the recordings count as those of cameras that have none."""


class DetectionsSettings(Model):
    """Keypoints and segmentation candidates, from files or from a model; see docs/detectors.md."""

    min_score: Fraction = 0.05
    """Candidates below this detector score are left out."""
    category_names: Literal["coco", "coco80"] | Path = "coco"
    """Which class a number in a file of candidates means, where the file does not list its classes:
    COCO's published ids from 1 to 90, its 80 classes from 0, or a file of class names."""
    segmentation_model: Path | None = None
    """ONNX model for instance segmentation (Mask R-CNN, PointRend or YOLO-seg exports); it sees the
    images of which no file of candidates says anything."""
    segmentation_labels: Path | None = None
    """File of the model's class names; without one, the names in the model or COCO's."""
    segmentation_input: Literal["auto", "rgb", "bgr255", "bgr_mean"] = "auto"
    """Pixel values that the model takes: RGB from 0 to 1, BGR from 0 to 255 (detectron2), BGR less
    the mean of ImageNet (maskrcnn-benchmark); auto = by the kind of its outputs."""
    segmentation_device: Literal["cpu", "cuda"] = "cpu"
    """Where the model runs; cuda needs the package onnxruntime-gpu."""
    keypoint_model: Path | None = None
    """ONNX model for people's keypoints (RTMPose, RTMW, DWPose, HRNet or ViTPose exports); it sees
    the images of which no file of keypoints says anything."""
    keypoint_device: Literal["cpu", "cuda"] = "cpu"
    """Where the model of keypoints runs."""
    keypoint_full_confidence: Positive = 1.0
    """Confidence of a keypoint, as files or the model state it, that counts as 1; raw responses of
    RTMW reach 5 and more."""
    keypoint_heatmap_grid: Literal["msra", "udp"] = "msra"
    """How a model of heatmaps was trained. msra: a cell is so many pixels (mmpose's HRNet, with or
    without DARK); udp: the last cell stands for the last pixel (ViTPose)."""


class SceneSettings(Model):
    """Extrinsics, ground plane and background."""

    refine_extrinsics: bool = True
    """Refine the camera poses from the static background; the start is kept where that does not
    improve held-out points."""
    floor_tolerance_mm: Positive = 15.0
    """Background points this close to the plane count as floor."""


class PersonSettings(Model):
    """The subject over views, and the triangulated keypoints."""

    min_confidence: Fraction = 0.3
    """Keypoints below this confidence do not take part."""
    max_reprojection_px: Positive = 20.0
    """A view disagrees with a triangulated point beyond this error (at 1080p)."""
    segmentation: Literal["both", "auto", "detector", "images"] = "both"
    """Where candidates of the object, and masks of the person that no detector gave, come from:
    both = a detector's, and in every image those of the images alone (what stands before the
    background), which costs 0.15 s a six-view frame; auto = the images alone only where no
    detector looked; or only one of the two."""


class ObjectTrackSettings(Model):
    """The object's pose in every frame (equation 1)."""

    min_overlap: Fraction = 0.3
    """A view's candidate is kept when its IoU with the predicted silhouette is at least this."""
    background_term: bool = True
    """Also penalise render over known background, beside the paper's one-sided silhouette."""
    lost_overlap: Fraction = 0.25
    """The track counts as lost when the mean overlap over its views falls below this."""
    render_on: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where the object is drawn: a GPU needs the extra gpu; auto takes one where it can be used."""


class BodyFitSettings(Model):
    """SMPL-X parameters in every frame (equation 2)."""

    hands: bool = True
    """Fit finger poses; without, hands stay at their mean."""
    face: bool = True
    """Fit jaw and expression from the face keypoints."""
    shape: Literal["shared", "per_frame"] = "shared"
    """One shape for the sequence, or a free shape in every frame as in the paper's first stage."""
    betas: Annotated[int, Field(ge=1, le=300)] = 10
    """Numbers of the shape. Most readers of SMPL-X take ten; the open body has thirty, with which
    it lies some 4 % closer, a licensed file of full size 300."""
    keypoint_definition: Path | None = None
    """Where the detector's body points lie on the body: a table that ``intercap
    keypoint-definition`` learns from recordings with depth; without it, within 10 mm of the body
    model's."""
    points_per_frame: Annotated[int, Field(ge=200, le=20000)] = 1500
    """Person points kept of each frame's fused cloud."""
    cloud_weight: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Weight of points and rims of masks against the keypoints (lambda_D)."""
    self_penetration_weight: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Weight of the body's parts not entering each other (lambda_P of equation 2)."""


class JointSettings(Model):
    """Body and object together, over all frames (equation 6)."""

    contact_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight of contact (lambda_Q)."""
    contact_to: Literal["any", "annotated"] = "any"
    """What touching skin is drawn to: any point of the object (the paper's appendix), or what the
    object's ``contact_vertices`` span (its text). Contact is found on all of it with both."""
    stick_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight of held skin not sliding over the object (without a symbol in equation 6)."""
    plant_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight of standing feet not moving (without a symbol in equation 6)."""
    ground_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight of not sinking into the floor (lambda_G)."""
    penetration_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight of body and object not entering each other (without a symbol in equation 6)."""
    body_smoothness: Annotated[float, Field(ge=0)] = 1.0
    """Weight of the body's smooth motion (lambda_S)."""
    lemo: Path | None = None
    """Folder of LEMO's release: the body's smooth motion is then that of its motion encoder, for
    recordings at 30 frames a second. Without, small accelerations of the joints."""
    object_smoothness: Annotated[float, Field(ge=0)] = 1.0
    """Weight of the object's small acceleration (lambda_A)."""
    drift_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight of corrections of the sequential fits that last (without a symbol in equation 6)."""
    look_again: bool = True
    """Compare the object with the images anew in each round; else its track stands for them."""
    refine_cameras: bool = True
    """Correct poses and depth bias of the cameras by what body and object show (beyond the paper);
    needs ``look_again``. Switch off where given poses are to be kept."""
    detect_contact: bool = True
    """Find contact from the geometry where it is not annotated."""
    annotation_uncertainty_frames: Annotated[int, Field(ge=0, le=100)] = 5
    """Frames by which annotators err at the ends of an interval of contact: within them what is
    seen may move the ends."""

    @property
    def lemo_files(self) -> tuple[Path, Path] | None:
        """Weights and statistics of LEMO's encoder of smooth motion, where its release has them."""
        if self.lemo is None:
            return None
        statistics = "preprocess_stats_smooth_withHand_global_markers.npz"
        return (
            self.lemo / "runs" / "15217" / "Enc_last_model.pkl",
            self.lemo / "preprocess_stats" / statistics,
        )

    def check_object(self, entry: ObjectEntry) -> str:
        """What these settings need and the object's entry lacks, "" = nothing."""
        if self.contact_to == "annotated" and entry.contact_vertices is None:
            return (
                f"object {entry.name!r} has no contact_vertices, which joint.contact_to: annotated "
                "needs; name its list there, or set joint.contact_to to any"
            )
        return ""


class MetricsSettings(Model):
    """Distances, penetration and errors against truth."""

    contact_mm: Positive = 4.5
    """A body vertex this close to the object's surface is in contact."""
    hold_out: bool = True
    """Judge the result without truth: fit body and object again without each camera, compare them
    with what it shows, and state their errors."""


class PageSettings(Model):
    """The page of each sequence."""

    cameras: Annotated[int, Field(ge=1, le=16)] = 6
    """Cameras shown with the fit drawn over their images; those that see most of body and object
    where there are more."""
    frames: Annotated[int, Field(ge=1, le=50)] = 4
    """Frames shown with the fit drawn over them, for each camera."""


class ExportSettings(Model):
    """Files for other people's tools."""

    formats: tuple[Literal["intercap", "amass", "bop", "coco", "glb", "contact", "meshes"], ...] = (
        "intercap",
        "amass",
        "bop",
        "coco",
        "glb",
        "contact",
    )
    """Which exports are written; contact = its probability by frame, the vertices that touch, and a
    draft annotation; meshes = body and object of each frame as mesh files, half a megabyte each."""
    frame: Literal["z-up", "camera"] = "z-up"
    """Frame of amass, glb and meshes: gravity-aligned with the ground at z = 0, or the master
    camera. The intercap, bop and coco layouts are in camera frames by definition."""
    mesh_format: Literal["ply", "obj"] = "ply"
    """What the meshes are; ply alone can say which vertices touch."""
    mesh_every: Annotated[int, Field(ge=1)] = 1
    """Meshes of every so many frames, from the first on."""
    masks: bool = True
    """Draw the object's masks and boxes for bop, with what the body hides."""
    images: bool = False
    """Copy the recorded colour images into bop and coco: as recorded, lenses not straightened."""


class CardSettings(Model):
    """What the dataset's card says to whom it is given."""

    title: str = ""
    """Title; empty = the dataset's name."""
    description: str = ""
    """What was recorded, why and how; Markdown."""
    version: Annotated[str, Field(pattern=r"^\d+\.\d+\.\d+$")] = "1.0.0"
    """Version of the dataset."""
    published: date | None = None
    """Day of this version."""
    licence: str = ""
    """Name of the licence, as CC-BY-4.0, or the address of its text; empty = not stated, which the
    card says."""
    creators: tuple[str, ...] = ()
    """Who made the dataset."""
    url: str = ""
    """Where the dataset is found."""
    citation: str = ""
    """How to cite it, e.g. BibTeX."""
    test_share: Annotated[float, Field(ge=0, le=0.9)] = 0.2
    """Share of the frames that each split, by subject and by object, holds out for tests; 0 = no
    splits."""
    test_subjects: tuple[Name, ...] = ()
    """Subjects that are held out; empty = chosen by share. Name them to keep a split when the
    dataset grows."""
    test_objects: tuple[Name, ...] = ()
    """Objects that are held out; likewise."""


StudioFault = Literal[
    "dead_half",
    "no_depth",
    "zero_depth",
    "same_serial",
    "backwards_clock",
    "no_overlap",
    "swapped_lenses",
    "wrong_resolution",
]


class StudioCapture(Model):
    """One virtual recording."""

    interaction: Name
    """Script to play, e.g. suitcase_carry, cup_drink, stool_sit."""
    subject: Name
    """Studio subject that plays it (see subjects.tsv)."""
    seed: int
    """Seed of the motion and of every error."""
    redrawn_detections: Annotated[int, Field(ge=0)] = 0
    """Other numbers give the same recording, of which detectors err in another way."""
    frames: Annotated[int, Field(ge=2, le=3000)] = 45
    """Number of frame sets."""
    annotate: bool = False
    """Also write an annotation file that errs by up to 10 mm, 5 degrees and 5 frames."""
    starts_apart: Annotated[float, Field(ge=0, le=1.5)] = 0.0
    """The cameras are started apart by up to so many seconds, and their times do not tell."""
    every: dict[Name, Annotated[int, Field(ge=2, le=12)]] = {}
    """Cameras with fewer frames a second: {k2: 2} records every second frame set only."""
    keypoint_bias: Annotated[float, Field(ge=0, le=3)] = 1.0
    """Scale of what a detector means otherwise by the body's joints, 10 to 20 mm at 1."""
    room: Literal["random", "furnished", "sparse", "bare"] = "random"
    """With walls and furniture, a floor with two low pieces, or only a floor; by chance one capture
    in five is bare."""
    passer_by: Literal["nobody", "walks", "stands"] = "nobody"
    """Another person in the room, who walks 0.8 to 1.6 m past the subject or stands there."""
    shoes: Literal["plain", "heavy"] = "plain"
    """Shoes as thin as skin, or heavy ones: soles of 22 mm, 10 to 15 mm round the feet."""
    look: Literal["random", "mesh", "plain", "printed"] = "random"
    """Colours of the object: its mesh's, one for all, or printed in a way that no scan knows."""
    layout: LayoutName = "k4a"
    """How the recordings are laid out; the same as in the table of sequences."""
    depth: bool = True
    """Whether the cameras record depth."""
    video: bool = False
    """Plain recordings as one video a camera instead of a folder of images."""
    sound: bool = False
    """Whether videos carry sound: steps, a voice, reverberation, each device's noise and delay."""
    states_starts: Annotated[float, Field(ge=0, le=1)] | None = None
    """Also write an annotation that says when cameras started, with this deviation, seconds."""
    faults: tuple[StudioFault, ...] = ()
    """What is broken in this recording on top of the usual errors; see docs/studio.md."""


class StudioSettings(Model):
    """Virtual recordings made before the rest runs; absent for real recordings."""

    captures: dict[Name, StudioCapture]
    """One entry for each sequence that the studio makes."""
    fps: Literal[5, 15, 30, 60] = 15
    """Frame sets a second; 60 is for layout plain."""
    noise: Annotated[float, Field(ge=0, le=4)] = 1.0
    """Scale of every error; 1 is the headline."""
    noise_family: Literal["a", "b"] = "a"
    """Shapes of the error distributions."""
    colour_mode: Literal["720P", "1080P", "1440P", "1536P", "2160P", "3072P"] = "1080P"
    """Resolution of the colour cameras."""
    depth_mode: Literal["NFOV_UNBINNED", "NFOV_2X2BINNED", "WFOV_UNBINNED", "WFOV_2X2BINNED"] = (
        "NFOV_UNBINNED"
    )
    """Field of view and resolution of the depth cameras."""
    cameras: Annotated[int, Field(ge=1, le=16)] = 6
    """Kinects in the ring."""
    slips: Literal["missing", "silent"] = "missing"
    """Two cameras lose frames, or deliver old frames whose device times do not tell."""


class BodyModels(Model):
    """SMPL-X files; without one, the open body is used."""

    neutral: Path | None = None
    """SMPLX_NEUTRAL.npz."""
    female: Path | None = None
    """SMPLX_FEMALE.npz."""
    male: Path | None = None
    """SMPLX_MALE.npz."""
    vposer: Path | None = None
    """VPoser's weights, the prior of the body's pose: TR00_E096.pt (version 1) or a V02_05 .ckpt;
    without, the open prior is used."""
    vposer_version: Literal[1, 2] | None = None
    """Version that the file must have; without, it is told from the weights."""

    def of(self, gender: str) -> Path | None:
        """The body file for a gender: its own, else the neutral one, else None (the open body)."""
        return getattr(self, gender) or self.neutral


class ClusterSettings(Model):
    """What jobs ask of a cluster's scheduler; decides no result."""

    memory_scale: dict[Name, Positive] = {}
    """Times the memory that a stage's jobs ask for, by stage, "all" = the others; a job that was
    killed for its memory still comes back with more."""
    time_scale: dict[Name, Positive] = {}
    """Times the minutes, likewise."""
    gpu_partition: str = ""
    """Partition for the stages that run on a GPU; empty = the one that the profile names."""

    @field_validator("memory_scale", "time_scale")
    @classmethod
    def _names_stages(cls, scales: dict[str, float]) -> dict[str, float]:
        known = ("all", "studio", *STAGES, "dataset")
        unknown = sorted(set(scales) - set(known))
        if unknown:
            raise ValueError(f"{unknown[0]!r} is no stage; expected any of {', '.join(known)}")
        return scales


class Config(Model):
    """config.yaml."""

    dataset: Name
    """Name of the dataset; results go to results/<dataset>/."""
    exclude: tuple[Name, ...] = ()
    """Sequences of the table to leave out of everything."""
    sequences: Path = Path("sequences.tsv")
    """Table of recordings."""
    subjects: Path = Path("subjects.tsv")
    """Table of people."""
    objects: Path = Path("objects.yaml")
    """The objects' meshes."""
    annotations: Path = Path("annotations")
    """Folder of <sequence>.yaml files, all optional."""
    results: Path = Path("results")
    """Folder for everything that is computed, relative to where the workflow runs."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the fits run."""
    body_models: BodyModels = BodyModels()
    """SMPL-X files; without one, the open body is used."""
    frames: FramesSettings = FramesSettings()
    """Recordings to synchronised frame sets."""
    detections: DetectionsSettings = DetectionsSettings()
    """Keypoints and segmentation candidates."""
    scene: SceneSettings = SceneSettings()
    """Extrinsics, ground plane and background."""
    person: PersonSettings = PersonSettings()
    """The subject over views."""
    object_track: ObjectTrackSettings = ObjectTrackSettings()
    """The object's pose in every frame."""
    body_fit: BodyFitSettings = BodyFitSettings()
    """The body in every frame."""
    joint: JointSettings = JointSettings()
    """Body and object together."""
    metrics: MetricsSettings = MetricsSettings()
    """Distances and errors."""
    page: PageSettings = PageSettings()
    """The HTML page."""
    export: ExportSettings = ExportSettings()
    """Files for other tools."""
    card: CardSettings = CardSettings()
    """The dataset's card."""
    cluster: ClusterSettings = ClusterSettings()
    """What jobs ask of a cluster's scheduler."""
    studio: StudioSettings | None = None
    """Virtual recordings to make; absent for real ones."""


# --- tables ----------------------------------------------------------------------------------


class SequenceEntry(Model):
    """One row of sequences.tsv."""

    sequence: SequenceName
    """Name of the sequence; letters, digits, _ and - only."""
    subject: Name
    """Row of subjects.tsv."""
    object: Name | None = None
    """Key of objects.yaml; empty = a person alone, and no object is looked for."""
    intent: Name | None = None
    """What the person was asked to do with the object, e.g. use or pass; empty = not stated.
    Statistics are given by it, nothing else depends on it."""
    recordings: Path
    """Folder of the recordings, one file or folder for each camera."""
    layout: LayoutName = "k4a"
    """How the recordings are laid out: Azure Kinect files, InterCap's or BEHAVE's release, or plain
    images and videos; see docs/recordings.md."""
    calibration: Path
    """Where the cameras are: a file or folder in the form that docs/recordings.md names for the
    layout, or as Pose2Sim, Anipose, EasyMocap, COLMAP or nerfstudio write it."""
    calibration_scale: Positive | None = None
    """Metres for one unit of the calibration, where its form does not fix the unit."""
    calibration_up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None
    """The axis of the calibration's own world that points up; not stated = it is not relied on."""
    calibration_floor: Metres | None = None
    """Metres from the origin of the calibration's world up to the floor, 0 where the floor goes
    through it; only with calibration_up."""
    keypoints: Path | None = None
    """Folder of people's keypoints: <camera>/<image>_keypoints.json as OpenPose writes them, or
    <camera>.json or <camera>/<image>.json in the manner of COCO-WholeBody; docs/detectors.md."""
    candidates: Path | None = None
    """Folder of <camera>.json files: instance segmentation in COCO's result format."""
    results: Path | None = None
    """Results that another program made of this sequence, measured and shown in place of the joint
    fit: as the InterCap release has them (res.pkl, or its folder), or the sequence's folder of
    BEHAVE with its registrations; in the master camera's frame. See docs/recordings.md."""
    truth: Path | None = None
    """Truth of a virtual recording; read by the metrics alone."""
    annotation: Path | None = None
    """This sequence's annotation file; without one, <sequence>.yaml in the folder of annotations,
    where it is there."""

    @model_validator(mode="after")
    def _floor_needs_up(self) -> SequenceEntry:
        if self.calibration_floor is not None and self.calibration_up is None:
            raise ValueError(
                "calibration_floor is stated without calibration_up, which it is along"
            )
        return self


class SubjectEntry(Model):
    """One row of subjects.tsv."""

    subject: Name
    """Name of the person."""
    gender: Literal["female", "male", "neutral"]
    """Which body file is used, or of the open body whose shapes are expected; neutral: of all."""
    height: Annotated[float, Field(ge=0.5, le=2.6)] | None = None
    """Barefoot, in metres, where it is known; believed to 2 cm."""


class ContinuousSymmetry(Model):
    """As in BOP's models_info."""

    axis: Vector3
    """Unit axis in the mesh's frame."""
    offset: Position = (0.0, 0.0, 0.0)
    """A point on the axis, metres."""


class Symmetry(Model):
    """Motions that leave the object looking the same."""

    discrete: tuple[tuple[float, ...], ...] = ()
    """4x4 transforms, row by row, metres; the identity is implied."""
    continuous: tuple[ContinuousSymmetry, ...] = ()
    """Axes of rotational symmetry."""
    sphere: bool = False
    """Any rotation about the mesh's origin looks the same."""

    @model_validator(mode="after")
    def _sixteen(self) -> Symmetry:
        for row, transform in enumerate(self.discrete):
            if len(transform) != 16:
                raise ValueError(f"discrete[{row}] has {len(transform)} numbers, expected 16")
        return self


class ObjectEntry(Model):
    """One entry of objects.yaml."""

    name: Name
    """The entry's key, repeated by the loader."""
    mesh: Path
    """Watertight mesh in metres (.ply or .obj)."""
    contact_vertices: Path | None = None
    """Vertices that people are likely to touch: a JSON list (or one that also says on which mesh it
    was chosen, see geometry/rigid/contact_vertices.py), or a pickle as InterCap released."""
    symmetry: Symmetry = Symmetry()
    """Symmetry group."""
    labels: tuple[str, ...] = ()
    """Detector classes that this object may be given (COCO names); empty = any."""


# --- annotations -----------------------------------------------------------------------------


class ContactInterval(Model):
    """One body part touching the object for a while."""

    part: ContactPart
    """Contact region of the body; any = it is not known which, only that none touches outside of
    these intervals."""
    start: FrameNumber
    """First frame set in contact, from 0."""
    end: FrameNumber
    """First frame set after the contact; start = no frame, which is told and ignored."""

    @model_validator(mode="after")
    def _forward(self) -> ContactInterval:
        if self.end < self.start:
            raise ValueError(f"interval is reversed: start {self.start}, end {self.end}")
        return self


class ObjectPose(Model):
    """The object's pose in one frame, in the master camera's frame."""

    frame: FrameNumber = 0
    """Frame set of the pose."""
    rotation_vector: Vector3
    """Axis times angle of master_from_object, radians."""
    translation: Position
    """Of the mesh's origin, metres."""
    sigma_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.01
    """Standard deviation of where the object's centre is, along each axis, metres."""
    sigma_degrees: Annotated[float, Field(gt=0.0, le=90.0)] = 5.0
    """Standard deviation of the rotation about each axis, degrees."""


class ExchangedSides(Model):
    """Frames in which a detector took the subject's left for its right."""

    start: FrameNumber
    """First frame set of them, from 0."""
    end: FrameNumber
    """First frame set after them."""
    camera: CameraName | None = None
    """Name of the camera, as in the calibration; absent = in all cameras."""

    @model_validator(mode="after")
    def _forward(self) -> ExchangedSides:
        if self.end <= self.start:
            raise ValueError(f"no frame from start {self.start} to end {self.end}")
        return self


class SubjectPoint(Model):
    """A point of one image that lies on the subject, where several people are in the room."""

    camera: str
    """Name of the camera, as in the calibration."""
    frame: FrameNumber = 0
    """Frame set of the image."""
    x: float
    """Pixels from the left edge of the colour image as recorded."""
    y: float
    """Pixels from its upper edge."""

    def fault(self, sizes: Mapping[str, tuple[int, int]]) -> str | None:
        """Say that no camera of the recording has the point; ``sizes`` are the cameras' widths and
        heights, pixels."""
        if self.camera not in sizes:
            return _no_camera(self.camera, list(sizes))
        width, height = sizes[self.camera]
        if not (0 <= self.x < width and 0 <= self.y < height):
            return (
                f"is at x {self.x:g}, y {self.y:g}; camera {self.camera} has {width} x {height} "
                "pixels"
            )
        return None


def _no_camera(name: str, names: Sequence[str]) -> str:
    return f"names camera {name!r}; the recording has {', '.join(names)}"


def floor_spread(points: Sequence[Position] | np.ndarray) -> float:
    """Root mean square distance of points, metres, from the line that fits them best."""
    at = np.array(points, np.float64)
    values = np.linalg.svd(at - at.mean(0), compute_uv=False)
    return float(values[1] / np.sqrt(len(at)))


class StatedStart(Model):
    """When one camera started, and how well that is known."""

    seconds: Seconds
    """When its first image was taken, on the clock that all of them are stated on."""
    sigma: StartSigma | None = None
    """Standard deviation, seconds; absent = starts_sigma."""


Start = Annotated[
    Annotated[Seconds, Tag("number")] | Annotated[StatedStart, Tag("entries")],
    Discriminator(lambda value: "number" if not isinstance(value, dict | Model) else "entries"),
]


class Recorded(NamedTuple):
    """What an annotation's entries are of: the number of ``frames``, each camera's image by name
    as (width, height), and the name of the ``master``."""

    frames: int
    sizes: dict[str, tuple[int, int]]
    master: str


STATED_EMPTY = ("contact",)  # sections of an annotation in which an empty list states something


class Annotation(Model):
    """annotations/<sequence>.yaml; every section is optional."""

    contact: tuple[ContactInterval, ...] | None = None
    """Frames in which body parts touch the object; absent = find them, an empty list = nothing
    touches in the whole sequence."""
    object_poses: tuple[ObjectPose, ...] = ()
    """Where the object is in some frames; its track agrees with them, and is carried from them
    where nothing is seen of it; empty = search."""
    object_pose: ObjectPose | None = None
    """The same where there is one frame alone, instead of ``object_poses``."""
    floor: tuple[Position, ...] | None = None
    """Three or more points of the floor, master camera frame, metres; absent = fit."""
    subject: tuple[SubjectPoint, ...] = ()
    """Who of several people is the subject; more than one point where it left and came back;
    absent = who handles the object, or is seen most."""
    left_right: tuple[ExchangedSides, ...] = ()
    """Where a detector exchanged the subject's left and right: they are exchanged back."""
    drop_frames: tuple[FrameNumber, ...] = ()
    """Frame sets to treat as not recorded."""
    starts: dict[CameraName, Start] | None = None
    """When cameras took their first images, seconds on one clock, whatever its zero: by camera, or
    with a deviation of its own. The master is among them; absent = by the motion and the sound."""
    starts_sigma: StartSigma = START_SIGMA_S
    """Standard deviation of each of the starts that has none of its own, seconds."""

    @model_validator(mode="after")
    def _starts_beside_others(self) -> Annotation:
        if self.starts is None and "starts_sigma" in self.model_fields_set:
            raise ValueError("starts_sigma is stated without starts")
        if self.starts is not None and len(self.starts) < 2:
            raise ValueError(
                "starts names fewer than two cameras; a start is told beside another's"
            )
        return self

    @model_validator(mode="after")
    def _floor_points(self) -> Annotation:
        if self.floor is not None and len(self.floor) < 3:
            raise ValueError(f"floor has {len(self.floor)} points, a plane needs 3 or more")
        if self.floor is not None and floor_spread(self.floor) < MIN_FLOOR_SPREAD_M:
            raise ValueError(
                f"the floor points lie on one line within {MIN_FLOOR_SPREAD_M * 1000:.0f} mm; a "
                "plane needs one beside it"
            )
        return self

    @model_validator(mode="after")
    def _one_pose_a_frame(self) -> Annotation:
        if self.object_pose is not None and self.object_poses:
            raise ValueError("object_pose and object_poses are both given; move it into the list")
        first: dict[int, int] = {}
        for index, pose in enumerate(self.object_poses):
            other = first.setdefault(pose.frame, index)
            if other != index:
                raise ValueError(
                    f"object_poses[{other}] and object_poses[{index}] are both of frame "
                    f"{pose.frame}; keep one"
                )
        return self

    @property
    def poses(self) -> tuple[ObjectPose, ...]:
        """The object's annotated poses, by frame."""
        given = self.object_poses if self.object_pose is None else (self.object_pose,)
        return tuple(sorted(given, key=lambda pose: pose.frame))

    def check_object(self, name: str | None) -> str | None:
        """Say which section speaks of an object where the sequence's ``name`` of one is None."""
        if name is None:
            for section in ("contact", "object_pose", "object_poses"):
                if getattr(self, section):
                    return f"{section} is annotated, and the sequence names no object"
        return None

    @property
    def names_cameras(self) -> bool:
        """Whether an entry is of a camera by its name."""
        return bool(self.subject or self.starts) or any(one.camera for one in self.left_right)

    @property
    def stated_starts(self) -> dict[str, tuple[float, float]]:
        """Seconds and their standard deviation by camera; empty where no start is stated."""
        stated = {}
        for name, start in (self.starts or {}).items():
            if isinstance(start, StatedStart):
                stated[name] = (start.seconds, start.sigma or self.starts_sigma)
            else:
                stated[name] = (start, self.starts_sigma)
        return stated

    def check_cameras(self, names: Sequence[str], master: str) -> str | None:
        """Say which entry is of none of the cameras ``names``, or that the ``master``'s start
        lacks."""
        for index, point in enumerate(self.subject):
            if point.camera not in names:
                return f"subject[{index}] {_no_camera(point.camera, names)}"
        for index, sides in enumerate(self.left_right):
            if sides.camera is not None and sides.camera not in names:
                return f"left_right[{index}] {_no_camera(sides.camera, names)}"
        for name in self.starts or ():
            if name not in names:
                return f"starts {_no_camera(name, names)}"
        if self.starts and master not in self.starts:
            return (
                f"starts lacks {master}, the master, beside which the others' are told (0 where "
                "they are counted from it)"
            )
        return None

    def check_recording(self, recorded: Recorded) -> str | None:
        """Say which entry is not of what was recorded, or None."""
        problem = self.check_frames(recorded.frames)
        if problem:
            return problem
        for index, point in enumerate(self.subject):
            problem = point.fault(recorded.sizes)
            if problem:
                return f"subject[{index}] {problem}"
        return self.check_cameras(list(recorded.sizes), recorded.master)

    def check_frames(self, count: int) -> str | None:
        """Say which entry lies past the recording's ``count`` frame sets, or None."""
        for index, interval in enumerate(self.contact or ()):
            if interval.end > count:
                return f"contact[{index}].end is {interval.end}, the recording has {count} frames"
        if self.object_pose is not None and self.object_pose.frame >= count:
            return (
                f"object_pose.frame is {self.object_pose.frame}, the recording has {count} frames"
            )
        for index, pose in enumerate(self.object_poses):
            if pose.frame >= count:
                return (
                    f"object_poses[{index}].frame is {pose.frame}, the recording has {count} frames"
                )
        for index, sides in enumerate(self.left_right):
            if sides.end > count:
                return f"left_right[{index}].end is {sides.end}, the recording has {count} frames"
        for index, point in enumerate(self.subject):
            if point.frame >= count:
                return f"subject[{index}].frame is {point.frame}, the recording has {count} frames"
        beyond = [frame for frame in self.drop_frames if frame >= count]
        if beyond:
            return f"drop_frames holds {beyond[0]}, the recording has {count} frames"
        if count and len(set(self.drop_frames)) == count:
            return f"drop_frames drops all {count} frames of the recording"
        return None


def digest(value: BaseModel | Any) -> str:
    """A short digest of settings or of any JSON-like value: equal content, equal digest."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
