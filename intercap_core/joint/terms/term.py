"""What the joint problem is a sum of: one term of equation 6, or one that goes beyond it."""

from __future__ import annotations

from abc import ABC, abstractmethod

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.state import State


class Term(ABC):
    """One part of the joint energy.

    ``name`` is what its energy is called in joint.h5; E_G and E_G' share one. What stays fixed
    while the energy is minimised is held by the term and taken anew by :meth:`refresh`.
    """

    name: str

    def refresh(self, state: State) -> None:  # noqa: B027  most terms hold nothing
        """Take anew at ``state`` what is held during a round; nothing for most terms."""

    @abstractmethod
    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the term's energy and its Gauss-Newton equations, linearised at ``state``."""
