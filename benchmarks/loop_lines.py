"""How many lines of code the loop has, where they are, and how many of them are rules that `benchmarks/ablation.py` can switch off.

    python benchmarks/loop_lines.py

Comments, docstrings and empty lines do not count.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

from ablation import SEARCH, VERDICT

import femsense.loop

LOOP = Path(femsense.loop.__file__).parent
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def code_lines(text: str) -> set[int]:
    """Return the numbers of the lines with code."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = {n for t in tokens if t.type not in NO_CODE for n in range(t.start[0], t.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def main() -> None:
    """Print the lines of each room, of imports, and of the rules."""
    rules = {path.rsplit(".", 1)[1] for switch in (*SEARCH, *VERDICT) for path in switch.constants}
    rooms, of_rules, imports = Counter[str](), Counter[str](), 0
    for file in sorted(LOOP.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        lines = code_lines(text)
        rooms[file.relative_to(LOOP).parts[0]] += len(lines)
        for node in ast.walk(ast.parse(text)):
            own = lines & set(range(getattr(node, "lineno", 0), (getattr(node, "end_lineno", 0) or 0) + 1))
            if isinstance(node, ast.Import | ast.ImportFrom):
                imports += len(own)
            elif isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name in rules:
                of_rules[node.name] += len(own)
    print(f"{rooms.total()} lines of code; {imports} are imports")
    print(", ".join(f"{room} {count}" for room, count in rooms.most_common()))
    print(
        f"rules that a switch takes out as functions: {len(of_rules)}, {of_rules.total()} lines: {dict(of_rules.most_common())}"
    )


if __name__ == "__main__":
    main()
