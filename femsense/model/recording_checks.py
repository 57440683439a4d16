"""Whether a recording fits a robot, and whether its numbers can be meant."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import diagonal, freeze
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean, look_alike, plain_name
from femsense.fem.cables import cable_length
from femsense.fem.mesh import embed_points
from femsense.model.marker_units import check_marker_distances
from femsense.model.plausibility import doubts_of_recording, place_of, warn_of
from femsense.model.recording import Recording, with_marker_table
from femsense.model.recording_parts import RestMarkers
from femsense.model.robot import Robot
from femsense.model.stale_markers import without_far_markers, without_stale_markers, without_twins

FAR_LOAD = 0.25
"""A known load farther from the body than this times the mesh's diagonal is an error."""


def check_against(robot: Robot, recording: Recording) -> Recording:
    """Return the recording as this robot needs it: cables and chambers in the robot's order,
    without markers that the robot lacks.

    Warns of markers that are dropped, of inputs beyond the limits of cables and chambers, and of numbers that are hardly meant.

    Raises:
        InputError: other cables or chambers than the robot's, no marker in common, a known load far from the body.
        DataError: markers in another unit.
    """
    size = diagonal(np.vstack([robot.body.mesh.nodes, robot.marker_points]))
    measured = without_far_markers(without_stale_markers(without_twins(_composed(recording))), size)
    fitted = _without_strangers(robot, _with_chamber_order(robot, _with_cable_order(robot, measured)))
    check_marker_distances(robot, fitted)
    _check_loads(robot, fitted)
    _check_displacements(robot, fitted)
    _warn_of_inputs(robot, fitted)
    warn_of(doubts_of_recording(fitted, robot))
    return fitted


def _composed(recording: Recording) -> Recording:
    """Return the recording with its names in their composed form: é is one name, however it is spelt."""
    names = {key: tuple(map(plain_name, getattr(recording, key))) for key in ("marker_names", "cable_names", "chamber_names")}
    return replace(recording, **names)  # type: ignore[arg-type]


def in_frames(recording: Recording) -> str:
    """Return " in frames.csv" where a recording has one."""
    return " in frames.csv" if recording.folder else ""


def camera_text(name: str) -> str:
    """Return how messages refer to a camera; the only one of a recording has no name."""
    return f"camera {name}" if name else "the camera"


def how_to_free(recording: Recording) -> str:
    """Return how frames are said to be free of undeclared contact."""
    if recording.folder is None:
        return "with True in free of Recording.from_arrays"
    return f"with 1 in the column free of {recording.folder.name}/frames.csv"


def _with_cable_order(robot: Robot, recording: Recording) -> Recording:
    wanted = robot.body.cable_names
    order = _drive_order(robot, recording, "cable", wanted, recording.cable_names)
    return replace(recording, cable_names=wanted, inputs=freeze(recording.inputs[:, order]))


def _with_chamber_order(robot: Robot, recording: Recording) -> Recording:
    wanted = robot.body.chamber_names
    order = _drive_order(robot, recording, "chamber", wanted, recording.chamber_names)
    return replace(recording, chamber_names=wanted, pressures=freeze(recording.pressures[:, order]))


def _drive_order(robot: Robot, recording: Recording, kind: str, wanted: tuple[str, ...], given: tuple[str, ...]) -> list[int]:
    """Return where the robot's cables or chambers stand among the columns."""
    if set(wanted) != set(given):
        lacking = [name for name in wanted if name not in given]
        extra = [name for name in given if name not in wanted]
        parts = [f"lacks {', '.join(lacking)}"] if lacking else []
        parts += [f"has {', '.join(extra)}, which the robot lacks"] if extra else []
        idle = "a cable that was slack" if kind == "cable" else "a chamber without pressure"
        column = f"{kind}_" if recording.folder else ""
        renamed = (
            f"rename the column of frames.csv, or import again with --map {extra[0]}={kind}_{(lacking or ['NAME'])[0]}"
            if extra and recording.folder
            else None
        )
        logged = "; inputs that another program logged: femsense import --actuation LOG.csv" if recording.folder else ""
        raise InputError(
            f"other {kind}s than those of the robot {robot.name!r}: the recording {' and '.join(parts)}",
            where=place_of(recording, "frames.csv", "inputs" if kind == "cable" else "pressures"),
            found=", ".join(column + name for name in given) or f"no {kind}s",
            expected=", ".join(column + name for name in wanted) or f"no {kind}s",
            hint=(did_you_mean(extra[0], wanted) or renamed) if extra else f"{idle} has zeros in all frames{logged}",
        )
    return [given.index(name) for name in wanted]


def _without_strangers(robot: Robot, recording: Recording) -> Recording:
    """Return the recording without the markers that the robot lacks."""
    known = set(robot.marker_names)
    strangers = [name for name in recording.marker_names if name not in known]
    if recording.has_markers and len(strangers) == len(recording.marker_names):
        raise InputError(
            f"no marker that the robot {robot.name!r} has",
            where=place_of(recording, "markers.csv", "markers"),
            found=", ".join(recording.marker_names),
            expected=", ".join(robot.marker_names) or "the robot declares no [[markers]]",
            hint=did_you_mean(strangers[0], robot.marker_names),
        )
    result = _without_rest_strangers(robot, recording)
    if not strangers:
        return result
    where = place_of(recording, "markers.csv", "markers")
    warnings.warn(f"{where}: {_left_out(strangers, robot)}", stacklevel=3)
    names = [name for name in recording.marker_names if name in known]
    kept = np.array([recording.marker_names[i] in known for i in recording.marker_index], dtype=bool)
    index = [names.index(recording.marker_names[i]) for i in recording.marker_index[kept]]
    r = recording
    return with_marker_table(
        result, names, r.marker_frame[kept], np.array(index, dtype=np.int64), r.marker_xyz[kept], view=r.marker_view[kept]
    )


def _left_out(strangers: Sequence[str], robot: Robot) -> str:
    """Return the markers that the robot lacks as text, with those that are its own in another spelling."""
    text = f"markers that the robot {robot.name!r} lacks are left out: {', '.join(strangers)}"
    near = look_alike(strangers, robot.marker_names)
    return text + (f"; are they {', '.join(near.values())} in another spelling? Rename them" if near else "")


def _without_rest_strangers(robot: Robot, recording: Recording) -> Recording:
    rest, known = recording.rest, set(robot.marker_names)
    if rest is None or known.issuperset(rest.names):
        return recording
    lost = sorted(set(rest.names) - known)
    warnings.warn(f"{place_of(recording, 'rest.csv', 'markers at rest')}: {_left_out(lost, robot)}", stacklevel=4)
    kept = np.array([name in known for name in rest.names], dtype=bool)
    names = tuple(name for name in rest.names if name in known)
    left = RestMarkers(names, freeze(rest.positions[kept]), freeze(rest.std[kept]), freeze(rest.view[kept], np.int64))
    return replace(recording, rest=left if names else None)


def _check_loads(robot: Robot, recording: Recording) -> None:

    if not len(recording.load_points):
        return
    places = np.unique(recording.load_points, axis=0)
    outside = embed_points(robot.body.mesh, places).outside
    size = diagonal(robot.body.mesh.nodes)
    worst = int(outside.argmax())
    if outside[worst] > FAR_LOAD * size:
        k = int(recording.load_frame[(recording.load_points == places[worst]).all(axis=1)][0])
        looks = np.abs(places[worst]).max() > 20 * np.abs(robot.body.mesh.nodes).max()
        raise InputError(
            "a known load is far from the body",
            where=f"{place_of(recording, 'loads.csv', 'loads')}, frame {recording.frame_numbers[k]}",
            found=f"{places[worst].tolist()} m, {1e3 * outside[worst]:.4g} mm outside",
            expected=f"a place on the body at rest, robot frame, at most {250 * size:.4g} mm outside",
            hint="this looks like millimetres: places are in metres"
            if looks
            else "loads are in the robot frame, not the camera's",
        )


def _check_displacements(robot: Robot, recording: Recording) -> None:
    """Refuse a cable that is shortened by more than its length. Raises InputError."""
    if recording.actuation != "displacement":
        return
    for cable, pulled in zip(robot.body.cables, recording.inputs.T):
        length = cable_length(cable, robot.body.mesh.nodes)
        span = float(np.ptp(pulled)) if recording.actuation_zero == "unknown" else float(pulled.max(initial=0.0))
        if span > max(length, 1e-3):
            raise InputError(
                f"cable {cable.name!r} is shortened by more than its length",
                where=place_of(recording, "frames.csv", "inputs"),
                found=f"{span:.4g} m",
                expected=f"less than {length:.4g} m from its far end to its pull point",
                hint="this looks like millimetres: displacements are in metres" if span > 5 * length else None,
            )


def _warn_of_inputs(robot: Robot, recording: Recording) -> None:
    """Warn of pressures and tensions beyond what chambers and cables are declared for."""
    for j, chamber in enumerate(robot.body.chambers):
        highest = recording.pressures[:, j].max(initial=-np.inf)
        if highest > chamber.max_pressure * (1 + 1e-9):
            warnings.warn(
                (
                    f"{place_of(recording, 'frames.csv', 'pressures')}: chamber {chamber.name!r} reaches {highest:.4g} Pa, more than its "
                    f"max_pressure_pa of {chamber.max_pressure:.4g} Pa"
                ),
                stacklevel=3,
            )
    if recording.actuation != "tension":
        return
    for j, cable in enumerate(robot.body.cables):
        tension = recording.inputs[:, j]
        if recording.actuation_zero != "absolute":
            span = max(float(tension.max(initial=0.0)), 0.0) - min(float(tension.min(initial=0.0)), 0.0)
            if span > (cable.max_tension - cable.min_tension) * (1 + 1e-9):
                warnings.warn(
                    (
                        f"{place_of(recording, 'frames.csv', 'inputs')}: the tensions of cable {cable.name!r} span {span:.4g} N, more "
                        f"than from its min_tension_n to its max_tension_n"
                    ),
                    stacklevel=3,
                )
            continue
        if tension.max(initial=-np.inf) > cable.max_tension * (1 + 1e-9):
            warnings.warn(
                (
                    f"{place_of(recording, 'frames.csv', 'inputs')}: cable {cable.name!r} reaches {tension.max():.4g} N, more than its "
                    f"max_tension_n of {cable.max_tension:.4g} N"
                ),
                stacklevel=3,
            )
        if tension.min(initial=np.inf) < 0:
            warnings.warn(
                (
                    f"{place_of(recording, 'frames.csv', 'inputs')}: cable {cable.name!r} goes down to {tension.min():.4g} N; a cable "
                    f"cannot push"
                ),
                stacklevel=3,
            )
