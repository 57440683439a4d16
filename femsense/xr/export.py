"""From a run to a skinned, animated mesh in one call."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.io.files import check_target, write_beside
from femsense.io.own_files import GLB, USDZ
from femsense.model.robot import Robot
from femsense.sensing.types import ContactForce, FrameReport
from femsense.xr.glb_arrows import with_arrows
from femsense.xr.gltf import ExportReport
from femsense.xr.run_contents import export_run
from femsense.xr.usdz_export import write_usdz
from femsense.xr.user_skin import UserSkin, export_surface

ENDINGS = (".glb", ".usdz")
"""Supported formats."""


class _States(Protocol):
    @property
    def time_s(self) -> FloatArray: ...
    @property
    def nodes_m(self) -> npt.NDArray[np.float32]: ...
    @property
    def tets(self) -> IntArray: ...
    @property
    def rest_nodes_m(self) -> FloatArray: ...


class RunLike(Protocol):
    """A run, as far as an export looks at it."""

    @property
    def states(self) -> _States: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def contacts(self) -> tuple[ContactForce, ...]: ...
    @property
    def frames(self) -> tuple[FrameReport, ...]: ...


def export_glb(
    run: RunLike | str | Path,
    path: str | Path,
    *,
    bones: int | None = None,
    color_rgb: npt.ArrayLike | None = None,
    skin: UserSkin | None = None,
    arrows: bool = False,
) -> ExportReport:
    """Write a run as a skinned, animated mesh (binary glTF 2.0), or as `.usdz` if the path has that suffix.

    Arguments:
        run: result of `estimate`, or the folder of a run.
        path: the `.glb` or `.usdz` file; its folder is created.
        bones: number of bones. Default: the number with the smallest error on held-out frames.
        color_rgb: colour of the body, sRGB from 0 to 1, shape (3,). Default: that of the robot.
        skin: a surface that deforms with the body, result of `read_skin`. Default: the surface of the finite-element mesh.
        arrows: whether to add the contact forces as animated arrows; `.glb` only. Default: no.

    Returns:
        a report of the export, with the distance to the finite-element surface.

    Raises:
        InputError: another suffix, a foreign file at that path, a folder without states, times that do not increase, or `.usdz` without the package usd-core.

    Example:
        >>> import tempfile
        >>> import femsense as fs
        >>> robot = fs.load_robot("finger")
        >>> recording = fs.load_recording(fs.robot_names()["finger"] / "recordings" / "press")  # installed with femsense
        >>> run = fs.estimate(robot, recording, fs.calibrate(robot, recording), at=[0.088, 0.0, 0.014])
        >>> report = fs.export_glb(run, tempfile.mkdtemp() + "/finger.glb", bones=8)
        >>> report.bones, report.frames
        (8, 12)
    """
    target = Path(path).expanduser()
    if target.suffix.lower() not in ENDINGS:
        hint = "--mcap and --rerun write for Foxglove and Rerun" if target.suffix.lower() in (".mcap", ".rrd") else None
        raise InputError("unsupported file suffix", where=target, expected=" or ".join(ENDINGS), hint=hint)
    check_target(target, folder=False, kind=GLB if target.suffix.lower() == ".glb" else USDZ)
    target.parent.mkdir(parents=True, exist_ok=True)
    if arrows:
        if target.suffix.lower() != ".glb":
            raise InputError("arrows are supported in .glb files only", where=target, expected="a .glb file")
        return _with_arrows(run, export_glb(run, target, bones=bones, color_rgb=color_rgb, skin=skin))
    if target.suffix.lower() == ".usdz":
        with tempfile.TemporaryDirectory(prefix="femsense-export-") as folder:
            report = export_glb(run, Path(folder, "robot.glb"), bones=bones, color_rgb=color_rgb, skin=skin)
            return replace(report, path=write_usdz(report.path.read_bytes(), target))
    if isinstance(run, str | Path):
        return export_run(run, target, bones=bones, color_rgb=color_rgb, skin=skin)
    states, robot = run.states, run.robot
    color = robot.color_rgb if color_rgb is None else color_rgb
    body = states.rest_nodes_m, states.tets, states.time_s, states.nodes_m
    return export_surface(*body, target, skin=skin, bones=bones, color_rgb=color, name=robot.name)


def _with_arrows(run: RunLike | str | Path, report: ExportReport) -> ExportReport:
    """Add the contact forces of a run to a file that was written of it."""
    from femsense.sensing.run_files import read_run

    whole = read_run(run) if isinstance(run, str | Path) else run
    data = with_arrows(report.path.read_bytes(), whole)
    with write_beside(report.path) as part:
        part.write_bytes(data)
    return report
