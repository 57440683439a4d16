"""Effects of what holds the body."""

from __future__ import annotations

from femsense.effects.effect import Effect, Entry, Parameter, number
from femsense.errors import InputError
from femsense.model import Robot


def _clamp_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    """The coordinate is the compliance of a node's spring [m/N], which is 0 for the clamp."""
    count = len(robot.body.clamp_nodes)
    if not count:
        return ()
    reach = float((robot.body.mesh.nodes.max(axis=0) - robot.body.mesh.nodes.min(axis=0)).max())
    body_compliance = count / (float(robot.body.material.young_modulus.mean()) * reach)
    return (Parameter("stiffness_n_m", None, "N/m", 0.0, 0.0, 10.0 * body_compliance, 1e-3 * body_compliance, "reciprocal"),)


def _apply_clamp(robot: Robot, entry: Entry) -> Robot:
    if "rotation_stiffness_nm_rad" in entry:
        raise InputError("a clamp that turns as a whole is not modelled", where="base_compliance.rotation_stiffness_nm_rad",
                         expected="stiffness_n_m", hint="give the spring of each node, stiffness_n_m")  # fmt: skip
    value = entry.get("stiffness_n_m")
    stiffness = float("inf") if value == float("inf") else number(entry, "stiffness_n_m", "base_compliance", low=1e-6)
    return robot.with_body(robot.body.with_clamp_stiffness(stiffness))


BASE_COMPLIANCE = Effect(
    "base_compliance", "a clamp that gives", _clamp_parameters, _apply_clamp, keys=("stiffness_n_m", "rotation_stiffness_nm_rad")
)
