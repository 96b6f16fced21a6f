"""Print the size of the package, by folder: files, lines, constants, class names, documentation.

    python tools/size_report.py [ROOT]

Constants are counted as in :mod:`bench.evaluate.constants`.
"""

from __future__ import annotations

import ast
import statistics
import sys
from collections import Counter, defaultdict
from pathlib import Path

from bench.evaluate.constants import count_constants

PACKAGE = "intercap_core"
GENERATED = ("artefacts.md", "workflow.md")
CODE = (PACKAGE, "snakemake_executor_plugin_intercap_slurm", "tests", "bench", "tools", "workflow")


def main() -> None:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1]
    classes: dict[str, set[Path]] = defaultdict(set)
    constants: Counter[str] = Counter()
    print(f"{'folder':42}{'files':>6}{'lines':>8}{'constants':>10}{'source':>7}{'tuned':>6}")
    totals: dict[str, list[int]] = {}
    sizes: list[int] = []
    for folder in _folders(root):
        counts: Counter[str] = Counter()
        for path in _modules(root / folder, deep=folder != PACKAGE):
            text = path.read_text(encoding="utf-8")
            counts["files"] += 1
            counts["lines"] += len(text.splitlines())
            if not folder.startswith(PACKAGE):
                continue
            sizes.append(len(text.splitlines()))
            counts += count_constants(text)
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.ClassDef):
                    classes[node.name].add(path)
        constants += counts
        row = [counts[key] for key in ("files", "lines", "constants", "source", "tuned")]
        print(f"{folder:42}{row[0]:6}{row[1]:8}{row[2]:10}{row[3]:7}{row[4]:6}")
        total = totals.setdefault(folder.partition("/")[0], [0] * 5)
        totals[folder.partition("/")[0]] = [a + b for a, b in zip(total, row, strict=True)]
    print()
    for name, row in totals.items():
        print(f"{name:42}{row[0]:6}{row[1]:8}{row[2]:10}{row[3]:7}{row[4]:6}")
    ambiguous = sorted(name for name, paths in classes.items() if len(paths) > 1)
    print(f"\nmedian file of {PACKAGE}: {statistics.median(sizes):.0f} lines")
    print(f"class names with several meanings: {len(ambiguous)} {' '.join(ambiguous)}")
    words = {path: len(path.read_text(encoding="utf-8").split()) for path in _documents(root)}
    for path, count in words.items():
        print(f"{count:8} words  {path.relative_to(root)}")
    guides = {path: n for path, n in words.items() if path.parent.name == "docs"}
    written = sum(n for path, n in guides.items() if path.name not in GENERATED)
    print(f"{sum(words.values()):8} words in all, {written} of them in docs/ and not generated")


def _folders(root: Path) -> list[str]:
    """The package, its subpackages, and the other folders that hold code."""
    found = [PACKAGE]
    found += sorted(
        f"{PACKAGE}/{path.name}" for path in (root / PACKAGE).iterdir() if any(path.glob("*.py"))
    )
    return found + [name for name in CODE[1:] if (root / name).is_dir()]


def _modules(folder: Path, *, deep: bool) -> list[Path]:
    return sorted(folder.rglob("*.py") if deep else folder.glob("*.py"))


def _documents(root: Path) -> list[Path]:
    top = [root / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    return [
        *top,
        root / "config/README.md",
        root / "bench/RESULTS.md",
        *sorted(root.glob("docs/*.md")),
    ]


if __name__ == "__main__":
    main()
