"""The whole chain on a recording of this package, compared with its truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from femsense.app.commands import estimate_into, improve_into, written_page
from femsense.app.demo.truth import force_errors, true_effects
from femsense.core.errors import InputError
from femsense.io.files import check_target, write_json
from femsense.io.own_files import DEMO, check_files
from femsense.io.provenance import versions
from femsense.io.robot_toml import robot_names
from femsense.loop.files import saved_loop
from femsense.report.loop.text import effect_text
from femsense.report.text import columns, run_document
from femsense.sensing.comparison import TrueContact, read_truth

if TYPE_CHECKING:
    from femsense.sensing.types import Run

ROBOT = "four-leg"


@dataclass(frozen=True, slots=True)
class DemoSteps:
    """The steps of the chain."""

    estimate: Callable[..., Run] = estimate_into
    improve: Callable[..., dict[str, Any]] = improve_into


def run_demo(
    folder: str | Path,
    *,
    say: Callable[[str], None],
    progress: Callable[..., None] | None = None,
    steps: DemoSteps | None = None,
) -> dict[str, Any]:
    """Estimate with the declared robot, improve it, estimate again; export the result and measure both against the truth.

    Steps whose results are in the folder are not repeated.

    Arguments:
        folder: gets `declared/`, `loop/`, `run/`, robot.glb, picture.png, report.html and demo.json.
        say: called with a line on each step.
        progress: called with (items done, items in all).
        steps: other ways to estimate and to improve.

    Returns:
        the content of demo.json.

    Raises:
        FemsenseError: the demo's recording is not there, or a step failed.
    """
    from femsense.app.demo.picture import draw_demo
    from femsense.xr.export import export_glb

    how, out, recording = steps or DemoSteps(), Path(folder), demo_recording(robot_names())
    check_target(out, folder=True)
    check_files(out, DEMO)
    say(f"1/4  forces with the robot as it is declared → {out / 'declared'}")
    before = how.estimate(out / "declared", ROBOT, recording, say=say, progress=progress)
    say(f"2/4  which effects does the model lack? → {out / 'loop'}")
    loop = how.improve(out / "loop", ROBOT, [recording], say=say, progress=progress)
    say(f"3/4  forces with the improved robot → {out / 'run'}")
    after = how.estimate(out / "run", out / "loop", recording, say=say, progress=progress)
    say(f"4/4  mesh, picture and report → {out}")
    truth = read_truth(recording)
    document = demo_document(out, before, loop, after, truth, true_effects(recording))
    export_glb(after, out / "robot.glb")
    draw_demo(before, after, truth, document, out / "picture.png")
    document["report"] = str(out / "report.html")
    write_json(out / "demo.json", document)
    page = written_page(out, say=say)
    document["report"] = None if page is None else str(page)
    return document


def demo_recording(robots: Mapping[str, Path]) -> Path:
    """Return the folder of the recording that comes along with a robot, of name → folder. Raises InputError."""
    folder = robots.get(ROBOT)
    recording = None if folder is None else folder / "recordings" / "demo"
    if recording is None or not (recording / "recording.toml").is_file():
        raise InputError(
            "the demo's recording is not in this installation",
            where=recording or ROBOT,
            expected="meshes/four-leg/recordings/demo",
            hint="reinstall femsense",
        )
    return recording


def demo_document(
    out: Path,
    before: Run,
    loop: Mapping[str, Any],
    after: Run,
    truth: Sequence[TrueContact],
    effects: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the figures of the demo: both runs, the loop, and the errors against the truth."""
    return {
        "folder": str(out),
        "declared": {**run_document(before), **force_errors(before, truth)},
        "improved": {**run_document(after), **force_errors(after, truth)},
        "loop": {key: loop.get(key) for key in ("verdict", "noise_m", "before", "after", "effects")},
        "truth": {"contacts": len(truth), "effects": list(effects)},
        "versions": versions(),
    }


def demo_text(document: Mapping[str, Any]) -> str:
    """Return the closing table of the demo."""
    a, b, loop = document["declared"], document["improved"], document["loop"]
    out = Path(document["folder"])
    rows = [["", "declared robot", "improved robot"]]
    for title, key, scale, unit in (
        ("error of force (median)", "force_error_n", 1.0, "N"),
        ("  in percent", "force_error_share", 100.0, "%"),
        ("error of place (median)", "place_error_m", 1e3, "mm"),
    ):
        rows.append([title, _figure(a[key], scale, unit), _figure(b[key], scale, unit)])
    rows.append(["true contacts in frames", *(f"{run['contacts_found']} of {run['contacts_true']}" for run in (a, b))])
    rows.append(["false ones in frames", *(str(run["contacts_false"]) for run in (a, b))])
    for title, key in (("residual of the markers", "train_rms_m"), ("  on held-out sweeps", "validation_rms_m")):
        rows.append([title, *(_figure((loop.get(when) or {}).get(key), 1e3, "mm") for when in ("before", "after"))])
    rows.append(["time a frame", *(_figure(run["ms_per_frame"], 1.0, "ms") for run in (a, b))])
    lines = [columns(rows, indent=0), "", f"what the declared model lacks (verdict: {loop['verdict']}):"]
    found = [effect_text(effect) for effect in saved_loop({"effects": loop.get("effects") or []}).effects]
    lines += [f"  {line}" for text in found for line in text.splitlines()] or ["  nothing that these data show"]
    true = [[effect["name"], _entry(effect)] for effect in document["truth"]["effects"]]
    lines += ["", "effects of the truth:", columns(true)] if true else []
    places = [["see it", f"femsense view {out / 'run'}"], ["mesh", str(out / "robot.glb")], ["picture", str(out / "picture.png")]]
    if document.get("report"):
        places.append(["report", str(document["report"])])
    return "\n".join([*lines, "", columns(places, indent=0)])


def _entry(effect: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in effect.items() if key != "name")


def _figure(value: float | None, scale: float, unit: str) -> str:
    return "–" if value is None else f"{scale * value:.3g} {unit}"
