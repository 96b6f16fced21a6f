"""Cost of the site of a large dataset: merging 223 sequences of 300 frames, and one page.

Sequences of the demo (`make demo` must have run) are extended to 300 frames, and their summaries
are repeated under other names, subjects and objects. Every figure is measured in a separate
process: wall seconds and peak memory.
"""

from __future__ import annotations

import http.server
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from bench.command import from_command_line, report_figures
from bench.stage_resources import lengthen, peak_mb, run_apart
from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project, load_project
from intercap_core.schemas import SUMMARY
from intercap_core.stage_list import STAGES

SEQUENCES, FRAMES, SUBJECTS = 223, 300, 10
MEGABYTE = 1e6
LOAD_TIMEOUT_S = 120.0


def measure(settings: Path, output: Path, count: int) -> None:
    """Print ``dataset.*`` and add them to the JSON ``output``.

    Raises UserError if no sequence of the project is completely computed.
    """
    project = load_project(settings)
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory(dir=project.results) as folder:
        long = Path(folder) / "long"
        names = [n for n in project.sequences if project.artefact(n, "metrics").is_file()]
        if not names:
            raise UserError(f"{project.results}: no sequence is computed; run `make demo` first")
        for name in names:
            _lengthen(project, name, long / name)
        figures["page_s"], _ = _timed("page", settings, names[0], long / names[0])
        folder_of_page = long / names[0] / "page"
        figures["page_mb"] = (folder_of_page / "index.html").stat().st_size / MEGABYTE
        viewer = sum(p.stat().st_size for p in folder_of_page.iterdir()) / MEGABYTE
        figures["viewer_mb_300"] = viewer - figures["page_mb"]
        load = load_seconds(folder_of_page)
        if load is not None:
            figures["viewer_load_s_300"] = load
        summed = [_timed("summary", settings, name, long / name) for name in names]
        figures["summary_s"] = max(seconds for seconds, _ in summed)
        many = Path(folder) / "many"
        _repeat(project, [long / name / "summary.h5" for name in names], many, count)
        seconds, peak = _timed("merge", settings, "", many)
        figures[f"aggregate_s_{count}"], figures[f"aggregate_mb_{count}"] = seconds, peak
        figures["overview_mb"] = (many / "merged" / "site" / "index.html").stat().st_size / MEGABYTE
        figures["one_more_s"] = figures["summary_s"] + seconds + figures["page_s"]
    report_figures(output, "dataset", figures)


def load_seconds(folder: Path) -> float | None:
    """Seconds until a page's viewer is ready in a browser without a GPU; None without Chromium.

    A copy of the page notifies a local server when it is ready; released pages make no requests.
    """
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        return None
    answers: list[float] = []

    class Answer(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            answers.append(float(self.path.rpartition("=")[2]) / 1000)
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.HTTPServer(("127.0.0.1", 0), Answer)
    server.timeout = LOAD_TIMEOUT_S
    call = f"""<script>setInterval(() => {{
      const root = document.querySelector(".viewer");
      if (root.dataset.ready !== "yes" || root.dataset.told) return;
      root.dataset.told = "yes";
      new Image().src = "http://127.0.0.1:{server.server_port}/?ms=" + root.dataset.loadedMs;
    }}, 20);</script></body>"""
    with tempfile.TemporaryDirectory() as copy:
        shutil.copy(folder / "viewer.js", copy)
        text = (folder / "index.html").read_text(encoding="utf-8")
        text = text.replace("img-src data: blob:", "img-src *").replace("</body>", call)
        page = Path(copy) / "index.html"
        page.write_text(text, encoding="utf-8")
        browser = subprocess.Popen(
            [
                program, "--headless", "--no-sandbox", "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-first-run",
                f"--user-data-dir={copy}/profile", "--remote-debugging-port=0", page.as_uri(),
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            server.handle_request()
        finally:
            browser.terminate()
            browser.wait()
            server.server_close()
    return answers[0] if answers else float("nan")


def _lengthen(project: Project, name: str, folder: Path) -> None:
    folder.mkdir(parents=True)
    for stage in STAGES["summary"].reads:
        lengthen(project.artefact(name, stage), stage, folder / f"{stage}.h5", FRAMES)


def _repeat(project: Project, summaries: list[Path], folder: Path, count: int) -> None:
    """``count`` copies under other names, of ten subjects."""
    import h5py

    folder.mkdir()
    for number in range(count):
        source = summaries[number % len(summaries)]
        path = folder / f"seq_{number:03d}.h5"
        shutil.copyfile(source, path)
        with h5py.File(path, "r+") as file:
            file.attrs["sequence"] = path.stem
            file.attrs["subject"] = f"s{1 + number % SUBJECTS:02d}"
    with artefacts.read(path, SUMMARY) as last:  # what was changed is still a whole artefact
        assert last.attributes["sequence"] == path.stem


def _timed(what: str, settings: Path, sequence: str, folder: Path) -> tuple[float, float]:
    """Seconds, start of the process included, and peak megabytes of :func:`_work`."""
    started = time.perf_counter()
    peak = run_apart(_work, what, settings, sequence, folder)
    return time.perf_counter() - started, peak


def _work(what: str, settings: Path, sequence: str, folder: Path) -> float:
    """Merge the summaries in ``folder``, or run stage ``what`` there; returns peak megabytes."""
    project = load_project(settings)
    if what == "merge":
        from intercap_core.stages import dataset

        dataset.run(
            dataset="scale",
            summaries={path.stem: path for path in sorted(folder.glob("*.h5"))},
            objects=project.objects,
            body_models=project.config.body_models,
            results=folder / "merged",
            card=project.config.card,
            formats=project.config.export.formats,
        )
    else:
        row = project.sequences[sequence]  # the truth is of the frames that were recorded
        project.sequences[sequence] = row.model_copy(update={"truth": None})
        inputs = {stage: folder / f"{stage}.h5" for stage in STAGES[what].reads}
        output = folder / (what if STAGES[what].writes_folder else f"{what}.h5")
        run_step(what, project, sequence, inputs=inputs, output=output)
    return peak_mb()


if __name__ == "__main__":
    from_command_line(
        measure, (__doc__ or "").splitlines()[0], SEQUENCES, "sequences",
        settings=Path("config/demo/config.yaml"),
    )  # fmt: skip
