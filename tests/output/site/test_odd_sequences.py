"""Sequences with something wrong or missing: named, survived by the others, and listed."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import h5py
import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.pipeline.step import write_site
from intercap_core.project import Project, load_project
from intercap_core.schemas import METRICS
from tests.helpers import fitted_capture as fitted

GOOD = "s01_o09"
MARKUP = '<b onclick="x">p&01</b>'
Damage = Callable[[Path], object]  # of a sequence's folder


@pytest.fixture
def capture(captures: dict[str, fitted.Capture]) -> fitted.Capture:
    return captures[GOOD]


def _project(folder: Path, capture: fitted.Capture, copies: Iterable[str] = ()) -> Project:
    """A project of the measured capture without truth, and copies of it, with small pages."""
    path = fitted.write_project(folder, capture, GOOD)
    path.write_text(path.read_text() + "page: {cameras: 1, frames: 1}\n")
    results = folder / "results" / "trial"
    shutil.copy(capture.paths["metrics"], results / GOOD)
    for name in copies:
        shutil.copytree(results / GOOD, results / name)
        for artefact in (results / name).iterdir():
            _set(artefact, sequence=name)
    table = folder / "sequences.tsv"
    head, row = (line.rpartition("\t")[0] for line in table.read_text().splitlines())
    rows = [row, *(row.replace(GOOD, name, 1) for name in copies)]
    table.write_text("\n".join([head, *rows]) + "\n")
    return load_project(path)


def _set(artefact: Path, **attributes: object) -> None:
    with h5py.File(artefact, "r+") as file:
        for key, value in attributes.items():
            file.attrs[key] = value


def _of_another_body(folder: Path) -> None:
    with h5py.File(folder / "metrics.h5", "r+") as file:
        for name in ("body_to_object", "body_contact_distance"):
            distances = file[name][:, :1000]
            del file[name]
            file.create_dataset(name, data=distances, fletcher32=True)


DAMAGES: dict[str, tuple[Damage, list[str]]] = {
    "no_metrics": (lambda folder: (folder / "metrics.h5").unlink(), ["no_metrics/summary.h5"]),
    "other_version": (
        lambda folder: _set(folder / "metrics.h5", schema_version=METRICS.version + 1),
        ["other_version/metrics.h5", f"version {METRICS.version + 1}", "re-run stage 'metrics'"],
    ),
    "other_vertices": (_of_another_body, ["has 1000 vertices", "excluded from the body's heatmap"]),
    "other_body": (
        lambda folder: _set(folder / "joint.h5", body_model="0123"),
        ["another body file"],
    ),
}


def test_a_damaged_sequence_is_reported_and_others_are_shown(
    capture: fitted.Capture, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    project = _project(tmp_path, capture, DAMAGES)
    for name, (damage, _) in DAMAGES.items():
        damage(project.results / name)
    for stage in ("body_fit", "metrics"):
        _set(project.results / GOOD / f"{stage}.h5", subject=MARKUP)
    with caplog.at_level(logging.WARNING):
        overview = write_site(project)
    pages = overview.parent / "sequences"
    assert [path.name for path in pages.iterdir()] == [GOOD]
    text = overview.read_text()
    assert f"sequences/{GOOD}/index.html" in text
    for name, (_, expected) in DAMAGES.items():
        assert name in text
        for part in expected:
            assert part.replace("'", "&#39;") in text or part in caplog.text + text
    for shown in (text, (pages / GOOD / "index.html").read_text()):
        assert "<b onclick" not in shown
        assert "&lt;b onclick=&#34;x&#34;&gt;p&amp;01&lt;/b&gt;" in shown


def test_an_empty_dataset_names_its_sequences(capture: fitted.Capture, tmp_path: Path) -> None:
    project = _project(tmp_path, capture)
    shutil.rmtree(project.results / GOOD)
    with pytest.raises(UserError, match="dataset 'trial': no sequence has a result") as raised:
        write_site(project)
    assert GOOD in str(raised.value)


def test_a_sequence_without_contact_has_no_figures_of_it(
    capture: fitted.Capture, tmp_path: Path
) -> None:
    """The cup hangs a metre away: no contact frame, no close-up, no figure of penetration."""
    apart = capture.copied(tmp_path, "object_track", "joint", "metrics")
    for stage in ("object_track", "joint"):
        with apart.edit(stage) as file:
            file["translation"][..., 0] += 1.0
    with apart.edit("joint") as file:
        file["contact_probability"][...] = 0.01
    apart.measure(hold_out=False)
    (tmp_path / "project").mkdir()
    overview = write_site(_project(tmp_path / "project", apart))
    text = overview.read_text()
    page = (overview.parent / "sequences" / GOOD / "index.html").read_text()
    assert "maximum 0.0 % of 4 frames" in text and ">nan" not in text
    assert "<b>0 %</b><small>of the frames" in page and " hand, frames " not in page
    assert "<span>penetration</span><b>–</b>" in page
    with h5py.File(overview.parents[1] / GOOD / "summary.h5") as file:
        assert not np.any(file["contact_frame"][()])
