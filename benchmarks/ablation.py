"""Which rules of the loop earn their keep: each one switched off in turn on a fixed tuning set,
with paired differences to all of them.

    python benchmarks/ablation.py run --cases 40 --workers 2      # what is not in ablation.jsonl yet, by whole cases
    python benchmarks/ablation.py table                           # the table of what is there
    python benchmarks/ablation.py run --only swap,apart --cases 200

A switch is a value of `Thresholds` or `Effort`, or of a constant of a module of the loop. Rules of the verdict alone share one search.
One line of the file is one case under one switch.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from ablation_cases import make_problem, tuning_cases
from ablation_watch import SEEN, simplest_watched, table_of_best
from loop import answer_set, named
from loop_cases import Case

from femsense.core.errors import FemsenseError
from femsense.loop.improve import ImproveOptions, search_recordings
from femsense.loop.result.tables import table_of
from femsense.loop.thresholds import Effort, Thresholds
from femsense.loop.verdict.verdict import conclude
from femsense.many.engines import open_engine, spread

INF = float("inf")


def nothing(*given: Any, **more: Any) -> None:
    """A rule that finds nothing."""


def none_at_all(*given: Any) -> tuple[()]:
    """A rule that yields nothing."""
    return ()


def no_words(*given: Any) -> str:
    """A rule that has nothing to say."""
    return ""


def as_it_is(data: Any, fitted: Any, refitted: Any, *given: Any) -> Any:
    """A rule that leaves a refit as it is."""
    return refitted


def as_found(data: Any, history: Any, refits: Any, *given: Any) -> Any:
    """A rule that swaps nothing."""
    return history, refits


def no_spread(data: Any, fitted: Any, *given: Any) -> Any:
    """A rule that adds nothing to standard deviations."""
    return np.zeros(len(fitted.fit.coordinates))


@dataclass(frozen=True)
class Switch:
    """A rule that is off."""

    name: str
    thresholds: dict[str, float] = field(default_factory=dict)
    effort: dict[str, int] = field(default_factory=dict)
    constants: dict[str, Any] = field(default_factory=dict)
    """"module.NAME" of femsense.loop → its value, or what is in a rule's place."""

    def options(self) -> ImproveOptions:
        """Return what the loop is asked with."""
        return ImproveOptions(thresholds=Thresholds(**self.thresholds), effort=Effort(**self.effort))  # type: ignore[arg-type]

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """Give its constants their values, in all modules of the loop that have them."""
        was = list[tuple[Any, str, Any]]()
        for path, value in self.constants.items():
            home, name = path.rsplit(".", 1)
            known = getattr(importlib.import_module(f"femsense.loop.{home}"), name)
            holders = [m for key, m in sys.modules.items() if key.startswith("femsense.loop") and vars(m).get(name) is known]
            was += [(module, name, known) for module in holders]
            for module in holders:
                setattr(module, name, value)
        try:
            yield
        finally:
            for module, name, known in was:
                setattr(module, name, known)


BEST = "the simplest"
BASE = Switch("all rules", {}, {}, {"search.swaps.simplest": simplest_watched})
SEARCH = (
    Switch("held_gain", {"held_gain": -1e9}),
    Switch("plainly_worse", {"plainly_worse": INF}),
    Switch("swap", {"swap": INF}),
    Switch("places", {}, {"starts": 1, "rounds": 0}),
    Switch("mesh_turns", {"mesh_turns": 0.0}),
    Switch("mesh_varies", {"mesh_varies": 0.0}),
    Switch("mesh error", {"mesh_share": 1e-6, "mesh_varies": 0.0, "mesh_turns": 0.0}),
    Switch("evidence", {"evidence": 5.0}),
    Switch("testable", {"testable": 0.0}),
    Switch("hinted", {"hinted": INF}),
    Switch("mesh_share", {"mesh_share": 1e-6}),
    Switch("outliers", {"outlying": INF}),
    Switch("states", {"states": 0}),
    Switch("effects", {}, {"effects": 6}),
    Switch("refits", {}, {"refits": 12}),
    Switch("sizes", {}, {"work": 10**9}, {"data.dataset.MAX_ROWS": 10**6, "fit.discretisation_error.MOST_WORK": 10**9}),
    Switch("rows for the noise", {}, {}, {"fit.noise_components.MAX_REML_ROWS": 1000}),
    Switch("noise near the last", {}, {}, {"fit.noise_components.NEAR_STD": 10.0}),
    Switch("rough fits", {}, {}, {"fit.fitted_model.ROUGHLY": 8}),
    Switch("declared pose", {}, {}, {"fit.joint_fit.BESIDE_MARKERS": np.array([0.1] * 3 + [0.01] * 3)}),
    Switch("needless", {}, {}, {"search.swaps._if_needless": nothing}),
    Switch("richer forms", {}, {}, {"search.forward_selection._enriched": as_it_is}),
    Switch("more markers", {}, {}, {"search.forward_selection._with_more_markers": as_it_is}),
    Switch("slack cables", {}, {}, {"fit.slack_nonsmoothness.trial_nonsmoothness": nothing}),
    Switch("instead of offsets", {}, {}, {"search.swaps.instead_of_offsets": nothing}),
    Switch(BEST, {}, {}, {"search.swaps.simplest": as_found}),
    Switch("some states", {}, {"work": 0}, {"data.representative_states.FEWEST": 8}),
    Switch("fewer states", {}, {"work": 0}, {"data.representative_states.FEWEST": 4}),
    Switch("nearly all states", {}, {"work": 0}, {"data.representative_states.FEWEST": 12, "search.some_states.SPARED": 1.0}),
    Switch("weights with the error", {}, {}, {"search.search.nothing_explains": nothing}),
)
"""Rules of the search, each with a search of its own."""
VERDICT = (
    Switch("relevant", {"relevant": 0.0}),
    Switch("explained", {"explained": -INF}),
    Switch("lacks", {"lacks": INF}),
    Switch("significant", {"significant": 2.0}),
    Switch("structure", {"structure": 0.0}),
    Switch("not_worse", {"not_worse": INF}),
    Switch("much is lacking", {}, {}, {"verdict.verdict.lacks_much": nothing}),
    Switch("surprise", {}, {}, {"verdict.verdict._surprise": no_words}),
    Switch("moves alike", {}, {}, {"verdict.confounding._in_common": none_at_all}),
    Switch("in place of an error", {}, {}, {"verdict.confounding._in_place_of_an_error": none_at_all}),
    Switch("absorbed", {}, {}, {"verdict.confounding._absorbed": none_at_all}),
    Switch("open seeds", {}, {}, {"fit.covariance._with_open_seeds": no_spread}),
)
"""Rules of the verdict, on what one search found."""


# --- runs --------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """A case, and the switches that it is asked with."""

    case: Case
    switches: tuple[Switch, ...]
    concluded: tuple[Switch, ...] = ()
    """Switches of the verdict, asked of what the first of the others found."""


def run_job(job: Job) -> list[dict[str, Any]]:
    """Return one record for each switch."""
    warnings.simplefilter("ignore")
    case = job.case
    about = {"case": case.number, "kind": case.kind, "hidden": [e["name"] for e in case.hidden], "outside": case.outside}
    every = (*job.switches, *job.concluded)
    try:
        problem = make_problem(case)
    except FemsenseError as error:
        return [{**about, "switch": s.name, "failed": f"no data: {error}"} for s in every]
    records = []
    for switch in job.switches:
        began = time.process_time()
        SEEN.clear()
        try:
            with switch.in_force():
                data, search = search_recordings(problem.declared, problem.recordings, options=switch.options())
        except FemsenseError as error:
            failed = [switch, *(job.concluded if switch is job.switches[0] else ())]
            records += [{**about, "switch": s.name, "failed": f"improve: {error}"} for s in failed]
            continue
        spent = time.process_time() - began
        records.append(_concluded(about, switch, lambda d=data, s=search: conclude(d, s, np.random.default_rng(0)), spent))
        records[-1]["best"] = list(SEEN)
        for other in job.concluded if switch is job.switches[0] else ():
            asked = replace(data, thresholds=other.options().thresholds)
            records.append(_concluded(about, other, lambda d=asked, s=search: conclude(d, s, np.random.default_rng(0)), spent))
    return records


def _concluded(about: dict[str, Any], switch: Switch, ask: Callable[[], Any], spent: float) -> dict[str, Any]:
    began = time.process_time()
    try:
        with switch.in_force():
            loop = ask()
    except FemsenseError as error:
        return {**about, "switch": switch.name, "failed": f"conclude: {error}"}
    return {
        **about,
        "switch": switch.name,
        "verdict": loop.verdict,
        "effects": [{"name": e.name} for e in loop.effects],
        "confounded": table_of(loop.confounded),
        "before_m": loop.before.validation_rms_m,
        "after_m": loop.after.validation_rms_m,
        "search_s": spent,
        "cpu_s": spent + time.process_time() - began,
    }


def jobs_of(count: int, known: set[tuple[int, str]], only: Sequence[str] | None, each: int = 4) -> Iterator[Job]:
    """Yield what is still to be asked, case by case."""
    for case in tuning_cases(count):

        def asked(switches: Sequence[Switch], case: Case = case) -> list[Switch]:
            wanted = [s for s in switches if only is None or s.name in only]
            return [s for s in wanted if (case.number, s.name) not in known]

        concluded = asked(VERDICT)
        if concluded or (case.number, BASE.name) not in known:
            yield Job(case, (BASE,), tuple(concluded))
        search = asked(SEARCH)
        for i in range(0, len(search), each):
            yield Job(case, tuple(search[i : i + each]))


# --- scores --------------------------------------------------------------------------------------------------------------------

Score = Callable[[dict[str, Any]], float | None]
"""1 or 0 of a record; None where it is not asked."""


def _hidden(r: dict[str, Any]) -> dict[str, Any]:
    return {**r, "hidden": [{"name": n} for n in r["hidden"]]}


def first_named(r: dict[str, Any]) -> float | None:
    """Return whether the one hidden effect of the list is named first."""
    return float(named(_hidden(r))[:1] == r["hidden"]) if len(r["hidden"]) == 1 else None


def in_set(r: dict[str, Any]) -> float | None:
    """Return whether it is named, or said to be indistinguishable from what is."""
    return float(r["hidden"][0] in answer_set(_hidden(r))) if len(r["hidden"]) == 1 else None


def both(r: dict[str, Any]) -> float | None:
    """Return whether both of a pair are in the answered set."""
    return float(set(r["hidden"]) <= answer_set(_hidden(r))) if len(r["hidden"]) == 2 else None


def false_alarm(r: dict[str, Any]) -> float | None:
    """Return whether something is said of a robot that lacks nothing."""
    return float(bool(named(_hidden(r))) or r["verdict"] == "unexplained") if r["kind"] == "null" else None


def confident_error(r: dict[str, Any]) -> float | None:
    """Return whether what is named is wrong, is not said to be like what is right, and the verdict leaves no doubt."""
    hidden, pairs = set(r["hidden"]), [set(c["pair"]) for c in r["confounded"]]
    wrong = [n for n in named(_hidden(r)) if n not in hidden | {"cable_offset"} and not any(n in p and p & hidden for p in pairs)]
    return float(bool(wrong) and r["verdict"] == "effects")


def doubted(r: dict[str, Any]) -> float | None:
    """Return whether an error that no effect of the list makes is called unexplained."""
    return float(r["verdict"] == "unexplained") if r["outside"] else None


SCORES: dict[str, tuple[Score, float]] = {
    "first named": (first_named, 1.0),
    "answered set": (in_set, 1.0),
    "both of a pair": (both, 1.0),
    "false alarm": (false_alarm, -1.0),
    "confident error": (confident_error, -1.0),
    "doubted": (doubted, 1.0),
}
"""Score → its function, and whether more of it is better."""


def table(records: Sequence[dict[str, Any]]) -> None:
    """Print what each rule is worth: the score without it less that with all rules, in points,
    with a 95 % interval of the paired differences."""
    done = {(r["case"], r["switch"]): r for r in records if "failed" not in r}
    base = {case: r for (case, name), r in done.items() if name == BASE.name}
    print(f"{len(base)} cases; failed: {sum('failed' in r for r in records)} of {len(records)}")
    for name, (score, _) in SCORES.items():
        values = [v for r in base.values() if (v := score(r)) is not None]
        print(f"  {name:16s}{100 * np.mean(values):5.1f} % of {len(values)}")
    table_of_best(list(base.values()))
    print(f"\n{'without':22s}{'cases':>6s}" + "".join(f"{name:>18s}" for name in SCORES) + f"{'time':>8s}{'changed':>9s}")
    for switch in (*SEARCH, *VERDICT):
        pairs = [(base[case], r) for (case, name), r in done.items() if name == switch.name and case in base]
        if not pairs:
            continue
        cells = [_difference([(s(a), s(b)) for a, b in pairs]) for s, _ in SCORES.values()]
        ratio = np.sum([b["cpu_s"] for _, b in pairs]) / np.sum([a["cpu_s"] for a, _ in pairs])
        changed = sum(_answer(a) != _answer(b) for a, b in pairs)
        print(f"{switch.name:22s}{len(pairs):6d}" + "".join(f"{cell:>18s}" for cell in cells) + f"{ratio:8.2f}{changed:9d}")


def _answer(r: dict[str, Any]) -> tuple[str, tuple[str, ...]]:
    return r["verdict"], tuple(e["name"] for e in r["effects"])


def _difference(pairs: Sequence[tuple[float | None, float | None]]) -> str:
    """Return the mean difference in points ± half its 95 % interval."""
    d = np.array([b - a for a, b in pairs if a is not None and b is not None])
    if not len(d):
        return "-"
    half = 1.96 * d.std() / np.sqrt(len(d)) if d.any() else 3.0 / len(d)  # the rule of three where nothing changed
    return f"{100 * d.mean():+5.1f} ± {100 * half:4.1f}"


def main() -> None:
    """Ask what is not yet in the file, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--only", default=None, help="names of switches, with commas between them")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--dask", help="as of femsense estimate")
    parser.add_argument("--limit", type=float, default=INF, help="stop after so many seconds")
    parser.add_argument("--out", type=Path, default=Path("ablation.jsonl"))
    options = parser.parse_args()
    records = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    if options.what == "run":
        known = {(r["case"], r["switch"]) for r in records}
        jobs = list(jobs_of(options.cases, known, None if options.only is None else options.only.split(",")))
        records += _run(jobs, options)
    table(records)


def _run(jobs: Sequence[Job], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the records of jobs, as many as there is time for, and append them to a file as they come."""
    records, end = list[dict[str, Any]](), time.monotonic() + options.limit
    with open_engine(options.workers, options.dask, None) as engine, options.out.open("a") as file:
        for found in spread(engine, run_job, ((job,) for job in jobs)):
            records += found
            file.writelines(json.dumps(r, default=float) + "\n" for r in found)
            file.flush()
            if time.monotonic() > end:
                break
    return records


if __name__ == "__main__":
    main()
