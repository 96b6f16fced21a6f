"""The energy of equation 6 as an ordered tuple of terms, each in a file of :mod:`.terms`.

    E = E_B + E_O + lambda_Q Q_t E_C + stick + body in object + object in body
        + lambda_G E_G + plant + lambda_S E_S + drift + lambda_A E_A + drift + lambda_G E_G'

The paper's E_P (equation 5) is part of E_B; body in object and object in body, stick, plant and
drift go beyond the paper. To read a term, open its file; to leave one out or add one, change
:func:`joint_terms`. Every residual is divided by the standard deviation that its source leaves
unexplained, so that a term's weight in the settings is 1 where it is as strong as its evidence. The
table of all equations is in docs/equations.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from intercap_core.config import JointSettings
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.floor import Ground
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.sequential import Trust
from intercap_core.joint.state import State
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.drift import BodyDrift, ObjectDrift
from intercap_core.joint.terms.ground import BodyGround, ObjectGround
from intercap_core.joint.terms.motion import BodyMotion, ObjectMotion
from intercap_core.joint.terms.penetration import ObjectInBody, Penetration
from intercap_core.joint.terms.plant import Plant
from intercap_core.joint.terms.stick import Stick
from intercap_core.joint.terms.term import Term


def joint_terms(
    geometry: Geometry,
    settings: JointSettings,
    sequential: State,
    *,
    data: Sequence[Term],
    contact: Contact | None,
    floor: Ground | None,
    fps: float,
    trust: Trust,
    motion: Term | None = None,
) -> tuple[Term, ...]:
    """All terms of equation 6 and what goes beyond it, in the order in which they are added.

    ``sequential`` is the state of the sequential fits; ``data`` are E_B and E_O; ``floor`` is None
    where none was seen: then nothing keeps body or object above it. ``motion`` takes the place of
    the joints' small accelerations. Without ``contact`` there is no object: the body's own terms.
    """
    handling: tuple[Term, ...] = ()
    of_object: tuple[Term, ...] = ()
    if contact is not None:
        handling = (
            contact,
            Stick(geometry, contact, fps, settings.stick_weight),
            Penetration(geometry, settings.penetration_weight),
            ObjectInBody(geometry, settings.penetration_weight),
        )
        of_object = (
            ObjectMotion(geometry, fps, settings.object_smoothness),
            ObjectDrift(
                geometry, sequential, fps, trust.object_, trust.still, settings.drift_weight
            ),
            *((ObjectGround(geometry, floor, settings.ground_weight),) if floor else ()),
        )
    return (
        *data,
        *handling,
        *((BodyGround(geometry, floor, settings.ground_weight),) if floor else ()),
        Plant(geometry, floor, fps, settings.plant_weight),
        motion or BodyMotion(geometry, fps, settings.body_smoothness),
        BodyDrift(geometry, sequential, fps, trust.body, settings.drift_weight),
        *of_object,
    )


@dataclass(frozen=True)
class Problem:
    """The sum of ``terms``, whose rows ``threads`` make."""

    terms: tuple[Term, ...]
    threads: ThreadPool = field(default_factory=ThreadPool)

    def equations(self, state: State) -> NormalEquations:
        """Linearise every term at ``state``."""
        equations = NormalEquations(len(state), self.threads)
        for term in self.terms:
            term.add(state, equations)
        return equations

    def refresh(self, state: State, but: Term | None = None) -> None:
        """Take anew at ``state`` what terms, all ``but`` one, hold fixed during a round of
        minimisation."""
        for term in self.terms:
            if term is not but:
                term.refresh(state)
