"""The metrics stage on a capture whose errors are known."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.flags import PARTS
from intercap_core.schemas import METRIC_REGIONS, METRICS
from tests.helpers import fitted_capture as fitted


@pytest.fixture(scope="module")
def measured(
    capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, np.ndarray]:
    output = capture.measure(tmp_path_factory.mktemp("measured") / "metrics.h5", truth=True)
    with artefacts.read(output, METRICS) as artefact:
        assert artefact.attributes["has_truth"]
        return {key: artefact[key] for key in artefact.keys()}  # noqa: SIM118


def test_errors_are_the_offsets_that_were_put_in(measured: dict[str, np.ndarray]) -> None:
    for stage in ("body_fit", "joint"):
        for key in ("body_pve", "body_mpjpe", "hand_mpjpe"):
            found = measured[f"truth/{stage}/{key}"]
            assert found == pytest.approx(fitted.BODY_OFFSET_M, abs=1e-6)
        assert measured[f"truth/{stage}/hand_mpjpe_wrist"] == pytest.approx(0, abs=1e-6)
    offsets = {"object_track": fitted.OBJECT_OFFSET_M, "joint": fitted.OBJECT_OFFSET_M / 2}
    for stage, offset in offsets.items():
        assert measured[f"truth/{stage}/object_translation"] == pytest.approx(offset, abs=1e-6)
        assert measured[f"truth/{stage}/object_rotation"] == pytest.approx(0, abs=1e-4)
        assert measured[f"truth/{stage}/acceleration_object"][1:-1] == pytest.approx(0, abs=1e-6)


def test_stages_have_only_what_they_estimate(measured: dict[str, np.ndarray]) -> None:
    assert "truth/object_track/body_pve" not in measured
    assert "truth/object_track/region_contact" not in measured
    assert "truth/body_fit/object_translation" not in measured
    assert "truth/body_fit/joint_normalised" in measured


def test_extrinsics_errors_before_and_after(measured: dict[str, np.ndarray]) -> None:
    unknown = np.nan  # of the master
    before, after = (measured[f"truth/extrinsics_{when}"] for when in ("before", "after"))
    assert before == pytest.approx([unknown, 0.012, 0], abs=1e-6, nan_ok=True)
    assert after == pytest.approx([unknown, 0, 0], abs=1e-6, nan_ok=True)


def test_contact_is_the_right_hand(measured: dict[str, np.ndarray]) -> None:
    hand = METRIC_REGIONS.index("right_hand")
    assert measured["region_contact"][:, hand].all()
    assert measured["truth/joint/region_contact"][:, hand].all()
    assert measured["contact_frame"].all() and measured["truth/contact_frame"].all()
    assert measured["object_sample_contact"].max() == len(measured["contact_frame"])
    near = measured["object_sample_contact"] > 0
    assert 0.001 < near.mean() < 0.2


def test_distances_agree_with_an_independent_search(
    capture: fitted.Capture, measured: dict[str, np.ndarray]
) -> None:
    import trimesh

    t = 2
    vertices = capture.vertices[t] + np.array([0, fitted.BODY_OFFSET_M, 0])
    translation = capture.translation[t] + np.array([0, fitted.OBJECT_OFFSET_M / 2, 0])
    ball = trimesh.Trimesh(capture.mesh.vertices, capture.mesh.faces, process=False)
    chosen = np.argsort(np.linalg.norm(vertices - translation, axis=1))[:300]
    query = trimesh.proximity.ProximityQuery(ball)
    expected = -query.signed_distance(vertices[chosen] - translation)
    assert measured["body_to_object"][t, chosen] == pytest.approx(expected, abs=2e-6)
    person = trimesh.Trimesh(vertices, capture.model.faces.numpy(), process=False)
    nearest = np.argsort(measured["object_to_body"][t])[:40]
    # all faces, one by one: trimesh's own search returned one that is 2 micrometres farther
    distance = [
        np.linalg.norm(trimesh.triangles.closest_point(person.triangles, here) - here, axis=1).min()
        for here in (
            np.broadcast_to(point, (len(person.faces), 3))
            for point in ball.vertices[nearest] + translation
        )
    ]
    assert np.abs(measured["object_to_body"][t, nearest]) == pytest.approx(distance, abs=5e-7)


def test_penetration_is_that_of_the_distances(measured: dict[str, np.ndarray]) -> None:
    distance = measured["body_to_object"][1]
    inside = -distance[distance < 0]
    assert measured["penetration_mean"][1] == pytest.approx(inside.mean(), rel=1e-5)
    assert measured["penetration_median"][1] == pytest.approx(np.median(inside), rel=1e-5)
    assert measured["penetration_max"][1] == pytest.approx(inside.max(), rel=1e-5)
    assert measured["ground_penetration"] == pytest.approx(fitted.BODY_OFFSET_M, abs=1e-5)


def test_the_floor_of_cloud_distances_is_below_the_fit(measured: dict[str, np.ndarray]) -> None:
    # pixels of the depth images are 12 mm apart on the body: no point is nearer than some 5 mm
    for key in ("body", "object"):
        for visible in ("", "_visible"):
            fit = measured[f"{key}{visible}_to_cloud"].mean()
            floor = measured[f"truth/{key}{visible}_floor"].mean()
            assert 0.003 < floor < 0.010
            assert floor - 1e-4 < fit < floor + 0.010
    assert (measured["truth/body_visible_floor"] < measured["truth/body_floor"]).all()


def test_flags_carry_every_reason(measured: dict[str, np.ndarray]) -> None:
    assert measured["flag_reason"].tolist() == [
        fitted.FLAG_REASON, "", "", "",
        "body, hands, contact: person seen in fewer than two views, without depth",
    ]  # fmt: skip
    parts = [PARTS[p] for p in np.flatnonzero(measured["flagged"][0])]
    assert parts == ["object", "contact"]  # the body of this frame is measured
    parts = [PARTS[p] for p in np.flatnonzero(measured["flagged"][4])]
    assert parts == ["body", "hands", "contact"]
    assert not measured["flagged"][1:4].any()


def test_the_hand_carries_the_object(measured: dict[str, np.ndarray]) -> None:
    pytest.importorskip("mujoco", reason="the extra physics is not installed")
    carriers = [str(name) for name in measured["physics/carrier"]]
    assert carriers == ["body"] * len(carriers)
    assert not len(measured["physics/release_frame"]) and not measured["physics/bad"].any()


def test_without_the_library_the_extra_is_named(
    capture: fitted.Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)  # its import fails
    output = capture.measure(tmp_path / "metrics.h5")
    with artefacts.read(output, METRICS) as artefact:
        assert not artefact.keys("physics/")
        assert "intercap-core[physics]" in str(artefact.attributes["physics_note"])


def test_without_truth_all_other_values_are_the_same(
    capture: fitted.Capture, measured: dict[str, np.ndarray], tmp_path: Path
) -> None:
    output = capture.measure(tmp_path / "metrics.h5")  # the verdict reads no truth either
    with artefacts.read(output, METRICS) as artefact:
        assert not artefact.keys("truth/")
        for key in artefact.keys():  # noqa: SIM118
            if key.endswith("visible_to_cloud"):  # seen by the fit instead of by the truth
                assert artefact[key] == pytest.approx(measured[key], abs=2e-3)
            elif measured[key].dtype == object:
                assert artefact[key].tolist() == measured[key].tolist()
            else:
                assert np.array_equal(artefact[key], measured[key], equal_nan=True)


def test_truth_at_other_times_is_rejected(capture: fitted.Capture, tmp_path: Path) -> None:
    late = capture.copied(tmp_path, "truth")
    with late.edit("truth") as file:
        file["times"][...] += 0.05
    with pytest.raises(UserError, match=r"truth\.h5: holds 5 frames, the recording 5"):
        late.measure(tmp_path / "metrics.h5", truth=True)


def test_truth_of_another_recording_is_noticed(
    capture: fitted.Capture, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = capture.copied(tmp_path, "truth")
    with other.edit("truth") as file:
        for key in ("body_vertices", "translation"):
            file[key][...] += 0.5
    other.measure(tmp_path / "metrics.h5", truth=True, hold_out=False)
    assert "truth of another recording" in caplog.text
