"""Write docs/workflow.md: the rules of the demo's workflow as a diagram."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "workflow.md"
INTRODUCTION = """\
# The workflow

Graph of the rules by `snakemake --rulegraph mermaid-js`; `make docs` writes this page. All rules
except `dataset` and `all` run once per sequence. `studio` exists only for virtual recordings, and
`broken_annotation` (not drawn) only for invalid annotation files.
"""


def page() -> str:
    """Text of the page; raises CalledProcessError if Snakemake rejects the workflow."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "snakemake", "--rulegraph", "mermaid-js", "--quiet", "all"),
            *("--configfile", "config/demo/config.yaml", "--forceall"),
        ],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    graph = "\n".join(line.rstrip() for line in done.stdout.splitlines()).strip()
    return f"{INTRODUCTION}\n```mermaid\n{graph}\n```\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
