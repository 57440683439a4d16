"""A run as a Rerun recording (.rrd): the deformed body, forces with their uncertainty, clouds, and values over time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.packages import needed
from femsense.io.files import check_target, write_beside
from femsense.io.own_files import RERUN
from femsense.sensing.run_files import read_run
from femsense.sensing.types import ContactForce, FrameReport, Run
from femsense.xr.run_scene import BODY, FORCE, arrow_of, body_surface, camera_pose, cloud_of, recording_of

UNCERTAIN = (0.9, 0.25, 0.15, 0.25)
"""The ellipsoid of a place: two standard deviations along each axis."""


@dataclass(frozen=True, slots=True)
class RerunReport:
    """Result of `export_rerun`."""

    frames: int
    clouds: int
    contacts: int


def export_rerun(folder: str | Path, path: str | Path) -> RerunReport:
    """Write a run as a file of the Rerun viewer.

    Entities: world/body (mesh), world/forces (arrows, N in the labels), world/places (ellipsoids of two standard deviations),
    world/camera/cloud; force/…, tension/… and pressure/… as plots; log (statuses other than ok). The timeline is `time` [s].

    Arguments:
        folder: a run that `femsense estimate` wrote.
        path: the .rrd file.

    Raises:
        InputError: no run, or another file at that place. MissingDependency: without the extra rerun.
    """
    check_target(path, folder=False, kind=RERUN)
    rr, run = needed("rerun", "rerun", "writing .rrd"), read_run(folder)
    pose, recording, clouds = camera_pose(folder), recording_of(run), 0
    with write_beside(path) as part:
        stream = rr.RecordingStream("femsense", recording_id=str(Path(folder).resolve()))
        stream.save(str(part))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if pose is not None:
            stream.log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static=True)
        for index, report in enumerate(run.frames):
            stream.set_time("time", duration=report.time_s)
            contacts = [c for c in run.contacts if c.frame == report.frame]
            _log_body(rr, stream, run, index)
            _log_contacts(rr, stream, contacts)
            _log_values(rr, stream, report, contacts)
            cloud = cloud_of(recording, report.frame)
            if cloud is not None and pose is not None:
                stream.log("world/camera/cloud", rr.Points3D(cloud.points, colors=_bytes(cloud.colors), radii=5e-4))
                clouds += 1
        stream.flush()
        stream.disconnect()
    return RerunReport(len(run.frames), clouds, len(run.contacts))


def _log_body(rr: Any, stream: Any, run: Run, index: int) -> None:
    nodes, triangles = body_surface(run, index)
    if np.isfinite(nodes).all():
        stream.log("world/body", rr.Mesh3D(vertex_positions=nodes, triangle_indices=triangles, albedo_factor=BODY))
    else:
        stream.log("world/body", rr.Clear(recursive=False))


def _log_contacts(rr: Any, stream: Any, contacts: list[ContactForce]) -> None:
    known = [c for c in contacts if np.isfinite(c.force_n_xyz).all()]
    arrows = [arrow_of(c) for c in known]
    labels = [f"{c.force_n:.3g} ± {c.std_n:.1g} N" for c in known]
    origins, vectors = (np.array([a[k] for a in arrows]).reshape(-1, 3) for k in (0, 1))
    colors = np.tile(_bytes(np.array(FORCE)), (len(known), 1))
    stream.log("world/forces", rr.Arrows3D(vectors=vectors, origins=origins, labels=labels, colors=colors, radii=8e-4))
    placed = [c for c in known if np.isfinite(c.position_std_m).all()]
    places, halves = (
        np.array(v).reshape(-1, 3) for v in ([c.position_m for c in placed], [2.0 * c.position_std_m for c in placed])
    )
    colors = np.tile(_bytes(np.array(UNCERTAIN)), (len(placed), 1))
    stream.log("world/places", rr.Ellipsoids3D(centers=places, half_sizes=halves, colors=colors))


def _log_values(rr: Any, stream: Any, report: FrameReport, contacts: list[ContactForce]) -> None:
    for contact in contacts:
        stream.log(f"force/track_{contact.track}", rr.Scalars(float(contact.force_n)))
    for kind, values in (("tension", report.tension_n), ("pressure", report.pressure_pa)):
        for name, value in values.items():
            stream.log(f"{kind}/{name}", rr.Scalars(float(value)))
    if report.status != "ok":
        stream.log("log", rr.TextLog(f"frame {report.frame}: {report.status}", level="WARN"))


def _bytes(colors: FloatArray | None) -> Any:
    return None if colors is None else np.rint(255 * np.asarray(colors)).astype(np.uint8)
