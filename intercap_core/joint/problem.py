"""The energy of equation 6 as an ordered tuple of terms, each in a file of :mod:`.terms`.

    E = E_B + E_O + lambda_Q Q_t E_C + stick + body in object + object in body
        + lambda_G E_G + plant + lambda_S E_S + drift + lambda_A E_A + drift + lambda_G E_G'

E_B and E_O are the data of body and object, and E_C is contact. E_G and E_G' keep body and object
above the floor. E_S and E_A are the smoothness of body and object. The first drift is the body's,
the second the object's. The paper's E_P (equation 5) is part of E_B. Body in object, object in
body, stick, plant and drift go beyond the paper. ``TERMS`` lists all terms except E_B and E_O, in
the order in which their equations are added; docs/extending.md shows how to add one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.drift import BodyDrift, ObjectDrift
from intercap_core.joint.terms.ground import BodyGround, ObjectGround
from intercap_core.joint.terms.motion import BodyMotion, LearnedMotion, ObjectMotion
from intercap_core.joint.terms.object_data import NoObject, ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.joint.terms.penetration import ObjectInBody, Penetration
from intercap_core.joint.terms.plant import Plant
from intercap_core.joint.terms.stick import Stick
from intercap_core.joint.terms.term import JointTerm, TermContext

DATA_TERMS: tuple[type[JointTerm], ...] = (BodyData, ObjectImagesData, ObjectData, NoObject)
"""Terms of the recording's data, which :func:`intercap_core.joint.assembly.assemble` builds."""
TERMS: tuple[type[JointTerm], ...] = (
    Contact,
    Stick,
    Penetration,
    ObjectInBody,
    BodyGround,
    Plant,
    BodyMotion,
    LearnedMotion,
    BodyDrift,
    ObjectMotion,
    ObjectDrift,
    ObjectGround,
)
"""All other terms. A term that needs data that the recording lacks is left out."""


def build_terms(context: TermContext, data: Sequence[JointTerm]) -> tuple[JointTerm, ...]:
    """All terms of a recording: E_B and E_O, which are ``data``, then those of ``TERMS``."""
    for kind in TERMS:
        if kind.applies(context):
            context.terms.append(kind(context))
    return (*data, *context.terms)


@dataclass(frozen=True)
class JointProblem:
    """The sum of ``terms``; ``threads`` compute their equations."""

    terms: tuple[JointTerm, ...]
    threads: ThreadPool = field(default_factory=ThreadPool)

    def equations(self, state: State) -> BandedEquations:
        """Linearise every term at ``state``."""
        equations = BandedEquations(len(state), self.threads)
        for term in self.terms:
            term.add(state, equations)
        return equations

    def energies(self, state: State) -> BandedEquations:
        """Compute the energies of every term at ``state``, without derivatives."""
        energies = BandedEquations(len(state), self.threads, energies_only=True)
        for term in self.terms:
            term.add(state, energies)
        return energies

    def refresh(self, state: State) -> None:
        """Compute at ``state`` the quantities that the terms keep fixed during a round."""
        for term in self.terms:
            term.refresh(state)


def equation_table() -> list[str]:
    """Rows of the generated table in docs/equations.md, in Markdown."""
    lines = ["| term | formula here | paper | file | setting |", "|---|---|---|---|---|"]
    for term in (*DATA_TERMS, *TERMS):
        row = term.equation
        file = term.__module__.removeprefix("intercap_core.").replace(".", "/") + ".py"
        settings = ", ".join(f"`joint.{name}`" for name in row.settings) or "-"
        lines.append(
            f"| {row.symbol} | {row.formula} | {row.source} | `{file}` {term.__name__} "
            f"| {settings} |"
        )
    return lines
