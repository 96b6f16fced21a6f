"""Heavy shoes: flat soles under the feet and leather round them, worn as clothing is worn.

The bare feet stay what is true; floor is met by the soles. Thicknesses are those of work boots:
22 mm of sole under the lowest skin, 10 to 15 mm at the sides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.studio.subjects import Subject

SOLE_M = 0.022
LEATHER_M = (0.010, 0.015)
THICKEST_M = 0.045  # a sole fills the arch of a foot, and no more
SHAFT_M = 0.01  # how far above the ankles shoes end
RIM_M = 0.02  # over which the leather gets thin there
SLOPING = 0.3  # how far down normals point from where on the skin is over the sole
FEET = ((7, 10), (8, 11))  # joints: ankle and ball of the left foot, of the right one


def shoe_area(subject: Subject) -> np.ndarray:
    """Which vertices (V,) are in the shoes."""
    share = np.asarray(subject.weights[:, [joint for foot in FEET for joint in foot]].sum(1))
    return (share.ravel() > 0.5) & (subject.rest[:, 1] < _top(subject))


def in_heavy_shoes(subject: Subject, rng: np.random.Generator) -> Subject:
    """The same person in heavy shoes, which are part of the clothing; ``rng`` draws the leather."""
    leather = rng.uniform(*LEATHER_M)
    down = -subject.normals(subject.rest[None])[0, :, 1]
    clothing, height = subject.clothing.copy(), subject.rest[:, 1]
    worn = shoe_area(subject)
    for foot in FEET:
        share = np.asarray(subject.weights[:, foot].sum(1)).ravel()
        own = np.flatnonzero(worn & (share > 0.5))
        ground = height[own].min() - SOLE_M
        # along the normal down to the sole, but not farther to the side than leather may be thick
        across = np.sqrt(np.maximum(1 - down[own] ** 2, 1e-6))
        deep = (height[own] - ground) / np.maximum(down[own], SLOPING)
        sole = np.minimum(deep, LEATHER_M[1] / across)
        sides = leather * np.clip((_top(subject) - height[own]) / RIM_M, 0.3, 1)
        below = np.maximum(sides, np.minimum(sole, THICKEST_M))
        clothing[own] = np.where(down[own] > SLOPING, below, sides)
    return replace(subject, clothing=clothing, sole_m=SOLE_M)


def _top(subject: Subject) -> float:
    """Height in the T-pose at which shoes end, metres."""
    return float(subject.rest_joints[[7, 8], 1].mean()) + SHAFT_M
