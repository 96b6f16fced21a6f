"""The workflow's files: rules agree with the stages they run, and Snakemake finds no fault."""

from __future__ import annotations

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

from intercap_core.stage_list import SEQUENCE_STAGES, STAGES

ROOT = Path(__file__).resolve().parents[2]
TEXT = "\n".join(path.read_text() for path in sorted((ROOT / "workflow/rules").glob("*.smk")))
RULES = dict(re.findall(r"^rule (\w+):\n(.*?)(?=^rule |\Z)", TEXT, re.DOTALL | re.MULTILINE))


@pytest.mark.parametrize("stage", STAGES)
def test_a_rule_s_inputs_are_what_its_stage_reads(stage: str) -> None:
    run = importlib.import_module(f"intercap_core.stages.{stage}").run
    reads = set(inspect.signature(run).parameters) & set(SEQUENCE_STAGES)
    asked = re.findall(r"\*\*artefacts_read\(\"(\w+)\"\)", RULES[stage])
    assert {name for listed in asked for name in STAGES[listed].reads} == reads


@pytest.mark.parametrize("stage", STAGES)
def test_a_rule_depends_on_all_that_its_stage_is_given(stage: str) -> None:
    run = importlib.import_module(f"intercap_core.stages.{stage}").run
    names = set(inspect.signature(run).parameters)
    sections = {
        "frames_to_drop": "drop_frames",
        "floor": "floor",
        "starts": 'starts", "starts_sigma',
        "initial": "object_pose",
        "contact": "contact",
        "subject_points": "subject",
    }
    annotated = ", ".join(f'"{sections[name]}"' for name in sections if name in names)
    found = re.search(r"annotation=annotation_of\((.*)\)", RULES[stage])
    assert (found.group(1) if found else "") == annotated
    entries = {
        "object_": "object=tracked_object",
        "subject": "subject=tracked_subject",
        "device": "device=SETTINGS.device",
        "body_models": "body=body_file",
    }
    for name, param in entries.items():
        assert (param in RULES[stage]) == (name in names), name


@pytest.mark.parametrize("rule", sorted(RULES))
def test_every_rule_says_what_it_needs(rule: str) -> None:
    for part in ('"""', "output:", "log:", "benchmark:", "mem_mb=", "runtime=", "message:"):
        assert part in RULES[rule], part
    assert rule == "broken_annotation" or "code=" in RULES[rule]


def snakemake(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "snakemake", "--configfile", "config/demo/config.yaml"]
    return subprocess.run([*command, *arguments], cwd=ROOT, capture_output=True, text=True)


def test_lint_is_clean() -> None:
    done = snakemake("--lint")
    assert done.returncode == 0, done.stderr


def test_the_slurm_profile_is_understood() -> None:
    done = snakemake("--workflow-profile", "profiles/slurm", "-n")
    assert done.returncode == 0, done.stderr


def test_the_rule_graph_in_the_docs_is_in_step() -> None:
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        from write_rule_graph import page
    finally:
        sys.path.pop(0)
    written = (ROOT / "docs" / "workflow.md").read_text()
    assert sorted(written.splitlines()) == sorted(page().splitlines()), "run `make docs`"
