"""From a recording to forces, and back to inputs: `calibrate`, `estimate`, `reach`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import Json, RecordingPath, RobotPath, places

USE_CORRECTION = "Use the correction that femsense improve --correct learned: of markers, never a cause."


class SensingMethod(StrEnum):
    """How forces are found."""

    rays = "rays"
    paper = "paper"


def calibrate(
    robot: RobotPath,
    recording: RecordingPath,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="The file to write.")] = Path("calibration.json"),
    correct: Annotated[bool, typer.Option("--correct", help=USE_CORRECTION)] = False,
    json: Json = False,
) -> Answer:
    """Find the camera's pose and the cables' initial inputs."""
    from femsense.app.force_resolution import force_resolution
    from femsense.calib.calibrate import calibrate as calibrate_recording
    from femsense.calib.files import calibration_document, write_calibration
    from femsense.io.files import check_target
    from femsense.io.own_files import CALIBRATION
    from femsense.io.recording_folder import load_recording
    from femsense.io.robot_toml import load_robot
    from femsense.report.text import calibration_text

    check_target(output, folder=False, kind=CALIBRATION)
    body, frames = load_robot(robot), load_recording(recording)
    calibration = calibrate_recording(body, frames, correct=correct)
    if not calibration.settled:
        text = calibration_text(calibration) + "\n\nnothing is written: this calibration is not to be used"
        return Answer({"path": None, **calibration_document(calibration)}, text, exit_status=1)
    write_calibration(calibration, output)
    resolved, said = force_resolution(body, frames, calibration)
    text = f"{calibration_text(calibration)}\n\n{said}\n\nwritten: {output}"
    return Answer({"path": str(output), **calibration_document(calibration), "force_resolution": resolved}, text)


def estimate(
    robot: RobotPath,
    recording: RecordingPath,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN", help="The folder to write.", show_default=False)],
    calibration: Annotated[
        Path | None,
        typer.Option(
            "-c",
            "--calibration",
            metavar="FILE",
            help="Of femsense calibrate; made first where it is not given.",
            show_default=False,
        ),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option("--at", metavar="X,Y,Z …", help="Where forces act, in metres on the body at rest.", show_default=False),
    ] = None,
    method: Annotated[
        SensingMethod,
        typer.Option(
            "--method", help="rays: every point a measurement; paper: feature points and normal forces, one linear step."
        ),
    ] = SensingMethod.rays,
    friction: Annotated[
        float, typer.Option("--friction", metavar="MU", help="The cone about the normal in which contact forces lie.")
    ] = 1.0,
    push: Annotated[
        bool, typer.Option("--push", help="What acts at the places of --at pushes, within the cone; else it may pull, too.")
    ] = False,
    smooth: Annotated[
        float, typer.Option("--smooth", metavar="SECONDS", help="Average forces over so long; they lag by as much.")
    ] = 0.0,
    correct: Annotated[bool, typer.Option("--correct", help=USE_CORRECTION)] = False,
    again: Annotated[bool, typer.Option("--again", help="Compute even where RUN holds this result already.")] = False,
    json: Json = False,
) -> Answer:
    """Find contacts and forces in every frame."""
    from femsense.app.commands import estimate_into
    from femsense.app.force_resolution import force_resolution
    from femsense.calib.files import read_calibration
    from femsense.io.recording_folder import load_recording
    from femsense.report.text import run_document, run_text
    from femsense.sensing.types import SensingOptions

    if push and not at:
        raise typer.BadParameter("--push is of the places of --at, and none is given; what is found pushes anyway")
    options = SensingOptions(method=method.value, friction=friction, push=push, smooth_s=smooth, correct=correct)
    if smooth > 0:
        say(f"forces are averaged over {smooth:g} s and lag by as much")
    with progress_bar("estimate") as progress:
        run = estimate_into(
            output,
            robot,
            recording,
            calibration=calibration,
            at=places(at or []),
            options=options,
            again=again,
            say=say,
            progress=progress,
        )
    resolved, said = force_resolution(run.robot, load_recording(recording), read_calibration(output))
    return Answer(
        {"run": str(output), **run_document(run), "force_resolution": resolved},
        f"{run_text(run)}\n\n{said}\n\nwritten: {output}\nlook at it: femsense view {output}",
    )


def reach(
    robot: RobotPath,
    target: Annotated[
        list[str],
        typer.Option(
            "--target", metavar="MARKER=X,Y,Z …", help="Where a marker is wanted, in metres, robot frame.", show_default=False
        ),
    ],
    control: Annotated[str, typer.Option("--control", help="What is commanded of cables: tension or displacement.")] = "tension",
    force: Annotated[
        list[str] | None,
        typer.Option("--force", metavar="X,Y,Z=FX,FY,FZ …", help="Known contact forces.", show_default=False),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option("-c", "--calibration", metavar="FILE", help="Commands count from its initial inputs.", show_default=False),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="A JSON file to write.", show_default=False)
    ] = None,
    correct: Annotated[bool, typer.Option("--correct", help=USE_CORRECTION)] = False,
    json: Json = False,
) -> Answer:
    """Find the inputs that bring points of the body to places."""
    from femsense.app.reach_command import reach_targets

    document, text, reached = reach_targets(
        robot, target, control=control, forces=force or [], calibration=calibration, output=output, correct=correct
    )
    return Answer(document, text, exit_status=0 if reached else 1)
