"""Break one line at a time and check that the test named for it fails.

    python scripts/sabotage.py [WORD …] [--sample N] [--seed S] [--jobs N]

The lines stand in scripts/sabotages.toml. With words, only entries whose file or test contains one of them run; `--sample` draws N
of them, with a new seed each time, which is printed. Exit status 1: a test passed on broken code, or an entry names a line or a
test that does not exist. The named tests are expected to pass on the code as it is.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NEEDED = ("femsense", "tests", "meshes", "docs", "benchmarks", "scripts", "pyproject.toml")
LONGEST_S = 600.0
"""A broken solver may never end: a test that runs longer than this counts as failed."""


@dataclass(frozen=True)
class Sabotage:
    """One line to break and the test that must fail."""

    file: str
    """Path from the root of the repository."""
    line: str
    """Text that occurs exactly once in the file."""
    broken: str
    """Its replacement."""
    test: str
    """Node id of pytest."""

    def __str__(self) -> str:
        return f"{self.file}: {self.line} → {self.broken}"

    def stale(self, root: Path = ROOT) -> str:
        """Return what is wrong with the entry itself, "" where its line and its test exist."""
        source, (test, _, function) = root / self.file, self.test.partition("::")
        if (count := source.read_text(encoding="utf-8").count(self.line) if source.is_file() else 0) != 1:
            return f"the line occurs {count} times in the file"
        defined = rf"^def {re.escape(function.partition('[')[0])}\("
        found = (root / test).is_file() and re.search(defined, (root / test).read_text(encoding="utf-8"), re.MULTILINE)
        return "" if found else f"there is no {self.test}"


def load(file: Path = ROOT / "scripts" / "sabotages.toml") -> list[Sabotage]:
    return [Sabotage(**entry) for entry in tomllib.loads(file.read_text(encoding="utf-8"))["sabotage"]]


def copy_repository(root: Path, folder: Path) -> Path:
    """Copy what the tests need into a folder, compiled kernels too; data that stand beside the repository are linked."""
    copy = folder / root.name
    for part in (root / name for name in NEEDED if (root / name).exists()):
        if part.is_dir():
            shutil.copytree(part, copy / part.name, symlinks=True, ignore=shutil.ignore_patterns("node_modules"))
        else:
            shutil.copy2(part, copy / part.name)
    if (root.parent / "shared").exists():
        (folder / "shared").symlink_to(root.parent / "shared")
    return copy


def result_of(sabotage: Sabotage, root: Path = ROOT) -> str:
    """Run the test in a copy of the repository with the line broken; return "failed", "SURVIVED", "skipped" or "DID NOT RUN".

    numba compiles the kernels of the changed file again. A kernel of another file that inlines one of them stays as it was: the
    test has to call the broken file itself.
    """
    with tempfile.TemporaryDirectory(prefix="sabotage-") as folder:
        copy = copy_repository(root, Path(folder))
        broken = copy / sabotage.file
        broken.write_text(broken.read_text(encoding="utf-8").replace(sabotage.line, sabotage.broken), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-x", "--tb=no", "-p", "no:cacheprovider", sabotage.test]
        threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
        environment = {**os.environ, **threads, "PYTHONPATH": str(copy), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        try:
            done = subprocess.run(
                command, cwd=copy, env=environment, capture_output=True, text=True, timeout=LONGEST_S, check=False
            )
        except subprocess.TimeoutExpired:
            return "failed"
    if done.returncode == 0:
        return "SURVIVED" if " passed" in done.stdout else "skipped"
    return "failed" if done.returncode == 1 and " failed" in done.stdout else "DID NOT RUN"


def main() -> int:
    parser = argparse.ArgumentParser(description="Break one line at a time and check that the test named for it fails.")
    parser.add_argument("words", nargs="*", help="only entries whose file or test contains one of these")
    parser.add_argument("--sample", type=int, help="draw this many entries")
    parser.add_argument("--seed", type=int, default=random.randrange(10**6), help="of the sample; drawn anew by default")
    parser.add_argument("--jobs", type=int, default=1, help="tests that run at a time")
    options = parser.parse_args()
    entries = load()
    stale = [f"{entry}: {why}" for entry in entries if (why := entry.stale())]
    chosen = [e for e in entries if not options.words or any(word in f"{e.file} {e.test}" for word in options.words)]
    if options.sample:
        chosen = random.Random(options.seed).sample(chosen, min(options.sample, len(chosen)))
        print(f"{len(chosen)} of {len(entries)} sabotages, drawn with --seed {options.seed}")
    if stale or not chosen:
        print(*(stale or ["no entry contains these words"]), sep="\n")
        return 1
    survived = 0
    with ThreadPoolExecutor(options.jobs) as pool:
        for entry, result in zip(chosen, pool.map(result_of, chosen)):
            print(f"{result:11}  {entry}", flush=True)
            survived += result in ("SURVIVED", "DID NOT RUN")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
