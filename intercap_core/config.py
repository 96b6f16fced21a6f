"""Settings as pydantic models, which document and validate each entry.

All files that a user writes are validated before any job starts. Relative paths in a settings file
are relative to its folder. ``config/README.md`` and the JSON schemas in ``config/schemas/`` are
generated from these models, those in ``entries`` and in ``annotation``.
"""

from __future__ import annotations

import hashlib
import json
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    NonNegativeInt,
    field_validator,
)

from intercap_core.config_types import Fraction, LayoutName, Model, Name, Positive
from intercap_core.entries import ObjectEntry
from intercap_core.stage_list import STAGES


class FramesSettings(Model):
    """Recordings to synchronised frame sets."""

    max_skew_ms: Positive = 8.0
    """Largest difference between the device time of an image and the time of its frame set, ms."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras to use; empty = all. Other cameras are treated as not recorded."""
    depth: bool = True
    """Use depth images. If false, all cameras are treated as colour cameras without depth."""
    stereo_baseline_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Distance between the two infrared lenses of depth cameras that measure by stereo, metres
    (RealSense D415 0.055, D435 0.050, D455 0.095), unless the recording states it; 0 = time of
    flight. Noise of stereo grows with squared distance."""


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
    keypoint_layout: str | None = None
    """Layout of the body points in keypoint files, by a name of docs/detectors.md; null = stated in
    the files, or recognised by their number and by the lengths of the bones."""
    keypoint_first_number: NonNegativeInt | None = None
    """Number of the first image in names and ids of keypoint files; null = recognised."""
    candidate_first_number: NonNegativeInt | None = None
    """Number of the first image in names and ids of candidate files; null = recognised."""
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
    find_starts: bool = True
    """Search for cameras that started seconds apart, by the keypoints of moving people. false =
    keep device times and stated starts."""
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


def _packaged_definition(value: Any) -> Any:
    """Return the packaged table of this name; any other value as it is."""
    table = Path(__file__).parent / "body_fit/data" / f"{value}.tsv"
    return table if isinstance(value, str) and value.isalnum() and table.is_file() else value


class BodyFitSettings(Model):
    """SMPL-X parameters in every frame (equation 2)."""

    hands: bool = True
    """Fit finger poses; otherwise hands have their mean pose."""
    face: bool = True
    """Fit jaw and expression from the face keypoints."""
    shape: Literal["shared", "per_frame"] = "shared"
    """shared = one body shape for the sequence; per_frame = a free shape in every frame, as in the
    paper's first stage."""
    betas: Annotated[int, Field(ge=1, le=300)] = 10
    """Number of shape coefficients. Most readers of SMPL-X expect ten. The open body has 30, which
    reduce its distance to the data by about 4 %; a licensed file has up to 300."""
    keypoint_definition: Annotated[Path | None, BeforeValidator(_packaged_definition)] = None
    """Table of the detector's joint positions on the body: a file that ``intercap
    keypoint-definition`` wrote, or ``mediapipe`` for the packaged table. Without it, the fit
    estimates offsets with a standard deviation of 10 mm from the body model's joints."""
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
    """Weight against fast changes of the corrections of the sequential fits (no symbol in equation
    6)."""
    look_again: bool = True
    """Compare the object with the images in each round; otherwise use the object track's poses
    and covariances as observations."""
    refine_cameras: bool = True
    """Refine poses and depth biases of the cameras from body and object (beyond the paper); needs
    ``look_again``. Set to false to keep given camera poses."""
    detect_contact: bool = True
    """Detect contact from the geometry in sequences without contact annotation."""
    annotation_uncertainty_frames: Annotated[int, Field(ge=0, le=100)] = 5
    """Uncertainty of ends of annotated contact that are marked ``uncertain``, frames. Within it,
    the observed distance may move the ends. All other statements hold exactly."""

    @property
    def lemo_files(self) -> tuple[Path, Path] | None:
        """Weights and statistics of LEMO's motion encoder; None without LEMO's release."""
        if self.lemo is None:
            return None
        statistics = "preprocess_stats_smooth_withHand_global_markers.npz"
        return (
            self.lemo / "runs" / "15217" / "Enc_last_model.pkl",  # the released run's number
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

    formats: tuple[
        Literal[
            "intercap", "amass", "bop", "coco", "glb", "contact", "meshes", "rrd", "bvh", "gmr",
            "holosoma",
        ], ...,
    ] = ("intercap", "amass", "bop", "coco", "glb", "contact")  # fmt: skip
    """Exported formats. contact = contact probability by frame, vertices in contact, and a draft
    annotation; meshes = body and object of each frame as mesh files of half a megabyte each; rrd =
    recording for the Rerun viewer, needs the extra `rerun`; bvh = skeleton; gmr, holosoma = motion
    for programs that retarget it to humanoids."""
    frame: Literal["z-up", "camera"] = "z-up"
    """Coordinate frame of amass, glb, meshes and rrd: z-up = z against gravity, ground at z = 0;
    camera = the master camera. The formats intercap, bop and coco use camera frames; bvh, gmr and
    holosoma have their own."""
    mesh_format: Literal["ply", "obj"] = "ply"
    """File format of the meshes; only ply marks the vertices in contact."""
    mesh_every: Annotated[int, Field(ge=1)] = 1
    """Step between exported mesh frames."""
    masks: bool = True
    """Render object masks and boxes for bop, with and without occlusion by the body."""
    images: bool = False
    """Write the colour images into bop and coco, and depth of the same pixels into bop."""
    undistort: bool = False
    """Write these images resampled to a pinhole; masks, boxes and keypoints of bop and coco are
    those of the resampled images."""


class CardSettings(Model):
    """The dataset's card and overview."""

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
    collection: str = ""
    """Who recorded whom, where, when and how: statement of the datasheet."""
    consent: str = ""
    """How the recorded persons consented, and to which uses; approval by an ethics board."""
    uses: str = ""
    """Tasks that the data is meant for, and uses to avoid."""
    biases: str = ""
    """Groups of people, objects and actions that are rare or absent."""
    social_impact: str = ""
    """Good and harm that can come from the data's use."""
    maintenance: str = ""
    """Who maintains the data, and where errors are reported."""
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
    heatmap_scale: Literal["own", "common"] = "own"
    """Colour scale of the contact heatmaps: own = each map's maximum has the last colour; common =
    the largest maximum of all maps, so that colours compare between maps."""


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
    keypoints: Literal["simulated", "measured", "mediapipe"] = "simulated"
    """simulated = true keypoints with errors; measured = with errors as those of a real detector;
    mediapipe = detected in the images, and those of measured in another folder; see
    docs/studio.md."""
    depth_errors: Literal["usual", "large", "stereo"] = "usual"
    """large = depth biases of up to 11 mm, growing with distance and incidence, and holes at thin
    parts; stereo = noise of a stereo camera with a baseline of 50 mm; see docs/studio.md."""
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
    camera: Literal["rig", "hand_held"] = "rig"
    """hand_held = one camera is carried around the object at rest, and no person is in view."""
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


# The open body: the package's own body model, with SMPL-X's parameters and another mesh
# (docs/body.md).
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
    """Partition for detectors that run on a GPU; empty = the profile's partition."""

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
    """Folder of all results, relative to the folder that
    holds ``config/``, or to that of a settings file outside of ``config/``."""
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
    """The dataset's card and overview."""
    cluster: ClusterSettings = ClusterSettings()
    """Resources that jobs request from a cluster's scheduler."""
    one_process: tuple[tuple[Name, ...], ...] = (
        ("frames", "detections", "scene", "person"),
        ("joint", "metrics", "summary"),
    )
    """Groups of consecutive stages that share a process and a job; [] = one job for each stage.
    Without effect on results."""
    studio: StudioSettings | None = None
    """Virtual recordings to make; absent for real ones."""

    @field_validator("one_process")
    @classmethod
    def _groups_consecutive_stages(
        cls, groups: tuple[tuple[str, ...], ...]
    ) -> tuple[tuple[str, ...], ...]:
        order, start = list(STAGES), 0
        for group in groups:
            first = order.index(group[0]) if group and group[0] in order[start:] else len(order)
            end = first + len(group)
            if not group or tuple(order[first:end]) != group:
                raise ValueError(
                    f"the group {list(group)} is expected to name consecutive stages that follow "
                    f"those of earlier groups; the order is {', '.join(order)}"
                )
            start = end
        return groups


def digest(value: BaseModel | Any) -> str:
    """Digest of settings or of a JSON-like value: 16 hexadecimal digits of SHA-256."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
