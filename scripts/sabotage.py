"""Break key lines one at a time (a sign, a transpose, millimetres for metres, a factor) and demand that named tests turn red.

    python scripts/sabotage.py [WORD …] [--list] [--jobs N] [--sample N [--seed S] [--seconds T]] [--green]

The lines stand in scripts/sabotages/<room>.toml.
With words only those entries run whose file or tests contain one of them; `--sample` draws so many, spread over all files, each
with the first of its tests alone. No entry begins later than `--seconds`. The work is done in copies of the repository, one a
job. The tests must be green there first; `--green` says that they have just been seen so.

Exit status 0: every sabotage was noticed; 1: one survived,
or an entry names a line or a test that is not there (all entries are looked at for that, whichever run).
"""

from __future__ import annotations

import argparse
import os
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("docs", "femsense", "tests", "meshes", "examples", "scripts", "pyproject.toml", "hatch_build.py")
MOST_S = 600.0
"""Tests that take longer than this [s] have noticed: what is broken does not end."""


@dataclass(frozen=True)
class Sabotage:
    """One line to break and the tests that must notice."""

    file: str
    """Path from the root of the repository."""
    line: str
    """Text that stands in the file exactly once."""
    broken: str
    """What it is replaced by."""
    tests: tuple[str, ...]
    """Node ids of pytest, in tests/; the cheapest first."""


def load_sabotages(folder: Path = ROOT / "scripts" / "sabotages") -> list[Sabotage]:
    """Return all entries, room by room. Each table is called after its file in the room."""
    found = []
    for room in sorted(folder.glob("*.toml")):
        for file, entries in tomllib.loads(room.read_text(encoding="utf-8")).items():
            found += [Sabotage(f"femsense/{room.stem}/{file}", **{**e, "tests": tuple(e["tests"])}) for e in entries]
    return found


# Entries that are no longer true


def what_is_stale(sabotage: Sabotage, root: Path = ROOT) -> str:
    """Return what an entry names that is not there, "" where all of it is."""
    path = root / sabotage.file
    count = path.read_text(encoding="utf-8").count(sabotage.line) if path.is_file() else 0
    if count != 1:
        return f"the line stands {count} times in the file"
    missing = [test for test in sabotage.tests if not _is_test(test, root)]
    return f"no test is called {missing[0]}" if missing else ""


def _is_test(name: str, root: Path) -> bool:
    file, _, function = name.partition("::")
    path = root / "tests" / file
    wanted = rf"^\s*def {re.escape(function.partition('[')[0])}\("
    return path.is_file() and re.search(wanted, path.read_text(encoding="utf-8"), re.MULTILINE) is not None


# What runs


def draw(sabotages: Sequence[Sabotage], count: int, rng: random.Random) -> list[Sabotage]:
    """Return so many entries, one of each file before the second of any, each with its first test alone."""
    by_file: dict[str, list[Sabotage]] = {}
    for sabotage in rng.sample(list(sabotages), len(sabotages)):
        by_file.setdefault(sabotage.file, []).append(sabotage)
    drawn = list[Sabotage]()
    while by_file and len(drawn) < count:
        for file in list(by_file)[: count - len(drawn)]:
            drawn.append(by_file[file].pop())
        by_file = {file: rest for file, rest in by_file.items() if rest}
    return [replace(sabotage, tests=sabotage.tests[:1]) for sabotage in drawn]


def copy_repository(folder: Path) -> Path:
    """Copy what the tests need into a folder, compiled kernels too; data that stand beside the repository are linked."""
    copy = folder / ROOT.name
    copy.mkdir(parents=True)
    for part in PARTS:
        source = ROOT / part
        if source.is_dir():
            shutil.copytree(source, copy / part, symlinks=True)
        elif source.is_file():
            shutil.copy2(source, copy / part)
    beside = ROOT.parent / "shared"
    if beside.exists():
        (folder / "shared").symlink_to(beside)
    return copy


def red(copy: Path, tests: Sequence[str], *, most_s: float = MOST_S) -> tuple[bool, str]:
    """Run tests in the copy; return whether any fails, and the last line of the report."""
    one_thread = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
    environment = {**os.environ, **one_thread, "PYTHONPATH": str(copy), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    options = ["-x", "--no-header", "--tb=no", "--disable-warnings"]
    command = [sys.executable, "-m", "pytest", *options, *(f"tests/{test}" for test in tests)]
    try:
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=most_s, check=False)
    except subprocess.TimeoutExpired:
        return True, "took too long"
    lines = (done.stdout + done.stderr).strip().splitlines() or ["no report"]
    summary = next((line for line in reversed(lines) if " passed" in line or " failed" in line), lines[-1])
    if done.returncode not in (0, 1) or (done.returncode == 1 and " failed" not in summary):
        return False, f"the tests did not run: {summary}"  # a name that no test has is no red
    return done.returncode == 1, summary


@contextmanager
def broken(copy: Path, sabotage: Sabotage) -> Iterator[None]:
    """Break the line in the copy, and put it back with the kernels that were compiled from the whole file.

    Kernels of other files that take in one of this file keep what they took in: its tests have to call the file itself.
    """
    path = copy / sabotage.file
    original, status = path.read_text(encoding="utf-8"), path.stat()
    aside = copy / "compiled"
    aside.mkdir()
    for kernel in (path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ic]"):
        kernel.rename(aside / kernel.name)
    path.write_text(original.replace(sabotage.line, sabotage.broken), encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(original, encoding="utf-8")
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
        for kernel in (path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ic]"):
            kernel.unlink()
        for kernel in aside.iterdir():
            kernel.rename(path.parent / "__pycache__" / kernel.name)
        aside.rmdir()


def try_one(copy: Path, sabotage: Sabotage) -> tuple[str, str]:
    """Break one line, run its tests, mend it; return "red", "SURVIVED" or "skipped", and a remark."""
    began = time.monotonic()
    with broken(copy, sabotage):
        noticed, remark = red(copy, sabotage.tests)
    result = "red" if noticed else "skipped" if "skipped" in remark and "passed" not in remark else "SURVIVED"
    return result, f"{time.monotonic() - began:5.1f} s  {remark}"


def try_all(chosen: Sequence[Sabotage], copies: Sequence[Path], *, most_s: float) -> list[str]:
    """Try entries, one a copy at a time; return the results of those that began in time."""
    idle: queue.SimpleQueue[Path] = queue.SimpleQueue()
    for copy in copies:
        idle.put(copy)
    end = time.monotonic() + most_s

    def run(sabotage: Sabotage) -> str:
        if time.monotonic() > end:
            return "left"
        copy = idle.get()
        try:
            result, remark = try_one(copy, sabotage)
        finally:
            idle.put(copy)
        print(f"{result:8}  {shown(sabotage)}  {remark}", flush=True)
        return result

    with ThreadPoolExecutor(len(copies)) as pool:
        return list(pool.map(run, chosen))


def shown(sabotage: Sabotage) -> str:
    line, changed = (" ".join(text.split())[:44] for text in (sabotage.line, sabotage.broken))
    return f"{sabotage.file:40}  {line:44}  →  {changed:44}"


def options_of(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Break key lines one at a time and demand that named tests turn red.")
    parser.add_argument("words", nargs="*", help="only entries whose file or tests contain one of these")
    parser.add_argument("--list", action="store_true", help="only say what would run")
    parser.add_argument("--jobs", type=int, default=1, help="how many run at a time")
    parser.add_argument("--sample", type=int, help="draw so many, spread over all files")
    today = datetime.now(tz=UTC).toordinal()
    parser.add_argument("--seed", type=int, default=today, help="of the drawing; by default the day's own")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="none begins later than this [s]")
    parser.add_argument("--green", action="store_true", help="the tests have just been seen to be green")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str]) -> int:
    options = options_of(arguments)
    sabotages = load_sabotages()
    stale = [(sabotage, why) for sabotage in sabotages if (why := what_is_stale(sabotage))]
    for sabotage, why in stale:
        print(f"STALE     {shown(sabotage)}  {why}")
    dead = {id(sabotage) for sabotage, _ in stale}
    words = options.words
    chosen = [s for s in sabotages if id(s) not in dead and (not words or any(w in " ".join((s.file, *s.tests)) for w in words))]
    if not chosen:
        print(f"no file and no test of an entry contains {' or '.join(words)}")
        return 1
    if options.sample:
        chosen = draw(chosen, options.sample, random.Random(options.seed))
        print(f"{len(chosen)} of {len(sabotages)} entries, drawn with --seed {options.seed}")
    if options.list:
        print(*map(shown, chosen), sep="\n")
        return 1 if stale else 0
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="sabotage") as folder:
        copies = [copy_repository(Path(folder) / str(i)) for i in range(options.jobs)]
        if not options.green:
            broken_already, remark = red(copies[0], list(dict.fromkeys(test for s in chosen for test in s.tests)), most_s=7200.0)
            if broken_already or "passed" not in remark:
                print(f"the tests are not green to begin with: {remark}")
                return 1
        results = try_all(chosen, copies, most_s=options.seconds)
    counts = {result: results.count(result) for result in ("red", "SURVIVED", "skipped", "left")}
    print(
        f"{counts['red']} of {len(results)} noticed, {counts['SURVIVED']} survived, {len(stale)} stale, "
        f"{counts['skipped']} without their data, {counts['left']} left for want of time; {time.monotonic() - began:.0f} s"
    )
    return 1 if stale or counts["SURVIVED"] else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
