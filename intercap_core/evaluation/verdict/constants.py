"""Numbers of the verdict without truth: each with its unit and the reason for its value."""

from __future__ import annotations

from typing import NamedTuple

from intercap_core.evaluation.verdict.part import Part

# A camera judges so many seconds of frames before the next one does: longer than velocities are
# taken over, short enough that every camera judges a recording of two seconds.
HELD_S = 0.2
# Of fewer frames of a sequence, as a share, no error is stated: the rest would be a guess.
MIN_JUDGED_SHARE = 0.5


class Factors(NamedTuple):
    """Of the stated error: ``rest``, metres, the factors ``of`` the features, and the ``spread``:
    four of five true errors are within this factor of the stated one."""

    rest: float
    of: tuple[float, float, float, float]
    spread: float


# Fitted by `python -m bench.verdict` to the studio's truth: 41 recordings seen by two to six
# cameras, with and without depth, at usual and twice the noise, with other builds, people alone and
# a beam. The spreads are those of kinds of recordings that were left out of the fit.
FACTORS = {
    Part.BODY: Factors(0.0041, (1.55, 0.07, 0.69, 1.08), 1.28),
    Part.HANDS: Factors(0.0, (0.97, 0.15, 0.81, 1.40), 1.25),
    Part.OBJECT: Factors(0.0013, (1.37, 0.08, 0.0, 0.0), 1.88),
}
