"""From a recording to forces, and back to inputs: `calibrate`, `estimate`, `reach`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.adapter import command
from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import Recordings, RobotPath, option, places
from femsense.app.command_line.several import Several
from femsense.app.live_options import LiveOptions
from femsense.sensing.options import SensingOptions

USE_CORRECTION = "Use the empirical correction of femsense improve --correct, which applies to markers."


@command(Several.EACH)
def calibrate(
    robot: RobotPath,
    recordings: Recordings,
    output: Annotated[Path, option("-o --output", "FILE", "The file to write.")] = Path("calibration.json"),
    correct: Annotated[bool, option("--correct", help=USE_CORRECTION)] = False,
) -> Answer:
    """Find the camera's pose and the cables' initial inputs."""
    from femsense.app.force_resolution import force_resolution
    from femsense.app.input_checks import warn_of_pictures
    from femsense.calib.calibrate import calibrate as calibrate_recording
    from femsense.calib.files import calibration_document, write_calibration
    from femsense.io.files import check_target
    from femsense.io.own_files import CALIBRATION
    from femsense.io.recording_folder import load_recording
    from femsense.io.robot_toml import load_robot
    from femsense.report.text import calibration_text

    check_target(output, folder=False, kind=CALIBRATION)
    body, frames = load_robot(robot), load_recording(recordings[0])
    warn_of_pictures(body, frames)
    calibration = calibrate_recording(body, frames, correct=correct)
    if not calibration.settled:
        text = calibration_text(calibration) + "\n\nnothing is written: this calibration is not to be used"
        return Answer({"path": None, **calibration_document(calibration)}, text, exit_status=1)
    write_calibration(calibration, output)
    resolved, said = force_resolution(body, frames, calibration)
    text = f"{calibration_text(calibration)}\n\n{said}\n\nwritten: {output}"
    return Answer({"path": str(output), **calibration_document(calibration), "force_resolution": resolved}, text)


@command(Several.EACH)
def estimate(
    robot: RobotPath,
    recordings: Recordings,
    output: Annotated[Path, option("-o --output", "RUN", "The folder to write.")],
    *,
    calibration: Annotated[
        Path | None,
        option(
            "-c --calibration",
            "FILE",
            "Result of femsense calibrate, or its folder for several recordings; by default it is computed first.",
        ),
    ] = None,
    at: Annotated[list[str] | None, option("--at", "X,Y,Z …", "Contact point, in metres on the body at rest.")] = None,
    options: SensingOptions,
    again: Annotated[bool, option("--again", help="Repeat the computation even if RUN contains its result.")] = False,
) -> Answer:
    """Find contacts and forces in every frame."""
    from femsense.app.commands import estimate_into
    from femsense.app.force_resolution import force_resolution
    from femsense.calib.files import read_calibration
    from femsense.io.recording_folder import load_recording
    from femsense.report.text import run_document, run_text

    (recording,) = recordings
    if options.push and not at:
        raise typer.BadParameter("--push applies to the points of --at, and none is given; contacts that are found push anyway")
    if options.smooth_s > 0:
        say(f"forces are averaged over {options.smooth_s:g} s and lag by as much")
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


@command()
def live(
    robot: RobotPath,
    camera: Annotated[
        str,
        option(
            "--camera",
            "SOURCE",
            "realsense[:SERIAL], orbbec[:SERIAL], oak[:ID], mcap:FILE, foxglove:ws://…, a folder that grows, or a recording.",
        ),
    ],
    options: LiveOptions,
) -> Answer:
    """Calibrate and sense while it happens, from a camera."""
    from femsense.app.live_command import sense_live, summary_text
    from femsense.live.link import LinkState

    document = sense_live(robot, camera, options, say=say)
    failed = document["link"] == LinkState.GAVE_UP.value or not document["frames_used"]
    return Answer(document, summary_text(document), exit_status=1 if failed else 0)


@command()
def reach(
    robot: RobotPath,
    target: Annotated[list[str], option("--target", "MARKER=X,Y,Z …", "Where a marker is wanted, in metres, robot frame.")],
    control: Annotated[str, option("--control", help="Quantity of the cable commands: tension or displacement.")] = "tension",
    force: Annotated[list[str] | None, option("--force", "X,Y,Z=FX,FY,FZ …", "Known contact forces.")] = None,
    calibration: Annotated[Path | None, option("-c --calibration", "FILE", "Commands count from its initial inputs.")] = None,
    output: Annotated[Path | None, option("-o --output", "FILE", "A JSON file to write.")] = None,
    correct: Annotated[bool, option("--correct", help=USE_CORRECTION)] = False,
) -> Answer:
    """Find the inputs that bring points of the body to places."""
    from femsense.app.reach_command import reach_targets

    document, text, reached = reach_targets(
        robot, target, control=control, forces=force or [], calibration=calibration, output=output, correct=correct
    )
    return Answer(document, text, exit_status=0 if reached else 1)
