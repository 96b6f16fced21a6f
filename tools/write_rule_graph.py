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

## Stages that share a process

A process takes 0.5 to 2.5 s to import its libraries. Consecutive stages of a sequence therefore
share a process, and with it a job. The setting `one_process` names the groups; its default:

```yaml
one_process: [[frames, detections, scene, person], [joint, metrics, summary]]
```

| value | effect |
|---|---|
| the default | an eighth less CPU time for a short recording; branches still run in parallel |
| one group of all stages | least CPU time and fewest jobs, for more sequences than cores |
| `[]` | a job for each stage |

- A job computes only the stages of its group that are missing or stale. After an edit of a setting
  of `metrics`, the job is `metrics_to_summary`; `joint` is not computed again.
- Each stage has its own artefact, manifest, log and benchmark, as with separate processes.
- If a stage fails, the outputs of the earlier stages are kept, and stages that do not read its
  output still run. The error names the stage.
- A job requests the memory of the stage that needs most, and the time of all its stages.
- A stage has its own job if it runs on a GPU or with several threads, or if an option of Snakemake
  names it (`--until person`, `--set-threads joint=4`).
- A job ends at a target file: `intercap run SETTINGS -- results/lab/s03/joint.h5` does not compute
  `metrics`.

## Graph
"""


def page() -> str:
    """Text of the page; raises CalledProcessError if Snakemake rejects the workflow."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "snakemake", "--rulegraph", "mermaid-js", "--quiet", "all"),
            *("--configfile", "config/demo/config.yaml", "--forceall"),
            *("--config", "one_process=[]"),  # shared jobs depend on the results that exist
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
