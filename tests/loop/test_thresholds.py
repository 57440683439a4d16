"""How many numbers decide in the loop: those of `Thresholds` and `Effort`, and constants of modules that are no mere tolerances."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import femsense.loop
from femsense.loop.thresholds import Effort, Thresholds

MOST = 56
LOOP = Path(femsense.loop.__file__).parent
TOLERANCES = {
    "calibration": {"STEPS"},
    "covariance": {"RINGS", "SPOKES"},
    "cross_validation": {"OPEN"},
    "identifiability": {"ABSORBED"},
    "joint_fit": {"NEAR", "TRUSTED", "GAIN", "SERVES"},
    "noise_components": {"ROUNDING", "FLOOR", "UNTOLD", "FLAT"},
    "correction": {"LENGTHS", "RATIOS"},
    "representative_states": {"SAME"},
    "returned_model": {"COMPARED"},
    "sentences": {"ROUNDED"},
    "slack_nonsmoothness": {"NEAR_ZERO", "ALIKE"},
    "verdict": {"SAME"},
}
"""Numerics: when an iteration ends, what is rounding, grids and draws."""
SHOWN = {
    "candidate_tables": {"DRAWS", "MAP"},
    "covariates": {"FEWEST", "EACH_INPUT"},
    "force_impact": {"POINTS", "FIELD_POINTS", "WEAKEST"},
    "improve": {"MOST_STEPS"},
    "report_data": {"MOST_NODES"},
    "residual_diagnostics": {"PERMUTATIONS", "WORST_FRAMES", "GOES_WITH"},
    "summary": {"DRAWS"},
    "work_plan": {"PASSES", "COSTS", "QUADRATIC", "MORE", "EVERY"},
}
"""What a report or a progress bar shows."""
PROPOSED = {
    "candidate_experiments": {"BEND", "SAG", "BEARABLE", "TOGETHER", "STEP_S", "SLOW_S", "HOLD_S", "MOST_EACH", "FAR", "DOWN"},
    "next_steps": {"WEIGHED", "HOLDS", "BRINGS", "AT_REST", "TOGETHER"},
    "planner": {"NOISE_M", "FRAMES", "WORTH"},
}
"""What experiments are proposed, after a verdict or before any data."""


def constants(file: Path) -> Iterator[str]:
    """Yield the constants of a module that hold a number."""
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        if not any(isinstance(n, ast.Constant) and type(n.value) in (int, float) for n in ast.walk(node.value)):
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        yield from (n.id for n in ast.walk(target) if isinstance(n, ast.Name) and n.id.isupper())


def named_numbers() -> set[tuple[str, str]]:
    return {(file.stem, name) for file in LOOP.rglob("*.py") for name in constants(file)}


def test_few_numbers_decide() -> None:
    others = {(module, name) for group in (TOLERANCES, SHOWN, PROPOSED) for module, names in group.items() for name in names}
    assert others <= named_numbers()  # none of them is gone
    deciding = [f"{module}.{name}" for module, name in sorted(named_numbers() - others)]
    count = len(fields(Thresholds)) + len(fields(Effort)) + len(deciding)
    assert count <= MOST, deciding
