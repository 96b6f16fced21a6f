"""Sequences with something wrong or missing: named, survived by the others, and listed."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from intercap_core.commands.report import write_site
from intercap_core.errors import UserError
from intercap_core.project import load_project
from intercap_core.schemas import METRICS
from tests.helpers import fitted_capture as fitted
from tests.helpers.site import MEASURED, measure

GOOD, ODD = "good", "odd"
Damage = Callable[[Path], object]  # of a sequence's folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    made = fitted.make_capture(tmp_path_factory.mktemp("capture"), name=GOOD, total=3)
    measure(made)
    return made


@pytest.fixture
def settings(capture: fitted.Capture, tmp_path: Path) -> Path:
    """A project of two sequences, all computed: the second one is a copy of the first."""
    path = fitted.write_project(tmp_path, capture, GOOD)
    folder = tmp_path / "results" / "trial"
    shutil.copy(capture.paths["metrics"], folder / GOOD)
    shutil.copytree(folder / GOOD, folder / ODD)
    for artefact in (folder / ODD).iterdir():
        _set(artefact, sequence=ODD)
    table = tmp_path / "sequences.tsv"
    head, row = table.read_text().splitlines()
    rows = [row.rpartition("\t")[0], row.rpartition("\t")[0].replace(GOOD, ODD, 1)]
    table.write_text("\n".join([head.rpartition("\t")[0], *rows]) + "\n")
    return path


def _set(artefact: Path, **attributes: object) -> None:
    with h5py.File(artefact, "r+") as file:
        for key, value in attributes.items():
            file.attrs[key] = value


def _of_another_body(folder: Path) -> None:
    with h5py.File(folder / "metrics.h5", "r+") as file:
        distances = file["body_to_object"][:, :1000]
        del file["body_to_object"]
        file.create_dataset("body_to_object", data=distances, fletcher32=True)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda folder: (folder / "metrics.h5").unlink(), [f"{ODD}/summary.h5"]),
        (
            lambda folder: _set(folder / "metrics.h5", schema_version=METRICS.version + 1),
            [f"{ODD}/metrics.h5", f"version {METRICS.version + 1}", "re-run stage 'metrics'"],
        ),
        (_of_another_body, ["a body of 1000 vertices", "not in the body's heatmap"]),
        (lambda folder: _set(folder / "joint.h5", body_model="0123"), ["another body file"]),
    ],
    ids=["no metrics", "metrics of another version", "another body's vertices", "another body"],
)
def test_what_is_wrong_with_one_sequence_is_told_and_the_other_is_shown(
    settings: Path, damage: Damage, says: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    project = load_project(settings)
    damage(project.results / ODD)
    with caplog.at_level(logging.WARNING):
        overview = write_site(project)
    pages = overview.parent / "sequences"
    assert (pages / GOOD / "index.html").is_file() and not (pages / ODD).exists()
    text = overview.read_text()
    assert ODD in text and f"sequences/{GOOD}/index.html" in text
    told = caplog.text + text
    for words in says:
        assert words.replace("'", "&#39;") in told or words in told


def test_an_empty_dataset_says_that_nothing_is_computed(settings: Path) -> None:
    project = load_project(settings)
    for name in (GOOD, ODD):
        shutil.rmtree(project.results / name)
    with pytest.raises(UserError, match="dataset 'trial': no sequence has a result") as raised:
        write_site(project)
    assert GOOD in str(raised.value) and ODD in str(raised.value)


def test_a_sequence_without_contact_is_shown_as_that(
    capture: fitted.Capture, tmp_path: Path
) -> None:
    """The ball hangs a metre away: no contact frame, no close-up, no figure of penetration."""
    paths = {}
    for stage in MEASURED:
        paths[stage] = Path(shutil.copy(capture.paths[stage], tmp_path / f"{stage}.h5"))
    for stage in ("object_track", "joint"):
        with h5py.File(paths[stage], "r+") as file:
            file["translation"][..., 0] += 1.0
    with h5py.File(paths["joint"], "r+") as file:
        file["contact_probability"][...] = 0.01
    apart = fitted.Capture(
        **{**capture.__dict__, "paths": {**paths, "metrics": tmp_path / "metrics.h5"}}
    )
    measure(apart)
    project_folder = tmp_path / "project"
    project_folder.mkdir()
    apart.paths["truth"] = capture.paths["truth"]
    path = fitted.write_project(project_folder, apart, GOOD)
    table = project_folder / "sequences.tsv"
    table.write_text("\n".join(line.rpartition("\t")[0] for line in table.read_text().splitlines()))
    shutil.copy(apart.paths["metrics"], project_folder / "results" / "trial" / GOOD)
    overview = write_site(load_project(path))
    text = overview.read_text()
    page = (overview.parent / "sequences" / GOOD / "index.html").read_text()
    assert "maximum 0.0 % of 3 frames" in text and ">nan" not in text
    assert "<b>0 %</b><small>of the frames" in page and " hand, frames " not in page
    assert "<span>penetration</span><b>–</b>" in page
    with h5py.File(overview.parents[1] / GOOD / "summary.h5") as file:
        assert not np.any(file["contact_frame"][()])


def test_a_name_with_markup_in_it_is_a_name(settings: Path) -> None:
    project = load_project(settings)
    name = '<b onclick="x">p&01</b>'
    for stage in ("body_fit", "metrics"):
        _set(project.results / ODD / f"{stage}.h5", subject=name)
    overview = write_site(project)
    for page in (overview, overview.parent / "sequences" / ODD / "index.html"):
        text = page.read_text()
        assert (
            "<b onclick" not in text and "&lt;b onclick=&#34;x&#34;&gt;p&amp;01&lt;/b&gt;" in text
        )
