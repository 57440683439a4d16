"""Sensors as a stream: readings, the learnt model, bones, and the robot's skin on them, or a tube without one."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.xr.gltf import glb_bytes
from femsense.xr.landmarks import Landmark, Landmarks
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.skeleton import skeleton_at
from femsense.xr.skinning import INFLUENCES, Skin
from femsense.xr.stream.payloads import Input, Twin, TwinFrame, bone_rows
from femsense.xr.stream.publisher import STALE_S
from femsense.xr.stream.readings import Readings
from femsense.xr.user_skin import UserSkin

AROUND, BETWEEN = 20, 6
"""Vertices around the tube, and rings between neighbouring bones."""
THICKNESS = 1 / 16
"""Radius of the tube, as a share of its length."""


def sensor_twin(model: ProprioceptiveModel, name: str, worn: UserSkin | None = None) -> Twin:
    """Return the streamed twin of a learnt model: a surface on its chain of bones.

    Arguments:
        model: a proprioceptive model with a chain of bones.
        name: name of the robot in topics.
        worn: the robot's surface, in the frame of reference of the model's markers; None: a tube.

    Raises:
        InputError: the model has no chain, or the surface is not at its bones.
    """
    rest = model.rest_bones
    surface = worn or UserSkin(*tube_around(rest.positions, rest.T_robot_bone[:, :3, :2]))
    skin = bound_to_chain(surface.rest, rest.positions)
    still = skin.skeleton.T_robot_bone[None]
    colors, texture = surface.colors, surface.texture
    glb = glb_bytes(skin.rest, surface.triangles, skin, still, [0.0], color_rgb=colors, texture=texture, name=name)
    inputs = tuple(
        Input(channel, "", float(low), float(high), "learnt")
        for channel, low, high in zip(model.channels, model.domain.low, model.domain.high)
    )
    places = () if model.chain is None else model.chain.rest_points
    marks = tuple(Landmark(label, place) for label, place in zip(model.marker_names, places))
    stated = model.report.get("error_mm")
    error = 1e-3 * stated if isinstance(stated, float) else float("nan")
    bones = skin.skeleton
    known = Landmarks(marks, ())
    return Twin(name, glb, bones.names, bones.T_robot_bone, inputs, landmarks=known, error_m=error, frame=model.frame)


def bound_to_chain(vertices: FloatArray, bones: FloatArray) -> Skin:
    """Return a skin whose vertices move with the two bones between which they lie, as shares of the way from one to the other.

    Arguments:
        vertices: vertices of a surface at rest [m], shape (v, 3).
        bones: places at rest, in their order along the body, same frame of reference [m], shape (b, 3).

    Raises:
        InputError: half of the vertices are farther from the chain than half of its length.
    """
    length = float(np.linalg.norm(np.diff(bones, axis=0), axis=1).sum()) or 1e-3
    along = np.diff(bones, axis=0, append=bones[-1:])  # of no length beyond the last bone, for a chain of one
    off = vertices[:, None] - bones
    t = np.clip(np.einsum("vbi,bi->vb", off, along) / np.maximum((along**2).sum(axis=1), 1e-18), 0.0, 1.0)
    apart = np.linalg.norm(off - t[..., None] * along, axis=2)
    owner = apart.argmin(axis=1)
    share, away = (part[np.arange(len(vertices)), owner] for part in (t, apart))
    if np.median(away) > 0.5 * length:
        raise InputError(
            "the skin is not at the model's bones",
            where="--skin",
            found=f"half of its vertices are more than {1e3 * float(np.median(away)):.3g} mm from them",
            expected=f"at most half of the chain's length, {500.0 * length:.3g} mm",
            hint="--skin-unit, or a surface in the frame in which the markers were measured",
        )
    weights, joints = np.zeros((len(vertices), INFLUENCES)), np.zeros((len(vertices), INFLUENCES), dtype=np.int64)
    weights[:, 0], weights[:, 1] = 1.0 - share, share
    joints[:, 0], joints[:, 1] = owner, np.minimum(owner + 1, len(bones) - 1)
    joints[weights == 0.0] = 0
    return Skin(skeleton_at(bones), vertices, joints, weights)


def frames_of_sensors(readings: Readings, model: ProprioceptiveModel) -> Iterator[TwinFrame]:
    """Yield a frame for each row of readings (see `readings_of`).

    If a required reading is not finite, the last valid pose is kept, with the time of its reading.
    """
    live, straight = model.live(), np.linalg.inv(model.rest_bones.T_robot_bone)
    straight[:, :3, 3] = 0.0
    bones = bone_rows(skeleton_at(model.rest_bones.positions).T_robot_bone)
    read_at = float("-inf")
    for time_s, row in readings:
        pose = live.step(row, time_s)
        if pose.bones is not None:
            read_at = readings.came
            bones = bone_rows(pose.bones.T_robot_bone @ straight)  # bones that have the robot's axes at rest
        said = "; ".join(item.text for item in pose.outside[:2])
        inputs = tuple(float(v) for v in row)
        known = {} if pose.interval is None else dict(zip(model.marker_names, pose.interval.tolist()))
        yield TwinFrame(time_s, bones, contacts=None, inputs=inputs, status=said or "ok", read_at=read_at, interval_m=known)


def markers_of_sensors(readings: Readings, model: ProprioceptiveModel) -> Iterator[tuple[float, dict[str, FloatArray], str]]:
    """Yield the time [s] and the positions of the markers [m], name → shape (3,), of each reading (see `readings_of`).

    Readings outside of the model's training domain give no positions, which would be guesses, but the reason.
    Readings that are outdated on arrival are left out.
    """
    live = model.live()
    for time_s, row in readings:
        pose = live.step(row, time_s)
        if time.monotonic() - readings.came <= STALE_S:
            why = "; ".join(item.text for item in pose.outside[:1])
            yield time_s, {} if why else dict(zip(model.marker_names, pose.markers)), why


def tube_around(places: FloatArray, across: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the vertices of a closed tube around a chain of bones [m], shape (v, 3), and outward triangles, shape (t, 3).

    Arguments:
        places: positions of the bones at rest, in their order along the body [m], shape (b, 3).
        across: two unit vectors across the body at each bone, shape (b, 3, 2).
    """
    from trimesh.creation import revolve

    b = len(places)
    radius = THICKNESS * (float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()) or 1e-3)
    at = np.linspace(-0.5, b - 0.5, BETWEEN * b + 1)  # in bones, half of one beyond the first and the last
    straight = revolve([(0.0, at[0]), *((radius, z) for z in at), (0.0, at[-1])], sections=AROUND)
    xy, z = straight.vertices[:, :2], straight.vertices[:, 2]
    k = np.clip(np.floor(z).astype(int), 0, max(b - 2, 0))
    middle = places[k] + (z - k)[:, None] * (places[np.minimum(k + 1, b - 1)] - places[k])
    nearest = np.clip(np.rint(z).astype(int), 0, b - 1)
    return middle + np.einsum("vij,vj->vi", across[nearest], xy), np.asarray(straight.faces, dtype=np.int64)
