"""Forces of a solved state, and the residual forces of a slightly different robot in the same state."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.assembly import add_elements, element_forces, internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles, cable_forces, shortening
from femsense.fem.capstan import capstan_tensions
from femsense.fem.chambers import volume_gradient
from femsense.fem.clamp import first_give
from femsense.fem.equilibrium import Equilibrium
from femsense.model.drive import DrivenRobot, body_in, frame_loads

Tensions = tuple[FloatArray, ...]
"""Tensions along the cables [N], one array (s,) a cable."""


class Balance:
    """Forces of the base state of a frame, and the residual forces of variants."""

    def __init__(self, driven: DrivenRobot, frame: int, base: Equilibrium) -> None:
        self.driven, self.frame, self.base = driven, frame, base
        self.body = self._body(driven)

    @cached_property
    def dead(self) -> FloatArray:
        """Weight and other dead forces [N], (n, 3)."""
        return self.body.dead_load()

    @cached_property
    def inner(self) -> FloatArray:
        """Inner forces [N], (n, 3)."""
        return internal(self.body, self.base.positions, tangent=False).forces

    @cached_property
    def by_element(self) -> FloatArray:
        """Inner forces of each element [N], (m, k, 3)."""
        return element_forces(self.body, self.base.positions)

    def _body(self, driven: DrivenRobot) -> BodyModel:
        return body_in(driven, self.frame)

    def _loads(self, driven: DrivenRobot) -> FloatArray:
        loads = frame_loads(driven, self.frame)
        return np.zeros((len(driven.robot.body.mesh.nodes), 3)) if loads is None else loads

    def carried(self, variant: DrivenRobot) -> FloatArray:
        """Return where the variant's response starts [m], (n, 3): the base state,
        grown as its body is and with its clamp given way."""
        body, other, x = self.body, variant.robot.body, self.base.positions
        if other.mesh is not body.mesh:
            x = x + (other.mesh.nodes - body.mesh.nodes)
        if body.clamp_is_rigid and not other.clamp_is_rigid:
            return x + first_give(other, self.left())
        return x

    def left(self) -> FloatArray:
        """Return the sum of all forces in the base state [N], (n, 3): reactions at the clamp, the residual of Newton elsewhere."""
        base, pressures = self.base, [self.base.pressure[chamber.name] for chamber in self.body.chambers]
        driven = driving_forces(self.body, base.positions, base.segment_tensions, pressures)
        return np.asarray(self.dead + base.nodal_forces + driven - self.inner)

    def along(self, variant: DrivenRobot) -> Tensions:
        """Return the tensions along a variant's cables where these do not rub."""
        motors = motor_tensions(variant, self.frame, self.base)
        return tuple(np.full(len(c.path), T) for c, T in zip(variant.robot.body.cables, motors))

    def more_tension(self, along: Tensions) -> FloatArray:
        """Return the difference of the tensions along all cables from those of the base state [N], shape (s,)."""
        differences = [a - b for a, b in zip(along, self.base.segment_tensions)]
        return np.concatenate(differences) if differences else np.zeros(0)

    def whole(self, variant: DrivenRobot, tensions: Tensions, x: FloatArray) -> FloatArray:
        """Return all forces on a variant's body at x near the base state [N], (n, 3), for tensions along its cables."""
        body = self._body(variant)
        driven = driving_forces(body, x, tensions, variant.drive.pressures[self.frame])
        return np.asarray(body.dead_load() + self._loads(variant) + driven - internal(body, x, tangent=False).forces)

    def change(self, variant: DrivenRobot) -> FloatArray:
        """Return the residual forces of a variant in the base state, without the change of tensions along cables [N], (n, 3)."""
        body = self._body(variant)
        x, own, drive = self.base.positions, self.body, variant.drive
        force = np.zeros_like(x)
        if body is not own:
            force += body.dead_forces - own.dead_forces
            if not _same_weight(body, own):
                force += body.weight() - own.weight()
            self._add_inner(body, force)
            self._add_paths(body, force)
        if drive.load_forces is not self.driven.drive.load_forces:
            force += self._loads(variant) - self._loads(self.driven)
        for i, chamber in enumerate(body.chambers):
            more = drive.pressures[self.frame, i] - self.driven.drive.pressures[self.frame, i]
            if more != 0.0:
                force += more * volume_gradient(chamber, x)
        return force

    def _add_inner(self, body: BodyModel, force: FloatArray) -> None:
        """Add the difference of the internal forces of another body to a force [N], (n, 3)."""
        own, x = self.body, self.base.positions
        springs = [(b.clamp_stiffness, b.clamp_turn_stiffness) for b in (body, own)]
        if springs[0] != springs[1] or not _same_but_modulus(body, own):
            force += self.inner - internal(body, x, tangent=False).forces
        elif body.material is not own.material:
            softer = 1.0 - body.material.young_modulus / own.material.young_modulus
            add_elements(own.stencil.tets, self.by_element, softer, force)

    def _add_paths(self, body: BodyModel, force: FloatArray) -> None:
        """Add the difference of the cable forces on another body, whose cables take other paths, under the tensions of the base state
        to a force [N], (n, 3)."""
        x = self.base.positions
        for cable, own, along in zip(body.cables, self.body.cables, self.base.segment_tensions):
            if cable.path is not own.path and along.any():
                force += cable_forces(cable, x, along, len(x)) - cable_forces(own, x, along, len(x))

    def pulled(self, variant: DrivenRobot, x: FloatArray | None) -> FloatArray:
        """Return the shortening that a variant adds to held cables at x, by default in the base state [m], (a,)."""
        body, cables = self._body(variant), self.body.cables
        if variant.drive.control != "displacement":
            return np.zeros(len(cables))
        stretch = [
            self.base.tension[c.name] * (1.0 / b.stretch_stiffness - 1.0 / c.stretch_stiffness)
            for b, c in zip(cables, body.cables)
        ]
        pulled = variant.drive.inputs[self.frame] - self.driven.drive.inputs[self.frame] + np.array(stretch)
        if x is None and any(b.path is not c.path for b, c in zip(body.cables, cables)):
            x = self.base.positions
        if x is not None:
            pulled = pulled - shortening(body, x) + shortening(self.body, self.base.positions)
        return np.asarray(pulled)


def driving_forces(body: BodyModel, x: FloatArray, tensions: Tensions, pressures: Iterable[float]) -> FloatArray:
    """Return the forces of cables and chambers at positions x [N], shape (n, 3), for tensions along the cables and pressures [Pa]."""
    force = np.zeros_like(x)
    for cable, along in zip(body.cables, tensions):
        force += cable_forces(cable, x, along, len(x))
    for chamber, pressure in zip(body.chambers, pressures):
        force += pressure * volume_gradient(chamber, x)
    return force


def rubbed(variant: DrivenRobot, frame: int, base: Equilibrium, x: FloatArray) -> Tensions:
    """Return the tensions along the cables of a variant at positions x, with those of the base state as the previous tensions."""
    motors = motor_tensions(variant, frame, base)
    return tuple(
        capstan_tensions(c, bend_angles(c, x), before, T) if c.friction > 0 else np.full(len(c.path), T)
        for c, before, T in zip(variant.robot.body.cables, base.segment_tensions, motors)
    )


def motor_tensions(variant: DrivenRobot, frame: int, base: Equilibrium) -> list[float]:
    """Return the tension at the motor of each cable [N]: of held ones as in the base state."""
    names = variant.robot.body.cable_names
    held = variant.drive.control == "displacement"
    return [base.tension[name] if held else float(T) for name, T in zip(names, variant.drive.inputs[frame])]


def _same_but_modulus(body: BodyModel, other: BodyModel) -> bool:
    """Return whether the elements of two bodies differ at most in their modulus, given meshes that differ at most in node positions."""
    a, b = body.material, other.material
    if a is b or body.mesh is not other.mesh:
        return a is b
    return np.array_equal(a.poisson_ratio, b.poisson_ratio) and (a.law, a.stretch_limit) == (b.law, b.stretch_limit)


def _same_weight(body: BodyModel, other: BodyModel) -> bool:
    volume, others = body.stencil.node_volume, other.stencil.node_volume
    return (
        (volume is others or np.array_equal(volume, others))
        and body.material.density == other.material.density
        and body.carried_mass is other.carried_mass
        and np.array_equal(body.gravity, other.gravity)
    )
