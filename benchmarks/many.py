"""Many short recordings over processes and over dask: efficiency, overhead of a task, memory, and what happens when things die.

    python benchmarks/many.py OUT [--count 200] [--only overhead|efficiency|trouble|joint|paper] [--page docs/results/many.md]

`overhead`: ten times COUNT jobs that write one line, on two processes: time of a worker beside each, and memory of the driver.

`efficiency`: COUNT recordings of the finger are simulated, and each tenth of them is calibrated: in process, on one process, on two, and
on a local dask cluster of two. Printed for each: CPU time of all processes and that of `in process` over it, which other programs hardly
change; wall time, and efficiency by it (time inside the tasks over workers × wall time, without the start of the workers); CPU time of a
task beside that in process, without the start; memory of the driver at a tenth of the tasks and at the end; and whether all results are
the same bytes.

`trouble`: a worker is killed by a signal, the scheduler is killed, one recording kills its workers, one eats memory, the disk is full
(a file system of a few megabytes; needs the right to mount), and two drivers work on one folder.

`joint`: `improve` with 8, 20 and 80 recordings at once: its largest resident memory and CPU time; and whether one process, two, and dask give
the same bytes for 20.

`paper`: 10⁴ recordings on 50 machines, by the constants that `efficiency` has measured.

`--page` puts the tables of `efficiency`, `joint` and `paper` in the place of those of the page.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from femsense.io.files import file_hash, write_text
from femsense.many.drive import Progress, run_jobs
from femsense.many.engines import processes
from femsense.many.jobs import RECORDS, Job
from femsense.many.limits import ONE_THREAD
from femsense.many.outcome import JobStatus, Outcome
from femsense.many.work import Result, work_on

WORDS = [sys.executable, "-m", "femsense"]
ENGINES = {
    "in process": ["--workers", "0"],
    "1 process": ["--workers", "1"],
    "2 processes": ["--workers", "2"],
    "dask, 2 processes": ["--dask", "local", "--workers", "2"],
}
CAMERA = {"width": 64, "height": 48, "fx": 60.0, "eye_m": [0.05, -0.3, 0.1], "target_m": [0.05, 0.0, 0.0]}


@dataclass(frozen=True, slots=True)
class Measured:
    """What one run over all recordings took."""

    engine: str
    jobs: int
    workers: int
    wall_s: float
    """From the start of the command to its end."""
    start_s: float
    """Until the first task began."""
    inside_s: float
    """Sum over the tasks, of the command in each."""
    early_mb: float
    """Memory of the driver when a tenth of the tasks were done …"""
    late_mb: float
    """… and before the last one; then the summary is written, for which pyarrow is loaded."""
    sent_bytes: int
    """Largest record of a task, which holds more than what is sent."""
    cpu_s: float
    """CPU time of all its processes, the start included."""
    load: float
    """How many processes wanted a core meanwhile, on average over the last minute."""

    @property
    def efficiency(self) -> float:
        """Share of the workers' time between the first task and the end that was spent inside tasks."""
        return self.inside_s / (self.workers * (self.wall_s - self.start_s))

    @property
    def row(self) -> str:
        """The row of a table."""
        mb = f"{self.early_mb:.0f}, {self.late_mb:.0f} MB"
        return f"{self.cpu_s:.0f} s | {self.wall_s:.0f} s | {self.efficiency:.2f} | {mb} | {self.load:.1f}"


def task_ms(many: Measured, few: Measured) -> float:
    """Return the CPU time of one task more [ms]: the start is in both runs."""
    return 1e3 * (many.cpu_s - few.cpu_s) / (many.jobs - few.jobs)


def write_scripts(folder: Path, count: int) -> None:
    """Write scripts of the virtual rig that differ in their pull, so that their recordings do."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        sweeps = [
            {"label": f"s{k}", "cables": {"flexor": 0.5 + 0.005 * i + 0.2 * k}, "rest": 1, "up": 2, "down": 2} for k in range(2)
        ]
        truth = {"refinements": 0, "element": "tet4", "law": "corotational", "substeps": 1}
        script = {"format": "femsense-script-1", "seed": i, "dt_s": 0.5, "sweeps": sweeps, "camera": CAMERA, "truth": truth}
        (folder / f"push-{i:04d}.toml").write_text(tomli_w.dumps(script), encoding="utf-8")


def command(*words: object) -> list[str]:
    """Return the words of a command of femsense."""
    return [*WORDS, *map(str, words)]


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return float("nan")


def done_in(out: Path, name: str) -> list[Path]:
    """Return the records of the tasks that have ended."""
    return sorted((out / RECORDS / name).glob("*.json"))


def measured(engine: str, name: str, words: list[str], out: Path, count: int) -> Measured:
    """Run a command over many recordings and watch it."""
    began, started, early, late, cpu = time.perf_counter(), 0.0, float("nan"), float("nan"), cpu_of_children()
    run = subprocess.Popen(
        [*command(name), *words, "-o", str(out), *ENGINES[engine]],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **ONE_THREAD},
    )
    while run.poll() is None:
        time.sleep(0.05)
        now = resident_mb(run.pid)
        if not started and any((out / RECORDS / name).glob("*.running")):
            started = time.perf_counter() - began
        done = len(done_in(out, name))
        early = now if early != early and done >= count / 10 else early
        late = now if done < count else late
    wall, cpu = time.perf_counter() - began, cpu_of_children() - cpu
    if run.returncode:
        raise SystemExit(f"{name} ended with {run.returncode}")
    records = done_in(out, name)
    inside = sum(json.loads(file.read_text(encoding="utf-8"))["outcome"]["seconds"] for file in records)
    workers, largest = max(int(ENGINES[engine][-1]), 1), max(file.stat().st_size for file in records)
    return Measured(engine, len(records), workers, wall, started, inside, early, late, largest, cpu, os.getloadavg()[0])


def cpu_of_children() -> float:
    """Return the CPU time of all processes that were started here and have ended, with those that these started [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def content(folder: Path) -> str:
    """Return a hash of all results of a folder, without records and summaries, which hold times."""
    digest = hashlib.sha256()
    for file in sorted(folder.glob("*/**/*")):
        if file.is_file() and RECORDS not in file.parts:
            digest.update(f"{file.relative_to(folder)}\0".encode() + file.read_bytes())
    return digest.hexdigest()


def efficiency(root: Path, count: int) -> str:
    """Simulate and calibrate all recordings on each engine; return a table."""
    scripts, recordings, few = root / "scripts", root / "recordings", count // 10
    write_scripts(scripts, count)
    found, same = dict[tuple[str, str], Measured](), list[str]()
    lines = [
        "| | CPU | of that in process | wall | efficiency | driver, early and late | load |",
        "|---|---|---|---|---|---|---|",
    ]

    def run(name: str, pattern: Path, jobs: int, engine: str) -> Path:
        out = fresh(root / f"{name}-{jobs}-{engine.replace(', ', '-').replace(' ', '-')}")
        m = found[f"{name} {jobs}", engine] = measured(engine, name, ["finger", str(pattern)], out, jobs)
        share, (cpu, rest) = m.cpu_s / found[f"{name} {jobs}", "in process"].cpu_s, m.row.split(" | ", 1)
        lines.append(f"| {name} {jobs}, {engine} | {cpu} | {share:.2f} | {rest} |")
        print(lines[-1], flush=True)
        return out

    for name, jobs in (("simulate", few), ("simulate", count), ("calibrate", few)):
        outs = [
            run(
                name,
                scripts / ("*0.toml" if jobs == few else "*.toml") if name == "simulate" else recordings / "push-*5",
                jobs,
                engine,
            )
            for engine in ENGINES
        ]
        if jobs == count:
            shutil.copytree(outs[0], recordings, ignore=shutil.ignore_patterns(RECORDS), dirs_exist_ok=True)
        same.append(f"{name} {jobs}: {'the same bytes' if len({content(out) for out in outs}) == 1 else 'OTHER bytes'}")
    alone, *others = {
        engine: task_ms(found[f"simulate {count}", engine], found[f"simulate {few}", engine]) for engine in ENGINES
    }.items()
    overheads = {engine: ms - alone[1] for engine, ms in others}
    constants = {"overhead_ms": overheads["dask, 2 processes"], "sent_bytes": max(m.sent_bytes for m in found.values())}
    (root / "measured.json").write_text(json.dumps(constants), encoding="utf-8")
    beside = ", ".join(f"{ms:.0f} ms on {engine}" for engine, ms in overheads.items())
    lines += ["", f"CPU time of one task more, beside the {alone[1]:.0f} ms of it in process: {beside}."]
    return "\n".join([*lines, f"On all engines: {', '.join(same)}. The largest record has {constants['sent_bytes']} bytes."])


# Overhead


def write_line(job: Job) -> Outcome:
    """Do next to nothing, as a job."""
    return work_on(job, _write, memory_bytes=2_000_000_000)


def _write(words: Sequence[str]) -> Result:
    write_text(Path(words[0]) / "line.txt", words[0])
    return Result({})


def overhead(root: Path, count: int) -> None:
    """Print what a task costs beside its work, and whether the driver grows."""
    out = fresh(root / "overhead")
    jobs = [
        Job(f"{i:05d}", (str(out / f"{i:05d}"),), (), out / f"{i:05d}", out / RECORDS / "write" / f"{i:05d}.json")
        for i in range(count)
    ]
    early, first, began = 0.0, 0, time.perf_counter()

    def watch(now: Progress) -> None:
        nonlocal early, first, began
        if not early and now.finished >= count / 10:
            early, first, began = resident_mb(os.getpid()), now.finished, time.perf_counter()

    with processes(2) as engine:
        outcomes = run_jobs(jobs, write_line, engine, progress=watch)
        wall, late = time.perf_counter() - began, resident_mb(os.getpid())
    beside = 2 * wall / (count - first) - sum(o.seconds for o in outcomes) / count
    again = time.perf_counter()
    with processes(2) as engine:
        kept = run_jobs(jobs, write_line, engine)
    again = time.perf_counter() - again
    print(
        f"{count} jobs on two processes: {1e3 * beside:.1f} ms of a worker beside each; driver {early:.0f} MB at a tenth, {late:.0f} MB at "
        f"the end; a rerun that keeps all {sum(o.status is JobStatus.KEPT for o in kept)}: {1e3 * again / count:.2f} ms each",
        flush=True,
    )


# Trouble


def wait_for(condition: object, seconds: float = 120.0) -> bool:
    """Wait until a function returns something true."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if condition():  # type: ignore[operator]
            return True
        time.sleep(0.02)
    return False


def ended(run: subprocess.Popen[str]) -> tuple[int, str]:
    """Return exit status and the first line of what a command said last."""
    out, err = run.communicate()
    lines = [line for line in (err + out).splitlines() if line.strip() and "compiling" not in line and " running" not in line]
    return run.returncode, lines[0] if lines else ""


def started(words: list[str]) -> subprocess.Popen[str]:
    """Start a command."""
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def trouble(root: Path, count: int) -> None:
    """Have things die, and print what became of it."""
    recordings = root / "trouble-recordings"
    write_scripts(root / "trouble-scripts", count)
    made = command("simulate", "finger", root / "trouble-scripts/*.toml", "-o", recordings, "--workers", 2)
    subprocess.run(made, check=True, capture_output=True)
    whole = root / "whole"
    subprocess.run(command("calibrate", "finger", recordings, "-o", whole, "--workers", 2), check=True, capture_output=True)

    out = fresh(root / "worker-killed")
    run = started(command("calibrate", "finger", recordings, "-o", out, "--workers", 2))
    wait_for(lambda: len(done_in(out, "calibrate")) > count // 4 and list((out / RECORDS / "calibrate").glob("*.running")))
    mark = next((out / RECORDS / "calibrate").glob("*.running"))
    os.kill(json.loads(mark.read_text())["pid"], signal.SIGKILL)
    print(f"worker killed at {mark.stem}: {ended(run)}, {same(whole, out)}", flush=True)

    out = fresh(root / "driver-killed")
    run = started(command("calibrate", "finger", recordings, "-o", out, "--workers", 2))
    wait_for(lambda: len(done_in(out, "calibrate")) > count // 4)
    run.send_signal(signal.SIGKILL)
    run.communicate()
    before = len(done_in(out, "calibrate"))
    run = started(command("calibrate", "finger", recordings, "-o", out, "--workers", 2))
    print(f"driver killed after {before} of {count}: the same command again: {ended(run)}, {same(whole, out)}", flush=True)

    out, file = fresh(root / "scheduler-killed"), root / "scheduler.json"
    run = None
    for kill in (True, False):
        file.unlink(missing_ok=True)
        scheduler, workers = cluster(file)
        run = started(command("calibrate", "finger", recordings, "-o", out, "--dask", file))
        if kill:
            wait_for(lambda: len(done_in(out, "calibrate")) > count // 4)
            scheduler.kill()
        print(f"scheduler {'killed' if kill else 'started again'}: {ended(run)}", flush=True)
        for process in (scheduler, *workers):
            process.kill()
            process.wait()
    print(f"after both: {same(whole, out)}", flush=True)

    out = fresh(root / "two-drivers")
    first = started(command("calibrate", "finger", recordings, "-o", out, "--workers", 1))
    wait_for(lambda: list((out / RECORDS / "calibrate").glob("*.running")))
    second = started(command("calibrate", "finger", recordings, "-o", out, "--workers", 1))
    print(f"two drivers: the second {ended(second)}; the first {ended(first)}, {same(whole, out)}", flush=True)

    hungry(root, recordings)
    full_disk(root, recordings, count)


def fresh(folder: Path) -> Path:
    """Return a folder that is not there."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def same(whole: Path, out: Path) -> str:
    """Return whether two folders hold the same results."""
    return "the same bytes" if content(whole) == content(out) else "OTHER bytes"


def cluster(file: Path) -> tuple[subprocess.Popen[bytes], list[subprocess.Popen[bytes]]]:
    """Start a scheduler and two workers of dask, as on machines."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "distributed.cli.dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            "0",
            "--no-dashboard",
            "--scheduler-file",
            str(file),
        ],
        **quiet,
    )
    wait_for(file.exists)
    words = ["--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard", "--memory-limit", "3GB"]
    return scheduler, [subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_worker", *words], **quiet) for _ in range(2)]


def hungry(root: Path, recordings: Path) -> None:
    """Run one effect of a user that eats memory and one that kills its worker, among others that do not."""
    table, rows = root / "trouble.csv", ["name,recording,user_effect,effects"]
    first = sorted(item.name for item in recordings.iterdir() if item.name.startswith("push-"))[0]
    for name, body in {
        "eats": "import numpy\nkept = [numpy.ones(10**8) for _ in range(100)]\n",
        "kills": "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n",
    }.items():
        (root / f"{name}.py").write_text(body, encoding="utf-8")
        rows.append(f"{name},{recordings.name}/{first},{name}.py,stiffness")
    rows.append(f"calm,{recordings.name}/{first},,stiffness")
    table.write_text("\n".join(rows) + "\n", encoding="utf-8")
    out = fresh(root / "hungry")
    run = started(command("improve", "finger", "--jobs", table, "-o", out, "--workers", 2, "--memory", 3, "--json"))
    text = run.communicate()[0]
    for job in json.loads(text)["jobs"]:
        print(f"recording {job['name']}: {job['status']}: {' '.join(job['reason'].split())[:160]}", flush=True)
    print("poison.csv: " + (out / "poison.csv").read_text(encoding="utf-8").splitlines()[-1][:160], flush=True)


def full_disk(root: Path, recordings: Path, count: int) -> None:
    """Run into a full file system, make room, and run again."""
    disk = fresh(root / "disk")
    disk.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=120k", "tmpfs", str(disk)], capture_output=True, check=False
    ).returncode:
        print("full disk: not tried, no right to mount", flush=True)
        return
    try:
        words = command("calibrate", "finger", recordings, "-o", disk / "out", "--workers", 2)
        print(f"full disk: {ended(started(words))}", flush=True)
        subprocess.run(["mount", "-o", "remount,size=100m", str(disk)], check=True)
        print(f"with more room: {ended(started(words))}, {same(root / 'whole', disk / 'out')}", flush=True)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


# One joint question


def joint(root: Path) -> str:
    """Ask `improve` with more and more recordings; return a table."""
    write_scripts(root / "joint-scripts", 80)
    recordings = root / "joint-recordings"
    made = command("simulate", "finger", root / "joint-scripts/*.toml", "-o", recordings, "--workers", 2)
    subprocess.run(made, check=True, capture_output=True)
    every, lines, same = sorted(recordings.glob("push-*")), ["| recordings | CPU | largest memory |", "|---|---|---|"], set[str]()
    for count, engine in (
        (8, "in process"),
        (20, "in process"),
        (80, "in process"),
        (20, "2 processes"),
        (20, "dask, 2 processes"),
    ):
        out = fresh(root / "joint")
        words = [*command("improve", "finger", *every[:count], "-o", out, "--effects", "cable_gain"), *ENGINES[engine]]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        run = subprocess.Popen(words, env={**os.environ, **ONE_THREAD}, **quiet)
        _, status, used = os.wait4(run.pid, 0)
        run.returncode = os.waitstatus_to_exitcode(status)
        if run.returncode:
            raise SystemExit(f"improve ended with {run.returncode}")
        if count == 20:
            same.add(file_hash(out / "loop.json"))
        lines.append(f"| {count}, {engine} | {used.ru_utime + used.ru_stime:.0f} s | {used.ru_maxrss / 1e3:.0f} MB |")
        print(lines[-1], flush=True)
    return "\n".join(
        [*lines, "", f"Of 20, loop.json has {'the same bytes' if len(same) == 1 else 'OTHER bytes'} on all engines."]
    )


# On paper

RECORDINGS, MACHINES, CORES = 10_000, 50, 32
JOB_S, JOB_READ_MB, JOB_WRITE_MB = 120.0, 500.0, 20.0
DISK_MB_S, CORE_HOUR_EUR = 1000.0, 0.04
SCHEDULER_TASKS_S = 1000.0
"""What one dask scheduler hands out at most (its own documentation: about 200 µs to 1 ms a task)."""


def paper(root: Path) -> str:
    """Return what 10⁴ recordings on 50 machines cost, by measured constants and those above."""
    found = json.loads((root / "measured.json").read_text(encoding="utf-8"))
    overhead_s, sent = found["overhead_ms"] / 1e3, found["sent_bytes"]
    workers = MACHINES * CORES
    waves, read = -(-RECORDINGS // workers), workers * JOB_READ_MB / JOB_S
    rows = {
        "workers": f"{workers}",
        "compute": f"{RECORDINGS * (JOB_S + overhead_s) / workers / 60:.0f} min; {waves * (JOB_S + overhead_s) / 60:.0f} min in whole waves of workers",
        "overhead of the tasks": f"{1e3 * overhead_s:.0f} ms each, {100 * overhead_s / JOB_S:.2f} % of a task",
        "tasks a second at the scheduler": f"{workers / JOB_S:.0f} of about {SCHEDULER_TASKS_S:.0f}",
        "messages": f"{RECORDINGS * sent * 2 / 1e6:.0f} MB at most",
        "read from the shared disk": f"{RECORDINGS * JOB_READ_MB / 1e6:.0f} TB, {read / 1e3:.1f} GB/s of {DISK_MB_S / 1e3:.0f} GB/s: "
        f"**{RECORDINGS * JOB_READ_MB / min(read, DISK_MB_S) / 60:.0f} min**",
        "workers that the disk supports": f"{DISK_MB_S * JOB_S / JOB_READ_MB:.0f}",
        "written": f"{RECORDINGS * JOB_WRITE_MB / 1e3:.0f} GB, {workers * JOB_WRITE_MB / JOB_S / 1e3:.2f} GB/s",
        "shortest task that the scheduler keeps up with": f"{workers / SCHEDULER_TASKS_S:.1f} s",
        "cost": f"{RECORDINGS * JOB_S / 3600 * CORE_HOUR_EUR:.0f} EUR",
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def put(page: Path, name: str, text: str) -> None:
    """Put a text between the marks of its name in a page."""
    begin, end = f"<!-- {name} -->\n", f"\n<!-- /{name} -->"
    before, _, rest = page.read_text(encoding="utf-8").partition(begin)
    if not rest:
        raise SystemExit(f"{page} has no mark {begin.strip()}")
    page.write_text(before + begin + text + end + rest.partition(end)[2], encoding="utf-8")


def main() -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--only", choices=("overhead", "efficiency", "trouble", "joint", "paper"))
    parser.add_argument("--page", type=Path, help="page whose tables are replaced")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    root = given.out.absolute()
    if given.only in (None, "overhead"):
        overhead(root, 10 * given.count)
    if given.only in (None, "trouble"):
        trouble(root, max(given.count // 10, 12))
    tables = {"efficiency": lambda: efficiency(root, given.count), "joint": lambda: joint(root), "paper": lambda: paper(root)}
    for name, table in tables.items():
        if given.only in (None, name):
            text = table()
            print(text)
            if given.page is not None:
                put(given.page, name, text)


if __name__ == "__main__":
    main()
