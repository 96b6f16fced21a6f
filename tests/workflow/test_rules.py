"""The workflow's files: rules agree with the stages they run, and Snakemake finds no fault."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from intercap_core.annotation import Annotation
from intercap_core.pipeline import stage_inputs
from intercap_core.pipeline.checksums import InputChecksums
from intercap_core.project import load_project
from intercap_core.sequence_inputs import FitSettings, SequenceModels
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES
from tests.helpers.flow import ONE, OTHER, Flow, edited

ROOT = Path(__file__).resolve().parents[2]
TEXT = "\n".join(path.read_text() for path in sorted((ROOT / "workflow/rules").glob("*.smk")))
# Text by name; the rule of all stages takes its name from the stages of a job.
RULES = dict(re.findall(r"^ *rule ?(\w*):\n(.*?)(?=^\w|\Z)", TEXT, re.DOTALL | re.MULTILINE))


@pytest.mark.parametrize("stage", STAGES)
def test_stages_take_the_artefacts_that_they_declare(stage: str) -> None:
    run = importlib.import_module(f"intercap_core.stages.{stage}").run
    names = set(inspect.signature(run).parameters)
    reads = set(STAGES[stage].reads)
    assert "paths" in names or names & set(SEQUENCE_STAGES) == reads
    assert STAGES[stage].reuses in {"", *names}


@pytest.mark.parametrize("stage", STAGES)
def test_manifests_contain_all_arguments_of_a_stage(stage: str) -> None:
    """Artefacts and output are not arguments in this sense; the device belongs to the machine."""
    run = importlib.import_module(f"intercap_core.stages.{stage}").run
    names = set(inspect.signature(run).parameters) - set(SEQUENCE_STAGES)
    names -= {"output", "paths", STAGES[stage].reuses}
    for group, members in (("models", SequenceModels), ("fit_settings", FitSettings)):
        if group in names:
            names = names - {group} | {member.name for member in fields(members)}
    project = load_project(ROOT / "config/test/config.yaml")
    sequence = next(iter(project.sequences))
    made_from = stage_inputs.stage_manifest(
        project, sequence, stage, Annotation(),
        artefacts=dict.fromkeys(STAGES[stage].reads, "made"), checksums=InputChecksums(ROOT /
        "none"),
    )  # fmt: skip
    assert set(made_from.given) == names - {"device"}
    assert set(made_from.artefacts) == set(STAGES[stage].reads)


def test_stages_cannot_read_undeclared_columns() -> None:
    row = next(iter(load_project(ROOT / "config/test/config.yaml").sequences.values()))
    with pytest.raises(AttributeError):
        _ = stage_inputs.restrict_row("frames", row).intent
    assert stage_inputs.restrict_row("summary", row).sequence == row.sequence


@pytest.mark.parametrize("rule", sorted(RULES))
def test_rules_declare_log_resources_and_message(rule: str) -> None:
    for part in ('"""', "output:", "log:", "benchmark:", "mem_mb=", "runtime=", "message:"):
        assert part in RULES[rule], part
    stage = f'"{rule}"' if rule else "*_stages"
    assert rule == "broken_annotation" or f"mark=out_of_date({stage})" in RULES[rule]


def test_one_rule_has_the_inputs_of_all_stages() -> None:
    assert RULES.keys() == {"", "studio", "dataset", "broken_annotation"}
    assert "unpack(inputs_of(*_stages))" in RULES[""]


@pytest.mark.parametrize("arguments", [("--lint",), ("--workflow-profile", "slurm", "--dry-run")])
def test_snakemake_finds_no_fault_and_understands_the_profile(
    flow: Flow, arguments: tuple[str, ...]
) -> None:
    done = flow.ask(*arguments)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("profile", [(), ("--workflow-profile", "slurm")])
def test_the_scene_of_another_sequence_is_made_first(flow: Flow, profile: tuple[str, ...]) -> None:
    """Only the sequence that reuses the other one's cameras is requested."""
    table = flow.folder / "config" / "test" / "sequences.tsv"
    header, *rows = table.read_text().splitlines()
    cells = [f"{row}\t{ONE if row.startswith(OTHER) else ''}" for row in rows]
    scene = flow.artefact(ONE, "scene")
    with (
        edited(table, "\n".join([f"{header}\trig_from", *cells, ""])),
        edited(scene, None),
    ):
        done = flow.ask("--dry-run", *profile, f"results/test/{OTHER}/scene.h5")
    assert done.returncode == 0, done.stderr
    reasons = re.findall(r"^Job \d+: (\w+): .*\nReason: (.*)$", done.stdout, re.MULTILINE)
    made = f"results/test/{ONE}/scene.h5"
    waits = [name for name, reason in reasons if made in reason.partition("another job: ")[2]]
    assert waits == [OTHER]


def test_conda_without_a_checkout_is_refused(flow: Flow) -> None:
    done = flow.ask("--sdm", "conda", "--dry-run")
    said = done.stdout + done.stderr  # dry runs print to standard output
    assert done.returncode == 1 and "Traceback" not in said
    assert f"expected as the working directory: {flow.folder} is none; leave" in said


def test_the_rule_graph_in_the_docs_is_up_to_date() -> None:
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        from write_rule_graph import page
    finally:
        sys.path.pop(0)
    written = (ROOT / "docs" / "workflow.md").read_text()
    assert sorted(written.splitlines()) == sorted(page().splitlines()), "run `make docs`"
