"""A recording from arrays in memory."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import as_numbers
from femsense.core.errors import InputError
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, MarkerRows, Timeline, Views


def recording_from_arrays(
    time_s: npt.ArrayLike,
    *,
    inputs: Mapping[str, npt.ArrayLike] | None = None,
    actuation: str = "tension",
    pressures: Mapping[str, npt.ArrayLike] | None = None,
    markers: Mapping[str, npt.ArrayLike] | None = None,
    T_robot_camera: npt.ArrayLike | None = None,
    free: npt.ArrayLike | None = None,
) -> Recording:
    """Make a recording of F frames and one camera from arrays.

    Arguments:
        time_s: time of each frame [s], increasing, shape (F,).
        inputs: dict, name of a cable → its absolute input in each frame [N or m], shape (F,). Default: none.
        actuation: kind of the inputs: "tension" [N] (default) or "displacement" [m].
        pressures: dict, name of a chamber → its pressure in each frame [Pa], shape (F,). Default: none.
        markers: dict, name of a marker → its position in camera coordinates [m], shape (F, 3), nan where it is hidden. Default: none.
        T_robot_camera: pose of the camera, shape (4, 4), from camera to robot coordinates; the identity if the markers are in robot coordinates.
            Default: unknown.
        free: whether each frame is free of contacts, shape (F,). Default: unknown.

    Returns:
        the recording, for `calibrate` and `estimate`.

    Raises:
        InputError: no frame, shapes that do not match, times that do not increase, or values that are not finite.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> recording = fs.recording_from_arrays(
        ...     [0.0, 0.1], inputs={"flexor": [0.0, 0.5]}, actuation="tension", markers={"tip": np.zeros((2, 3))}
        ... )
        >>> recording.frame_count
        2
    """
    times = as_numbers(time_s, "time_s", expected="the time of each frame [s]").reshape(-1)
    frames = times.size
    if not frames:
        raise InputError("no frame", where="time_s", found="no time", expected="the time of each frame [s]")
    places = {
        name: as_numbers(x, f"markers[{name!r}]", expected=f"places [m], shape {(frames, 3)}")
        for name, x in _named(markers, "markers").items()
    }
    for name, x in places.items():
        _check_places(x, frames, f"markers[{name!r}]")
    grid = np.stack(list(places.values()), axis=1) if places else np.zeros((frames, 0, 3))
    frame, index = np.nonzero(np.isfinite(grid).all(axis=2))
    return make_recording(
        Timeline(times, free=free),
        drives=Drives(
            actuation=actuation,
            cable_names=tuple(inputs or ()),
            inputs=_columns(inputs, frames, "inputs"),
            chamber_names=tuple(pressures or ()),
            pressures=_columns(pressures, frames, "pressures"),
        ),
        markers=MarkerRows(tuple(places), frame, index, grid[frame, index]),
        views=Views(T_robot_camera=[T_robot_camera]),
    )


def _named(series: Mapping[str, npt.ArrayLike] | None, what: str) -> Mapping[str, npt.ArrayLike]:
    if series is not None and not isinstance(series, Mapping):
        raise InputError("no names", where=what, found=f"a {type(series).__name__}", expected=f'{what}={{"name": values, …}}')
    return series or {}


def _check_places(places: npt.NDArray[np.float64], frames: int, where: str) -> None:
    """Raise InputError unless there is a place, or three nan, in each frame."""
    if places.shape != (frames, 3):
        raise InputError("places of another shape", where=where, found=places.shape, expected=(frames, 3))
    wrong = ~np.isfinite(places).all(axis=1) & ~np.isnan(places).all(axis=1)
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        raise InputError(
            "not a place",
            where=where,
            found=f"{places[k].tolist()} in frame {k}",
            expected="three numbers [m], or three nan where it is hidden",
        )


def _columns(series: Mapping[str, npt.ArrayLike] | None, frames: int, what: str) -> npt.NDArray[np.float64]:
    wanted = f"a number for each of {frames} frames"
    columns = {name: as_numbers(values, f"{what}[{name!r}]", expected=wanted) for name, values in _named(series, what).items()}
    for name, values in columns.items():
        if values.shape != (frames,):
            raise InputError("a series of another length", where=f"{what}[{name!r}]", found=values.shape, expected=(frames,))
        if not np.isfinite(values).all():
            k = int(np.flatnonzero(~np.isfinite(values))[0])
            raise InputError("not finite", where=f"{what}[{name!r}]", found=f"{values[k]} in frame {k}", expected=wanted)
    return np.stack(list(columns.values()), axis=1) if columns else np.zeros((frames, 0))
