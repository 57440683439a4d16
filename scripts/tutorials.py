"""Run the tutorials of the site, and write their pages with what they print and draw.

    python scripts/tutorials.py [NAME …]

A tutorial is a script in docs/tutorials in the percent format, which Jupyter opens by Jupytext. Each runs in an empty folder. The page NAME.md next
to it holds its text, its code, and what each cell printed; pictures that it saves go to docs/pictures. Nothing is written if a cell fails.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import os
import re
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl

DOCS = Path(__file__).parents[1] / "docs"
CELL = re.compile(r"^# %%(?P<head>.*)\n", re.MULTILINE)
LONGEST = 60
"""Lines of an output that a page shows."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of a tutorial."""

    text: str
    is_markdown: bool
    is_setup: bool
    """Shown folded."""


def cells_of(script: str) -> list[Cell]:
    """Return the cells of a script in the percent format."""
    parts = CELL.split(script)[1:]
    cells = []
    for head, body in zip(parts[::2], parts[1::2]):
        is_markdown = "[markdown]" in head
        text = re.sub(r"^# ?", "", body, flags=re.MULTILINE) if is_markdown else body
        cells.append(Cell(text.strip(), is_markdown, "setup" in head))
    return cells


def code_of(cell: Cell) -> str:
    """Return how a page shows the code of a cell: a cell of commands only as a terminal."""
    lines = [re.fullmatch(r'shell\((".*")\)', line) for line in cell.text.splitlines()]
    if all(lines):
        return "```sh\n" + "\n".join(ast.literal_eval(line[1]) for line in lines if line) + "\n```\n"
    shown = f"```python\n{cell.text}\n```\n"
    return f":::{{dropdown}} Imports and a helper\n{shown}:::\n" if cell.is_setup else shown


def printed_by(cell: Cell, names: dict[str, Any], scratch: Path) -> str:
    """Run a cell and return what it prints, its own processes included."""
    file = scratch / "printed.txt"
    with file.open("w", encoding="utf-8") as stream, contextlib.redirect_stdout(stream):
        exec(compile(cell.text, "<cell>", "exec"), names)  # the tutorials of this repository
    lines = file.read_text(encoding="utf-8").splitlines()
    return "\n".join(line for line in lines if not line.startswith("compiling kernels")).strip("\n")


def page_of(name: str) -> tuple[str, dict[str, Path]]:
    """Run a tutorial; return its page and the pictures that it saved, in a folder that stays."""
    scratch = Path(tempfile.mkdtemp(prefix="femsense-tutorial-"))
    cells = cells_of((DOCS / "tutorials" / f"{name}.py").read_text(encoding="utf-8"))
    names: dict[str, Any] = {"__name__": "__main__"}
    parts, pictures, known = [], dict[str, Path](), set[Path]()
    with contextlib.chdir(scratch):
        for cell in cells:
            if cell.is_markdown:
                parts.append(cell.text + "\n")
                continue
            printed = printed_by(cell, names, scratch)
            parts.append(code_of(cell))
            if printed:
                lines = printed.replace(str(scratch) + os.sep, "").splitlines()
                parts.append("```text\n" + "\n".join([*lines[:LONGEST], *["…"][: len(lines) > LONGEST]]) + "\n```\n")
            for picture in sorted(set(scratch.glob("*.png")) - known):
                known.add(picture)
                pictures[f"tutorial-{picture.name}"] = picture
                parts.append(f"![{picture.stem.replace('-', ' ')}](../pictures/tutorial-{picture.name})\n")
    return "\n".join(parts), pictures


def main() -> None:
    mpl.use("Agg")
    parser = argparse.ArgumentParser(description="Run the tutorials and write their pages.")
    parser.add_argument("names", nargs="*", metavar="NAME")
    every = sorted(path.stem for path in (DOCS / "tutorials").glob("*.py"))
    for name in parser.parse_args().names or every:
        page, pictures = page_of(name)
        (DOCS / "tutorials" / f"{name.replace('_', '-')}.md").write_text(page, encoding="utf-8")
        for picture, file in pictures.items():
            shutil.copyfile(file, DOCS / "pictures" / picture)
        print(f"docs/tutorials/{name.replace('_', '-')}.md: {len(page.splitlines())} lines, {len(pictures)} pictures")


if __name__ == "__main__":
    main()
