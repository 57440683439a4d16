"""Run the lines of docs/guides/notebooks.md and print their values.

    python benchmarks/notebook.py

A block that needs arrays of the reader's own is left out. About twenty seconds of one core.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "guides" / "notebooks.md"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
READERS_OWN = "from_arrays"
LONGEST = 160


def main() -> None:
    """Print each expression of the page with its value."""
    known: dict[str, object] = {}
    for block in BLOCK.findall(PAGE.read_text(encoding="utf-8")):
        if READERS_OWN in block:
            continue
        for statement in ast.parse(block).body:
            if not isinstance(statement, ast.Expr):
                exec(compile(ast.Module([statement], []), PAGE.name, "exec"), known)
                continue
            value = eval(compile(ast.Expression(statement.value), PAGE.name, "eval"), known)
            print(f"{ast.unparse(statement)}\n    {' '.join(repr(value).split())[:LONGEST]}", flush=True)
            if hasattr(value, "stop"):
                value.stop()


if __name__ == "__main__":
    main()
