"""Contacts in a frame: the patch of each, the direction of its force, and the pose of its object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.fem.body import BodyModel
from femsense.rig.objects import Surface, along_surface, object_pose, object_surface, pressing
from femsense.rig.patches import LoadPatch, Pressing, contact_patch, nearest_place, pressed_patch
from femsense.rig.plan import Plan
from femsense.rig.planned_contact import PlannedContact

PROBE_M = 0.006
"""Default radius of a contact patch [m]."""
HOVER_N = 1e-3
"""Force for which the patch of an object without contact is computed [N]."""


@dataclass(frozen=True, eq=False, slots=True)
class Press:
    """One contact at one moment."""

    contact: int
    """Index of the script's contact."""
    patch: LoadPatch
    force: float
    """[N]."""
    ratio: float
    """Ratio of tangential to normal force [1]."""
    pressing: Pressing | None
    """Contact geometry of its object; None: a probe."""


@dataclass(frozen=True, eq=False, slots=True)
class TrueContact:
    """A contact in one frame."""

    contact: int
    """Index of the script's contact."""
    place: FloatArray
    """Centre of the contact patch on the deformed body [m], shape (3,)."""
    normal: FloatArray
    """Outward unit normal there, shape (3,)."""
    force: FloatArray
    """On the body [N], shape (3,)."""
    rest: FloatArray | None = None
    """Centre of the contact patch at rest [m], shape (3,)."""
    radius: float = 0.0
    """Radius of a circle with the area of the contact patch [m]."""
    T_robot_object: FloatArray | None = None
    """Pose of its object, shape (4, 4); None: a probe."""


@dataclass(frozen=True, eq=False, slots=True)
class Hovering:
    """An object that is present without contact."""

    contact: int
    T_robot_object: FloatArray
    """Shape (4, 4)."""


class Presses:
    """The contacts of a plan on a body; unchanged patches are the same objects."""

    def __init__(self, body: BodyModel, plan: Plan, folder: Path) -> None:
        self.mesh, self.plan = body.mesh, plan
        material = body.material
        self.modulus = float(np.median(material.young_modulus / (1.0 - material.poisson_ratio**2)))
        self.surfaces: dict[str, Surface] = {}
        for contact in plan.contacts:
            if contact.item is not None and contact.item.name not in self.surfaces:
                self.surfaces[contact.item.name] = object_surface(contact.item, folder)
        self.made: dict[tuple[object, ...], tuple[LoadPatch, Pressing | None]] = {}

    def at(self, k: int) -> tuple[Press, ...]:
        """Return the contacts with a force in frame k."""
        result = []
        for i, contact in enumerate(self.plan.contacts):
            force = float(contact.force[k])
            if force > 0:
                patch, how = self._patch(contact, k, force)
                result.append(Press(i, patch, force, 0.0 if contact.tangent is None else float(contact.tangent[k]), how))
        return tuple(result)

    def direction(self, press: Press, positions: FloatArray) -> FloatArray:
        """Return the direction of a force on the deformed body, unit, shape (3,)."""
        contact = self.plan.contacts[press.contact]
        if contact.table.direction is not None:
            given = np.array(contact.table.direction)
            return np.asarray(given / np.linalg.norm(given))
        normal = press.patch.normal(positions)
        if not press.ratio:
            return np.asarray(-normal)
        along = along_surface(contact.way, normal)
        return np.asarray((press.ratio * along - normal) / np.hypot(1.0, press.ratio))

    def total(self, presses: tuple[Press, ...], positions: FloatArray) -> FloatArray:
        """Return the nodal forces of the contacts [N], shape (n, 3)."""
        n = len(self.mesh.nodes)
        total = np.zeros((n, 3))
        for press in presses:
            total += press.patch.spread(press.force * self.direction(press, positions), n)
        return total

    def contacts(self, presses: tuple[Press, ...], positions: FloatArray) -> tuple[TrueContact, ...]:
        """Return the contacts on the deformed body."""
        return tuple(
            TrueContact(
                p.contact,
                freeze(p.patch.place(positions)),
                freeze(p.patch.normal(positions)),
                freeze(p.force * self.direction(p, positions)),
                freeze(p.patch.place(self.mesh.nodes)),
                p.patch.radius,
                None if p.pressing is None else freeze(self._pose(p.contact, p.pressing, p.patch, positions)),
            )
            for p in presses
            if p.force > 0
        )

    def hovering(self, k: int, positions: FloatArray) -> tuple[Hovering, ...]:
        """Return the objects that are present in frame k without contact."""
        result = []
        for i, contact in enumerate(self.plan.contacts):
            if contact.item is None or contact.away is None or contact.force[k] > 0 or not np.isfinite(contact.away[k]):
                continue
            patch, how = self._patch(contact, k, HOVER_N)
            assert how is not None
            T = self._pose(i, how, patch, positions)
            T[:3, 3] += float(contact.away[k]) * T[:3, 2]
            result.append(Hovering(i, freeze(T)))
        return tuple(result)

    def _pose(self, i: int, how: Pressing, patch: LoadPatch, positions: FloatArray) -> FloatArray:
        contact = self.plan.contacts[i]
        stands = contact.item is not None and contact.item.kind == "weight"
        upright = -np.asarray(contact.table.direction) if stands else None
        return object_pose(how, patch, self.mesh.nodes, positions, upright=upright)

    def _patch(self, contact: PlannedContact, k: int, force: float) -> tuple[LoadPatch, Pressing | None]:
        place, radius = contact.place(k), contact.table.radius_m
        by_form = contact.item is not None and radius is None
        key = (contact.table.object, tuple(place.tolist()), radius, tuple(contact.along.tolist()), force if by_form else 0.0)
        if key not in self.made:
            how = None if contact.item is None else self._against(contact, place)
            if by_form and how is not None:
                patch = pressed_patch(self.mesh, how, force, self.modulus)
            else:
                patch = contact_patch(self.mesh, place, PROBE_M if radius is None else radius)
            self.made[key] = patch, how
        return self.made[key]

    def _against(self, contact: PlannedContact, place: FloatArray) -> Pressing:
        assert contact.item is not None
        spot, normal = nearest_place(self.mesh, place)
        return pressing(contact.item, self.surfaces[contact.item.name], spot, normal, contact.along)


def between(before: tuple[Press, ...], after: tuple[Press, ...], part: float) -> tuple[Press, ...]:
    """Return the contacts between two frames: forces on a common patch are interpolated, others grow from
    or fall to zero."""
    later = {(p.contact, id(p.patch)): p for p in after}
    result = []
    for p in before:
        other = later.pop((p.contact, id(p.patch)), None)
        to, ratio = (0.0, p.ratio) if other is None else (other.force, p.ratio + part * (other.ratio - p.ratio))
        result.append(replace(p, force=p.force + part * (to - p.force), ratio=ratio))
    result += [replace(p, force=part * p.force) for p in later.values()]
    return tuple(sorted(result, key=lambda p: p.contact))
