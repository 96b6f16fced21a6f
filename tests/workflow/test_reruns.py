"""Jobs that Snakemake plans after an edit of a finished project.

tests/pipeline/test_plan.py has what each edit makes stale; here Snakemake follows it. Most tests
ask a Snakemake process that is already running; some start one as a user does.
"""

from __future__ import annotations

import os
import re
import shutil

import yaml

from tests.helpers.flow import ONE, OTHER, Flow, edited

AFTER_METRICS = {"summary", "page", "export"}
DATASET = ("", "dataset")
CONTACT = "contact:\n- {part: right_hand, start: 1, end: 4}\n"


def test_touching_everything_and_running_again_does_nothing(flow: Flow) -> None:
    for path in [*flow.results.rglob("*.h5"), *(flow.folder / "config").rglob("*.*")]:
        os.utime(path)
    assert flow.pending() == set()
    done = flow.ask()
    assert done.returncode == 0
    assert "Nothing to be done" in done.stderr


def test_several_targets_are_remade_after_an_edit(flow: Flow) -> None:
    targets = [
        str(flow.artefact(ONE, stage).relative_to(flow.folder)) for stage in ("joint", "summary")
    ]
    with edited(flow.annotation(ONE), CONTACT):
        done = flow.ask("--dry-run", *targets)
    assert done.returncode == 0, done.stderr[-3000:]
    jobs = re.findall(r"^(\w+) +1$", done.stdout + done.stderr, re.MULTILINE)
    assert set(jobs) == {"joint", "metrics_to_summary"}


def test_editing_a_term_reruns_the_stages_that_reach_it(flow: Flow) -> None:
    path = flow.folder / "intercap_core" / "joint" / "terms" / "ground.py"
    with edited(path, path.read_text() + "\nEDITED = 1\n"):
        pending = {rule for _, rule in flow.pending(new_process=True)}
    assert pending == {"joint", "metrics", *AFTER_METRICS, "dataset"}


def test_moved_results_stay_up_to_date(flow: Flow) -> None:
    """Edits are found without Snakemake's bookkeeping and with other dates of files."""
    bookkeeping, aside = flow.folder / ".snakemake", flow.folder / "aside"
    bookkeeping.rename(aside)
    elsewhere = flow.folder / "elsewhere"
    shutil.copytree(flow.results, elsewhere, copy_function=shutil.copy)
    flow.results.rename(flow.folder / "here")
    elsewhere.rename(flow.results)
    try:
        assert flow.pending() == set()
        path = flow.folder / flow.settings
        settings = yaml.safe_load(path.read_text())
        with edited(path, yaml.safe_dump({**settings, "page": {"frames": 3}})):
            assert flow.pending() == {(name, "page") for name in (ONE, OTHER)} | {DATASET}
        with edited(flow.annotation(OTHER), CONTACT):
            stages = {"joint", "metrics", *AFTER_METRICS}
            assert flow.pending() == {(OTHER, stage) for stage in stages} | {DATASET}
    finally:
        shutil.rmtree(flow.results)
        shutil.rmtree(bookkeeping, ignore_errors=True)
        (flow.folder / "here").rename(flow.results)
        aside.rename(bookkeeping)


def test_a_deleted_output_is_remade_though_later_ones_exist(flow: Flow) -> None:
    with edited(flow.artefact(OTHER, "metrics"), None):
        pending = flow.pending()
    assert (OTHER, "metrics") in pending
    assert pending <= {(OTHER, stage) for stage in {"metrics", *AFTER_METRICS}}
    assert flow.pending() == set()
