"""Number of constants of the package, ``constants.total`` of `intercap dev evaluate`.

A constant is a name in capitals that a module binds to a number or to a tuple of numbers. It has a
source if the comment on its line or above it cites one: a paper, a data sheet, a standard, anatomy,
or a measurement. "Tuned" counts those whose comment says that they were tuned on the studio.
"""

from __future__ import annotations

import ast
import re
from collections import Counter

from bench.changed_constant import bound_constants
from intercap_core.shipped import PACKAGE

SOURCE = re.compile(
    r"et al|\b(19|20)\d\d\b|data ?sheet|doi|arXiv|ISO|IEEE|BOP|COCO|SMPL|Kinect|OpenPose|anatom|"
    r"measured|standard|paper|equation|specification|python -m bench",
    re.IGNORECASE,
)
TUNED = re.compile(r"\btuned\b|\bstudio\b", re.IGNORECASE)


def total_constants() -> int:
    """Number of constants in all modules of the package."""
    texts = (path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    return sum(count_constants(text)["constants"] for text in texts)


def count_constants(text: str) -> Counter[str]:
    """How many constants a module has, and how many of them cite a source or were tuned."""
    counts: Counter[str] = Counter()
    lines = text.splitlines()
    for node in ast.parse(text).body:
        names = bound_constants(node, keys_too=True)
        comment = _comment(lines, node.lineno, node.end_lineno or node.lineno)
        counts["constants"] += len(names)
        counts["source"] += len(names) * bool(SOURCE.search(comment))
        counts["tuned"] += len(names) * bool(TUNED.search(comment))
    return counts


def _comment(lines: list[str], first: int, last: int) -> str:
    """The comments on a statement's own lines and directly above it."""
    own = " ".join(line.partition("#")[2] for line in lines[first - 1 : last])
    above = []
    for line in reversed(lines[: first - 1]):
        if not line.startswith("#"):
            break
        above.append(line)
    return " ".join([own, *above])
