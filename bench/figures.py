"""matplotlib, which the comparisons draw their pictures with."""

from __future__ import annotations

from typing import Any

from intercap_core.errors import UserError


def figure_class() -> Any:
    """matplotlib's class of figures; raises UserError where it is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError(
            "pictures of comparisons are drawn by matplotlib, which is not installed; install it "
            "with pip install 'intercap-core[bench]'"
        ) from error
    return Figure
