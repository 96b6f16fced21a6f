"""Tables of the dataset by sequence, frame, object, subject, intent and camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow
from pyarrow import csv

from intercap_core.evaluation import figures
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.physics.figures import physics_figures
from intercap_core.evaluation.summary import SequenceSummary
from intercap_core.evaluation.verdict.figures import (
    IMAGE_MEASURES,
    TRUE,
    mean_stated,
    stated_errors,
)
from intercap_core.flags import PARTS
from intercap_core.stage_list import ESTIMATES

_MILLIMETRES = {
    "penetration_mean", "penetration_median", "penetration_max", "penetration_object",
    "ground_penetration", "body_to_cloud", "object_to_cloud", "body_visible_to_cloud",
    "object_visible_to_cloud", "cloud_to_body",
}  # fmt: skip
_RANKED = {  # columns of the table of sequences, and their names in worst_first
    "vertex_to_cloud.body_visible_mm": "body_to_cloud",
    "vertex_to_cloud.object_visible_mm": "object_to_cloud",
    "penetration.p98_mm": "penetration",
}
_ACCELERATIONS = {"acceleration_body", "acceleration_object"}


def sequence_table(
    sequences: Sequence[SequenceMetrics],
    residuals: Mapping[str, tuple[float, float]],
    intents: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Return one row per sequence; lengths in millimetres, accelerations in mm/frame^2 at 30 fps.

    Columns ``<stage>.<figure>`` are errors against truth. Column ``rank`` is :func:`worst_first`.
    Values that a sequence does not have are NaN.

    Args:
        residuals: median point-to-plane distance between cameras before and after refinement, by
            sequence, metres.
        intents: by sequence, "" if not stated.
    """
    rows = []
    for s in sequences:
        row: dict[str, object] = {
            "sequence": s.name,
            "subject": s.subject,
            "object": s.object_,
            "intent": (intents or {}).get(s.name, ""),
            "frames": len(s),
            "fps": s.fps,
            "made_by": s.made_by,
            **{
                f"flagged.{part}_frames": int(count)
                for part, count in zip(PARTS, s.flags.flagged.sum(axis=0), strict=True)
            },
            "contact_frames": int(s.values["contact_frame"].sum()) if s.has_object else np.nan,
        }
        row |= _figures([s])
        for error in stated_errors(s):
            row[f"verdict.{error.part}_mm"] = error.stated
            row[f"verdict.{error.part}_factor"] = error.factor
            row[f"verdict.{error.part}_silent"] = error.silent
            row[f"verdict.{error.part}_odd_even_mm"] = error.repeated
        before, after = residuals.get(s.name, (np.nan, np.nan))
        row["extrinsics_residual_before_mm"] = 1e3 * before
        row["extrinsics_residual_after_mm"] = 1e3 * after
        if s.has_truth:
            for stage in ESTIMATES:
                row |= _prefixed(stage, figures.truth_figures([s], stage))
            row |= _prefixed("extrinsics_error", figures.extrinsics_figures([s]))
        rows.append(row)
    table = pd.DataFrame(rows)
    for name in _RANKED:
        if name not in table:  # no sequence has an object
            table[name] = np.nan
    table.insert(1, "rank", worst_first(table))
    return table


def _figures(sequences: Sequence[SequenceMetrics]) -> dict[str, float]:
    """Pool penetration, distances to clouds with their noise floor, and accelerations."""
    row = {
        **_prefixed("penetration", figures.penetration_figures(sequences)),
        **_prefixed("physics", physics_figures(sequences)),
        **_prefixed("vertex_to_cloud", figures.cloud_figures(sequences)),
        **_prefixed("vertex_to_cloud_floor", figures.floor_figures(sequences)),
    }
    for name in sorted(_ACCELERATIONS):
        values = figures.pooled(sequences, name)
        if values is not None:
            row[f"{name}_mm"] = 1e3 * _mean(values)
    return row


def _prefixed(prefix: str, values: Mapping[str, float]) -> dict[str, float]:
    return {f"{prefix}.{name}": value for name, value in values.items()}


def group_table(
    sequences: Sequence[SequenceMetrics], by: str, group_of: Mapping[str, str]
) -> pd.DataFrame:
    """Return one row per group, over all frames of its sequences; missing values are NaN.

    Args:
        by: name of the first column.
        group_of: group of each sequence, "" for none.
    """
    rows = []
    for group in sorted({group_of[s.name] for s in sequences} - {""}):
        members = [s for s in sequences if group_of[s.name] == group]
        flags = figures.pooled_flags(members)
        touching = figures.pooled(members, "contact_frame")
        row: dict[str, object] = {
            by: group,
            "sequences": len(members),
            "frames": len(flags.reasons),
            "minutes": sum(len(s) / s.fps for s in members) / 60,
            **{f"flagged.{part}_percent": 100 * s for part, s in flags.shares().items()},
            "contact_percent": np.nan if touching is None else 100 * float(touching.mean()),
            **_figures(members),
        }
        row |= {f"verdict.{part}_mm": value for part, value in mean_stated(members).items()}
        if any(s.has_truth for s in members):
            row |= _prefixed("joint", figures.truth_figures(members, "joint"))
        rows.append(row)
    return pd.DataFrame(rows, columns=None if rows else [by, "sequences", "frames"])


def camera_table(summaries: Sequence[SequenceSummary]) -> pd.DataFrame:
    """Return one row per sequence and camera, in the units that end the columns' names.

    Unknown values are NaN. Columns ``verdict.*`` are medians of the camera's errors over all
    frames, those with ``_held_out`` over the frames that were fitted without the camera.
    """
    rows = []
    for summary in summaries:
        rig, values = summary.rig, summary.metrics.values
        judged = list(values.get("verdict/camera_names", ()))
        for c, name in enumerate(rig["camera_names"]):
            row: dict[str, object] = {
                "sequence": summary.name,
                "camera": str(name),
                "frames": len(summary.metrics),
                "images": int(rig["images"][c]),
                "time_offset_ms": 1e3 * float(rig["time_offset"][c]),
                "time_offset_sigma_ms": 1e3 * float(rig["time_offset_sigma"][c]),
                "depth_bias_mm": 1e3 * float(rig["depth_bias"][c]),
                "moved_mm": 1e3 * float(rig["moved"][c]),
                "note": str(rig["note"][c]),
            }
            if "verdict/held_camera" in values and name in judged:
                place = judged.index(name)
                held = values["verdict/held_camera"] == place
                for view in IMAGE_MEASURES:
                    name, unit = view.key.removesuffix("_m"), "_mm" if view.unit == "mm" else ""
                    for end, frames in (("", slice(None)), ("_held_out", held)):
                        errors = values[f"verdict/{view.key}{end}"][frames, place]
                        row[f"verdict.{name}{end}{unit}"] = view.scale * figures.finite_median(
                            errors
                        )
            rows.append(row)
    return pd.DataFrame(rows)


def camera_groups(cameras: pd.DataFrame) -> pd.DataFrame:
    """Return one row per camera over all its sequences.

    Frames and images are summed, and sequences with a note are counted. The other numbers of
    :func:`camera_table` are means weighted by frames.
    """
    if cameras.empty:
        return pd.DataFrame(columns=["camera", "sequences", "frames", "images"])
    rows = []
    means = cameras.select_dtypes("float").columns
    for name, entries in cameras.groupby("camera", sort=True):
        row: dict[str, object] = {
            "camera": name,
            "sequences": len(entries),
            "frames": int(entries["frames"].sum()),
            "images": int(entries["images"].sum()),
            "with_note": int((entries["note"] != "").sum()),
        }
        for column in means:
            known = entries[np.isfinite(entries[column])]
            weights = known["frames"]
            row[column] = np.average(known[column], weights=weights) if len(known) else np.nan
        rows.append(row)
    return pd.DataFrame(rows)


def worst_first(table: pd.DataFrame) -> pd.Series:
    """Return the rank of each sequence, 1 = worst, by its mean rank in several measures.

    The measures are:
    - share of flagged frames, mean over the parts
    - distances of the visible body and object to the cloud
    - 98th percentile of penetration
    - stated error of each part; the worst rank if none is stated

    Measures of the object are omitted without an object.
    """
    measures = pd.DataFrame(
        {
            "flagged": table[[f"flagged.{part}_frames" for part in PARTS]].sum(axis=1)
            / table["frames"],
            **{name: table[column] for column, name in _RANKED.items()},
            **{
                part: table[f"verdict.{part}_mm"].fillna(np.inf)
                for part in TRUE
                if f"verdict.{part}_mm" in table
            },
        }
    )
    ranks = measures.rank(ascending=False, na_option="bottom")
    of_object = ranks.columns.intersection(["object_to_cloud", "penetration", "object"])
    ranks.loc[table["contact_frames"].isna(), of_object] = np.nan
    mean_rank = ranks.mean(axis=1)
    return mean_rank.rank(method="first").astype(int)


def frame_table(sequences: Sequence[SequenceMetrics]) -> pd.DataFrame:
    """Return one row per frame; millimetres, degrees, mm/frame^2 at 30 fps."""
    parts = []
    for s in sequences:
        total = len(s)
        columns: dict[str, object] = {
            "sequence": np.repeat(s.name, total),
            "frame": np.arange(total),
            "time_s": np.arange(total) / s.fps,
            **dict(zip((f"flagged.{part}" for part in PARTS), s.flags.flagged.T, strict=True)),
            "flag_reason": s.flags.reasons,
        }
        if s.has_object:
            names = s.values["region_names"]
            columns["contact"] = s.values["contact_frame"]
            columns["contact_regions"] = [
                ";".join(names[row]) for row in s.values["region_contact"]
            ]
            for r, region in enumerate(names):
                columns[f"contact_probability.{region}"] = s.values["contact_probability"][:, r]
        for name in sorted((_MILLIMETRES | _ACCELERATIONS) & s.values.keys()):
            columns[f"{name}_mm"] = 1e3 * s.values[name].astype(np.float64)
        if "physics/carrier" in s.values:
            columns["physics.carrier"] = [str(name) for name in s.values["physics/carrier"]]
            columns["physics.bad"] = s.values["physics/bad"]
            depth = s.values["physics/penetration"].astype(np.float64)
            columns["physics.penetration_mm"] = 1e3 * depth
        for place, part in enumerate(s.values.get("verdict/part_names", ())):
            columns[f"verdict.{part}_mm"] = 1e3 * s.values["verdict/error_frame"][place]
        for stage in ESTIMATES:
            for name, unit, factor in (
                ("body_pve", "mm", 1e3), ("body_mpjpe", "mm", 1e3),
                ("object_translation", "mm", 1e3), ("object_rotation", "deg", 1.0),
            ):  # fmt: skip
                if f"truth/{stage}/{name}" in s.values:
                    values = s.values[f"truth/{stage}/{name}"].astype(np.float64)
                    columns[f"{stage}.{name}_{unit}"] = factor * values
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def write(folder: Path, tables: Mapping[str, pd.DataFrame]) -> None:
    """Write NAME.parquet and NAME.csv of each table; equal content gives equal bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        table.to_parquet(folder / f"{name}.parquet", index=False)
        rounded = table.assign(
            **{c: _significant(table[c]) for c in table.select_dtypes("float").columns}
        )
        # pyarrow writes csv several times as fast as pandas
        rows = pyarrow.Table.from_pandas(rounded, preserve_index=False)
        csv.write_csv(rows, folder / f"{name}.csv")


def _significant(values: pd.Series) -> np.ndarray:
    """Round finite values to six significant digits."""
    rounded = values.to_numpy(np.float64, copy=True)
    known = np.isfinite(rounded) & (rounded != 0)
    scale = 10.0 ** (5 - np.floor(np.log10(np.abs(rounded[known]))))
    rounded[known] = np.round(rounded[known] * scale) / scale
    return rounded


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")
