"""The report on a closed loop: the effects that the model lacked, their evidence, and the limits of the data."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from femsense.io.robot_toml import load_robot
from femsense.loop.files import read_loop, saved_loop
from femsense.loop.result.evidence import Evidence, ForceField, LoadRow, Ranked, Tests, Tip
from femsense.loop.result.loop_result import SavedLoop, Verdict
from femsense.loop.result.records import ModelError, Residuals
from femsense.model.robot import Robot
from femsense.report import words
from femsense.report.bodies import DrawnSurface, skin
from femsense.report.drawing import marker_bars
from femsense.report.loop.confounding_map import confounding_map
from femsense.report.loop.effects import OUTCOMES, lacks, outcome, ranked_values, smallest_sizes, value_rows
from femsense.report.loop.force_field import force_field
from femsense.report.loop.held_out import held_out_errors
from femsense.report.loop.residual_against import residual_against
from femsense.report.loop.residual_at_rest import mean_residual_panels
from femsense.report.loop.residual_in_frames import frame_residuals_panel
from femsense.report.loop.text import correction_text, open_pairs
from femsense.report.page import Chapter, render

TESTS = {
    "neighbours": "the residuals of neighbouring states are correlated",
    "pattern": "one pattern in many states",
    "sweep": "one sweep differs from the others",
    "marker": "one marker differs from the others",
    "cloud neighbours": "the residuals of neighbouring states of the clouds are correlated",
    "cloud sweep": "one sweep of the clouds differs from the others",
}
COMPONENTS = {
    "white": "each measurement by itself",
    "state": "a marker in a repeated state",
    "marker": "a marker on the body, in all frames",
    "frame": "all markers of a frame",
    "sweep": "all frames of a sweep",
}


def loop_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a loop.

    Arguments:
        file: loop.json; the improved robot next to it is drawn if it is there.
        title: of the chapter.

    Raises:
        InputError: either is broken.
    """
    result = saved_loop(read_loop(file), file)
    evidence, residuals = result.evidence or Evidence(), (result.residuals or Residuals()).known()
    robot = load_robot(file.parent, effects=False) if (file.parent / "robot.toml").is_file() else None
    rest = None if robot is None else skin(robot.body.mesh.nodes, robot.body.mesh.tets)
    pairs = open_pairs(result)
    body = render(
        "loop.html",
        result=result,
        evidence=evidence,
        residuals=residuals,
        model_error=result.model_error or ModelError(),
        recovered=recovered(result.before.validation_rms_m, result.after.validation_rms_m, result.noise_m),
        pictures=_pictures(result, evidence, residuals, robot, rest),
        correction_text=correction_text,
        lacks=lacks,
        value_rows=value_rows,
        ranked_values=lambda tried: ranked_values(tried, result.effects, evidence.ranking),
        first_share=lambda tried: evidence.ranking.get(tried.name, Ranked()).first_share,
        outcome=outcome,
        outcomes=OUTCOMES,
        open_pairs=pairs,
        other_pairs=[" / ".join(pair.pair) for pair in result.confounded if pair not in pairs],
        tests=_tests(evidence.tests),
        smallest=smallest_sizes(result, evidence),
        file_name=lambda path: Path(path or "").name.replace("None", ""),
        components=_components,
        hashes=_hashes(result),
        median_error=lambda name: _median_error(evidence.forces.loads or (), name),
        ratios=_ratios(evidence),
    )
    sentence = result.sentence or words.sentence(words.VERDICTS.get(result.verdict, ""))
    return Chapter(title, body, sentence, result.inputs.robot.name or "")


def _pictures(
    result: SavedLoop, evidence: Evidence, residuals: Residuals, robot: Robot | None, rest: DrawnSurface | None
) -> dict[str, Any]:
    left = result.left
    structured = left.structure.significant or (result.verdict == Verdict.UNEXPLAINED and not left.held_out)
    cameras = evidence.pictures.camera_axes
    return {
        "mean_residual": mean_residual_panels(result, residuals, cameras, robot, rest),
        "frame_residuals": frame_residuals_panel(evidence.pictures, rest),
        "against": residual_against(evidence.frames, evidence.score, evidence.tip or Tip()),
        "held_out": held_out_errors(residuals, evidence.frames, result.noise_m),
        "confounding": confounding_map(evidence.confounding),
        "left": [
            marker_bars(left.marker_rms_m, "Residual of each marker after", most=30, axis="rms residual after [mm]"),
            force_field(evidence.equivalent_forces or ForceField(), rest) if structured else None,
        ],
    }


def _tests(tests: Tests) -> list[tuple[str, str]]:
    """Return the names of the tests of structure that were made, each with its words."""
    made = {**tests.before.structure.tests, **tests.after.structure.tests}
    return [
        (name, TESTS.get(name, name)) for name in sorted(made, key=lambda name: (name not in TESTS, [*TESTS, name].index(name)))
    ]


def _components(stds_m: Mapping[str, float]) -> str:
    return "; ".join(f"{COMPONENTS.get(name, name)} {words.length(std)}" for name, std in stds_m.items())


def _hashes(result: SavedLoop) -> list[tuple[str, Any]]:
    inputs = result.inputs
    named = [("Robot", inputs.robot)]
    named += [
        (f"{kind} {i + 1}", r)
        for kind, all_ in (("Recording", inputs.recordings), ("Validation", inputs.validation))
        for i, r in enumerate(all_)
    ]
    return [(title, item) for title, item in named if item.sha256]


def _median_error(loads: tuple[LoadRow, ...], name: str) -> str:
    """Return the median size of the error of forces sensed at declared loads."""
    gaps = [(abs(getattr(row, name) - row.declared_n), row.declared_n) for row in loads if row.declared_n]
    known = [(gap, gap / declared) for gap, declared in gaps if np.isfinite(gap)]
    if not known:
        return words.NOTHING
    size, share = (statistics.median(gap[i] for gap in known) for i in (0, 1))
    return f"{words.quantity(size, 'N', 2)} ({words.percent(share, 1)})"


def _ratios(evidence: Evidence) -> tuple[float, float, float] | None:
    """Return the smallest, median and largest ratio of forces after to before for the same dent; None where none is known."""
    frames = () if evidence.forces.compliance is None else evidence.forces.compliance.frames
    ratios = [r for frame in frames for r in frame.ratio if words.known(r)]
    return (min(ratios), statistics.median(ratios), max(ratios)) if ratios else None


def recovered(before_m: float | None, after_m: float | None, noise_m: float | None) -> float | None:
    """Return the share of the excess over the noise that is gone, (b² − a²) / (b² − n²); None where the excess is below a tenth of b²."""
    if before_m is None or after_m is None or noise_m is None or not np.isfinite([before_m, after_m, noise_m]).all():
        return None
    excess = before_m**2 - noise_m**2
    if excess <= 0.1 * before_m**2:
        return None
    return min(1.0, max(0.0, (before_m**2 - after_m**2) / excess))
