"""Print the lines of code a room: those that hold a token other than docstrings, comments and layout.

python scripts/code_lines.py [FOLDER]
"""

from __future__ import annotations

import ast
import sys
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


def code_lines(file: Path) -> int:
    """Return the number of lines of a file that hold code."""
    with tokenize.open(file) as stream:
        text = stream.read()
    texts = set[int]()
    for node in ast.walk(ast.parse(text)):
        for statement in getattr(node, "body", []) if not isinstance(node, ast.Lambda | ast.IfExp) else []:
            if (
                isinstance(statement, ast.Expr)
                and isinstance(statement.value, ast.Constant)
                and isinstance(statement.value.value, str)
            ):
                texts.update(range(statement.lineno, (statement.end_lineno or statement.lineno) + 1))
    with file.open("rb") as stream:
        spans = [range(t.start[0], t.end[0] + 1) for t in tokenize.tokenize(stream.readline) if t.type not in LAYOUT]
    return len({line for span in spans for line in span} - texts)


def main() -> None:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "femsense"
    rooms = Counter[str]()
    files = Counter[str]()
    for file in root.rglob("*.py"):
        if "viewer" not in file.parts:
            room = file.relative_to(root).parts[0]
            rooms[room] += code_lines(file)
            files[room] += 1
    for room, lines in sorted(rooms.items()):
        print(f"{room:16} {files[room]:4} files {lines:6}")
    print(f"{'all':16} {files.total():4} files {rooms.total():6}")


if __name__ == "__main__":
    main()
