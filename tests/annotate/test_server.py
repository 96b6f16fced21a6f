"""What the page is given and what it may change; results that are old, missing or replaced."""

from __future__ import annotations

import base64
import gzip
import json
import shlex
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import yaml

from intercap_core.annotate import rerun
from intercap_core.annotate.server import MAX_WAITING
from intercap_core.annotation import Annotation
from intercap_core.errors import UserError
from intercap_core.output.viewer.page import unpacked
from tests.annotate.served import NAME, Served, annotation, artefact, copied, served, small_project

OF = f"sequences/{NAME}"


@pytest.fixture
def page(settings: Path) -> Iterator[Served]:
    with served(settings) as server:
        yield server


@pytest.fixture(scope="module")
def still(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The page of one copy of the project, for requests that change nothing."""
    with served(copied(made, tmp_path_factory.mktemp("still") / "project")) as server:
        yield server


def test_the_list_and_a_sequence_are_served(still: Served) -> None:
    rows = still.json("sequences")["sequences"]
    assert [row["name"] for row in rows] == [NAME] and not rows[0]["annotated"]
    answer = still.json(OF)
    assert answer["frames"] == 6 and answer["object"] == "football" and answer["viewer"]
    assert [entry["name"] for entry in answer["cameras"]] == ["k1", "k2", "k3"]
    assert answer["annotation"]["digest"] == "none"


def test_connections_without_a_request_shut_nobody_out(still: Served) -> None:
    waiting = [socket.create_connection(("127.0.0.1", still.port)) for _ in range(300)]
    for connection in waiting[:200]:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
    assert still.get("/")[0] == 200
    open_ = 0
    for connection in waiting:
        connection.settimeout(0.0)
        try:
            connection.recv(1)
        except BlockingIOError:
            open_ += 1
        except ConnectionResetError:
            pass
        connection.close()
    assert open_ <= MAX_WAITING


def test_images_come_as_large_as_they_are_shown(still: Served) -> None:
    for asked, wide in ((200, 240), (300, 320), (4000, 480)):
        status, data = still.get(f"/api/{OF}/image/k1/2?width={asked}")
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert status == 200 and image.shape[1] == wide
    assert still.get(f"/api/{OF}/image/k1/99?width=240")[0] == 422
    assert still.get(f"/api/{OF}/image/k9/0?width=240")[0] == 422


def test_the_objects_poses_are_the_joint_fits(still: Served, made: Path) -> None:
    _, data = still.get(f"/api/{OF}/object")
    _, arrays = unpacked(base64.b64encode(data).decode())
    with h5py.File(artefact(made, "joint")) as joint:
        assert np.allclose(arrays["poses/joint"][:, :, 3], joint["translation"][:], atol=1e-6)


@pytest.mark.parametrize("name", ["..", "../../etc/passwd", "%2e%2e", "nobody", "a/b"])
def test_only_sequences_of_the_table_are_known(still: Served, name: str) -> None:
    assert still.get(f"/api/sequences/{name}")[0] in (404, 405)
    assert still.get(f"/page/{name}/config.yaml")[0] == 404


def test_the_server_refuses_requests_without_token(still: Served) -> None:
    assert still.get("/api/sequences", **{"x-intercap-token": ""})[0] == 401
    assert still.get("/", host="evil.example")[0] == 400
    assert still.get("/")[0] == 200


def test_an_edit_is_checked_as_it_is_typed(still: Served) -> None:
    contact = [{"part": "right_hand", "start": 1, "end": 9}]
    _, answer = still.post(f"{OF}/check", {"changes": {"contact": contact}})
    assert answer["faults"] == [
        {"where": "contact", "message": "contact[0].end is 9, the recording has 6 frames"}
    ]
    contact[0]["end"] = 4
    _, answer = still.post(f"{OF}/check", {"changes": {"contact": contact}})
    assert (
        not answer["faults"] and "+  - {part: right_hand, start: 1, end: 4}" in answer["difference"]
    )
    _, answer = still.post(f"{OF}/check", {"changes": {"contact": [{"part": "tail"}]}})
    assert answer["faults"][0]["where"].startswith("contact.0")


_PLACE = {"rotation_vector": [0, 0, 0], "translation": [0, 0, 2]}


FAULTS: list[tuple[dict, str]] = [
    ({"contact": [{"part": "seat", "start": 1, "end": 9}]}, "contact[0].end is 9"),
    ({"object_poses": [{"frame": 6, **_PLACE}]}, "object_poses[0].frame is 6"),
    ({"subject": [{"camera": "k9", "x": 1, "y": 1}]}, "subject[0] names camera 'k9'"),
    ({"subject": [{"camera": "k1", "x": 1e9, "y": 1}]}, "camera k1 has 480 x 270 pixels"),
    ({"subject": [{"camera": "k1", "x": 1, "y": -1}]}, "subject[0] is at x 1, y -1"),
    ({"subject": [{"camera": "k1", "frame": 6, "x": 1, "y": 1}]}, "subject[0].frame is 6"),
    ({"left_right": [{"start": 0, "end": 2, "camera": "k9"}]}, "names camera 'k9'"),
    ({"left_right": [{"start": 0, "end": 7}]}, "left_right[0].end is 7"),
    ({"drop_frames": [0, 1, 2, 3, 4, 5]}, "drops all 6 frames"),
    ({"starts": {"k2": 0, "k3": 1}}, "lacks k1, the master"),
    ({"floor": [[0, 0, 1], [1, 0, 1], [1e9, 1, 1]]}, "millimetres"),
    ({"floor": [[0, 0, 1], [1, 0, 1], [0.5, 0.02, 1]]}, "on one line within 20 mm"),
]


def test_the_page_reports_the_same_faults_as_a_run(page: Served, settings: Path) -> None:
    path = annotation(settings)
    for changes, message in FAULTS:
        _, answer = page.post(f"{OF}/check", {"changes": changes})
        [fault] = answer["faults"]
        assert message in fault["message"]
        path.write_text(yaml.safe_dump(changes))
        with pytest.raises(UserError) as refused:
            page.annotator.project.annotation(NAME)
        assert fault["message"] in str(refused.value)
        _, answer = page.post(f"{OF}/check", {"changes": {}})  # of the file as it is, too
        assert answer["faults"] == [fault]
        path.unlink()


def test_a_click_outside_the_image_is_refused(still: Served) -> None:
    for x, y in ((-1, 5), (5, 270.5), (1e8, 5)):
        status, answer = still.post(f"{OF}/point", {"camera": "k1", "frame": 0, "x": x, "y": y})
        assert status == 422 and "outside of the image" in answer["error"]


def test_a_read_only_annotation_is_reported(page: Served, settings: Path) -> None:
    path = annotation(settings)
    path.write_text("drop_frames: [1]\n")
    path.chmod(0o444)
    answer = page.json(OF)
    assert "read-only" in answer["read_only"]
    digest = answer["annotation"]["digest"]
    status, answer = page.post(f"{OF}/save", {"digest": digest, "changes": {"drop_frames": [2]}})
    assert status == 422 and "read-only" in answer["error"]
    assert path.read_text() == "drop_frames: [1]\n"


def test_a_float_frame_number_is_a_fault(page: Served, settings: Path) -> None:
    """A page knows no 2.0 beside 2, a frame's number is a whole one."""
    annotation(settings).write_text("contact:\n- {part: seat, start: 2.0, end: 4}\n")
    contact = [{"part": "seat", "start": 2, "end": 4}, {"part": "any", "start": 0, "end": 1}]
    _, answer = page.post(f"{OF}/check", {"changes": {"contact": contact}})
    assert answer["faults"][0]["where"] == "contact.0.start"


def test_a_save_from_an_outdated_page_is_refused(page: Served, settings: Path) -> None:
    path = annotation(settings)
    path.write_text("# mine\ndrop_frames: [1] # dark\n")
    digest = page.json(f"{OF}/annotation")["digest"]
    pose = {"frame": 2, "rotation_vector": [0, 0.1, 0], "translation": [0, 0.2, 2.4]}
    content = {"digest": digest, "changes": {"object_pose": pose}}
    status, saved = page.post(f"{OF}/save", content)
    assert status == 200 and path.read_text().startswith("# mine\ndrop_frames: [1] # dark\n")
    assert Annotation.model_validate(yaml.safe_load(path.read_text())).object_pose is not None
    status, refused = page.post(f"{OF}/save", content)  # a second tab, with the older file
    assert status == 409 and refused["now"]["digest"] == saved["digest"]
    content = {"digest": saved["digest"], "changes": {"drop_frames": [77]}}
    status, refused = page.post(f"{OF}/save", content)
    assert status == 422 and "77" in refused["error"]


def test_name_and_time_are_saved_only_with_by(settings: Path) -> None:
    answers = annotation(settings).with_name(f"{NAME}.answers.jsonl")
    content = {"kind": "turn", "part": "", "answer": "yes", "from_s": 0.0, "to_s": 0.1}
    with served(settings) as page:
        assert page.post(f"{OF}/answer", content)[0] == 200
    with served(settings, by="ann") as page:
        assert page.post(f"{OF}/answer", content)[0] == 200
    without, named = map(json.loads, answers.read_text().splitlines())
    assert "by" not in without and "at" not in without
    assert named["by"] == "ann" and named["at"]


def test_a_save_succeeds_if_the_answer_log_fails(settings: Path) -> None:
    path = annotation(settings)
    path.with_name(f"{NAME}.answers.jsonl").mkdir(parents=True)
    with served(settings, by="ann") as page:
        content = {"digest": "none", "text": "", "changes": {"drop_frames": [1]}}
        assert page.post(f"{OF}/save", content)[0] == 200
    assert "drop_frames: [1]" in path.read_text()


@pytest.mark.parametrize(
    ("verb", "content"),
    [
        ("point", {"camera": "k1", "frame": None, "x": 1, "y": 2}),
        ("point", {"camera": "k1", "frame": 0, "x": [1], "y": 2}),
        ("point", {"camera": "k1", "frame": 0, "x": 10**400, "y": 2}),
        ("answer", {"kind": "turn", "part": "", "answer": "yes", "from_s": 10**400, "to_s": 1}),
        ("answer", {"kind": ["turn"], "part": "", "answer": "yes", "from_s": 0, "to_s": 1}),
        ("answer", {"kind": "turn", "part": "", "answer": "yes", "from_s": 0, "to_s": 1e300}),
    ],
)
def test_values_of_other_types_are_refused(still: Served, verb: str, content: dict) -> None:
    status, answer = still.post(f"{OF}/{verb}", content)
    assert status == 422 and "unexpected" not in str(answer)


def test_images_are_served_without_other_results(page: Served, settings: Path) -> None:
    for path in artefact(settings, "joint").parent.glob("*.h5"):
        if path.stem != "frames":
            path.unlink()
    answer = page.json(OF)
    assert answer["frames"] == 6 and not answer["viewer"]
    assert any("only images" in note for note in answer["notes"])
    assert page.get(f"/api/{OF}/image/k2/0?width=240")[0] == 200
    assert page.get(f"/api/{OF}/viewer")[0] == 422
    assert page.json(f"{OF}/questions") == []
    status, answer = page.post(
        f"{OF}/snap", {"frame": 0, "rotation_vector": [0, 0, 0], "translation": [0, 0, 2]}
    )
    assert status == 422 and "run it first" in answer["error"]


def test_before_the_first_run_the_page_names_the_command(page: Served, settings: Path) -> None:
    artefact(settings, "frames").unlink()
    answer = page.json(OF)
    assert answer["frames"] == 0 and "intercap run" in answer["notes"][0]


def test_a_result_of_another_version_is_reported(page: Served, settings: Path) -> None:
    with h5py.File(artefact(settings, "joint"), "r+") as file:
        file.attrs["schema_version"] = 1
    answer = page.json(OF)
    assert answer["frames"] == 6
    assert any("joint" in note and "re-run" in note for note in answer["notes"])
    status, answer = page.get(f"/api/{OF}/viewer")
    assert status == 422 and b"joint" in answer


def test_a_result_with_other_frames_is_not_drawn(page: Served, settings: Path) -> None:
    other = small_project(settings.parent / "shorter", total=4)
    shutil.copy(artefact(other, "joint"), artefact(settings, "joint"))
    answer = page.json(OF)
    assert any("has 4 frames, but 6 were read" in note for note in answer["notes"])
    assert "contact" not in answer and not answer["viewer"]


def test_missing_recordings_are_reported(still: Served) -> None:
    assert any("the recordings are missing" in note for note in still.json(OF)["notes"])


def test_changed_results_change_the_state(page: Served, settings: Path) -> None:
    before = page.json(f"{OF}/state")
    path = artefact(settings, "joint")
    shutil.copy(path, path.with_suffix(".new"))
    path.with_suffix(".new").replace(path)
    annotation(settings).write_text("drop_frames: [1]\n")
    after = page.json(f"{OF}/state")
    assert after["result"] != before["result"] and after["annotation"] != before["annotation"]
    assert page.get(f"/api/{OF}/object")[0] == 200


def test_an_edited_project_has_the_unsaved_annotation(page: Served, settings: Path) -> None:
    project = page.annotator.project
    edited = rerun.EditedProject.of(project, NAME, Annotation.model_validate({"drop_frames": [1]}))
    assert edited.annotation(NAME).drop_frames == (1,)
    assert project.annotation(NAME).drop_frames == ()
    command = rerun.command(project, NAME, profile=Path("profiles/slurm"))
    assert command[:2] == ["intercap", "run"] and "profiles/slurm" in command
    assert [Path(target).name for target in command[-3:]] == ["summary.h5", NAME, "export"]


def test_on_a_cluster_the_page_shows_the_command(settings: Path) -> None:
    with served(settings, profile=Path("profiles/slurm")) as page:
        status, answer = page.post(f"{OF}/run", {"do": "start"})
        assert status == 422 and "intercap run" in answer["error"]
        assert page.json(f"{OF}/run")["cluster"]


def test_commands_are_quoted_for_the_shell(made: Path, tmp_path: Path) -> None:
    settings = copied(made, tmp_path / "two words; $(x)")
    with served(settings) as page:
        answer = page.json(f"{OF}/run")["command"]
        assert shlex.split(answer)[:3] == ["intercap", "run", str(settings)]
        artefact(settings, "frames").unlink()
        assert shlex.quote(str(settings)) in page.json(OF)["notes"][0]


def test_unreadable_images_are_reported(page: Served, settings: Path) -> None:
    path = artefact(settings, "frames")
    path.write_bytes(path.read_bytes()[:3000])
    answer = page.json(OF)
    assert answer["frames"] == 0 and "frames.h5" in answer["notes"][0]
    assert page.json(f"{OF}/run")["command"]


def test_the_viewer_receives_only_the_result_compressed(still: Served) -> None:
    status, data = still.get(f"/api/{OF}/viewer")
    header, arrays = unpacked(base64.b64encode(data).decode())
    assert status == 200 and list(header["versions"]) == ["joint"]
    assert "joint/transforms" in arrays
    assert not [name for name in arrays if name.startswith(("sequential/", "truth/"))]
    _, answer = still.get(f"/api/{OF}", **{"accept-encoding": "gzip"})
    assert json.loads(gzip.decompress(answer))["frames"] == 6
