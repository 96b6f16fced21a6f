"""The command line: quick help, faults in one line, contents of files."""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from unittest import mock

import h5py
import numpy as np
import pytest
import trimesh
import typer
import yaml
from rich.console import Console

from intercap_core import artefacts, cli
from intercap_core.commands.check import (
    check_segmentation_model,
    check_sequences,
)
from intercap_core.commands.console import ListTable
from intercap_core.commands.watcher import Watcher
from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.project import load_project, root_of
from intercap_core.schemas import DETECTIONS
from intercap_core.stage_list import STAGES
from tests.helpers.kinect_files import record
from tests.helpers.synthetic_capture import fill, ring, write_frames

ROOT = Path(__file__).resolve().parents[2]

SCENE = ("stage", "scene", "config/demo/config.yaml", "cup_drink_s02")


def intercap(
    *arguments: str, folder: Path = ROOT, output: io.TextIOBase | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command line in this process; prints to ``output`` if it is given."""
    errors = io.StringIO()
    captured = output or io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(captured),
        contextlib.redirect_stderr(errors),
        mock.patch.object(sys, "argv", ["intercap", *arguments]),
        mock.patch.dict(os.environ, {"COLUMNS": "200"}),
    ):
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
    captured.flush()
    text = captured.getvalue() if isinstance(captured, io.StringIO) else ""
    return subprocess.CompletedProcess(arguments, status, text, errors.getvalue())


def test_help_is_quick_and_has_examples() -> None:
    start = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "intercap_core.cli", "--help"],
        cwd=ROOT,
        env={"PATH": "/usr/bin:/bin", "COLUMNS": "200", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    # Processor time, not wall time: whatever else the machine does
    assert end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime < 1.0
    assert done.returncode == 0
    for command in ("check", "run", "inspect", "stage", "intercap run config/demo"):
        assert command in done.stdout


def test_every_command_has_an_example() -> None:
    tree = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    commands = {**tree, **tree["stage"].commands, **tree["dev"].commands}
    texts = {name: c.help or "" for name, c in commands.items() if not hasattr(c, "commands")}
    assert {name.replace("-", "_") for name in texts} > set(STAGES)
    assert [name for name, text in texts.items() if "Example" not in text] == ["docs"]


def test_commands_of_groups_are_hidden_aliases() -> None:
    tree = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    assert tree["joint"].hidden and tree["evaluate"].hidden and not tree["run"].hidden
    inner = tree["stage"].commands["joint"]
    assert not inner.hidden and inner.help == tree["joint"].help
    assert intercap("--version").stdout.startswith("intercap-core ")


def test_view_and_annotate_take_a_sequence_of_the_default_settings(inside: Path) -> None:
    for command in ("view", "annotate"):
        done = intercap(command, "good", folder=inside.parent)
        assert done.stderr.startswith("error: config/config.yaml: there is no such file")
    done = intercap("view", "good", folder=inside)
    assert "results/trial/good/frames.h5: no such file" in done.stderr
    done = intercap("view", "config.yaml", folder=inside)
    assert "name one of its sequences: good, bad, empty" in done.stderr


@pytest.mark.parametrize("width", [40, 80, 400])
def test_tables_never_truncate_a_cell(width: int) -> None:
    table = ListTable("sequence", *(f"heading_{n}" for n in range(9)), "meaning")
    cells = [
        "subject_01_suitcase_carry",
        *(f"[green]cell{n}[/green]" for n in range(9)),
        "a b" * 30,
    ]
    table.add_row(*cells)
    stream = io.StringIO()
    Console(file=stream, width=width).print(table)
    words = stream.getvalue()
    for cell in ("subject_01_suitcase_carry", *(f"cell{n}" for n in range(9)), "heading_8"):
        assert cell in words
    assert max(len(line.rstrip()) for line in words.splitlines()) <= width


def test_help_imports_no_numerical_library() -> None:
    code = (
        "import sys; import intercap_core.cli, intercap_core.pipeline.job; "
        "print([m for m in ('torch', 'open3d', 'cv2', 'numpy', 'h5py', 'scipy', 'matplotlib')"
        " if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_stages_read_only_earlier_stages() -> None:
    for place, stage in enumerate(STAGES.values()):
        assert set(stage.reads) <= set(list(STAGES)[:place]), stage.name


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("check", "nowhere.yaml"), "nowhere.yaml: there is no such file"),
        (
            ("stage", "joint", "config/demo/config.yaml", "nobody"),
            "sequence 'nobody' is not in the table",
        ),
        (("dev", "studio", "config/config.yaml", "s01_o01_seg1"), "its recordings are real"),
        ((*SCENE, "--output", "README.md"), "README.md: exists and is no result file"),
        ((*SCENE, "--output", "docs"), "docs: is a folder, expected a file"),
        ((*SCENE, "--output", "README.md/a.h5"), "README.md/a.h5: cannot be written ("),
        ((*SCENE, "--output", "/proc/a.h5"), "/proc/a.h5: cannot be written ("),
        (("dev", "evaluate", "--output", "/proc/a.json"), "/proc/a.json: cannot be written ("),
        (("inspect", "README.md"), "README.md: not an artefact"),
        (("inspect", "nowhere.h5"), "nowhere.h5: there is no such file"),
    ],
)
def test_a_user_error_is_one_line_with_status_one(arguments: tuple[str, ...], says: str) -> None:
    done = intercap(*arguments)
    assert done.returncode == 1
    assert says in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("threads", ["0", "-1"])
def test_threads_are_one_or_more(threads: str) -> None:
    done = intercap(*SCENE, "--threads", threads)
    assert done.returncode == 2
    assert "--threads" in done.stderr


def test_long_faults_keep_their_ends() -> None:
    assert UserError("a" * 2000).shortened() == "a" * 2000
    text = UserError("a" * 5000 + "b" * 5000).shortened(100)
    assert text == f"{'a' * 50} [...] {'b' * 50}"


@pytest.fixture
def small_project(tmp_path: Path) -> Path:
    """A folder with a project of one good sequence and two that lack files."""
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "cup.ply")
    write_rig_file(tmp_path / "rig.json", Extrinsics("k1", {"k1": np.eye(4)}))
    (tmp_path / "config.yaml").write_text("dataset: trial\n")
    (tmp_path / "subjects.tsv").write_text("subject\tgender\ns01\tmale\n")
    (tmp_path / "objects.yaml").write_text("cup: {mesh: cup.ply}\n")
    (tmp_path / "sequences.tsv").write_text(
        "sequence\tsubject\tobject\trecordings\tcalibration\tkeypoints\n"
        "good\ts01\tcup\trec\trig.json\tpoints\nbad\ts01\tcup\tnone\tnone.json\t\n"
        "empty\ts01\tcup\t.\trig.json\t\n"
    )
    (tmp_path / "rec").mkdir()
    (tmp_path / "points" / "k1").mkdir(parents=True)
    (tmp_path / "points" / "k1" / "0_keypoints.json").write_text('{"people": []}')
    record(tmp_path / "rec", 0, range(1))
    (tmp_path / "annotations").mkdir()
    (tmp_path / "annotations" / "bad.yaml").write_text("floor: 3\n")
    return tmp_path


@pytest.fixture
def inside(small_project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same as the working directory."""
    monkeypatch.chdir(small_project)
    return small_project


def test_check_lists_all_faults_of_all_sequences(small_project: Path) -> None:
    done = intercap("check", "config.yaml", folder=small_project)
    assert done.returncode == 1
    assert "1 of 3 sequences are ready" in done.stdout
    problems = done.stderr.splitlines()
    assert len(problems) == 4
    assert sum("'bad'" in line for line in problems) == 3
    assert "'empty'" in problems[-1]


def test_check_lists_the_faults_of_all_files_in_one_pass(small_project: Path) -> None:
    """Settings, people, objects and sequences come first, in this order; then the recordings."""
    (small_project / "config.yaml").write_text(
        "dataset: trial\njoint: {contact_weight: -1}\nscene: {floor: 1}\n"
        "body_models: {male: body.npz, sex: male}\n"
    )
    (small_project / "body.npz").write_text("not a body")
    (small_project / "annotations" / "three.yaml").touch()
    (small_project / "subjects.tsv").write_text("subject\tgender\ns01\tmale\ns02\tM\n")
    (small_project / "objects.yaml").write_text("cup: {mesh: cup.ply}\nmug: {}\n")
    with (small_project / "sequences.tsv").open("a") as table:
        table.write("two\ts02\tcup\trec\trig.json\tpoints\n")
        table.write("three\ts09\tmug\trec\trig.json\tpoints\nbad\ts01\n")
        table.write("four\t\tcup\tnowhere\trig.json\t\n")
    done = intercap("check", "config.yaml", folder=small_project)
    assert done.returncode == 1 and "0 of 6 sequences are ready" in done.stdout
    expected = [
        ("config.yaml", "body_models.sex"), ("config.yaml", "scene.floor"),
        ("config.yaml", "joint.contact_weight"),
        ("subjects.tsv, line 3", "gender"), ("objects.yaml, object 'mug'", "mesh"),
        ("sequences.tsv, line 7", "number of columns"),
        ("sequences.tsv, line 8 (sequence 'four')", "column subject"),
        ("'three'", "subject 's09'"), ("Body file body.npz", "not a readable"),
        ("sequence 'bad'", "annotations/bad.yaml"),
    ]  # fmt: skip
    lines = done.stderr.splitlines()
    for line, parts in zip(lines, expected, strict=False):
        assert line.startswith("problem: ") and all(part in line for part in parts), line
    assert len(lines) == len(expected) + 4  # the other faults of the recordings
    assert "sequence 'four': column recordings names nowhere" in lines[-1]
    for name in ("two", "three"):
        assert f"sequence {name!r}: 1 camera; 1280x720" in done.stdout


def test_check_goes_on_if_no_row_is_valid(small_project: Path) -> None:
    (small_project / "subjects.tsv").write_text("subject\tgender\n")
    (small_project / "results").write_text("a file")
    problems = intercap("check", "config.yaml", folder=small_project).stderr
    for part in ("results/trial: the folder", "'bad': annotations/bad.yaml", "'empty': . contains"):
        assert part in problems


def test_paths_do_not_depend_on_the_working_directory(
    small_project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(small_project.parent)
    project = load_project(Path(small_project.name) / "config.yaml")
    assert project.results == Path(small_project.name) / "results" / "trial"
    assert project.logs == Path(small_project.name) / "logs" / "trial"
    assert project.target(project.results) == "results/trial"
    (small_project / "config").mkdir()
    for name in ("config.yaml", "subjects.tsv", "objects.yaml", "sequences.tsv"):
        (small_project / name).rename(small_project / "config" / name)
    assert root_of(small_project / "config" / "config.yaml") == Path(small_project.name)
    assert root_of(small_project / "config" / "lab" / "config.yaml") == Path(small_project.name)


def test_check_reports_results_that_cannot_be_written(small_project: Path) -> None:
    (small_project / "results").write_text("a file")
    done = intercap("check", "config.yaml", folder=small_project)
    assert done.stderr.startswith("problem: results/trial: the folder of results cannot be written")
    assert "0 of 3 sequences are ready" in done.stdout


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("rec/k1.mkv", "", "sequence 'good': rec/k1.mkv: "),
        ("rec/k2.mkv", None, "sequence 'good': rig.json: has no pose of k2"),
        ("rig.json", "{}", "sequence 'good': rig.json: expected 'master'"),
        ("cup.ply", "a mesh", "sequence 'good': cup.ply: "),
        (
            "annotations/good.yaml",
            "starts: {k1: 0, k9: 0.5}",
            "sequence 'good': annotations/good.yaml: starts names camera 'k9'; the recording has",
        ),
        (
            "annotations/good.yaml",
            "subject: [{camera: k9, x: 1, y: 1}]",
            "sequence 'good': annotations/good.yaml: subject[0] names camera 'k9'; the recording",
        ),
        ("annotations/godo.yaml", "", "problem: annotations/godo.yaml: no sequence has this"),
        ("annotations/good.yml", "", "problem: annotations/good.yml: no sequence has this"),
        ("annotations/good.YAML", "", "problem: annotations/good.YAML: no sequence has this"),
    ],
)
def test_check_opens_the_files(inside: Path, file: str, content: str | None, says: str) -> None:
    project = load_project(Path("config.yaml"), {"exclude": ["bad", "empty"]})
    assert check_sequences(project).faults == []
    if content is None:
        record(Path("rec"), 1, range(1))
    else:
        Path(file).write_text(content)
    (fault,) = check_sequences(project).faults
    assert says in f"problem: {fault}"


@pytest.mark.parametrize("name", ["good.json", "good.yaml.txt"])
def test_check_notes_other_files_of_annotations(inside: Path, name: str) -> None:
    Path("annotations", name).touch()
    project = load_project(Path("config.yaml"), {"exclude": ["bad", "empty"]})
    (note,) = check_sequences(project).notes
    assert f"annotations: {name} is not used; an annotation is <sequence>.yaml" in str(note)


def test_check_names_unknown_cameras(inside: Path) -> None:
    settings = {"exclude": ["bad", "empty"], "frames": {"cameras": ["k9"]}}
    (fault,) = check_sequences(load_project(Path("config.yaml"), settings)).faults
    assert "the setting frames.cameras names 'k9', rec has k1" in str(fault)
    settings = settings | {"frames": {"cameras": ["k1"]}}
    assert check_sequences(load_project(Path("config.yaml"), settings)).faults == []
    assert "\n" not in str(fault)


def test_check_refuses_one_camera_without_depth(inside: Path) -> None:
    settings = {"exclude": ["bad", "empty"], "frames": {"depth": False}}
    (fault,) = check_sequences(load_project(Path("config.yaml"), settings)).faults
    assert "only camera k1 is used, and without depth" in str(fault)


def test_check_refuses_a_sequence_without_keypoints(inside: Path) -> None:
    def faults() -> list[str]:
        exclude = {"exclude": ["bad", "empty"]}
        return [str(f) for f in check_sequences(load_project(Path("config.yaml"), exclude)).faults]

    assert faults() == []
    (inside / "points" / "k1").rename(inside / "points" / "camera1")
    (fault,) = faults()
    assert fault.startswith("sequence 'good': points: no keypoints of k1, and no keypoint model is")
    for content in ("{", '[{"image_id": 0, "keypoints": [1, 2, 3]}]'):
        (inside / "points" / "k1.json").write_text(content)
        assert "the first keypoints of k1 cannot be used, so no person will be" in faults()[0]
    (inside / "points" / "k1.json").unlink()
    table = Path("sequences.tsv")
    table.write_text(table.read_text().replace("\tpoints\n", "\t\n"))
    (fault,) = faults()
    assert fault.startswith("sequence 'good': rec: no keypoints of k1") and "column" in fault


def test_check_notes_cameras_without_recording_or_detections(inside: Path) -> None:
    beside = np.eye(4)
    beside[0, 3] = 1.5
    write_rig_file(Path("rig.json"), Extrinsics("k1", {"k1": np.eye(4), "k2": beside}))
    (inside / "masks").mkdir()
    assert [
        text.partition(": ")[2].partition(";")[0] for text in notes_with("candidates", "masks")
    ] == ["rec records k1", "masks has no k1.json"]
    (inside / "masks" / "k1.json").write_text("[]")
    done = intercap("check", "config.yaml", folder=inside)
    assert done.stdout.count("note: ") == 1
    assert "note: sequence 'good': rec records k1; rig.json also has k2" in done.stdout
    record(Path("rec"), 1, range(1))
    (inside / "masks" / "k2.json").write_text("[]")
    (note,) = (str(note) for note in check_sequences(load_project(Path("config.yaml"))).notes)
    assert "points has no file of keypoints for k2" in note


def notes_with(column: str, folder: str) -> list[str]:
    """Notes of the good sequence with another folder in one column of its row."""
    table = Path("sequences.tsv")
    head, good, *_ = table.read_text().splitlines()
    row = dict(zip(head.split("\t"), good.split("\t"), strict=True)) | {column: folder}
    table.write_text("\t".join(row) + "\n" + "\t".join(row.values()) + "\n")
    return [str(note) for note in check_sequences(load_project(Path("config.yaml"))).notes]


LARGE = [
    {"image_id": n, "category_id": 53, "segmentation": [[901, 502, 930, 502, 930, 540]]}
    for n in range(5000)
]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "k1.json is not valid JSON"),
        ([LARGE[0] | {"segmentation": {"size": [7, 7], "counts": "?"}}],
         "1 of its first 1 results cannot be used (first: entry 0 (image 0): the mask has 7x7"),
        (LARGE, "the labels of the first results are apple; object 'cup' expects mug"),
        ([LARGE[0] | {"category_name": "mug"}, *LARGE[1:]], ""),
        ([], ""),
    ],
)  # fmt: skip
def test_check_reads_the_first_candidates(inside: Path, content: str | list, says: str) -> None:
    objects = {"cup": {"mesh": "cup.ply", "labels": ["mug"]}}
    Path("objects.yaml").write_text(yaml.safe_dump(objects))
    Path("masks").mkdir()
    Path("masks/k1.json").write_text(content if isinstance(content, str) else json.dumps(content))
    notes = notes_with("candidates", "masks")
    notes = [note for note in notes if " images, it has " not in note]  # of one image
    assert len(notes) == bool(says)
    assert not says or says in notes[0]


WHOLE_BODY = [v for i in range(133) for v in (10.0 + i, 400.0, 0.5)]
FAR_OUT = [v for i in range(133) for v in (1300.0 + i, 20.0, 0.5)]


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("k1.json", "{", "k1.json is not valid JSON"),
        ("k1.json", [{"image_id": 0, "keypoints": [1.0] * 54}],
         "1 of its first 1 people cannot be used (first: entry 0 (image 0): has 18 keypoints"),
        ("k1.json", [{"image_id": 0, "keypoints": FAR_OUT}], "another size"),
        ("k1/0.json", [{"keypoints": [*WHOLE_BODY[:-1], 7.0]}], "1 of 133 confidences are beyond"),
        ("k1.json", [{"image_id": 0, "keypoints": WHOLE_BODY}] * 300, ""),
        ("k1/0_keypoints.json", {"people": []}, ""),
    ],
)  # fmt: skip
def test_check_reads_the_first_keypoints(
    inside: Path, name: str, content: object, says: str
) -> None:
    text = content if isinstance(content, str) else json.dumps(content)
    Path("points/k1/0_keypoints.json").unlink()
    Path("points", name).write_text(text)
    notes = [note for note in notes_with("keypoints", "points") if "candidates" not in note]
    assert len(notes) == bool(says), notes
    assert not says or says in notes[0]


def test_check_notes_objects_unknown_to_the_model(
    inside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxruntime")
    tiny_onnx = pytest.importorskip("tests.helpers.tiny_onnx", exc_type=ImportError)
    monkeypatch.chdir(inside)
    names = {"names": "{0: 'suitcase', 1: 'cup'}"}
    path = tiny_onnx.yolo(inside / "model.onnx", (64, 64), names)
    settings = {"detections": {"segmentation_model": path.name}}
    for labels, count in ((["mug"], 1), (["mug", "cup"], 0), ([], 0)):
        Path("objects.yaml").write_text(
            yaml.safe_dump({"cup": {"mesh": "cup.ply", "labels": labels}})
        )
        notes = check_segmentation_model(load_project(Path("config.yaml"), settings))
        assert len(notes) == count
        assert not notes or "(suitcase, cup) is a label of object 'cup' (mug)" in str(notes[0])


@pytest.mark.parametrize("model", ["segmentation_model", "keypoint_model"])
def test_check_reports_an_invalid_model(small_project: Path, model: str) -> None:
    (small_project / "model.onnx").write_text("not a model")
    config = small_project / "config.yaml"
    config.write_text(config.read_text() + f"detections: {{{model}: model.onnx}}\n")
    done = intercap("check", "config.yaml", folder=small_project)
    assert done.returncode == 1 and "model.onnx: " in done.stderr
    assert "Traceback" not in done.stderr
    (small_project / "model.onnx").unlink()
    done = intercap("check", "config.yaml", folder=small_project)
    assert f"{model} is model.onnx, and there is no such file" in done.stderr


@pytest.mark.parametrize("model", ["neutral", "vposer"])
@pytest.mark.parametrize("command", ["check", "run"])
def test_an_invalid_body_file_stops_before_any_job(
    small_project: Path, command: str, model: str
) -> None:
    (small_project / "body.npz").write_text("not a body")
    config = small_project / "config.yaml"
    config.write_text(config.read_text() + f"body_models: {{{model}: body.npz}}\n")
    done = intercap(command, "config.yaml", folder=small_project)
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    assert len(lines) == (5 if command == "check" else 1)  # check goes on with the recordings
    assert lines[0].startswith("problem: " if command == "check" else "error: ")
    assert " file body.npz " in lines[0]


@pytest.fixture
def detections(tmp_path: Path) -> Path:
    """A detections artefact of one camera and two frame sets."""
    path = tmp_path / "detections.h5"
    with artefacts.write(path, DETECTIONS, sequence="one") as writer:
        writer.put("camera_names", ["k1"])
        fill(writer, DETECTIONS, T=2, C=1)
    return path


def test_inspect_prints_attributes_and_datasets(detections: Path) -> None:
    done = intercap("inspect", str(detections), "--verify")
    assert done.returncode == 0, done.stderr
    assert "sequence  one" in done.stdout
    row = next(line for line in done.stdout.splitlines() if "keypoints_found" in line)
    assert "2 x 1" in row and "bool" in row
    assert "checksum is right" in done.stdout


def test_inspect_escapes_markup_and_marks_undeclared_entries(detections: Path) -> None:
    with h5py.File(detections, "r+") as file:
        file.attrs["sequence"] = "[/one] [red]two"
        file["extra"] = np.ones(3)
        file["scalar"] = True
    done = intercap("inspect", str(detections), "--verify")
    assert done.returncode == 0, done.stderr
    assert "sequence  [/one] [red]two" in done.stdout
    assert done.stdout.count("(not part of this schema)") == 2


def test_inspect_finds_damage(detections: Path) -> None:
    with h5py.File(detections) as file:
        offset = file["camera_names"].id.get_chunk_info(0).byte_offset
        size = file["camera_names"].id.get_chunk_info(0).size
    data = np.frombuffer(detections.read_bytes(), np.uint8).copy()
    data[offset : offset + size] ^= 0xFF
    detections.write_bytes(data.tobytes())
    done = intercap("inspect", str(detections), "--verify")
    assert done.returncode == 1
    assert "'camera_names' is damaged" in done.stderr
    assert "re-run stage 'detections'" in done.stderr


def test_a_stage_rejects_inputs_of_another_sequence(small_project: Path) -> None:
    place = small_project / "results" / "trial" / "good"
    place.mkdir(parents=True)
    write_frames(place / "frames.h5", ring(1)[0], num_sets=1)
    done = intercap("stage", "person", "config.yaml", "good", folder=small_project)
    assert done.returncode == 1
    assert done.stderr == (
        "error: results/trial/good/frames.h5: holds sequence 'test', expected 'good'; "
        "delete it and re-run stage 'frames' for sequence 'good'\n"
    )


def test_status_is_printed_on_terminals_of_any_encoding(inside: Path) -> None:
    output = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    Path("config.yaml").write_text("dataset: trial\nexclude: [bad, empty]\n")
    assert intercap("status", "config.yaml", folder=inside, output=output).returncode == 0
    assert "trial, 1 sequence: 1 not computed yet" in output.buffer.getvalue().decode("latin-1")


def test_reasons_with_markup_are_printed_literally(inside: Path) -> None:
    words = io.StringIO()
    watcher = Watcher(load_project(Path("config.yaml")), Console(file=words, width=200))
    log = Path("logs/trial/good/scene.log")
    log.parent.mkdir(parents=True)
    log.write_text("12:00:00 failed: a[/b] has [3] points\n")
    watcher.print_changes()
    assert words.getvalue() == "good: scene: failed a[/b] has [3] points\n"


def test_a_log_removed_while_it_is_read_is_ignored(inside: Path) -> None:
    watcher = Watcher(load_project(Path("config.yaml")), Console(file=io.StringIO()))
    gone = Path("logs/trial/good/scene.log")
    gone.parent.mkdir(parents=True)
    gone.symlink_to("removed.log")  # listed, but there is nothing behind it
    assert watcher.jobs() == {}


def test_the_studio_never_replaces_real_recordings(small_project: Path) -> None:
    place = small_project / "results" / "trial" / "recordings" / "good"
    place.parent.mkdir(parents=True)
    (small_project / "rec").rename(place)
    (small_project / "rig.json").rename(place / "calibration.json")
    (small_project / "sequences.tsv").write_text(
        "sequence\tsubject\tobject\trecordings\tcalibration\n"
        "good\ts01\tcup\tresults/trial/recordings/good"
        "\tresults/trial/recordings/good/calibration.json\n"
    )
    assert load_project(small_project / "config.yaml").recordings_made("good") is None
    done = intercap("dev", "studio", "config.yaml", "good", folder=small_project)
    assert done.returncode == 1 and "its recordings are real" in done.stderr


def test_a_run_without_a_terminal_prints_progress(inside: Path) -> None:
    project = load_project(Path("config.yaml"))
    watcher = Watcher(project, Console(file=io.StringIO()))
    watcher.transcript.parent.mkdir(parents=True)
    watcher.transcript.write_text("1 of 9 steps (11%) done\n3 of 9 steps (33%) done\n")
    logs = {"frames": "finished in 2.0 s", "person": "segmented 20 of 90 frames by depth"}
    for stage, last in logs.items():
        path = project.logs / "good" / f"{stage}.log"
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"12:00:00 started\n12:00:09 {last}\n")
    assert watcher.progress() == (
        "3 of 9 jobs done; 1 run: good: person (segmented 20 of 90 frames by depth)"
    )
