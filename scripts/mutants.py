"""Change the code of a room in all the ways that mutmut knows, and print which share of the changes its tests notice.

    python scripts/mutants.py ROOM [--jobs N]      a room (core) or a file of one (fem/capstan)

The work is done in a copy of the repository. The score is the share of mutants for which a test in tests/<room> fails. mutmut
leaves decorated functions alone: the compiled kernels are covered by scripts/sabotages.toml instead.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from sabotage import NEEDED, ROOT, copy_repository

SETTINGS = """
[tool.mutmut]
source_paths = {source}
pytest_add_cli_args_test_selection = {tests}
also_copy = {needed}
"""


def main() -> int:
    parser = argparse.ArgumentParser(description="Print which share of the mutants of a room its tests notice.")
    parser.add_argument("room", help="a room (core) or a file of one (fem/capstan)")
    parser.add_argument("--jobs", type=int, default=1, help="mutants that are tried at a time")
    options = parser.parse_args()
    source = Path("femsense") / options.room
    source = source if (ROOT / source).is_dir() else source.with_suffix(".py")
    tests = Path("tests") / source.parts[1]
    if not (ROOT / source).exists() or not (ROOT / tests).is_dir():
        parser.error(f"there is no {source} with tests in {tests}")
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = copy_repository(ROOT, Path(folder))
        settings = SETTINGS.format(source=json.dumps([str(source)]), tests=json.dumps([str(tests)]), needed=json.dumps(NEEDED))
        with (copy / "pyproject.toml").open("a", encoding="utf-8") as stream:
            stream.write(settings)
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        mutmut = [sys.executable, "-m", "mutmut"]
        done = subprocess.run([*mutmut, "run", "--max-children", str(options.jobs)], cwd=copy, env=environment, check=False)
        if done.returncode:
            return done.returncode
        results = subprocess.run([*mutmut, "results"], cwd=copy, env=environment, capture_output=True, text=True, check=True)
        print(*(line for line in results.stdout.splitlines() if line.endswith("survived")), sep="\n")
        subprocess.run([*mutmut, "export-cicd-stats"], cwd=copy, env=environment, capture_output=True, check=True)
        counts = json.loads((copy / "mutants" / "mutmut-cicd-stats.json").read_text(encoding="utf-8"))
    noticed = counts["killed"] + counts["timeout"]
    print(
        f"{options.room}: {noticed} of {counts['total']} mutants noticed ({100 * noticed / max(counts['total'], 1):.0f} %), "
        f"{counts['survived']} survived, {counts['no_tests']} in functions that no test of the room calls"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
