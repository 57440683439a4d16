"""The objects of a frame: segmented near the expected state, and again where a fit has moved the body; and where they touch it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.fem.equilibrium import Equilibrium
from femsense.inference.mixture import misfit
from femsense.inference.rows import Rows
from femsense.pointcloud.primitives import Shape
from femsense.sensing.fit import fit
from femsense.sensing.model import LIKELY, Fit, Frame, Model
from femsense.sensing.no_penetration import gap_std
from femsense.sensing.places import away_from_scenery, object_touches, objects_near
from femsense.sensing.types import Touch


def with_segmented_objects(model: Model, best: Fit) -> Fit:
    """Return a fit with the objects near its state.

    With colour they are segmented again once the state is an edge away from where they were; without, they are the pixels in front that the fit does not
    take for the robot.
    """
    frame = best.frame
    if frame.scan is None or (frame.coloured and _moved_by(frame.objects_at, best.state) <= model.sensor.surface.edge):
        return best
    if frame.coloured:
        objects = tuple(objects_near(model.sensor, frame.scan, best.state, frame.seen_before))
        frame = replace(frame, objects_at=best.state.positions)
        best = replace(best, frame=frame)
    else:
        objects = _in_front(model, frame, best.rows, best.of_robot, best.state)
    if len(objects) == len(frame.objects) and all(_agree(model, a, b) for a, b in zip(objects, frame.objects)):
        return best
    with_objects = replace(frame, objects=objects)
    again = fit(
        model, with_objects, best.contacts, best.forces, best.state, eta=best.eta, tau=best.tau, linearised=best.linearised
    )
    return best if again is None else again


def with_expected_objects(model: Model, frame: Frame, expected: Equilibrium) -> Frame:
    """Return a frame with the objects near the expected state. Without colour there are none before a state has been fitted."""
    assert frame.scan is not None
    if frame.coloured:
        objects = tuple(objects_near(model.sensor, frame.scan, expected, frame.seen_before))
        return replace(frame, objects=objects, objects_at=expected.positions)
    if expected is frame.predicted:
        return frame
    rows = model.rows(frame, expected)
    robot = misfit(rows.residual / rows.std, rows.log_other, rows.share)[1] > LIKELY
    return replace(frame, objects=_in_front(model, frame, rows, robot, expected))


def touching_objects(model: Model, best: Fit) -> list[Touch]:
    """Return where visible objects touch the state of a fit."""
    return away_from_scenery(model.sensor, object_touches(model.sensor, best.frame.objects, best.state))


def _in_front(model: Model, frame: Frame, rows: Rows, robot: BoolArray, state: Equilibrium) -> tuple[Shape, ...]:
    """Return the objects formed by the pixels in front of a state that do not belong to the robot; robot: responsibilities, shape (r,)."""
    assert frame.scan is not None
    pixels = rows.pixel
    other = ~robot[pixels] & (rows.residual[pixels] > 0.0)
    scan = replace(frame.scan, others=frame.scan.camera_points[other], others_view=frame.scan.view[other])
    return tuple(objects_near(model.sensor, scan, state, frame.seen_before))


def _moved_by(positions: FloatArray | None, state: Equilibrium) -> float:
    """Return how far the nodes of a state are from positions at most [m], shape (n, 3); 0 without positions, which a frame without pixels has."""
    return 0.0 if positions is None else float(np.linalg.norm(state.positions - positions, axis=1).max())


def _agree(model: Model, first: Shape, second: Shape) -> bool:
    """Return whether two shapes agree within the standard deviation of their surfaces; extents of plates, and of rods along their axis, do not count."""
    ways = {"plate": first.axes[2:], "cylinder": first.axes[1:]}.get(first.kind, first.axes)
    apart = float(np.linalg.norm(ways @ (first.center - second.center)))
    return first.kind == second.kind and apart < max(gap_std(model, first), gap_std(model, second))
