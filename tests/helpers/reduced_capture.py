"""Remove cameras, depth, colour or detections from the artefacts of a capture.

Each artefact is copied by its schema with shorter T and C axes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts, schemas
from intercap_core.artefact_schema import Schema
from intercap_core.artefacts import Artefact, Writer, pack_ragged, unpack_ragged

STAGES = {
    s.name: s
    for s in (
        schemas.FRAMES, schemas.DETECTIONS, schemas.SCENE, schemas.PERSON, schemas.OBJECT_TRACK,
        schemas.BODY_FIT, schemas.JOINT,
    )
}  # fmt: skip
_OF_DEPTH_LENS = {
    "depth_size": 0,
    "depth_intrinsics": np.nan,
    "depth_distortion": np.nan,
    "depth_metric_radius": np.nan,
    "colour_from_depth": np.nan,
}
# Value of an image that was taken away, and the field of Reduction that says which cameras keep it
_EMPTY = {
    "depth_index": (-1, "depth"),
    "colour_index": (-1, ""),
    "image_of": (-1, ""),
    "candidate": (-1, "candidates"),
    "keypoints_found": (False, "keypoints"),
    "candidates_found": (False, "candidates"),
}
_RAGGED = (
    ("people_offsets", ("people",)),
    ("candidate_offsets", ("candidate_labels", "candidate_scores", "candidate_boxes")),
)


@dataclass(frozen=True)
class Reduction:
    """The part of a capture that is kept; None keeps everything, else cameras are named."""

    cameras: Collection[str] | None = None
    sets: int | None = None
    """Number of frame sets, from the first."""
    depth: Collection[str] | None = None
    images_until: Mapping[str, int] | None = None
    """Set from which a camera has no more images."""
    keypoints: Collection[str] | None = None
    candidates: Collection[str] | None = None

    def apply(self, paths: Mapping[str, Path], folder: Path) -> dict[str, Path]:
        """Write the reduced artefacts of ``paths`` (by stage, frames at least) into ``folder``."""
        folder.mkdir(parents=True, exist_ok=True)
        with artefacts.read(paths["frames"], schemas.FRAMES) as frames:
            names = frames.text("camera_names")
        return {
            stage: self._copy(paths[stage], schema, names, folder / f"{stage}.h5")
            for stage, schema in STAGES.items()
            if stage in paths
        }

    def _copy(self, source: Path, schema: Schema, names: list[str], path: Path) -> Path:
        with artefacts.read(source, schema) as old:
            kept = [c for c, n in enumerate(names) if self.cameras is None or n in self.cameras]
            attributes = {name: old.attributes[name] for name in schema.attributes}
            digest = str(old.attributes["settings_digest"])
            with artefacts.write(path, schema, settings_digest=digest, **attributes) as new:
                for key in old.keys():  # noqa: SIM118 (not a dict)
                    if "/" not in key:
                        new.put(key, self._values(old, key, names, kept))
                for c in kept:
                    self._copy_camera(old, new, names[c])
        return path

    def _values(
        self, old: Artefact, key: str, names: list[str], kept: list[int]
    ) -> np.ndarray | list[str]:
        """A whole dataset with its T and C axes cut and what is taken away blanked out."""
        if key in ("mask_offsets", "mask_rle", "beside_offsets", "beside_rle"):
            what, which = key.split("_")
            return self._masks(old, what, names, kept)[which == "rle"]
        if key.startswith(("cloud_", "rim_")) and key != "cloud_residual":
            return self._of_cloud(old, key.partition("_")[0], key, names, kept)
        if key == "pairs" or key.startswith("pair_"):
            return old[key][:0]
        values = old[key].copy()
        dims = old._schema.field_of(key).dims
        for c, name in enumerate(names):
            if key in _OF_DEPTH_LENS and not _has(self.depth, name):
                values[c] = _OF_DEPTH_LENS[key]
            if key in _EMPTY:
                empty, needs = _EMPTY[key]
                if needs and not _has(getattr(self, needs), name):
                    values[:, c] = empty
                if name in (self.images_until or {}):
                    values[self.images_until[name] :, c] = empty
        for axis, dim in enumerate(dims):
            if dim == "T" and self.sets is not None:
                values = values.take(np.arange(min(self.sets, values.shape[axis])), axis)
            elif dim == "C":
                values = values.take(kept, axis)
        return list(values) if values.dtype == object else values

    def _of_cloud(
        self, old: Artefact, prefix: str, key: str, names: list[str], kept: list[int]
    ) -> np.ndarray:
        """A dataset of the person's clouds, with the rows of the cameras and sets that are kept."""
        if key == "cloud_window":
            return old[key][: self.sets][:, kept]
        offsets, view = old[f"{prefix}_offsets"], old[f"{prefix}_view"]
        set_of_row = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
        until = np.array([(self.images_until or {}).get(n, len(offsets)) for n in names])
        seen = np.isin(view, kept) & (set_of_row < until[view])
        if prefix == "cloud":
            seen &= np.array([_has(self.depth, name) for name in names])[view]
        sets = len(offsets) - 1 if self.sets is None else min(self.sets, len(offsets) - 1)
        seen &= set_of_row < sets
        if key == f"{prefix}_offsets":
            counts = np.bincount(set_of_row[seen], minlength=sets)
            return np.concatenate([[0], np.cumsum(counts)])
        return np.searchsorted(kept, view[seen]) if key.endswith("_view") else old[key][seen]

    def _masks(
        self, old: Artefact, what: str, names: list[str], kept: list[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        masks = unpack_ragged(old[f"{what}_offsets"], old[f"{what}_rle"])
        total = len(masks) // len(names) if self.sets is None else self.sets
        until = self.images_until or {}
        return pack_ragged(
            [
                masks[t * len(names) + c] if t < until.get(names[c], total) else b""
                for t in range(total)
                for c in kept
            ]
        )

    def _copy_camera(self, old: Artefact, new: Writer, name: str) -> None:
        group = f"cameras/{name}"
        keys = [key for key in old.keys(f"{group}/") if key.count("/") == 2]
        if f"{group}/people_offsets" in keys:
            self._copy_detections(old, new, name)
            return
        for key in keys:
            part = key.rsplit("/", 1)[1]
            if part in ("depth", "depth_time", "background") and not _has(self.depth, name):
                continue
            if part == "background":
                new.put(key, old[key])
                continue
            index = "depth_index" if part.startswith("depth") else "colour_index"
            count = self._num_images(old, name, index)
            if part == "depth":
                rows = new.stream(key, old.describe(key)[0][1:])
                for row in range(count):
                    rows.append(old.rows(key, slice(row, row + 1)))
            elif part == "colour":
                end = old[f"{group}/colour_offsets"][count]
                new.put(key, old.rows(key, slice(0, int(end))))
            elif part in ("depth_time", "colour_time"):
                new.put(key, old[key][:count])
            else:
                new.put(key, old[key][: count + 1])  # colour_offsets

    def _num_images(self, old: Artefact, name: str, index: str) -> int:
        """Images of a camera that the kept sets need."""
        column = old.text("camera_names").index(name)
        return int(old[index][: self.sets, column].max(initial=-1)) + 1

    def _copy_detections(self, old: Artefact, new: Writer, name: str) -> None:
        group = f"cameras/{name}"
        until = (self.images_until or {}).get(name)
        for (key, parts), wanted in zip(_RAGGED, (self.keypoints, self.candidates), strict=True):
            offsets = old[f"{group}/{key}"][: None if self.sets is None else self.sets + 1].copy()
            if until is not None:
                offsets[until + 1 :] = offsets[until]
            if not _has(wanted, name):
                offsets[:] = 0
            new.put(f"{group}/{key}", offsets)
            end = int(offsets[-1])
            for part in parts:
                new.put(f"{group}/{part}", old[f"{group}/{part}"][:end])
        starts = old[f"{group}/rle_offsets"][: end + 1]
        new.put(f"{group}/rle_offsets", starts)
        new.put(f"{group}/rle", old[f"{group}/rle"][: int(starts[-1])])


def _has(cameras: Collection[str] | None, name: str) -> bool:
    return cameras is None or name in cameras
