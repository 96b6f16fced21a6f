"""The examples of docs/extending.md, put in place in a copy of the project."""

from __future__ import annotations

import ast
import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
BLOCK = re.compile(
    r"^```python\n# (\S+?)(?:, before: (\"[^\n]*\"))?\n(.*?)^```$", re.MULTILINE | re.DOTALL
)


def apply_chapter(title: str, root: Path) -> list[Path]:
    """Write the code blocks of a chapter into the project at ``root``; returns the files.

    The first line of a block names its file. With ``, before: "TEXT"`` the code is inserted before
    the only occurrence of the text, otherwise it is a new file. Raises ValueError if a text does
    not occur exactly once, or a new file exists.
    """
    chapter = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    (text,) = [part for part in chapter if part.startswith(f"{title}\n")]
    files: dict[Path, None] = {}
    for name, anchor, code in BLOCK.findall(text):
        path = root / name
        if not anchor:
            if path.exists():
                raise ValueError(f"{name} exists")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(code, encoding="utf-8")
        else:
            before = ast.literal_eval(anchor)
            whole = path.read_text(encoding="utf-8")
            if whole.count(before) != 1:
                raise ValueError(f"{name} contains {before!r} {whole.count(before)} times")
            path.write_text(whole.replace(before, code + before), encoding="utf-8")
        files[path] = None
    return list(files)
