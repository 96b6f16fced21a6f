"""Settings, tables and annotations as pydantic models, which document and validate each entry.

All files that a user writes are validated before any job starts. Relative paths in a settings file
or a table are relative to the folder of that file. ``config/README.md`` and the JSON schemas in
``config/schemas/`` are generated from these models.
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
MIN_FLOOR_SPREAD_M = 0.02  # points closer to one line do not determine a plane
# A start that is read off a time code or a clap has the uniform error of one frame,
# 1/25/sqrt(12) s = 12 ms, once in the image and once on the clock.
START_SIGMA_S = 0.02


def _metres(value: float) -> float:
    if abs(value) >= MAX_POSITION_M:
        raise ValueError(
            f"positions are in metres, below {MAX_POSITION_M:.0f}; this looks like millimetres"
        )
    return value


def _as_text(name: Any) -> Any:
    """Convert names that YAML reads as integers to text."""
    return str(name) if isinstance(name, int) and not isinstance(name, bool) else name


def _not_reserved(name: str) -> str:
    if name in RESERVED_SEQUENCES:
        raise ValueError("this name is reserved for a folder of the results; choose another one")
    return name


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_-]*$", max_length=80)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
RESERVED_SEQUENCES = ("recordings", "site", "tables")  # other folders of the results
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
    """Base of all settings models: no unknown keys, finite numbers, valid paths, immutable."""

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
    """Largest difference between the device time of an image and the time of its frame set, ms."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras to use; empty = all. Other cameras are treated as not recorded."""
    depth: bool = True
    """Use depth images. If false, all cameras are treated as colour cameras without depth."""


class DetectionsSettings(Model):
    """Keypoints and segmentation candidates, from files or from a model; see docs/detectors.md."""

    min_score: Fraction = 0.05
    """Candidates below this detector score are ignored."""
    category_names: Literal["coco", "coco80"] | Path = "coco"
    """Classes of the category numbers in candidate files that do not list their classes: coco =
    COCO's published ids from 1 to 90; coco80 = its 80 classes from 0; or a file of class names."""
    segmentation_model: Path | None = None
    """ONNX model for instance segmentation (Mask R-CNN, PointRend or YOLO-seg exports). It runs on
    the images without an entry in the candidate files."""
    segmentation_labels: Path | None = None
    """File of the model's class names; default: the names in the model, otherwise COCO's."""
    segmentation_input: Literal["auto", "rgb", "bgr255", "bgr_mean"] = "auto"
    """Pixel values of the model's input: rgb = RGB from 0 to 1; bgr255 = BGR from 0 to 255
    (detectron2); bgr_mean = BGR minus ImageNet's mean (maskrcnn-benchmark); auto = inferred from
    the model's outputs."""
    segmentation_device: Literal["cpu", "cuda"] = "cpu"
    """Device of the segmentation model; cuda needs the package onnxruntime-gpu."""
    keypoint_model: Path | None = None
    """ONNX model for human keypoints (RTMPose, RTMW, DWPose, HRNet or ViTPose exports). It runs on
    the images without an entry in the keypoint files."""
    keypoint_device: Literal["cpu", "cuda"] = "cpu"
    """Device of the keypoint model."""
    keypoint_full_confidence: Positive = 1.0
    """Keypoint confidence in files or model outputs that is mapped to 1. Raw responses of RTMW
    reach 5 and more."""
    keypoint_heatmap_grid: Literal["msra", "udp"] = "msra"
    """Alignment of heatmap cells and pixels: msra = a cell covers a fixed number of pixels (HRNet
    of mmpose, with or without DARK); udp = the last cell is the last pixel (ViTPose)."""


class SceneSettings(Model):
    """Extrinsics, ground plane and background."""

    refine_extrinsics: bool = True
    """Refine the camera poses from the static background. The initial pose is kept if held-out
    points do not improve."""
    floor_tolerance_mm: Positive = 15.0
    """Largest distance of a background point to the ground plane that counts as floor, mm."""


class PersonSettings(Model):
    """The subject over views, and the triangulated keypoints."""

    min_confidence: Fraction = 0.3
    """Keypoints below this confidence are ignored."""
    max_reprojection_px: Positive = 20.0
    """Largest reprojection error of an inlier view of a triangulated point, pixels at 1080p."""
    segmentation: Literal["both", "auto", "detector", "images"] = "both"
    """Sources of object candidates and of person masks. detector = detector only; images =
    foreground segmentation of the images only; auto = foreground segmentation for images without
    detections; both = detector and foreground segmentation in every image, which costs 0.15 s per
    frame of six views."""


class ObjectTrackSettings(Model):
    """The object's pose in every frame (equation 1)."""

    min_overlap: Fraction = 0.3
    """Smallest IoU of a candidate with the predicted silhouette for the candidate to be used."""
    background_term: bool = True
    """Add a penalty for rendered pixels over known background to the paper's one-sided silhouette
    term."""
    lost_overlap: Fraction = 0.25
    """The track is lost if the mean overlap over its views is below this value."""
    render_on: Literal["cpu", "cuda", "auto"] = "cpu"
    """Device that renders the object; auto = cpu, and cuda is refused with an error."""


class BodyFitSettings(Model):
    """SMPL-X parameters in every frame (equation 2)."""

    hands: bool = True
    """Fit finger poses; otherwise hands have their mean pose."""
    face: bool = True
    """Fit jaw and expression from the face keypoints."""
    shape: Literal["shared", "per_frame"] = "shared"
    """One body shape for the sequence, or a free shape in every frame as in the paper's first
    stage."""
    betas: Annotated[int, Field(ge=1, le=300)] = 10
    """Number of shape coefficients. Most readers of SMPL-X expect ten. The open body has 30, which
    reduce its distance to the data by about 4 %; a licensed file has up to 300."""
    keypoint_definition: Path | None = None
    """Table of the detector's joint positions on the body, written by ``intercap
    keypoint-definition``. Without it, the fit estimates offsets with a standard deviation of 10 mm
    from the body model's joints."""
    points_per_frame: Annotated[int, Field(ge=200, le=20000)] = 1500
    """Number of person points sampled from each frame's fused point cloud."""
    cloud_weight: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Weight of point cloud and mask outlines relative to the keypoints (lambda_D)."""
    self_penetration_weight: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Weight of the body's self-penetration (lambda_P of equation 2)."""


class JointSettings(Model):
    """Body and object together, over all frames (equation 6)."""

    contact_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight of contact (lambda_Q)."""
    contact_to: Literal["any", "annotated"] = "any"
    """Surface that pulls touching skin: any = the whole object (the paper's appendix); annotated =
    the area of the object's ``contact_vertices`` (the paper's text). Contact is detected on the
    whole object with both."""
    stick_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight against sliding of skin in contact over the object (no symbol in equation 6)."""
    plant_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight against motion of standing feet (no symbol in equation 6)."""
    ground_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight against penetration of the floor (lambda_G)."""
    penetration_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight against interpenetration of body and object (no symbol in equation 6)."""
    body_smoothness: Annotated[float, Field(ge=0)] = 1.0
    """Weight of the body's smooth motion (lambda_S)."""
    lemo: Path | None = None
    """Folder of LEMO's release, whose motion encoder then measures the body's smoothness; needs
    recordings at 30 frames a second. Without it, joint accelerations are penalised."""
    object_smoothness: Annotated[float, Field(ge=0)] = 1.0
    """Weight of the object's acceleration (lambda_A)."""
    drift_weight: Annotated[float, Field(ge=0)] = 1.0
    """Weight of slowly varying corrections of the sequential fits (no symbol in equation 6)."""
    look_again: bool = True
    """Compare the object with the images in each round; otherwise use the object track's poses
    and covariances as observations."""
    refine_cameras: bool = True
    """Refine poses and depth biases of the cameras from body and object (beyond the paper); needs
    ``look_again``. Set to false to keep given camera poses."""
    detect_contact: bool = True
    """Detect contact from the geometry in sequences without contact annotation."""
    annotation_uncertainty_frames: Annotated[int, Field(ge=0, le=100)] = 5
    """Uncertainty of the ends of annotated contact intervals, frames. Within it, the observed
    distance may move the ends."""

    @property
    def lemo_files(self) -> tuple[Path, Path] | None:
        """Weights and statistics of LEMO's motion encoder; None without LEMO's release."""
        if self.lemo is None:
            return None
        statistics = "preprocess_stats_smooth_withHand_global_markers.npz"
        return (
            self.lemo / "runs" / "15217" / "Enc_last_model.pkl",
            self.lemo / "preprocess_stats" / statistics,
        )

    def check_object(self, entry: ObjectEntry) -> str:
        """Error message if the object's entry lacks something that these settings need, or ""."""
        if self.contact_to == "annotated" and entry.contact_vertices is None:
            return (
                f"object {entry.name!r} has no contact_vertices, which joint.contact_to: annotated "
                "needs; add contact_vertices to its entry, or set joint.contact_to to any"
            )
        return ""


class MetricsSettings(Model):
    """Distances, penetration and errors against truth."""

    contact_mm: Positive = 4.5
    """Largest distance of a body vertex in contact to the object's surface, mm."""
    hold_out: bool = True
    """Estimate the errors without truth: repeat the fits without each camera and compare them with
    that camera's images."""


class PageSettings(Model):
    """The page of each sequence."""

    cameras: Annotated[int, Field(ge=1, le=16)] = 6
    """Number of cameras shown with overlays; those that see most of body and object."""
    frames: Annotated[int, Field(ge=1, le=50)] = 4
    """Number of frames shown with overlays, per camera."""


class ExportSettings(Model):
    """Files for other tools."""

    formats: tuple[Literal["intercap", "amass", "bop", "coco", "glb", "contact", "meshes"], ...] = (
        "intercap",
        "amass",
        "bop",
        "coco",
        "glb",
        "contact",
    )
    """Exported formats. contact = contact probability by frame, vertices in contact, and a draft
    annotation; meshes = body and object of each frame as mesh files of half a megabyte each."""
    frame: Literal["z-up", "camera"] = "z-up"
    """Coordinate frame of amass, glb and meshes: z-up = gravity-aligned with the ground at z = 0;
    camera = the master camera. The formats intercap, bop and coco use camera frames."""
    mesh_format: Literal["ply", "obj"] = "ply"
    """File format of the meshes; only ply marks the vertices in contact."""
    mesh_every: Annotated[int, Field(ge=1)] = 1
    """Step between exported mesh frames."""
    masks: bool = True
    """Render object masks and boxes for bop, with and without occlusion by the body."""
    images: bool = False
    """Copy the recorded colour images, with lens distortion, into bop and coco."""


class CardSettings(Model):
    """Texts of the dataset's card."""

    title: str = ""
    """Title; empty = the dataset's name."""
    description: str = ""
    """Description of the recordings and their purpose, in Markdown."""
    version: Annotated[str, Field(pattern=r"^\d+\.\d+\.\d+$")] = "1.0.0"
    """Version of the dataset."""
    published: date | None = None
    """Publication date of this version."""
    licence: str = ""
    """Name of the licence, such as CC-BY-4.0, or its URL; empty = the card says "not stated"."""
    creators: tuple[str, ...] = ()
    """Names of the dataset's creators."""
    url: str = ""
    """URL of the dataset."""
    citation: str = ""
    """Citation, such as a BibTeX entry."""
    test_share: Annotated[float, Field(ge=0, le=0.9)] = 0.2
    """Share of frames in the test set of each split (by subject and by object); 0 = no splits."""
    test_subjects: tuple[Name, ...] = ()
    """Subjects of the test set; empty = chosen by share. Set it to keep the split when the dataset
    grows."""
    test_objects: tuple[Name, ...] = ()
    """Objects of the test set; empty = chosen by share."""


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
    """Subject of the studio (see subjects.tsv)."""
    seed: int
    """Seed of the motion and of all errors."""
    redrawn_detections: Annotated[int, Field(ge=0)] = 0
    """Seed of the detectors' errors; other values give the same recording with other errors."""
    frames: Annotated[int, Field(ge=2, le=3000)] = 45
    """Number of frame sets."""
    annotate: bool = False
    """Also write an annotation file with errors of up to 10 mm, 5 degrees and 5 frames."""
    starts_apart: Annotated[float, Field(ge=0, le=1.5)] = 0.0
    """Largest difference between the cameras' starts, seconds; their timestamps do not show it."""
    every: dict[Name, Annotated[int, Field(ge=2, le=12)]] = {}
    """Cameras with a lower frame rate: {k2: 2} records every second frame set only."""
    keypoint_bias: Annotated[float, Field(ge=0, le=3)] = 1.0
    """Scale of the detector's joint offsets from the body's joints, which are 10 to 20 mm at 1."""
    room: Literal["random", "furnished", "sparse", "bare"] = "random"
    """furnished = walls and furniture; sparse = a floor with two low pieces; bare = only a floor;
    random = bare in one capture of five."""
    passer_by: Literal["nobody", "walks", "stands"] = "nobody"
    """Second person, who walks past the subject or stands at a distance of 0.8 to 1.6 m."""
    shoes: Literal["plain", "heavy"] = "plain"
    """plain = as thin as skin; heavy = soles of 22 mm, 10 to 15 mm around the feet."""
    look: Literal["random", "mesh", "plain", "printed"] = "random"
    """Colours of the object: of its mesh, one plain colour, or a print unknown to the mesh."""
    layout: LayoutName = "k4a"
    """Layout of the recordings, as in the table of sequences."""
    depth: bool = True
    """Whether the cameras record depth."""
    video: bool = False
    """Write plain recordings as one video per camera instead of a folder of images."""
    sound: bool = False
    """Whether videos have sound: steps, voice, reverberation, noise and delay of each device."""
    states_starts: Annotated[float, Field(ge=0, le=1)] | None = None
    """Also write an annotation of the cameras' starts with this standard deviation, seconds."""
    faults: tuple[StudioFault, ...] = ()
    """Faults of this recording in addition to the usual errors; see docs/studio.md."""


class StudioSettings(Model):
    """Virtual recordings, made before all other stages; absent for real recordings."""

    captures: dict[Name, StudioCapture]
    """Virtual recordings by sequence."""
    fps: Literal[5, 15, 30, 60] = 15
    """Frame sets per second; 60 only for layout plain."""
    noise: Annotated[float, Field(ge=0, le=4)] = 1.0
    """Scale of all errors; evaluations use 1."""
    noise_family: Literal["a", "b"] = "a"
    """Family of the error distributions."""
    colour_mode: Literal["720P", "1080P", "1440P", "1536P", "2160P", "3072P"] = "1080P"
    """Resolution of the colour cameras."""
    depth_mode: Literal["NFOV_UNBINNED", "NFOV_2X2BINNED", "WFOV_UNBINNED", "WFOV_2X2BINNED"] = (
        "NFOV_UNBINNED"
    )
    """Field of view and resolution of the depth cameras."""
    cameras: Annotated[int, Field(ge=1, le=16)] = 6
    """Number of Kinects in the ring."""
    slips: Literal["missing", "silent"] = "missing"
    """Fault of two cameras: missing = they lose frames; silent = they deliver old frames with new
    timestamps."""


class BodyModels(Model):
    """SMPL-X files; without one, the open body is used."""

    neutral: Path | None = None
    """SMPLX_NEUTRAL.npz."""
    female: Path | None = None
    """SMPLX_FEMALE.npz."""
    male: Path | None = None
    """SMPLX_MALE.npz."""
    vposer: Path | None = None
    """VPoser's weights, the prior of the body's pose: TR00_E096.pt (version 1) or a V02_05 .ckpt
    (version 2). Without them, the open prior is used."""
    vposer_version: Literal[1, 2] | None = None
    """Version that the file must have; default: inferred from the weights."""

    def of(self, gender: str) -> Path | None:
        """The body file for a gender: its own, else the neutral one, else None (the open body)."""
        return getattr(self, gender) or self.neutral


class ClusterSettings(Model):
    """Resources that jobs request from a cluster's scheduler; without effect on results."""

    memory_scale: dict[Name, Positive] = {}
    """Factor of the requested memory by stage; "all" = all other stages. A job that exceeded its
    memory is submitted again with more."""
    time_scale: dict[Name, Positive] = {}
    """Factor of the requested time by stage; "all" = all other stages."""
    gpu_partition: str = ""
    """Partition for stages that run on a GPU; empty = the profile's partition."""

    @field_validator("memory_scale", "time_scale")
    @classmethod
    def _names_stages(cls, scales: dict[str, float]) -> dict[str, float]:
        known = ("all", "studio", *STAGES, "dataset")
        unknown = sorted(set(scales) - set(known))
        if unknown:
            raise ValueError(f"{unknown[0]!r} is no stage; expected one of {', '.join(known)}")
        return scales


class Config(Model):
    """config.yaml."""

    dataset: Name
    """Name of the dataset; results go to results/<dataset>/."""
    exclude: tuple[Name, ...] = ()
    """Sequences of the table to ignore."""
    sequences: Path = Path("sequences.tsv")
    """Table of recordings."""
    subjects: Path = Path("subjects.tsv")
    """Table of people."""
    objects: Path = Path("objects.yaml")
    """The objects' meshes."""
    annotations: Path = Path("annotations")
    """Folder of <sequence>.yaml files, all optional."""
    results: Path = Path("results")
    """Folder of all results, relative to the folder in which the workflow runs."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the fits."""
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
    """Resources that jobs request from a cluster's scheduler."""
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
    """Key of objects.yaml; empty = a person without an object."""
    intent: Name | None = None
    """Instruction to the person, such as use or pass; empty = not stated. Used to group
    statistics."""
    recordings: Path
    """Folder of the recordings, with one file or folder per camera."""
    layout: LayoutName = "k4a"
    """Layout of the recordings: k4a = Azure Kinect files; intercap, behave = files of these
    releases; plain = images and videos. See docs/recordings.md."""
    calibration: Path
    """File or folder of the camera calibration: the layout's own format (docs/recordings.md), or a
    file of Pose2Sim, Anipose, EasyMocap, COLMAP or nerfstudio."""
    calibration_scale: Positive | None = None
    """Metres per unit of the calibration, for formats without a fixed unit."""
    calibration_up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None
    """Axis of the calibration's world frame that points up; empty = unknown."""
    calibration_floor: Metres | None = None
    """Height of the floor above the origin of the calibration's world frame, metres; only with
    calibration_up."""
    keypoints: Path | None = None
    """Folder of human keypoints: <camera>/<image>_keypoints.json (OpenPose), or <camera>.json or
    <camera>/<image>.json (COCO-WholeBody); see docs/detectors.md."""
    candidates: Path | None = None
    """Folder of <camera>.json files: instance segmentation in COCO's result format."""
    results: Path | None = None
    """Another program's results for this sequence, in the master camera's frame; they replace the
    joint fit in metrics and pages. InterCap's res.pkl or its folder, or BEHAVE's sequence folder
    with its registrations. See docs/releases.md."""
    truth: Path | None = None
    """Truth file of a virtual recording; read by the metrics only."""
    annotation: Path | None = None
    """Annotation file of this sequence; default: <sequence>.yaml in the folder of annotations, if
    it exists."""

    @model_validator(mode="after")
    def _floor_needs_up(self) -> SequenceEntry:
        if self.calibration_floor is not None and self.calibration_up is None:
            raise ValueError(
                "calibration_floor is set without calibration_up, the axis of its measurement"
            )
        return self


class SubjectEntry(Model):
    """One row of subjects.tsv."""

    subject: Name
    """Name of the person."""
    gender: Literal["female", "male", "neutral"]
    """Body file, or shape prior of the open body; neutral = prior of all people."""
    height: Annotated[float, Field(ge=0.5, le=2.6)] | None = None
    """Height without shoes, metres, with a standard deviation of 2 cm; empty = unknown."""


class ContinuousSymmetry(Model):
    """Axis of rotational symmetry, as in BOP's models_info."""

    axis: Vector3
    """Unit axis in the mesh's frame."""
    offset: Position = (0.0, 0.0, 0.0)
    """Point on the axis, metres."""


class Symmetry(Model):
    """Transforms that do not change the object's appearance."""

    discrete: tuple[tuple[float, ...], ...] = ()
    """4x4 transforms in row-major order, metres; the identity is implied."""
    continuous: tuple[ContinuousSymmetry, ...] = ()
    """Axes of rotational symmetry."""
    sphere: bool = False
    """Invariance to all rotations about the mesh's origin."""

    @model_validator(mode="after")
    def _sixteen(self) -> Symmetry:
        for row, transform in enumerate(self.discrete):
            if len(transform) != 16:
                raise ValueError(f"discrete[{row}] has {len(transform)} numbers, expected 16")
        return self


class ObjectEntry(Model):
    """One entry of objects.yaml."""

    name: Name
    """Key of the entry."""
    mesh: Path
    """Watertight mesh in metres (.ply or .obj)."""
    contact_vertices: Path | None = None
    """Vertices of likely contact: a JSON list of indices, a JSON object with the list and the
    checksum of its mesh, or a pickle as in InterCap's release."""
    symmetry: Symmetry = Symmetry()
    """Symmetry group."""
    labels: tuple[str, ...] = ()
    """Detector classes of this object (COCO names); empty = any."""


# --- annotations -----------------------------------------------------------------------------


class ContactInterval(Model):
    """Interval in which one body part touches the object."""

    part: ContactPart
    """Contact region of the body; any = the region is unknown, and no region is in contact outside
    of the annotated intervals."""
    start: FrameNumber
    """First frame set in contact, from 0."""
    end: FrameNumber
    """First frame set after the contact. An interval with end = start is ignored with a warning."""

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
    """Rotation of master_from_object, axis times angle, radians."""
    translation: Position
    """Translation of master_from_object (position of the mesh's origin), metres."""
    sigma_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.01
    """Standard deviation of the object's centre along each axis, metres."""
    sigma_degrees: Annotated[float, Field(gt=0.0, le=90.0)] = 5.0
    """Standard deviation of the rotation about each axis, degrees."""


class ExchangedSides(Model):
    """Frames in which a detector exchanged the subject's left and right."""

    start: FrameNumber
    """First frame set of the interval, from 0."""
    end: FrameNumber
    """First frame set after the interval."""
    camera: CameraName | None = None
    """Name of the camera, as in the calibration; absent = all cameras."""

    @model_validator(mode="after")
    def _forward(self) -> ExchangedSides:
        if self.end <= self.start:
            raise ValueError(f"no frame from start {self.start} to end {self.end}")
        return self


class SubjectPoint(Model):
    """A pixel on the subject, for recordings of several people."""

    camera: str
    """Name of the camera, as in the calibration."""
    frame: FrameNumber = 0
    """Frame set of the image."""
    x: float
    """Pixels from the left edge of the recorded colour image."""
    y: float
    """Pixels from the upper edge of the recorded colour image."""

    def fault(self, sizes: Mapping[str, tuple[int, int]]) -> str | None:
        """Error message if the point is in no image, otherwise None.

        Args:
            sizes: width and height of each camera's images, pixels.
        """
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
    """Root mean square distance of points (N, 3) from their best-fitting line, metres."""
    at = np.array(points, np.float64)
    values = np.linalg.svd(at - at.mean(0), compute_uv=False)
    return float(values[1] / np.sqrt(len(at)))


class StatedStart(Model):
    """Start of one camera."""

    seconds: Seconds
    """Time of its first image on a clock shared by all cameras, seconds."""
    sigma: StartSigma | None = None
    """Standard deviation, seconds; absent = starts_sigma."""


Start = Annotated[
    Annotated[Seconds, Tag("number")] | Annotated[StatedStart, Tag("entries")],
    Discriminator(lambda value: "number" if not isinstance(value, dict | Model) else "entries"),
]


class RecordingExtent(NamedTuple):
    """Extent of a recording, within which annotations must lie."""

    frames: int
    """Number of frame sets."""
    sizes: dict[str, tuple[int, int]]
    """Width and height of each camera's images, pixels."""
    master: str
    """Name of the master camera."""


STATED_EMPTY = ("contact",)  # sections in which an empty list is not the same as no list


class Annotation(Model):
    """annotations/<sequence>.yaml; every section is optional."""

    contact: tuple[ContactInterval, ...] | None = None
    """Intervals in which body parts touch the object; absent = detect contact; an empty list = no
    contact in the whole sequence."""
    object_poses: tuple[ObjectPose, ...] = ()
    """Object poses in some frames. The track agrees with them within their deviations and is
    extrapolated from them in frames that show nothing of the object; empty = search."""
    object_pose: ObjectPose | None = None
    """Short form of ``object_poses`` for a single frame."""
    floor: tuple[Position, ...] | None = None
    """Three or more points of the floor in the master camera's frame, metres; absent = estimate."""
    subject: tuple[SubjectPoint, ...] = ()
    """Points on the subject, for recordings of several people; several points if the subject
    leaves and returns. Absent = the person who handles the object, otherwise the one seen most."""
    left_right: tuple[ExchangedSides, ...] = ()
    """Intervals in which a detector exchanged left and right; the stage person exchanges them
    back."""
    drop_frames: tuple[FrameNumber, ...] = ()
    """Frame sets to treat as not recorded."""
    starts: dict[CameraName, Start] | None = None
    """Time of each camera's first image on one clock with any origin, seconds, optionally with a
    standard deviation. Must include the master. Absent = estimated from motion and sound."""
    starts_sigma: StartSigma = START_SIGMA_S
    """Standard deviation of starts without their own, seconds."""

    @model_validator(mode="after")
    def _starts_of_several_cameras(self) -> Annotation:
        if self.starts is None and "starts_sigma" in self.model_fields_set:
            raise ValueError("starts_sigma is set without starts")
        if self.starts is not None and len(self.starts) < 2:
            raise ValueError("starts names fewer than two cameras; name the master and others")
        return self

    @model_validator(mode="after")
    def _floor_points(self) -> Annotation:
        if self.floor is not None and len(self.floor) < 3:
            raise ValueError(f"floor has {len(self.floor)} points, a plane needs 3 or more")
        if self.floor is not None and floor_spread(self.floor) < MIN_FLOOR_SPREAD_M:
            raise ValueError(
                f"the floor points lie on one line within {MIN_FLOOR_SPREAD_M * 1000:.0f} mm; add "
                "a point away from it"
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
                    f"object_poses[{other}] and object_poses[{index}] both describe frame "
                    f"{pose.frame}; keep one"
                )
        return self

    @property
    def poses(self) -> tuple[ObjectPose, ...]:
        """The object's annotated poses, ordered by frame."""
        given = self.object_poses if self.object_pose is None else (self.object_pose,)
        return tuple(sorted(given, key=lambda pose: pose.frame))

    def check_object(self, name: str | None) -> str | None:
        """Error message if the sequence has no object (``name`` None) but an annotated one."""
        if name is None:
            for section in ("contact", "object_pose", "object_poses"):
                if getattr(self, section):
                    return f"{section} is annotated, and the sequence names no object"
        return None

    @property
    def names_cameras(self) -> bool:
        """Whether an entry names a camera."""
        return bool(self.subject or self.starts) or any(sides.camera for sides in self.left_right)

    @property
    def stated_starts(self) -> dict[str, tuple[float, float]]:
        """Start and its standard deviation by camera, seconds; empty without annotated starts."""
        stated = {}
        for name, start in (self.starts or {}).items():
            if isinstance(start, StatedStart):
                stated[name] = (start.seconds, start.sigma or self.starts_sigma)
            else:
                stated[name] = (start, self.starts_sigma)
        return stated

    def check_cameras(self, names: Sequence[str], master: str) -> str | None:
        """Error message if an entry names an unknown camera or ``starts`` lacks the master."""
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
                f"starts lacks {master}, the master; add its start (0 if the others are relative "
                "to it)"
            )
        return None

    def check_recording(self, recorded: RecordingExtent) -> str | None:
        """Error message if an entry lies outside of the recording, otherwise None."""
        problem = self.check_frames(recorded.frames)
        if problem:
            return problem
        for index, point in enumerate(self.subject):
            problem = point.fault(recorded.sizes)
            if problem:
                return f"subject[{index}] {problem}"
        return self.check_cameras(list(recorded.sizes), recorded.master)

    def check_frames(self, count: int) -> str | None:
        """Error message if an entry lies beyond the recording's ``count`` frame sets, or None."""
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
    """Digest of settings or of a JSON-like value: 16 hexadecimal digits of SHA-256."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
