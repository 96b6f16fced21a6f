"""Run Snakemake repeatedly without its start-up: reads a line of arguments, prints a status.

It is started in a copy of the project. Each request is answered by a fork of this process, which
has imported Snakemake and parsed the code. If a module imported here was edited since, the fork
starts Snakemake as a new process.
"""

from __future__ import annotations

import importlib
import json
import os
import sys

PRELOADED = (
    "snakemake.cli",
    "snakemake.api",
    "snakemake.workflow",
    "snakemake.executors.touch",
    "pandas",
    "intercap_core.pipeline.code_digest",
    "intercap_core.formats.recordings.layouts",
    "intercap_core.project",
)


def imported() -> dict[str, tuple[int, int]]:
    """Date and size of each file of the package that this process has imported."""
    paths = [
        module.__file__
        for name, module in sys.modules.items()
        if name.partition(".")[0] == "intercap_core" and module.__file__
    ]
    return {path: (os.stat(path).st_mtime_ns, os.stat(path).st_size) for path in paths}


def answer(arguments: list[str], output: str, errors: str, *, edited: bool) -> int:
    """Run ``snakemake arguments`` in a fork, its output in two files; returns its exit status."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 1
    try:
        for path, number in ((output, 1), (errors, 2)):
            target = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(target, number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        if edited:
            os.execv(sys.executable, [sys.executable, "-m", "snakemake", *arguments])
        sys.argv = ["snakemake", *arguments]
        sys.modules["snakemake.cli"].main(arguments)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def serve() -> None:
    for name in PRELOADED:
        importlib.import_module(name)
    from intercap_core.pipeline.code_digest import code_digest
    from intercap_core.stage_list import STAGES

    for stage in (*STAGES, "dataset"):
        code_digest(f"stages.{stage}")
    files = imported()
    for line in sys.stdin:
        print(answer(*json.loads(line), edited=imported() != files), flush=True)


if __name__ == "__main__":
    serve()
