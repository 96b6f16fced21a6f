"""The result of a stage in one line, and its degradations, read from what the stage wrote."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts, schemas
from intercap_core.artefacts import Artefact
from intercap_core.flags import Flags
from intercap_core.object_track.artefact import SOURCE_NONE as NO_TRACK

_CHOSEN_BY = {
    "named": ", the subject is named",
    "handling": ", the subject handles the object",
    "middle": ", the subject is seen most",
}
_MAX_NAMED = 5  # left-out sequences named in a line
# Last step of the joint fit that a warning names, mm: figures would still change. With smaller
# ones, twice as many steps change errors by less than 0.1 mm (bench/RESULTS.md).
_LARGE_STEP_MM = 1.0


def line(stage: str, path: Path, inputs: Mapping[str, Path] | None = None) -> str:
    """One line about the output ``path`` of a stage; raises UserError if it cannot be read.

    Args:
        inputs: artefacts that the stage read, by stage.
    """
    if stage in _FOLDER_LINES:
        return _FOLDER_LINES[stage](path, inputs or {})
    with artefacts.read(path, getattr(schemas, stage.upper())) as artefact:
        return _LINES[stage](artefact) if stage in _LINES else f"{path.stat().st_size / 1e6:.1f} MB"


def dataset_line(results: Path) -> str:
    """One line about the outputs of all sequences, from the card in the folder ``results``."""
    card = json.loads((results / "card.json").read_text(encoding="utf-8"))
    counts, failed = card["counts"], [entry["sequence"] for entry in card["failed"]]
    merged = int(counts["sequences"])
    words = f"{merged} of {merged + len(failed)} sequences merged, {counts['frames']:,} frames"
    if failed:
        named = ", ".join(failed[:_MAX_NAMED])
        more = len(failed) - _MAX_NAMED
        words += f"; left out: {named}" + (f" and {more} more" if more > 0 else "")
    return words


def notes(stage: str, path: Path) -> list[str]:
    """Distinct degradations that an artefact states, in words; raises UserError as :func:`line`.

    The list is empty for a summary, which repeats the metrics.
    """
    if stage == "summary":
        return []
    with artefacts.read(path, getattr(schemas, stage.upper())) as artefact:
        found = []
        if "note" in artefact:
            names = artefact.text("camera_names")
            found += [
                f"camera {name}: {text}"
                for name, text in zip(names, artefact.text("note"), strict=True)
                if text
            ]
        for name in ("ground_note", "doubts", "shape_note"):
            text = str(artefact.attributes.get(name, ""))
            # without an object, the track's doubts only repeat that there is none
            alone = name == "doubts" and not artefact.attributes.get("object", name)
            found += [text] if text and not alone else []
        if stage == "scene" and not artefact.attributes["ground_found"]:
            found.append("no floor was found")
        if stage == "joint" and not artefact.attributes["converged"]:
            step = float(artefact.attributes.get("last_step_mm", np.inf))
            if not artefact.attributes["iterations"]:
                found.append("no step of the joint fit lowered its energy")
            elif step > _LARGE_STEP_MM:
                found.append(
                    f"the joint fit reached its iteration limit with a last step of {step:.1f} mm"
                )
        if "verdict/silent" in artefact:
            parts = zip(
                artefact.text("verdict/part_names"), artefact.text("verdict/silent"), strict=True
            )
            found += [
                f"the error of the {part} cannot be estimated: {text}"
                for part, text in parts
                if text
            ]
        return list(dict.fromkeys(found))


def flagged_frames(metrics: Path) -> tuple[Flags, list[tuple[str, int]]]:
    """Flags of a metrics artefact, and their reasons with the number of frames, most frequent
    first."""
    with artefacts.read(metrics, schemas.METRICS) as artefact:
        flags = Flags.read(artefact)
    counts: dict[str, int] = {}
    for text in flags.reasons:
        for reason in dict.fromkeys(part.strip() for part in text.split(";") if part.strip()):
            counts[reason] = counts.get(reason, 0) + 1
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return flags, ordered


def _frames(a: Artefact) -> str:
    times, index = a["times"], a["colour_index"]
    seconds = float(times[-1] - times[0]) if len(times) else 0.0
    depth = int((a["depth_index"] >= 0).any(axis=0).sum())
    return (
        f"{_share(a['present'])} cameras used, {depth} with depth; {len(times)} sets over "
        f"{seconds:.1f} s at {float(a.attributes['fps']):g} a second, "
        f"{100 * float((index >= 0).mean()):.0f} % of their images there"
    )


def _detections(a: Artefact) -> str:
    keypoints, candidates = a["keypoints_found"], a["candidates_found"]
    return (
        f"keypoints of {100 * float(keypoints.mean()):.0f} %, candidates of "
        f"{100 * float(candidates.mean()):.0f} % of {keypoints.size} images"
    )


def _scene(a: Artefact) -> str:
    shown = (a["image_of"] >= 0).any(axis=0)
    slipped = int((a["slip"] != 0).any(axis=0).sum())
    before, after = a["pair_residual_before"], a["pair_residual_after"]
    known = np.isfinite(before) & np.isfinite(after)
    poses = "no pair of cameras shares a surface"
    if known.any():
        poses = (
            f"backgrounds {1e3 * float(np.median(before[known])):.1f} to "
            f"{1e3 * float(np.median(after[known])):.1f} mm apart"
        )
    floor = {"fitted": "floor from depth", "feet": "floor from the feet", "none": "no floor"}
    source = str(a.attributes["ground_source"])
    return (
        f"{_share(shown)} cameras in step, {slipped} of them moved in time; {poses}; "
        f"{floor.get(source, f'floor {source}')}"
    )


def _person(a: Artefact) -> str:
    seen, missing = a["person"] >= 0, a["missing"]
    among = int((a["others"] > 0).sum())
    masked = 100 * float((np.diff(a["mask_offsets"]) > 0).mean())
    others = f"; others in {among} frames{_CHOSEN_BY.get(str(a.attributes['chosen_by']), '')}"
    return (
        f"the subject in {_share(~missing)} frames, by {float(seen.sum(axis=1).mean()):.1f} views "
        f"on average; a mask in {masked:.0f} % of images" + (others if among else "")
    )


def _object_track(a: Artefact) -> str:
    source = str(a.attributes["seed_source"])
    if source == NO_TRACK:
        return f"no object: {a.attributes['doubts']}"
    return (
        f"tracked in {_share(~a['lost'])} frames, {int(a['ambiguous'].sum())} of them ambiguous, "
        f"{int(a['resting'].sum())} at rest; found at frame {a.attributes['seed_frame']} ({source})"
    )


def _body_fit(a: Artefact) -> str:
    bridged = a["bridged"] | a["failed"]
    return (
        f"fitted in {_share(~bridged)} frames, the others filled in; {int(a['uncertain'].sum())} "
        f"not determined by what was seen; keypoints {_median(a['keypoint_residual']):.1f} px"
    )


def _joint(a: Artefact) -> str:
    if "made_by" in a.attributes:
        return f"made by {a.attributes['made_by']}; {Flags.read(a).summary()}"
    end = "converged" if a.attributes["converged"] else "iteration limit reached"
    if "last_step_mm" in a.attributes:
        end += f" (last step {a.attributes['last_step_mm']:.2g} mm)"
    touching = int((a["contact_probability"] > 0.5).any(axis=1).sum())
    contact = f"contact in {touching} of {len(a['flagged'])} frames"
    if np.isnan(a["contact_probability"]).all():
        contact = "the body alone, without an object"
    return (
        f"{a.attributes['iterations']} steps, {a.attributes['refused']} refused, {end}; "
        f"{contact}; {Flags.read(a).summary()}"
    )


def _metrics(a: Artefact) -> str:
    parts = []
    if "verdict/error" in a:
        stated = zip(
            a.text("verdict/part_names"), a["verdict/error"], a["verdict/error_factor"], strict=True
        )
        parts = [
            f"{part} {1e3 * e:.1f} mm ({1e3 * e / factor:.1f} to {1e3 * e * factor:.1f})"
            for part, e, factor in stated
            if np.isfinite(e)
        ]
    errors = f"estimated errors: {', '.join(parts)}; " if parts else ""
    return f"{errors}{Flags.read(a).summary()}"


def _summary(summary: Artefact) -> str:
    words = Flags.read(summary).summary()
    if "contact_frame" in summary:
        words += f", {_share(summary['contact_frame'])} in contact"
    return words


def _page(folder: Path, inputs: Mapping[str, Path]) -> str:
    pictures = (folder / "index.html").read_text(encoding="utf-8").count("data:image/")
    words = f"{pictures} pictures, {_megabytes(folder)} with the viewer"
    if "frames" not in inputs:
        return words
    with artefacts.read(inputs["frames"], schemas.FRAMES) as recorded:
        return f"{_share(recorded['present'])} cameras, {words}"


def _export(folder: Path, _: Mapping[str, Path]) -> str:
    manifest = json.loads((folder / "export.json").read_text(encoding="utf-8"))
    files = sum(path.is_file() for path in folder.rglob("*"))
    return (
        f"{', '.join(manifest['formats']) or 'no format'}: {manifest['frames']} frames in "
        f"{files} files, "
        f"{_megabytes(folder)}"
    )


def _megabytes(folder: Path) -> str:
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return f"{size / 1e6:.1f} MB"


_FOLDER_LINES: dict[str, Callable[[Path, Mapping[str, Path]], str]] = {
    "page": _page,
    "export": _export,
}

_LINES: dict[str, Callable[[Artefact], str]] = {
    "frames": _frames,
    "detections": _detections,
    "scene": _scene,
    "person": _person,
    "object_track": _object_track,
    "body_fit": _body_fit,
    "joint": _joint,
    "metrics": _metrics,
    "summary": _summary,
}


def _share(which: Any) -> str:
    """Text such as "5 of 6" of a boolean array."""
    return f"{int(which.sum())} of {which.size}"


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
