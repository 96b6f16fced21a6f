"""The dataset's tables: one row a sequence, one row a frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from intercap_core.metrics import figures
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.metrics.verdict_figures import TRUE, stated_errors
from intercap_core.stage_list import ESTIMATES

_MILLIMETRES = {
    "penetration_mean", "penetration_median", "penetration_max", "penetration_object",
    "ground_penetration", "body_to_cloud", "object_to_cloud", "body_visible_to_cloud",
    "object_visible_to_cloud", "cloud_to_body",
}  # fmt: skip
_RANKED = {  # columns of the table of sequences and what they are a measure of
    "vertex_to_cloud.body_visible_mm": "body_to_cloud",
    "vertex_to_cloud.object_visible_mm": "object_to_cloud",
    "penetration.p98_mm": "penetration",
}
_ACCELERATIONS = {"acceleration_body", "acceleration_object"}


def sequence_table(
    sequences: Sequence[SequenceMetrics], residuals: dict[str, tuple[float, float]]
) -> pd.DataFrame:
    """One row a sequence; lengths in millimetres, accelerations in mm/frame^2 at 30 fps.

    ``residuals``: median point-to-plane distance between cameras before and after refinement, by
    sequence, metres. Columns ``<stage>.<figure>`` are errors against truth. ``rank`` orders the
    sequences by :func:`worst_first`, 1 = worst. What a sequence does not have is NaN.
    """
    rows = []
    for s in sequences:
        row: dict[str, object] = {
            "sequence": s.name,
            "subject": s.subject,
            "object": s.object_,
            "frames": len(s),
            "fps": s.fps,
            "flagged_frames": int(s.values["flagged"].sum()),
            "contact_frames": int(s.values["contact_frame"].sum()) if s.has_object else np.nan,
        }
        for name, value in figures.penetration_figures([s]).items():
            row[f"penetration.{name}"] = value
        for name, value in figures.cloud_figures([s]).items():
            row[f"vertex_to_cloud.{name}"] = value
        for name, value in figures.floor_figures([s]).items():
            row[f"vertex_to_cloud_floor.{name}"] = value
        for name in sorted(_ACCELERATIONS):
            if name in s.values:
                row[f"{name}_mm"] = 1e3 * _mean(s.values[name])
        for error in stated_errors(s):
            row[f"verdict.{error.part}_mm"] = error.stated
            row[f"verdict.{error.part}_factor"] = error.factor
            row[f"verdict.{error.part}_silent"] = error.silent
        before, after = residuals.get(s.name, (np.nan, np.nan))
        row["extrinsics_residual_before_mm"] = 1e3 * before
        row["extrinsics_residual_after_mm"] = 1e3 * after
        if s.has_truth:
            for stage in ESTIMATES:
                for name, value in figures.truth_figures([s], stage).items():
                    row[f"{stage}.{name}"] = value
            for name, value in figures.extrinsics_figures([s]).items():
                row[f"extrinsics_error.{name}"] = value
        rows.append(row)
    table = pd.DataFrame(rows)
    for name in _RANKED:
        if name not in table:  # of no sequence, where nobody handles an object
            table[name] = np.nan
    table.insert(1, "rank", worst_first(table))
    return table


def worst_first(table: pd.DataFrame) -> pd.Series:
    """Rank of each sequence, 1 = worst: by the mean of its ranks in several measures.

    Share of flagged frames, body and object visible distance to the cloud, the 98th percentile of
    penetration, and the stated error of each judged part, worst where nothing can be said. Without
    an object there are no measures of it. Ranks need no weights between units.
    """
    measures = pd.DataFrame(
        {
            "flagged": table["flagged_frames"] / table["frames"],
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
    """One row a frame; millimetres, degrees, mm/frame^2 at 30 fps."""
    parts = []
    for s in sequences:
        total = len(s)
        columns: dict[str, object] = {
            "sequence": np.repeat(s.name, total),
            "frame": np.arange(total),
            "time_s": np.arange(total) / s.fps,
            "flagged": s.values["flagged"],
            "flag_reason": s.values["flag_reason"].astype(str),
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
        for place, part in enumerate(s.values.get("verdict/part_names", ())):
            columns[f"verdict.{part}_mm"] = 1e3 * s.values["verdict/error_frame"][place]
        for stage in ESTIMATES:
            for name in ("body_pve", "body_mpjpe", "object_translation"):
                if f"truth/{stage}/{name}" in s.values:
                    values = s.values[f"truth/{stage}/{name}"].astype(np.float64)
                    columns[f"{stage}.{name}_mm"] = 1e3 * values
            if f"truth/{stage}/object_rotation" in s.values:
                degrees = s.values[f"truth/{stage}/object_rotation"].astype(np.float64)
                columns[f"{stage}.object_rotation_deg"] = degrees
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def write(folder: Path, sequences: pd.DataFrame, frames: pd.DataFrame) -> None:
    """Write sequences.parquet, sequences.csv and frames.parquet; equal content, equal bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    sequences.to_parquet(folder / "sequences.parquet", index=False)
    sequences.to_csv(folder / "sequences.csv", index=False, float_format="%.6g")
    frames.to_parquet(folder / "frames.parquet", index=False)


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")
