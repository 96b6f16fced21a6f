"""Which outputs an edit makes stale, of a project whose outputs are all there.

The plan reads nothing of an output but its manifest, so empty files stand for the outputs.
tests/workflow checks that Snakemake follows the plan.
"""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
import yaml

from intercap_core.commands.release import write_release
from intercap_core.commands.status import print_status, print_verification
from intercap_core.errors import UserError
from intercap_core.inputs.files import referenced_files
from intercap_core.pipeline import checksums
from intercap_core.pipeline.checksums import remember_output
from intercap_core.pipeline.plan import OutputStatus, Plan, mark_of
from intercap_core.pipeline.provenance import DATASET_OUTPUTS, FILE, read_manifest, write_manifest
from intercap_core.project import Project, load_project
from intercap_core.stage_list import STAGES
from tests.helpers.flow import ONE, OTHER
from tests.helpers.manifests import rewrite_manifests

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = Path("config/test/config.yaml")
AFTER_METRICS = {"summary", "page", "export"}
AFTER_JOINT = {"metrics", *AFTER_METRICS}
AFTER_SCENE = {"scene", "person", "object_track", "body_fit", "joint", *AFTER_JOINT}
DATASET = {("", "dataset")}
CONTACT = "contact:\n- {part: right_hand, start: 1, end: 4}\n"
FLOOR = "floor: [[0.0, 1.0, 2.0], [1.0, 1.0, 2.0], [0.0, 1.0, 3.0]]\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of config/test with two virtual recordings; all outputs are up to date."""
    folder = tmp_path_factory.mktemp("made")
    shutil.copytree(ROOT / "config", folder / "config")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        project = load_project(SETTINGS)
        for name in project.sequences:
            recordings = project.recordings_made(name)
            assert recordings is not None
            recordings.mkdir(parents=True)
            for file in ("capture.json", "truth.h5", "calibration.yaml", "k1.mp4"):
                (recordings / file).write_text("made")
            for stage in STAGES:
                _write(project.artefact(name, stage))
        for file in DATASET_OUTPUTS:
            _write(project.results / file)
        _bring_up_to_date(project)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy that a test may change; the working directory."""
    shutil.copytree(made, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    return tmp_path / "copy"


def _write(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".h5":
        h5py.File(path, "w").close()
    elif path.suffix:
        path.touch()
    else:
        path.mkdir()
        (path / "index.html").touch()


def _bring_up_to_date(project: Project) -> None:
    rewrite_manifests(project)
    for name in project.sequences:
        for stage in STAGES:
            remember_output(project.artefact(name, stage))
        remember_output(project.results / "recordings" / name)
    remember_output(project.results)


def _pending() -> set[tuple[str, str]]:
    """(sequence, stage) of every output that a run would make; sequence "" for the dataset's."""
    plan = Plan(load_project(SETTINGS))
    pending = {
        (name, stage)
        for name in plan.project.sequences
        for stage, state in plan.states(name).items()
        if state.status is not OutputStatus.done
    }
    assert plan.all_done() == (not pending and plan.dataset.status is OutputStatus.done)
    return pending | (DATASET if plan.dataset.status is not OutputStatus.done else set())


def _annotate(folder: Path, text: str, sequence: str = OTHER) -> None:
    path = folder / SETTINGS.parent / "annotations" / f"{sequence}.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


def _set(folder: Path, **settings: object) -> None:
    path = folder / SETTINGS
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **settings}))


def _of(name: str, *stages: str) -> set[tuple[str, str]]:
    return {(name, stage) for stage in stages}


@pytest.mark.parametrize(
    ("text", "stages"),
    [
        (CONTACT, {"joint", *AFTER_JOINT}),
        (FLOOR, AFTER_SCENE),
        (
            "object_pose: {rotation_vector: [0, 0, 0], translation: [0, 0, 2]}\n",
            {"object_track", "joint", *AFTER_JOINT},
        ),
        ("drop_frames: [2]\n", {"frames", "detections", *AFTER_SCENE}),
        ("subject: [{camera: k1, frame: 0, x: 612, y: 340}]\n", AFTER_SCENE - {"scene"}),
        ("# nothing yet\ncontact:\n", set()),
    ],
)
def test_an_annotation_reruns_from_the_stage_that_reads_it(
    folder: Path, text: str, stages: set[str]
) -> None:
    assert _pending() == set()
    _annotate(folder, text)
    assert _pending() == _of(OTHER, *stages) | (DATASET if stages else set())


def test_a_section_reruns_only_its_own_stages(folder: Path) -> None:
    """Contact and floor are annotated; then one of them is edited, or both are reordered."""
    _annotate(folder, CONTACT + FLOOR)
    _bring_up_to_date(load_project(SETTINGS))
    _annotate(folder, "# a comment, and the same content\n" + FLOOR + CONTACT)
    assert _pending() == set()
    _annotate(folder, FLOOR + CONTACT.replace("end: 4", "end: 5"))
    assert _pending() == _of(OTHER, "joint", *AFTER_JOINT) | DATASET
    _annotate(folder, CONTACT + FLOOR.replace("2.0", "2.1"))
    assert _pending() == _of(OTHER, *AFTER_SCENE) | DATASET


def test_a_setting_reruns_its_own_stage(folder: Path) -> None:
    _set(folder, page={"frames": 2})
    # the site's first page lists settings that differ from the defaults
    assert _pending() == _of(ONE, "page") | _of(OTHER, "page") | DATASET
    _set(folder, page={}, joint={"ground_weight": 2.0})
    stages = {"joint", *AFTER_JOINT}
    assert _pending() == _of(ONE, *stages) | _of(OTHER, *stages) | DATASET


def test_another_model_reruns_the_detections(folder: Path) -> None:
    """A model counts by its content, not by its path."""
    model = folder / SETTINGS.parent / "model.onnx"
    model.write_text("one")
    _set(folder, detections={"segmentation_model": model.name})
    stages = {"detections", *AFTER_SCENE}
    expected = _of(ONE, *stages) | _of(OTHER, *stages) | DATASET
    assert _pending() == expected
    _bring_up_to_date(load_project(SETTINGS))
    assert _pending() == set()
    model.write_text("another")
    assert _pending() == expected


def _reuse(folder: Path, named: str, column: str = "rig_from") -> None:
    """Let the row ``OTHER`` name a sequence in its column."""
    path = folder / SETTINGS.parent / "sequences.tsv"
    header, *rows = path.read_text().splitlines()
    cells = [f"{row}\t{named if row.startswith(OTHER) else ''}" for row in rows]
    path.write_text("\n".join([f"{header}\t{column}", *cells, ""]))


def test_another_sequence_whose_cameras_are_reused_counts(folder: Path) -> None:
    """The manifest names the other scene, and what makes that one stale makes this one stale."""
    _reuse(folder, "")
    assert _pending() == set()
    shutil.copy(ROOT / SETTINGS.parent / "sequences.tsv", SETTINGS.parent)
    _reuse(folder, ONE)
    expected = _of(OTHER, *AFTER_SCENE) | DATASET
    assert _pending() == expected
    reasons = Plan(load_project(SETTINGS)).states(OTHER)["scene"].reasons
    assert f"scene of {ONE} is now read" in reasons
    _bring_up_to_date(load_project(SETTINGS))
    assert _pending() == set()
    _annotate(folder, FLOOR, ONE)
    assert _pending() == _of(ONE, *AFTER_SCENE) | expected
    reasons = Plan(load_project(SETTINGS)).states(OTHER)["scene"].reasons
    assert reasons == (f"scene of {ONE} changed",)


def test_another_sequence_whose_shape_is_reused_counts(folder: Path) -> None:
    """A change of the other's body makes this one's stale, and no stage before it."""
    table = folder / SETTINGS.parent / "sequences.tsv"
    table.write_text(table.read_text().replace("\ts04\t", "\ts03\t"))
    _bring_up_to_date(load_project(SETTINGS))
    _reuse(folder, ONE, "shape_from")
    expected = _of(OTHER, "body_fit", "joint", *AFTER_JOINT) | DATASET
    assert _pending() == expected
    _bring_up_to_date(load_project(SETTINGS))
    assert _pending() == set()
    _annotate(folder, "subject: [{camera: k1, frame: 0, x: 612, y: 340}]\n", ONE)
    assert _pending() == _of(ONE, *AFTER_SCENE - {"scene"}) | expected
    reasons = Plan(load_project(SETTINGS)).states(OTHER)["body_fit"].reasons
    assert reasons == (f"body_fit of {ONE} changed",)


def test_cameras_of_an_excluded_sequence_are_reused_as_they_are(folder: Path) -> None:
    _reuse(folder, ONE)
    _bring_up_to_date(load_project(SETTINGS))
    _set(folder, exclude=[ONE])
    assert _pending() == DATASET
    scene = load_project(SETTINGS).artefact(ONE, "scene")
    made_from = read_manifest(scene)
    assert made_from is not None
    write_manifest(scene, replace(made_from, libraries={"numpy": "0"}))
    assert _pending() == _of(OTHER, *AFTER_SCENE) | DATASET


def test_another_seed_makes_another_recording(folder: Path) -> None:
    text = (folder / SETTINGS).read_text()
    (folder / SETTINGS).write_text(text.replace("seed: 22", "seed: 23"))
    assert _pending() == _of(OTHER, "studio", *STAGES) | DATASET


def test_a_restored_result_of_other_settings_is_stale(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = load_project(SETTINGS)
    path = project.artefact(ONE, "scene")
    manifest = read_manifest(path)
    assert manifest is not None
    settings = {**manifest.given["settings"], "voxel_mm": 0.5}
    write_manifest(path, replace(manifest, given={**manifest.given, "settings": settings}))
    remember_output(path)
    assert _pending() == _of(ONE, "scene")  # what was made of the right one stays
    print_status(project)
    printed = capsys.readouterr().out
    assert f"scene out of date in {ONE}: settings: voxel_mm 0.5 → none" in printed


def test_a_damaged_artefact_is_stale(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = load_project(SETTINGS)
    project.artefact(ONE, "person").write_bytes(b"damaged")
    assert _pending() == _of(ONE, "person")
    print_status(project)
    reason = "what it was made from is not recorded, or the file is damaged"
    assert f"person out of date in {ONE}: {reason}" in capsys.readouterr().out


def test_another_processor_is_reported_and_reruns_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = load_project(SETTINGS)
    path = project.artefact(ONE, "joint")
    manifest = read_manifest(path)
    assert manifest is not None
    write_manifest(path, replace(manifest, machine={"device": "cuda", "cpu": "another"}))
    remember_output(path)
    assert _pending() == set()
    print_status(project)
    printed = capsys.readouterr().out
    assert "2 sequences: 2 done" in printed
    assert "1 results were computed on another machine or device (cuda, another)" in printed


def test_of_a_sequence_without_results_no_recording_is_read(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(path: Path) -> str:
        assert "recordings" not in path.parts, f"{path} was read"
        return digest(path)

    shutil.rmtree(folder / "results" / "test" / ONE)
    shutil.rmtree(folder / "results" / "test" / "site")
    digest = checksums.file_digest
    monkeypatch.setattr(checksums, "file_digest", never)
    plan = Plan(load_project(SETTINGS))
    states = {stage: state.status for stage, state in plan.states(ONE).items()}
    assert states.pop("studio") is OutputStatus.done
    assert states == dict.fromkeys(STAGES, OutputStatus.missing)
    assert plan.mark(ONE, "joint") == []


def test_broken_annotation_makes_all_stages_wait(folder: Path) -> None:
    _annotate(folder, CONTACT.replace("end: 4", "end: 0"))
    assert "interval is reversed" in Plan(load_project(SETTINGS)).annotation_fault(OTHER)
    assert _pending() == _of(OTHER, *STAGES) | DATASET
    _annotate(folder, CONTACT)
    assert Plan(load_project(SETTINGS)).annotation_fault(OTHER) == ""


def test_companion_files_of_a_mesh_count(folder: Path) -> None:
    mesh = load_project(SETTINGS).objects["cup"].mesh
    mesh.with_suffix(".mtl").write_text("newmtl cup\n")
    plan = Plan(load_project(SETTINGS))
    (reason,) = plan.states(OTHER)["studio"].reasons
    assert f"mesh/{mesh.stem}.mtl" in reason


@pytest.mark.parametrize(
    ("file", "pending"),
    [
        ("site/index.html", DATASET),
        ("summary.json", DATASET),
        ("heatmaps.h5", DATASET),
        ("tables/frames.csv", DATASET),
        ("export/coco/annotations.json", DATASET),
        (f"{ONE}/export/amass/body.npz", _of(ONE, "export")),
        (f"site/sequences/{ONE}/viewer/data.bin", _of(ONE, "page")),
        (f"recordings/{OTHER}/k1.mp4", _of(OTHER, "studio", *STAGES) | DATASET),
    ],
)
def test_a_cut_or_missing_file_of_any_output_is_made_again(
    folder: Path, file: str, pending: set[tuple[str, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    project = load_project(SETTINGS)
    path = project.results / file
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".h5":
        path.write_bytes(b"content")
    _bring_up_to_date(project)
    assert _pending() == set() and print_verification(project)
    path.write_bytes(path.read_bytes()[:-1])
    assert _pending() == pending
    capsys.readouterr()
    assert not print_verification(project)
    assert f"{path}: has " in capsys.readouterr().out
    path.unlink()
    assert _pending() == pending
    assert not print_verification(project)
    assert f"{path}: is missing" in capsys.readouterr().out


def test_an_output_of_another_sequence_is_no_output(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = load_project(SETTINGS)
    shutil.copy(project.artefact(OTHER, "joint"), project.artefact(ONE, "joint"))
    assert not print_verification(project)
    assert f"was made as joint of {OTHER}" in capsys.readouterr().out


def test_files_that_a_mesh_names_count(folder: Path) -> None:
    """Also through another file, in a folder, with an encoded name."""
    mesh = load_project(SETTINGS).objects["cup"].mesh
    (mesh.parent / "maps").mkdir()
    (mesh.parent / "2").mkdir()  # of which a face, "2/1", says nothing
    (mesh.parent / "2" / "1").write_text("frame 1")
    with mesh.open("ab") as file:
        file.write(b"comment TextureFile red.mtl 2/1\n")
    (mesh.parent / "red.mtl").write_text("map_Kd maps\\red%20one.png\n")
    texture = mesh.parent / "maps" / "red one.png"
    assert mesh.parent / "2/1" not in referenced_files(mesh)
    for content in ("red", "blue"):
        texture.write_text(content)
        (reason,) = [
            reason
            for reason in Plan(load_project(SETTINGS)).states(OTHER)["studio"].reasons
            if content == "blue"
        ] or [""]
        if content == "red":
            _bring_up_to_date(load_project(SETTINGS))
            assert _pending() == set()
    assert "mesh/maps/red one.png has another content" in reason


def test_external_weights_of_a_model_count(folder: Path) -> None:
    model = folder / SETTINGS.parent / "model.onnx"
    model.write_bytes(b"\x0a\x08location\x12\x0bweights.bin")
    model.with_name("weights.bin").write_bytes(b"one")
    _set(folder, detections={"segmentation_model": model.name})
    _bring_up_to_date(load_project(SETTINGS))
    assert _pending() == set()
    model.with_name("weights.bin").write_bytes(b"two")
    stages = {"detections", *AFTER_SCENE}
    assert _pending() == _of(ONE, *stages) | _of(OTHER, *stages) | DATASET


def test_a_moved_project_stays_up_to_date(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The body model, the meshes and the settings lie outside the working directory."""
    settings = folder / SETTINGS
    text = settings.read_text()
    shutil.copy(settings, settings.with_name("body.npz"))
    settings.write_text(f"{text}\nbody_models: {{neutral: {settings.with_name('body.npz')}}}\n")
    _bring_up_to_date(load_project(SETTINGS))
    assert _pending() == set()
    moved = tmp_path / "elsewhere" / "deeper"
    moved.parent.mkdir()
    monkeypatch.chdir(tmp_path)
    folder.rename(moved)
    monkeypatch.chdir(moved)
    settings = moved / SETTINGS
    settings.write_text(f"{text}\nbody_models: {{neutral: {settings.with_name('body.npz')}}}\n")
    assert _pending() == set()


def test_no_output_or_mark_is_dated_ahead_of_the_clock(folder: Path) -> None:
    """Snakemake refuses an output that is older than an input, and removes it."""
    project = load_project(SETTINGS)
    ahead = time.time() + 7200
    for path in project.results.rglob("*"):
        os.utime(path, (ahead, ahead))
    _set(folder, joint={"ground_weight": 2.0})
    plan = Plan(load_project(SETTINGS))
    plan.mark_all()
    assert plan.is_stale(ONE, "joint") and not plan.is_stale(ONE, "body_fit")
    for name in project.sequences:
        for stage in plan.states(name):
            output = plan.output(name, stage)
            assert output.stat().st_mtime <= time.time()
            for mark in plan.mark(name, stage):
                assert mark == mark_of(project, name, stage)
                assert output.stat().st_mtime < mark.stat().st_mtime < time.time() + 0.001


def test_marks_are_newer_where_dates_are_whole_seconds(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise Snakemake would not run the job of a stale output."""
    project = load_project(SETTINGS)
    set_date = os.utime

    def in_seconds(path: Path, times: object = None, *, ns: tuple[int, int] = (0, 0)) -> None:
        if ns[0]:
            set_date(path, ns=(ns[0] // 10**9 * 10**9, ns[1] // 10**9 * 10**9))

    for path in project.results.rglob("*.h5"):
        in_seconds(path, ns=(path.stat().st_mtime_ns, path.stat().st_mtime_ns))
    _set(folder, joint={"ground_weight": 2.0})
    monkeypatch.setattr(os, "utime", in_seconds)
    plan = Plan(load_project(SETTINGS))
    plan.mark_all()
    (mark,) = plan.mark(ONE, "joint")
    assert mark.stat().st_mtime_ns == plan.output(ONE, "joint").stat().st_mtime_ns + 10**9


@pytest.mark.parametrize("target", ["nowhere", "README.md", "joint.h5"])
def test_an_output_that_is_a_link_to_nothing_is_missing(
    folder: Path, target: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Snakemake fails at a link to itself."""
    project = load_project(SETTINGS)
    paths = (project.results / "README.md", project.artefact(ONE, "joint"))
    for path in paths:
        path.unlink()
        path.symlink_to(target)
    Plan(load_project(SETTINGS)).mark_all()
    assert not any(path.is_symlink() and not path.exists() for path in paths)
    assert caplog.text.count(f"removed, it was a link to {target}") == 2
    assert _pending() >= _of(ONE, "joint") | DATASET


@pytest.mark.parametrize("fault", ["cut", "all missing"])
def test_a_release_refuses_damaged_and_incomplete_sequences(folder: Path, fault: str) -> None:
    project = load_project(SETTINGS)
    page = project.artefact(OTHER, "page")
    (page / "index.html").write_text("page")
    _bring_up_to_date(project)
    if fault == "cut":
        (page / "index.html").write_text("pa")
    else:
        shutil.rmtree(project.results / OTHER)
        shutil.rmtree(page)
    with pytest.raises(UserError, match=rf"outputs of {OTHER} are damaged or missing"):
        write_release(project, ["card"])
    assert not (project.results / "release.json").exists()


def test_a_folder_without_a_list_of_its_files_is_made_again(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As versions wrote them that listed no files."""
    project = load_project(SETTINGS)
    _bring_up_to_date(project)
    for output in (project.artefact(ONE, "page"), project.results):
        manifest = read_manifest(output)
        assert manifest is not None
        (output / FILE).write_text(replace(manifest, outputs={}).to_text())
    assert _pending() == _of(ONE, "page") | DATASET
    assert not print_verification(project)
    printed = capsys.readouterr().out
    assert printed.count("does not list the folder's files; run again") == 2
    assert "delete" not in printed


def test_marking_changes_no_date_of_an_output(folder: Path) -> None:
    """The results may belong to another user, and a changed date has them read again."""
    project = load_project(SETTINGS)
    _set(folder, joint={"ground_weight": 2.0})
    before = {path: path.stat().st_mtime_ns for path in project.results.rglob("*.h5")}
    Plan(load_project(SETTINGS)).mark_all()
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_release_refuses_outputs_of_the_dataset_with_excluded_sequences(folder: Path) -> None:
    """Merged exports would still hold the images of a sequence that is excluded."""
    _bring_up_to_date(load_project(SETTINGS))
    _set(folder, exclude=[ONE])
    with pytest.raises(UserError, match="are of other sequences"):
        write_release(load_project(SETTINGS), ["card"])


def test_files_of_equal_names_in_folders_behind_links_count(folder: Path) -> None:
    mesh = load_project(SETTINGS).objects["cup"].mesh
    outside = folder / "textures"
    for name in ("inner", "outer"):
        (outside / name).mkdir(parents=True)
        (outside / name / "map.png").write_text("red")
    (outside / "outer" / "inner").symlink_to(mesh.parent.resolve())  # back, without an end
    (mesh.parent / "inner").symlink_to(outside / "inner")
    (mesh.parent / "outer").symlink_to(outside / "outer")
    (mesh.parent / "comment").symlink_to("nowhere")  # dangling before and after
    with mesh.open("ab") as file:
        file.write(b"comment TextureFile inner/map.png\ncomment TextureFile outer/map.png\n")
    _bring_up_to_date(load_project(SETTINGS))
    assert _pending() == set()
    for name in ("inner", "outer"):
        (outside / name / "map.png").write_text("blue")
        (reason,) = Plan(load_project(SETTINGS)).states(OTHER)["studio"].reasons
        assert f"{name}/map.png has another content" in reason
        _bring_up_to_date(load_project(SETTINGS))


def test_consecutive_stages_that_are_not_done_share_a_job(folder: Path) -> None:
    groups = [["frames", "detections", "scene", "person"], ["metrics", "summary", "page"]]
    _set(folder, one_process=groups)

    def shared(**options: set[str]) -> list[tuple[str, ...]]:
        return Plan(load_project(SETTINGS)).shared_jobs(OTHER, **options)

    project = load_project(SETTINGS)
    assert shared() == []
    _annotate(folder, CONTACT)  # joint and later stages
    assert shared() == [("metrics", "summary", "page")]
    for stage in ("detections", "person"):
        project.artefact(OTHER, stage).unlink()
    assert shared() == [("metrics", "summary", "page")]
    project.artefact(OTHER, "scene").unlink()
    assert shared() == [("detections", "scene", "person"), ("metrics", "summary", "page")]
    assert shared(alone={"summary"}) == [("detections", "scene", "person")]
    assert shared(last={"scene", "summary"}) == [("detections", "scene"), ("metrics", "summary")]


@pytest.mark.parametrize(
    "groups",
    [[["scene", "frames"]], [["frames", "scene"]], [["page"], ["joint"]], [["walk"]], [[]]],
)
def test_groups_of_other_stages_are_refused(folder: Path, groups: list[list[str]]) -> None:
    _set(folder, one_process=groups)
    with pytest.raises(UserError, match="expected to name consecutive stages"):
        load_project(SETTINGS)
