"""Settings and tables: mistakes are named by file, row and field before anything runs."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from intercap_core.annotation import Annotation
from intercap_core.config import Config, digest
from intercap_core.errors import UserError
from intercap_core.project import Project, load_project
from tools.generated_docs import contents

ROOT = Path(__file__).resolve().parents[1]
HEADER = "sequence\tsubject\tobject\trecordings\tcalibration\n"
POSE = "{frame: %d, rotation_vector: [0, 0, 0], translation: [0, 0, 1]}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small valid project; the working directory is its folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cup.ply").write_text("a mesh")
    (tmp_path / "config.yaml").write_text("dataset: trial\n")
    (tmp_path / "sequences.tsv").write_text(
        f"# comment\n{HEADER}one\ts01\tcup\trec/one\tcal\n\ntwo\ts02\tcup\trec/two\tcal\n"
    )
    (tmp_path / "subjects.tsv").write_text("subject\tgender\ns01\tfemale\ns02\tmale\n")
    (tmp_path / "objects.yaml").write_text("cup:\n  mesh: cup.ply\n")
    (tmp_path / "annotations").mkdir()
    return tmp_path


def test_a_valid_project_loads(folder: Path) -> None:
    project = load_project(Path("config.yaml"))
    assert list(project.sequences) == ["one", "two"]
    assert project.sequences["two"].recordings == Path("rec/two")
    assert project.subjects["s02"].gender == "male"
    assert project.annotation("one") == Annotation()
    assert project.artefact("one", "joint") == Path("results/trial/one/joint.h5")


def test_paths_are_relative_to_their_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    project = load_project(folder / "config.yaml")
    assert project.objects["cup"].mesh == Path(folder.name) / "cup.ply"


def test_overrides_win_and_nest(folder: Path) -> None:
    (folder / "config.yaml").write_text("dataset: trial\njoint: {ground_weight: 2}\n")
    project = load_project(
        Path("config.yaml"), {"joint": {"contact_weight": 3}, "exclude": ["one"]}
    )
    assert project.config.joint.ground_weight == 2
    assert project.config.joint.contact_weight == 3
    assert list(project.sequences) == ["two"]


Edit = Callable[[Path], object]


def settings(text: str) -> Edit:
    return lambda folder: (folder / "config.yaml").write_text(text)


def rows(text: str, header: str = HEADER) -> Edit:
    return lambda folder: (folder / "sequences.tsv").write_text(header + text)


def remove(name: str) -> Edit:
    return lambda folder: (folder / name).unlink()


def objects(text: str) -> Edit:
    return lambda folder: (folder / "objects.yaml").write_text(text)


REUSE = HEADER.strip() + "\tcalibration_scale\trig_from\n"
REUSED = "%s\ts01\tcup\trec\tcal\t%s\t%s\n"
SHAPES = "one\ts01\tcup\trec\tcal\ttwo\ntwo\ts02\tcup\trec\tcal\t\n"


def reuse(*cells: tuple[str, str, str]) -> Edit:
    """Rows of these names, calibration_scale and rig_from."""
    return rows("".join(REUSED % own for own in cells), REUSE)


MISTAKES: list[tuple[Edit, list[str]]] = [
    (remove("config.yaml"), ["config.yaml", "no such file"]),
    (settings("dataset: [\n"), ["config.yaml", "not valid YAML", "line"]),
    (settings("joint: {}\n"), ["config.yaml", "setting dataset: missing; add it"]),
    (settings("dataset: a b\n"), ["config.yaml", "dataset", "'a b'"]),
    (settings("dataset: x\njiont: {}\n"), ["jiont: no such setting (similar: joint)"]),
    (
        settings("dataset: x\njoint: {contact_weight: -1}\n"),
        ["config.yaml", "joint.contact_weight", "must be at least 0, found -1"],
    ),
    (
        settings("dataset: x\nbody_fit: {points_per_frame: 0}\n"),
        ["config.yaml", "body_fit.points_per_frame", "must be at least 200, found 0"],
    ),
    (
        settings("dataset: x\njoint: {contact_wieght: 1}\n"),
        ["joint.contact_wieght: no such setting (similar: joint.contact_weight); config/"],
    ),
    (
        settings("dataset: x\njoint: {contact_weight: abc}\n"),
        ["config.yaml", "joint.contact_weight: must be a number, found 'abc'; correct it"],
    ),
    (settings("dataset: x\njoint: 3\n"), ["setting joint: must be names and values, found 3"]),
    (settings("dataset: x\nexclude: one\n"), ["setting exclude: must be a list, found 'one'"]),
    (
        settings("dataset: x\njoint: {contact_weight: .inf}\n"),
        ["config.yaml", "joint.contact_weight", "finite", "inf"],
    ),
    (
        objects("cup: {mesh: cup.ply, symmetry: {continuous: [{axis: [0, 0, .nan]}]}}\n"),
        ["objects.yaml", "symmetry.continuous.0.axis.2", "finite"],
    ),
    (settings("dataset: x\nexclude: [three]\n"), ["exclude", "'three'"]),
    (
        reuse(("one", "", "lost"), ("two", "", "")),
        ["sequences.tsv: sequence 'one' has rig_from 'lost', which the table does not list (one, "],
    ),
    (reuse(("one", "", "one")), ["sequence 'one' has rig_from 'one', which is the row itself; "]),
    (
        reuse(("one", "", "two"), ("two", "", "three"), ("three", "", "one")),
        ["rig_from lead from a sequence back to itself", "one", "two", "three", "clear one of"],
    ),
    (
        reuse(("one", "1", "two"), ("two", "2", "")),
        ["'one' has rig_from 'two', but their calibration_scale differs: 1.0 for 'one', 2.0 for "],
    ),
    (
        rows(SHAPES, HEADER.strip() + "\tshape_from\n"),
        ["'one' has shape_from 'two', but 'one' shows subject 's01' and 'two' 's02'; name another"],
    ),
    (
        settings("dataset: x\njoint: {lemo: LEMO}\n"),
        ["config.yaml", "joint.lemo", "LEMO/runs/15217/Enc_last_model.pkl", "no such file"],
    ),
    (
        settings("dataset: x\njoint: {contact_to: annotated}\n"),
        ["objects.yaml", "'cup'", "no contact_vertices", "joint.contact_to to any"],
    ),
    (
        settings("dataset: x\nbody_models: {female: SMPLX_FEMALE.npz}\n"),
        ["config.yaml", "body_models.female", "SMPLX_FEMALE.npz", "no such file"],
    ),
    (
        settings("dataset: x\nbody_models: {male: cup.ply}\n"),
        ["config.yaml", "subject 's01' is female", "only a file for male", "body_models.neutral"],
    ),
    (
        settings(
            "dataset: x\nstudio:\n  captures:\n"
            "    other: {interaction: cup_drink, subject: s01, seed: 1}\n"
        ),
        ["studio.captures", "'other'", "sequences.tsv"],
    ),
    (
        settings(
            "dataset: x\nstudio:\n  captures:\n"
            "    one: {interaction: cup_drink, subject: s01, seed: 1}\n"
        ),
        ["sequences.tsv", "'one'", "results/x/recordings/one"],
    ),
    (remove("sequences.tsv"), ["sequences.tsv", "not a readable text file"]),
    (rows(""), ["sequences.tsv", "holds no sequence"]),
    (rows("one\ts09\tcup\tr\tc\n"), ["sequences.tsv", "'one'", "subject 's09'", "s01, s02"]),
    (rows("one\ts01\tmug\tr\tc\n"), ["sequences.tsv", "'one'", "object 'mug'", "cup"]),
    (rows("../x\ts01\tcup\tr\tc\n"), ["sequences.tsv", "line 2", "column sequence", "'../x'"]),
    (rows("..\ts01\tcup\tr\tc\n"), ["sequences.tsv", "line 2", "column sequence", "'..'"]),
    (rows("one\ts01\tcup\tr\n"), ["sequences.tsv", "line 2", "number of columns", "tabs"]),
    (rows("one\ts01\tcup\t\tc\n"), ["sequences.tsv", "line 2", "column recordings: missing"]),
    (
        rows("one\ts01\tcup\tr\tc\n# x\none\ts01\tcup\tr\tc\n"),
        ["sequences.tsv", "line 4", "'one'", "line 2"],
    ),
    (
        rows("one\tx\n", header="# x\nsequence\tpeople\n"),
        ["sequences.tsv", "line 2", "column 'subject' is missing", "sequence, subject", "tabs"],
    ),
    (
        rows("one s01 cup r c\n", header=HEADER.replace("\t", " ")),
        ["sequences.tsv", "line 1", "column 'sequence' is missing", "use tabs"],
    ),
    (
        rows("one\ts01\tcup\tr\tc\td\n", header=HEADER.rstrip() + "\tsubject\n"),
        ["sequences.tsv", "line 1", "column 'subject' is given twice"],
    ),
    (
        rows("one\ts01\tcup\tr\tc\td\n", header=HEADER.rstrip() + "\tpeople\n"),
        ["sequences.tsv", "line 1", "column 'people' is not known", "keypoints"],
    ),
    (rows("", header=""), ["sequences.tsv", "line 1", "'sequence' is missing"]),
    (rows("recordings\ts01\tcup\tr\tc\n"), ["line 2", "'recordings'", "choose another"]),
    (rows("a b\ts01\tcup\tr\tc\n"), ["line 2", "letters, digits, _ and - only", "'a b'"]),
    (
        settings("dataset: x\njoint:\n  ground_weight: 1\n  ground_weight: 2\n"),
        ["config.yaml", "line 4", "'ground_weight' is given twice"],
    ),
    (settings(f"dataset: x\nobjects: {'x' * 300}\n"), ["config.yaml", "setting objects"]),
    (rows(f"one\ts01\tcup\t{'x' * 300}\tc\n"), ["line 2", "recordings", "255 bytes a name"]),
    (rows(f"one\ts01\tcup\t{'y' * (1 << 20)}\tc\n"), ["line 2", "255 bytes a name"]),
    (settings("false\n"), ["config.yaml", "expected names and values"]),
    (objects("cup: false\n"), ["objects.yaml", "object 'cup'", "found False"]),
    (objects("cup:\n"), ["objects.yaml", "object 'cup'", "field mesh: missing"]),
    (
        lambda folder: (folder / "subjects.tsv").write_text("subject\tgender\ns01\tF\n"),
        ["subjects.tsv", "line 2", "'s01'", "'male' or 'neutral', found 'F'"],
    ),
    (objects("cup: {mesh: mug.ply}\n"), ["objects.yaml", "object 'cup'", "mug.ply", "no such"]),
    (
        objects("cup: {mesh: cup.ply, contact_vertices: no.json}\n"),
        ["objects.yaml", "contact_vertices", "no.json"],
    ),
    (
        objects("cup: {mesh: cup.ply, symmetry: {discrete: [[1, 2]]}}\n"),
        ["objects.yaml", "symmetry", "16"],
    ),
    (objects("[1, 2]\n"), ["objects.yaml", "expected object names"]),
]


@pytest.mark.parametrize(("edit", "says"), MISTAKES)
def test_mistakes_are_one_error_line(folder: Path, edit: Edit, says: list[str]) -> None:
    edit(folder)
    with pytest.raises(UserError) as raised:
        load_project(Path("config.yaml"))
    message = str(raised.value)
    for part in says:
        assert part in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("contact:\n- {part: left_hand, start: 9, end: 3}\n", ["contact.0", "reversed", "9", "3"]),
        ("contact:\n- {part: elbow, start: 1, end: 3}\n", ["contact.0.part", "'elbow'"]),
        ("contact:\n- {part: seat, start: -1, end: 3}\n", ["contact.0.start", "-1"]),
        ("contact:\n- {part: seat, start: true, end: 3}\n", ["contact.0.start", "True"]),
        (
            "contact:\n- {part: seat, start: 0, end: 3.0}\n",
            ["contact.0.end: must be a whole number, found 3.0"],
        ),
        ("drop_frames: [true]\n", ["drop_frames.0", "True"]),
        ("floor: [[0, 0, 1], [1, 0, 1]]\n", ["floor", "2 points"]),
        ("floor: [[0, 0, 1], [1, 0, 1], [2, 0, 1]]\n", ["on one line"]),
        ("floor: [[0, 0, 1], [900, 0, 1], [0, 1, 1]]\n", ["floor.1.0", "millimetres", "900"]),
        (
            "object_pose: {frame: 0, rotation_vector: [0, .nan, 0], translation: [0, 0, 1]}\n",
            ["object_pose.rotation_vector.1", "finite"],
        ),
        (
            "object_pose: {frame: 0, rotation_vector: [0, 0, 0], translation: [0, 0, 2400]}\n",
            ["object_pose.translation.2", "millimetres"],
        ),
        (
            f"object_poses: [{POSE % 1}, {POSE % 4}, {POSE % 1}]\n",
            ["object_poses[0] and object_poses[2] both describe frame 1"],
        ),
        (
            f"object_pose: {POSE % 1}\nobject_poses: [{POSE % 2}]\n",
            ["object_pose and object_poses are both given"],
        ),
        (
            "object_poses: [{frame: 0, rotation_vector: [0, 0, 0], translation: [0, 0, 1], "
            "sigma_m: 10}]\n",
            ["object_poses.0.sigma_m", "1", "10"],
        ),
        (
            "object_poses: [{frame: 0, rotation_vector: [0, 0, 0], translation: [0, 0, 1], "
            "sigma_degrees: 0}]\n",
            ["object_poses.0.sigma_degrees", "above 0"],
        ),
        ("object_poses: {frame: 0}\n", ["object_poses"]),
        ("left_right: [{start: 3, end: 3}]\n", ["left_right.0", "no frame", "3"]),
        ("left_right: [{start: 0, end: 3, camera: k/1}]\n", ["left_right.0.camera", "letters"]),
        ("left_right: [{end: 3}]\n", ["left_right.0.start: missing"]),
        ("subject: [{camera: k1, frame: 0, x: 612}]\n", ["subject.0.y: missing"]),
        ("subject: [{camera: k1, frame: -2, x: 1, y: 1}]\n", ["subject.0.frame", "-2"]),
        ("starts: {k1: 0}\n", ["starts names fewer than two cameras"]),
        ("starts: [0, 1]\n", ["starts", "[0, 1]"]),
        ("starts: {k1: 0, k2: true}\n", ["starts.k2", "True"]),
        ("starts: {k1: 0, k2: '0.4'}\n", ["starts.k2", "'0.4'"]),
        ("starts: {k1: 10:00:12:13, k2: 10:00:12:20}\n", ["starts.k1", "'10:00:12:13'"]),
        ("starts: {k1: 0, k/2: 1}\n", ["starts.k/2", "letters, digits"]),
        ("starts: {k1: 0, k2: {sigma: 1}}\n", ["starts.k2", "seconds: missing"]),
        ("starts: {k1: 0, k2: {seconds: 1, sigma: 0}}\n", ["starts.k2", "sigma", "above 0"]),
        ("starts: {k1: 0, k2: 1}\nstarts_sigma: 20\n", ["starts_sigma", "10", "20"]),
        ("starts_sigma: 0.1\n", ["starts_sigma is set without starts"]),
        ("flor: []\n", ["flor: no such annotation (similar: floor)"]),
        ("contact: [\n", ["not valid YAML"]),
        ("false\n", ["expected names and values", "False"]),
    ],
)
def test_broken_annotation_fails_only_its_sequence(
    folder: Path, text: str, says: list[str]
) -> None:
    (folder / "annotations" / "one.yaml").write_text(text)
    project = load_project(Path("config.yaml"))
    assert project.annotation("two") == Annotation()
    with pytest.raises(UserError) as raised:
        project.annotation("one")
    for part in ["annotations/one.yaml", *says]:
        assert part in str(raised.value)


@pytest.mark.parametrize("text", ["", "# nothing yet\n", "{}\n"])
def test_empty_annotation_has_no_sections(folder: Path, text: str) -> None:
    (folder / "annotations" / "one.yaml").write_text(text)
    assert load_project(Path("config.yaml")).annotation("one") == Annotation()


def test_tables_may_start_with_a_byte_order_mark(folder: Path) -> None:
    table = folder / "subjects.tsv"
    table.write_text(table.read_text(), encoding="utf-8-sig")
    assert set(load_project(Path("config.yaml")).subjects) == {"s01", "s02"}


@pytest.mark.parametrize("target", ["nowhere.yaml", "/dev/zero", "."])
def test_an_annotation_that_is_a_link_to_no_file_is_refused(folder: Path, target: str) -> None:
    (folder / "annotations" / "one.yaml").symlink_to(target)
    with pytest.raises(UserError, match=r"annotations/one\.yaml"):
        load_project(Path("config.yaml")).annotation("one")


def test_a_row_can_name_its_annotation(folder: Path) -> None:
    table = folder / "sequences.tsv"
    lines = table.read_text().splitlines()
    header, first, *others = [line for line in lines if line and not line.startswith("#")]
    rows = [f"{header}\tannotation", f"{first}\tannotations/other.yaml"]
    table.write_text("\n".join([*rows, *(f"{line}\t" for line in others)]) + "\n")
    (folder / "annotations" / "one.yaml").write_text("drop_frames: [1]\n")
    with pytest.raises(UserError, match=r"other.yaml: no such file, but sequence 'one' names it"):
        load_project(Path("config.yaml")).annotation("one")
    (folder / "annotations" / "other.yaml").write_text("drop_frames: [2]\n")
    project = load_project(Path("config.yaml"))
    assert project.annotation("one").drop_frames == (2,)
    assert project.annotation("two") == Annotation()


def test_single_pose_equals_a_list_with_one_pose() -> None:
    pose = {"frame": 3, "rotation_vector": [0, 0, 1], "translation": [0, 0, 2]}
    one = Annotation.model_validate({"object_pose": pose})
    several = Annotation.model_validate({"object_poses": [pose | {"frame": 5}, pose]})
    assert one.poses == several.poses[:1] and [p.frame for p in several.poses] == [3, 5]
    assert (one.poses[0].sigma_m, one.poses[0].sigma_degrees) == (0.01, 5.0)
    assert Annotation().poses == ()
    assert several.check_object("cup") is None
    assert "object_poses is annotated" in str(several.check_object(None))
    assert several.check_frames(6) is None
    assert "object_poses[0].frame is 5" in str(several.check_frames(5))


def test_stated_sides_of_frames_and_cameras_that_are_not_there() -> None:
    sides = [{"start": 0, "end": 4}, {"start": 2, "end": 9, "camera": "k2"}]
    stated = Annotation.model_validate({"left_right": sides})
    assert stated.check_frames(9) is None and stated.check_cameras(["k1", "k2"], "k1") is None
    assert "left_right[1].end is 9" in str(stated.check_frames(8))
    assert "left_right[1] names camera 'k2'" in str(stated.check_cameras(["k1", "k3"], "k1"))


def test_annotation_past_the_end(folder: Path) -> None:
    annotation = Annotation.model_validate(
        {
            "contact": [{"part": "seat", "start": 0, "end": 20}],
            "object_pose": {"frame": 11, "rotation_vector": [0, 0, 0], "translation": [0, 0, 1]},
            "drop_frames": [3, 30],
            "subject": [{"camera": "k1", "frame": 10, "x": 1, "y": 1}],
        }
    )
    assert annotation.check_frames(31) is None
    assert "drop_frames holds 30" in str(annotation.check_frames(30))
    assert "contact[0].end is 20" in str(annotation.check_frames(19))
    pose = annotation.model_copy(update={"contact": None, "drop_frames": ()})
    assert "object_pose.frame is 11" in str(pose.check_frames(11))
    who = pose.model_copy(update={"object_pose": None})
    assert who.check_frames(11) is None
    assert "subject[0].frame is 10" in str(who.check_frames(10))
    assert "all 3 frames" in str(Annotation(drop_frames=(0, 1, 2)).check_frames(3))
    assert Annotation(drop_frames=(0, 1)).check_frames(3) is None


def test_starts_of_cameras_that_are_not_there() -> None:
    stated = Annotation.model_validate({"starts": {"k1": 0, 2: {"seconds": -1.5, "sigma": 0.1}}})
    assert stated.stated_starts == {"k1": (0.0, 0.02), "2": (-1.5, 0.1)}
    assert stated.check_cameras(["k1", "2"], "k1") is None
    fault = str(stated.check_cameras(["k1", "k2", "k3"], "k1"))
    assert fault == "starts names camera '2'; the recording has k1, k2, k3"
    assert "lacks k3, the master" in str(stated.check_cameras(["k1", "2", "k3"], "k3"))
    assert Annotation().check_cameras(["k1"], "k1") is None and not Annotation().stated_starts


def test_digest_follows_content_alone() -> None:
    a = Config.model_validate({"dataset": "x", "joint": {"ground_weight": 1, "contact_weight": 2}})
    b = Config.model_validate({"joint": {"contact_weight": 2.0}, "dataset": "x"})
    assert digest(a) == digest(b)
    assert digest(a.joint) != digest(Config(dataset="x").joint)


@pytest.mark.parametrize("name", ["demo", "quickstart", "evaluation", "bench", "test", ""])
def test_the_committed_settings_are_valid(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    project = load_project(Path("config") / name / "config.yaml")
    assert isinstance(project, Project)


def test_the_default_settings_are_the_defaults() -> None:
    values = yaml.safe_load((ROOT / "config" / "config.yaml").read_text())
    assert Config.model_validate(values) == Config(dataset=values["dataset"])


def test_the_example_annotation_is_valid() -> None:
    values = yaml.safe_load((ROOT / "config" / "annotations.example.yaml").read_text())
    assert {*values, "object_pose"} == set(Annotation.model_fields)  # which is a list of one
    Annotation.model_validate(values)


GENERATED = contents(ROOT)


@pytest.mark.parametrize("relative", sorted(GENERATED))
def test_generated_files_are_in_step(relative: str) -> None:
    written = (ROOT / relative).read_text(encoding="utf-8")
    assert written == GENERATED[relative], f"run `intercap dev docs`: {relative} is stale"


def test_every_setting_is_described() -> None:
    page = GENERATED["config/README.md"]
    empty = [line for line in page.splitlines() if re.match(r"\| `.*\|\s*\|$", line)]
    assert not empty
