"""The object that the person handles, among everything that the candidates show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from intercap_core.errors import UserError
from intercap_core.scan.alignment import Cloud
from intercap_core.scan.surfaces import Recording, ViewSurface, connected_parts

MAX_SETS = 150  # frame sets of a recording that are used, evenly spaced
# Least distance between places of an object that was moved, metres. Middles of objects at rest move
# by 3 cm when a person hides a part of them (studio).
MOVED_M = 0.08
# Largest way of an object's middle from one frame set to the next, metres: 2 m/s at 15 a second
STEP_M = 0.15

Parts = list[list[ViewSurface]]
Chain = dict[int, list[ViewSurface]]


def find_handled(recording: Recording, name: str) -> Chain:
    """Points that show the handled object, by frame set.

    In each frame set, the points of all candidates form connected parts. Parts of consecutive frame
    sets are linked by the distance of their middles. The object is the chain that moved, or the
    only one of a recording in which nothing moves.

    Raises UserError if depth shows no candidate, if two objects moved, or if none moved and several
    stand still.
    """
    where = f"sequence {recording.frames.sequence}"
    step = max(1, -(-len(recording) // MAX_SETS))
    parts: dict[int, Parts] = {}
    for t in range(0, len(recording), step):
        views = recording.surfaces(t)
        if views:
            parts[t] = _parts(views)
    chains = sorted(_chains(parts), key=_way, reverse=True)
    shown = ", ".join(sorted(recording.labels)) or "any label"
    if not chains:
        raise UserError(
            f"{where}: no depth image shows a candidate of {name!r} ({shown}) outside the person; "
            "check the candidates and --label; shiny, dark and transparent objects measure no depth"
        )
    if is_still(chains[0]):
        often = [chain for chain in chains if len(chain) > len(parts) / 2]
        if len(often) == 1:
            return often[0]
        raise UserError(
            f"{where}: nothing moves among the candidates ({shown}), and {len(often)} objects "
            f"stand still, so that it is not known which is {name!r}; record a person who picks it "
            "up and turns it, or name its detector class (--label)"
        )
    object_ = chains[0]
    for other in chains[1:]:
        shared = object_.keys() & other.keys()
        # an object at rest of which a person hides one half moves its middle by a quarter
        if _way(other) > max(MOVED_M, _extent(other) / 2) and len(shared) > 0.3 * len(object_):
            a, b = (f"{_way(chain):.2f} m" for chain in (object_, other))
            raise UserError(
                f"{where}: two objects move, by {a} and {b}, in {len(shared)} frame sets at once; "
                f"expected {name!r} alone: record it alone, or name its detector class (--label)"
            )
    return object_


def is_still(chain: Chain) -> bool:
    """Whether the object stayed in its place."""
    return _way(chain) < MOVED_M


def slowest(chain: Chain) -> list[int]:
    """The third of the frame sets in which the object's middle moves least."""
    sets = sorted(chain)
    middles = np.array([_middle(chain[t]) for t in sets])
    speed = np.linalg.norm(np.gradient(middles, axis=0), axis=1) if len(sets) > 1 else np.zeros(1)
    return [sets[i] for i in np.argsort(speed, kind="stable")[: -(-len(sets) // 3)]]


def cloud_of(views: Sequence[ViewSurface]) -> Cloud:
    """The points of all cameras."""
    return Cloud(
        np.concatenate([view.points for view in views]).astype(float),
        np.concatenate([view.normals for view in views]).astype(float),
    )


def _parts(views: Sequence[ViewSurface]) -> Parts:
    """The connected parts of the points of all cameras, the largest first."""
    points = np.concatenate([view.points for view in views])
    ends = np.cumsum([0, *(len(view.points) for view in views)])
    result = []
    for part in connected_parts(points):
        cuts = np.searchsorted(part, ends)
        own = [
            view.subset(part[first:last] - start)
            for view, start, first, last in zip(views, ends[:-1], cuts[:-1], cuts[1:], strict=True)
            if last > first
        ]
        result.append(own)
    return result


def _middle(part: Sequence[ViewSurface]) -> np.ndarray:
    return np.concatenate([view.points for view in part]).mean(0)


def _chains(parts: Mapping[int, Parts]) -> list[Chain]:
    """Chains of parts over frame sets; each part goes to the nearest chain that was seen last."""
    chains: list[Chain] = []
    middles: list[np.ndarray] = []
    for t in sorted(parts):
        free = [(part, _middle(part)) for part in parts[t]]
        for number in sorted(range(len(chains)), key=lambda n: -max(chains[n])):
            if not free:
                break
            reach = STEP_M * np.sqrt(t - max(chains[number]))
            away = [np.linalg.norm(middle - middles[number]) for _, middle in free]
            nearest = int(np.argmin(away))
            if away[nearest] < reach:
                chains[number][t], middles[number] = free.pop(nearest)
        chains += [{t: part} for part, _ in free]
        middles += [middle for _, middle in free]
    return chains


def _extent(chain: Chain) -> float:
    """Median over the frame sets of the longest side of the box around the points, metres."""
    return float(np.median([np.ptp(cloud_of(p).points, axis=0).max() for p in chain.values()]))


def _way(chain: Chain) -> float:
    """Diagonal of the box around the middles of a chain, metres."""
    middles = np.array([_middle(part) for part in chain.values()])
    return float(np.linalg.norm(np.ptp(middles, axis=0)))
