"""The command line: each command is a few lines around one function of the library.

A command returns an `Answer`; `run` prints it, as text or as JSON, turns errors into one clear message each, and returns the
exit status: 0 done, 1 the data do not allow a result, 2 wrong usage or bad input, 130 stopped. Everything heavy is imported
inside the commands, so that `femsense --help` is quick.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import typer
from typer.exceptions import TyperException

import femsense
from femsense.app.compiling import announced_compiling
from femsense.core.errors import FemsenseError, InputError

if TYPE_CHECKING:
    from femsense.app.stream_command import LiveStream

T = TypeVar("T")
STOPPED = 130
STOPPED_TEXT = "stopped; nothing half-written is left, and the same command goes on"
"""Exit status after Ctrl-C, as shells have it."""
SEVERAL = ("--at", "--validation", "--effects", "--without", "--target", "--force", "--topic", "--map")
"""Options that take several values after one another."""


class SensingMethod(StrEnum):
    """How forces are found."""

    rays = "rays"
    paper = "paper"


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """What a command has to say."""

    document: dict[str, Any]
    """For `--json`."""
    text: str
    """For people."""
    exit_status: int = 0
    then: Callable[[], None] | None = field(default=None)
    """What goes on after it was said, until Ctrl-C."""


app = typer.Typer(
    name="femsense",
    help="An ordinary depth camera as a force sensor for soft robots.",
    epilog="Start with: femsense demo. Each command takes --help and --json.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

RobotPath = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT", help="A folder with robot.toml, or the name of a robot that comes along.", show_default=False
    ),
]
RecordingPath = Annotated[Path, typer.Argument(metavar="RECORDING", help="A folder with recording.toml.", show_default=False)]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="A folder that femsense estimate wrote.", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output, nothing else there.")]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"femsense {femsense.__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")] = False,
) -> None: ...


# Commands; `json` is declared for the help, `run` acts on it


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where the results go.")] = Path("femsense-demo"),
    json: Json = False,
) -> Answer:
    """Run the whole chain on a recording that comes along."""
    from femsense.app.demo.demo import demo_text, run_demo

    with _progress("demo") as progress:
        document = run_demo(output, say=_say, progress=progress)
    return Answer(document, demo_text(document))


@app.command()
def inspect(
    path: Annotated[str, typer.Argument(metavar="PATH", help="A file, a folder, or the name of a robot.", show_default=False)],
    accuracy: Annotated[
        bool, typer.Option("--accuracy", help="Of a robot: its discretisation error in motion and in force.")
    ] = False,
    robot: Annotated[
        str | None, typer.Option("--robot", metavar="ROBOT", help="Compare a recording with this robot.", show_default=False)
    ] = None,
    json: Json = False,
) -> Answer:
    """Say what a file or folder is and what is wrong with it."""
    from femsense.app.inspect import describe, inspect_accuracy, inspect_path

    if accuracy:
        from femsense.app.mesh_accuracy import expected_duration

        _say(expected_duration())
        with _progress("accuracy") as progress:
            report = inspect_accuracy(path, progress=progress)
    else:
        report = inspect_path(path, robot=robot)
    return Answer(report, describe(report), exit_status=2 if report["problems"] else 0)


@app.command("import")
def import_(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A bag, a motion capture, a folder of images or clouds.", show_default=False)
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RECORDING", help="The folder to write.", show_default=False)],
    format: Annotated[
        str | None,
        typer.Option("--format", metavar="NAME", help="If the guess is wrong; see docs/importing.md.", show_default=False),
    ] = None,
    topic: Annotated[
        list[str] | None,
        typer.Option("--topic", metavar="NAME", help="What to take, where there is a choice.", show_default=False),
    ] = None,
    map_: Annotated[
        list[str] | None,
        typer.Option(
            "--map", metavar="NAME=TARGET", help="Such as motor1=cable_north*4.6, 3=tip.x, /ft=load@X,Y,Z.", show_default=False
        ),
    ] = None,
    unit: Annotated[str | None, typer.Option("--unit", metavar="m|cm|mm", help="Of lengths.", show_default=False)] = None,
    up: Annotated[
        str | None, typer.Option("--up", metavar="x|y|z", help="The vertical axis; it is turned to z.", show_default=False)
    ] = None,
    clock: Annotated[str, typer.Option("--clock", metavar="auto|header|record", help="Which time stamps of a bag.")] = "auto",
    rate: Annotated[
        float | None, typer.Option("--rate", metavar="HZ", help="Where the source has no times.", show_default=False)
    ] = None,
    inputs: Annotated[
        str | None,
        typer.Option("--inputs", metavar="tension|displacement", help="What the cables' values are.", show_default=False),
    ] = None,
    zero: Annotated[
        str | None, typer.Option("--zero", metavar="absolute|unknown", help="What they count from.", show_default=False)
    ] = None,
    actuation: Annotated[
        Path | None,
        typer.Option("--actuation", metavar="FILE", help="A CSV file with the inputs over time.", show_default=False),
    ] = None,
    offset: Annotated[
        float | None,
        typer.Option("--offset", metavar="S", help="The frames' time minus that file's; else from motion.", show_default=False),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Import even where RECORDING holds an import.")] = False,
    json: Json = False,
) -> Answer:
    """Make a recording of what other programs recorded."""
    from femsense.app.import_command import import_into, import_options, import_text

    options = import_options(format=format, topics=topic or [], columns=map_ or [], unit=unit, up=up, clock=clock, rate=rate)
    with _progress("import") as progress:
        document = import_into(
            output,
            source,
            options,
            say=_say,
            inputs=inputs,
            zero=zero,
            actuation=actuation,
            offset=offset,
            again=again,
            progress=progress,
        )
    text = f"{import_text(output, document)}\n\nwritten: {output}\nlook at it: femsense inspect {output}"
    return Answer({"recording": str(output), **document}, text)


@app.command()
def mesh(
    surface: Annotated[
        Path,
        typer.Argument(
            metavar="SURFACE",
            help="Triangles around the body (STL, OBJ, PLY, OFF), STEP, or a line with radii (TOML).",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="ROBOT",
            help="The robot's folder; its robot.toml is kept where there is one.",
            show_default=False,
        ),
    ],
    unit: Annotated[
        str | None,
        typer.Option(
            "--unit",
            metavar="m|cm|mm",
            help="Unit of the surface file; required but for STEP, which says it.",
            show_default=False,
        ),
    ] = None,
    size: Annotated[float | None, typer.Option("--size", metavar="MM", help="Wanted edge length.", show_default=False)] = None,
    most: Annotated[int, typer.Option("--max-tets", metavar="N", min=6, help="Not more tetrahedra than this.")] = 2000,
    tolerance: Annotated[
        float | None,
        typer.Option("--tolerance", metavar="MM", help="How far the mesh may leave the surface.", show_default=False),
    ] = None,
    element: Annotated[str, typer.Option("--element", metavar="tet4|tet10", help="For a new robot.toml.")] = "tet10",
    close_holes: Annotated[bool, typer.Option("--close-holes", help="Close large holes too, by flat caps.")] = False,
    fill_cavities: Annotated[bool, typer.Option("--fill-cavities", help="Take inner shells as solid, not as chambers.")] = False,
    part: Annotated[
        int | None,
        typer.Option("--part", metavar="N", min=1, help="Which of several bodies; 1 is the largest.", show_default=False),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Fill even where ROBOT holds this mesh already.")] = False,
    json: Json = False,
) -> Answer:
    """Fill a surface with tetrahedra; start a robot."""
    from femsense.io.meshing.robot_from_surface import MeshOptions, mesh_into, mesh_text

    if surface.suffix.lower() == ".toml":
        return _line_mesh(surface, output, size=size, most=most, again=again)
    options = MeshOptions(unit, size, most, tolerance, element, close_holes, fill_cavities, part)
    with _progress("mesh") as progress:
        document = mesh_into(output, surface, options, say=_say, again=again, progress=progress)
    text = f"{mesh_text(document)}\n\nwritten: {output}\nlook at it: femsense inspect {output}"
    return Answer(document, text)


def _line_mesh(source: Path, output: Path, *, size: float | None, most: int, again: bool) -> Answer:
    """Make a robot of a line with radii."""
    from femsense.io.meshing.robot_from_line import line_into, line_text

    with _progress("mesh") as progress:
        document = line_into(output, source, most_tets=most, along_mm=size, say=_say, again=again, progress=progress)
    return Answer(document, f"{line_text(document)}\n\nwritten: {output}\nlook at it: femsense inspect {output}")


@app.command()
def simulate(
    context: typer.Context,
    robot: RobotPath,
    script: Annotated[Path, typer.Argument(metavar="SCRIPT", help="What the virtual rig does (TOML).", show_default=False)],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="RECORDING", help="The recording to write.", show_default=False)
    ] = None,
    plan: Annotated[bool, typer.Option("--plan", help="Say what this experiment could show; record nothing.")] = False,
    noise: Annotated[
        float, typer.Option("--noise", metavar="MM", min=0.0, help="With --plan: noise of each coordinate of a marker.")
    ] = 0.2,
    json: Json = False,
) -> Answer:
    """Record on the virtual rig, with the truth beside it."""
    from femsense.app.commands import script_identifiability, simulate_into

    if plan:
        return Answer(*script_identifiability(robot, script, noise=1e-3 * noise))
    output = _required(context, output, "'-o' / '--output'", "option")
    simulate_into(output, robot, script)
    return Answer({"recording": str(output)}, f"recording: {output}\nlook at it: femsense inspect {output}")


@app.command()
def calibrate(
    robot: RobotPath,
    recording: RecordingPath,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="The file to write.")] = Path("calibration.json"),
    json: Json = False,
) -> Answer:
    """Find the camera's pose and the cables' initial inputs."""
    from femsense.calib.calibrate import calibrate as calibrate_recording
    from femsense.calib.files import calibration_document, write_calibration
    from femsense.io.files import check_target
    from femsense.io.recording_folder import load_recording
    from femsense.io.robot_toml import load_robot
    from femsense.report.text import calibration_text

    check_target(output, folder=False)
    calibration = calibrate_recording(load_robot(robot), load_recording(recording))
    write_calibration(calibration, output)
    text = calibration_text(calibration) + f"\n\nwritten: {output}"
    settled = not calibration.status.startswith("not settled")
    return Answer({"path": str(output), **calibration_document(calibration)}, text, exit_status=0 if settled else 1)


@app.command()
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
    smooth: Annotated[
        float, typer.Option("--smooth", metavar="SECONDS", help="Average forces over so long; they lag by as much.")
    ] = 0.0,
    again: Annotated[bool, typer.Option("--again", help="Compute even where RUN holds this result already.")] = False,
    json: Json = False,
) -> Answer:
    """Find contacts and forces in every frame."""
    from femsense.app.commands import estimate_into
    from femsense.report.text import run_document, run_text
    from femsense.sensing.types import SensingOptions

    options = SensingOptions(method=method.value, friction=friction, smooth_s=smooth)
    if smooth > 0:
        _say(f"forces are averaged over {smooth:g} s and lag by as much")
    with _progress("estimate") as progress:
        run = estimate_into(
            output,
            robot,
            recording,
            calibration=calibration,
            at=_places(at or []),
            options=options,
            again=again,
            say=_say,
            progress=progress,
        )
    return Answer(
        {"run": str(output), **run_document(run)}, f"{run_text(run)}\n\nwritten: {output}\nlook at it: femsense view {output}"
    )


@app.command()
def improve(
    context: typer.Context,
    robot: RobotPath,
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="RECORDING", help="What the effects are found on.", show_default=False)
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="OUT", help="The folder to write; with --plan a script (TOML).", show_default=False
        ),
    ] = None,
    validation: Annotated[
        list[Path] | None,
        typer.Option("--validation", metavar="RECORDING …", help="What they are tested on.", show_default=False),
    ] = None,
    effects: Annotated[
        list[str] | None, typer.Option("--effects", metavar="NAME,…", help="Try these effects only.", show_default=False)
    ] = None,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="NAME,…", help="Do not try these effects.", show_default=False)
    ] = None,
    user_effect: Annotated[
        list[Path] | None,
        typer.Option(
            "--user-effect", metavar="FILE", help="Try an effect of your own (docs/effects/own.md).", show_default=False
        ),
    ] = None,
    measured: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="auto|markers|clouds|both",
            help="What is used of a recording; auto: its markers, or its clouds where it has none.",
        ),
    ] = "auto",
    again: Annotated[bool, typer.Option("--again", help="Compute even where OUT holds this result already.")] = False,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", metavar="N", min=1, help="Threads that work; by default one a core, four at most.", show_default=False
        ),
    ] = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="Propose what to record, so that effects can be distinguished; needs no RECORDING.")
    ] = False,
    given: Annotated[
        Path | None,
        typer.Option("--given", metavar="RECORDING", help="With --plan: what is recorded already.", show_default=False),
    ] = None,
    noise: Annotated[
        float, typer.Option("--noise", metavar="MM", min=0.0, help="With --plan: noise of each coordinate of a marker.")
    ] = 0.2,
    frames: Annotated[int, typer.Option("--frames", metavar="N", min=1, help="With --plan: not more new frames than this.")] = 60,
    actuation: Annotated[
        str, typer.Option("--actuation", metavar="tension|displacement", help="With --plan: what drives the cables.")
    ] = "tension",
    json: Json = False,
) -> Answer:
    """Find what the model lacks and write the better robot."""
    from femsense.app.commands import improve_into, loop_page, plan_into
    from femsense.core.parallel import set_workers
    from femsense.report.text import loop_text

    set_workers(workers)
    if plan and recordings:
        raise InputError(
            "recordings are not asked with --plan",
            where="--plan",
            found=str(recordings[0]),
            expected="ROBOT alone",
            hint="--given RECORDING plans beside one that exists",
        )
    if plan:
        with _progress("plan") as progress:
            return Answer(
                *plan_into(output, robot, given=given, noise=1e-3 * noise, frames=frames, control=actuation, progress=progress)
            )
    recordings = _required(context, recordings, "'RECORDING...'", "argument")
    output = _required(context, output, "'-o' / '--output'", "option")
    with _progress("improve") as progress:
        document = improve_into(
            output,
            robot,
            recordings,
            validation=validation or [],
            effects=split_names(effects),
            without=split_names(without),
            user_effects=user_effect or [],
            measured=measured,
            again=again,
            say=_say,
            progress=progress,
        )
    page = loop_page(output, say=_say)
    text = f"{loop_text(document)}\n\nwritten: {output}" + (f"\nlook at it: {page}" if page is not None else "")
    return Answer({"folder": str(output), **document}, text)


@app.command()
def export(
    run: RunPath,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="The file to write.")] = Path("robot.glb"),
    mcap: Annotated[
        Path | None,
        typer.Option("--mcap", metavar="FILE", help="Write messages of ROS 2 for Foxglove instead.", show_default=False),
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option("--rerun", metavar="FILE", help="Write a recording for the Rerun viewer instead.", show_default=False),
    ] = None,
    bones: Annotated[
        int | None,
        typer.Option("--bones", min=1, max=255, help="How many bones; chosen by itself if not given.", show_default=False),
    ] = None,
    json: Json = False,
) -> Answer:
    """Write a run as a skinned, animated mesh (glTF)."""
    if mcap is not None:
        from dataclasses import asdict

        from femsense.xr.mcap_export import export_mcap

        written = export_mcap(run, mcap)
        text = f"{written.frames} frames, {written.clouds} clouds, {written.contacts} contacts on {len(written.topics)} topics"
        return Answer({"path": str(mcap), **asdict(written)}, f"{text}\n\nwritten: {mcap}")
    if rerun is not None:
        from dataclasses import asdict

        from femsense.xr.rerun_export import export_rerun

        shown = export_rerun(run, rerun)
        text = f"{shown.frames} frames, {shown.clouds} clouds, {shown.contacts} contacts"
        return Answer({"path": str(rerun), **asdict(shown)}, f"{text}\n\nwritten: {rerun}")
    from femsense.xr.export import export_glb

    report = export_glb(run, output, bones=bones)
    document = {name: getattr(report, name) for name in ("bones", "vertices", "frames", "rms_m", "max_m")}
    text = f"{report.frames} frames, {report.bones} bones, {report.vertices} vertices; {1e3 * report.rms_m:.3f} mm rms from the finite elements"
    return Answer({"path": str(output), **document}, f"{text}\n\nwritten: {output}")


@app.command()
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
    json: Json = False,
) -> Answer:
    """Find the inputs that bring points of the body to places."""
    from femsense.app.reach_command import reach_targets

    document, text, reached = reach_targets(
        robot, target, control=control, forces=force or [], calibration=calibration, output=output
    )
    return Answer(document, text, exit_status=0 if reached else 1)


@app.command()
def learn(
    sensors: Annotated[
        Path, typer.Argument(metavar="SENSORS.csv", help="time_s, and a column for each sensor.", show_default=False)
    ],
    markers: Annotated[Path, typer.Argument(metavar="MARKERS.csv", help="frame,marker,x_m,y_m,z_m.", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MODEL", help="The ONNX file.", show_default=False)],
    test: Annotated[
        tuple[Path, Path] | None,
        typer.Option(metavar="SENSORS MARKERS", help="State the error on another recording.", show_default=False),
    ] = None,
    adapt: Annotated[
        Path | None,
        typer.Option(metavar="MODEL", help="Correct this model by a few labelled frames of another day.", show_default=False),
    ] = None,
    end_to_end: Annotated[bool, typer.Option("--end-to-end", help="A second network from readings to bones.")] = False,
    bones: Annotated[int, typer.Option(help="How many bones.")] = 8,
    plane: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Normal of the plane in which the body bends.", show_default=False)
    ] = None,
    json: Json = False,
) -> Answer:
    """Learn markers and bones from sensors in the body."""
    from femsense.app.learn_command import learn_into

    with _progress("learn") as progress:
        document, text = learn_into(
            (sensors, markers),
            output,
            test=test,
            adapt=adapt,
            end_to_end=end_to_end,
            bones=bones,
            plane=plane,
            progress=progress,
        )
    return Answer(document, text)


@app.command()
def view(
    run: Annotated[
        Path | None, typer.Argument(metavar="RUN", help="A folder that femsense estimate wrote.", show_default=False)
    ] = None,
    stream: Annotated[
        str | None,
        typer.Option("--stream", metavar="URL", help="Show what streams there instead: http:// or mqtt://.", show_default=False),
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0 takes a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the default browser.")] = True,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Write the page for a web server instead.", show_default=False),
    ] = None,
    json: Json = False,
) -> Answer:
    """Show a run, or what streams, on a page for browsers and headsets."""
    if stream is not None:
        from femsense.app.stream_command import need_one, show_stream

        need_one([] if run is None else [run], stream)
        return _live(show_stream(stream, port=port), browser)
    from femsense.xr.view import serve, write_static_page

    if run is None:
        raise InputError("nothing to show", where="femsense view", expected="RUN, or --stream URL")
    if output is not None:
        page = write_static_page(run, output)
        return Answer({"page": str(page)}, f"written: {page}")
    server = serve(run, port=port, open_browser=browser)

    def wait() -> None:
        with contextlib.suppress(KeyboardInterrupt), server:
            server.wait()

    return Answer({"url": server.url}, f"{server.url}\nCtrl-C ends it", then=wait)


@app.command()
def stream(
    runs: Annotated[list[Path] | None, typer.Argument(metavar="RUN", help="Runs to play.", show_default=False)] = None,
    sensors: Annotated[
        str | None,
        typer.Option("--sensors", metavar="SOURCE", help="A CSV file, udp://, mqtt:// or serial: instead.", show_default=False),
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="MODEL", help="Of femsense learn, for --sensors.", show_default=False)
    ] = None,
    drag: Annotated[bool, typer.Option("--drag", help="Let viewers drag the robot of the first run.")] = False,
    commands: Annotated[bool, typer.Option("--commands", help="With --drag: publish commands once a viewer arms them.")] = False,
    host: Annotated[str, typer.Option("--host", help="0.0.0.0 lets other machines watch; needs a password.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Of the page and its WebSocket; 0: a free one.")] = 8010,
    mqtt: Annotated[
        str | None,
        typer.Option("--mqtt", metavar="HOST[:PORT]", help="Send to this broker; mqtts:// encrypts.", show_default=False),
    ] = None,
    broker: Annotated[bool, typer.Option("--broker", help="Serve a broker for this machine.")] = False,
    broker_port: Annotated[int, typer.Option("--broker-port", min=0, max=65535, help="Of --broker; 0: a free one.")] = 1883,
    json_mirror: Annotated[bool, typer.Option("--json-mirror", help="Send pose_json too, for Unity's JsonUtility.")] = False,
    rate: Annotated[float, typer.Option("--rate", min=0.1, max=1000.0, help="Most poses a second.")] = 60.0,
    once: Annotated[bool, typer.Option("--once", help="Play once and end.")] = False,
    password_file: Annotated[
        Path | None, typer.Option("--password-file", metavar="FILE", help="Or variable FEMSENSE_PASSWORD.", show_default=False)
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", metavar="PEM", help="Encrypt with this.", show_default=False)
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", metavar="PEM", help="Of the certificate.", show_default=False)] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the default browser.")] = False,
    json: Json = False,
) -> Answer:
    """Send bone poses and forces over MQTT and WebSocket."""
    from femsense.app.stream_command import StreamOptions, let_drag, need_model, need_one, stream_runs, stream_sensors

    need_one(runs or [], sensors)
    need_model(sensors, model)
    options = StreamOptions(
        host=host,
        port=port,
        mqtt=mqtt,
        broker_port=broker_port if broker else None,
        json_mirror=json_mirror,
        password_file=password_file,
        certificate=certificate,
        key=key,
        rate_hz=rate,
    )
    if sensors is not None and model is not None:
        return _live(stream_sensors(sensors, model, options), browser)
    live = stream_runs(runs or [], options, loop=not once)
    if drag or commands:
        from femsense.xr.stream.command_gate import GateOptions
        from femsense.xr.stream.drag_server import DragOptions

        let_drag(live, (runs or [])[0], DragOptions(gate=GateOptions(allowed=commands)))
    return _live(live, browser)


def _live(live: LiveStream, browser: bool) -> Answer:
    """Return the answer that goes on until the stream ends."""
    from femsense.app.stream_command import stream_document, stream_text

    if browser:
        import webbrowser

        webbrowser.open(live.url)

    def wait() -> None:
        with contextlib.suppress(KeyboardInterrupt), live:
            live.wait()

    return Answer(stream_document(live), stream_text(live), then=wait)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of results.", show_default=False)],
    json: Json = False,
) -> Answer:
    """Write the figures of results as one HTML file."""
    from femsense.report import write_report

    page = write_report(folder)
    return Answer({"report": str(page)}, f"written: {page}")


@app.command()
def doctor(json: Json = False) -> Answer:
    """Check the installation."""
    from femsense.app.doctor import diagnose, doctor_text

    document = diagnose()
    return Answer(document, doctor_text(document), exit_status=0 if document["ok"] else 2)


# Running them


def main() -> NoReturn:
    """Run the command of `sys.argv` and exit with its status."""
    signal.signal(signal.SIGTERM, _stop)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded; why: `femsense.core.parallel.one_blas_thread`
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Run a command, print its answer or its error, and return the exit status."""
    notes: list[str] = []
    as_json = "--json" in arguments
    words = repeat_options(list(arguments)) or ["--help"]
    with _calm_warnings(notes, as_json):
        try:
            with _clean_stdout(as_json), announced_compiling(words, _say):
                answer = app(args=words, prog_name="femsense", standalone_mode=False)
            if isinstance(answer, Answer):
                return _print(answer, as_json, notes)
            return _fail(STOPPED_TEXT, STOPPED, as_json, notes) if answer == STOPPED else int(answer or 0)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            return 1
        except (KeyboardInterrupt, typer.Abort):
            return _fail(STOPPED_TEXT, STOPPED, as_json, notes)
        except Exception as error:
            if os.environ.get("FEMSENSE_DEBUG") == "1":
                raise
            return _fail(*_explained(error), as_json, notes)


def _print(answer: Answer, as_json: bool, notes: list[str]) -> int:
    if as_json:
        from femsense.io.files import json_text

        document = answer.document if "warnings" in answer.document else {**answer.document, "warnings": notes}
        typer.echo(json_text(document))
    else:
        typer.echo(answer.text)
    if answer.then is not None:
        sys.stdout.flush()
        answer.then()
    return answer.exit_status


def _fail(text: str, status: int, as_json: bool, notes: list[str]) -> int:
    if as_json:
        import json

        typer.echo(json.dumps({"error": text, "exit_status": status, "warnings": notes}, indent=2, ensure_ascii=False))
    typer.echo(f"femsense: {text}", err=True)
    return status


def _explained(error: Exception) -> tuple[str, int]:
    """Return a message and the exit status of an error."""
    if isinstance(error, FemsenseError):
        return str(error), error.exit_status
    if isinstance(error, TyperException):
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "femsense"
        message = " ".join(error.format_message().split()).rstrip(".")
        return f"{message}. See: {command} --help", 2
    if isinstance(error, ImportError) and not (error.name or "").startswith("femsense"):
        return (
            f"a part of the installation does not load: {' '.join(str(error).split())}. femsense doctor says what is missing",
            2,
        )
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}", 2
    return f"internal error: {_one_line(error)}; the details are in {_write_details(error)} (please report it)", 2


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:160]}" if text else type(error).__name__


def _write_details(error: Exception) -> str:
    import tempfile
    import traceback

    head = f"femsense {femsense.__version__}, Python {sys.version}\narguments: {sys.argv[1:]}\n\n"
    with tempfile.NamedTemporaryFile("w", prefix="femsense-error-", suffix=".txt", delete=False, encoding="utf-8") as stream:
        stream.write(head + "".join(traceback.format_exception(error)))
    return stream.name


@contextlib.contextmanager
def _calm_warnings(notes: list[str], as_json: bool) -> Iterator[None]:
    """Show each warning once, in one line on standard error; keep it for the JSON object too."""

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = " ".join(str(message).split())
        if text not in notes:
            notes.append(text)
            typer.echo(f"warning: {text}", err=True)

    with warnings.catch_warnings():
        if os.environ.get("FEMSENSE_DEBUG") != "1":
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
        yield


@contextlib.contextmanager
def _clean_stdout(active: bool) -> Iterator[None]:
    """While active, whatever a library prints, in Python or in C, goes to standard error."""
    if not active:
        yield
        return
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _flush_c()
        os.dup2(kept, 1)
        os.close(kept)


def _flush_c() -> None:
    """Have C libraries write what they hold back."""
    import ctypes

    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).fflush(None)


@contextlib.contextmanager
def _progress(title: str) -> Iterator[Callable[..., None] | None]:
    """Yield what a library function reports its progress to: a bar on a terminal, else None."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[count]}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None, count="")

        def advance(done: int | str, total: int | None = None) -> None:
            nonlocal task
            if isinstance(done, int):
                bar.update(task, completed=done, total=total, description=title, count=f"{done}/{total}")
                return
            bar.remove_task(task)  # an update cannot take a total away
            task = bar.add_task(done, total=None, count="")

        yield advance


def _say(text: str) -> None:
    """Tell people what happens, on standard error."""
    typer.echo(text, err=True)


# Arguments


def repeat_options(words: list[str]) -> list[str]:
    """Repeat an option for each of the values that follow it: --validation A B is --validation A --validation B."""
    result: list[str] = []
    option: str | None = None
    count = 0
    for word in words:
        is_value = not word.startswith("-") or re.match(r"-[\d.]", word) is not None
        if option is not None and is_value:
            result += [option, word] if count else [word]
            count += 1
            continue
        option, count = (word, 0) if word in SEVERAL else (None, 0)
        result.append(word)
    return result


def _required(context: typer.Context, value: T | None, name: str, kind: str) -> T:
    """Return what only --plan can do without."""
    if value is None:
        error = TyperException(f"Missing {kind} {name}.")
        error.ctx = context  # type: ignore[attr-defined]
        raise error
    return value


def _places(texts: Sequence[str]) -> list[list[float]] | None:
    places = []
    for text in texts:
        try:
            place = [float(part) for part in text.split(",")]
        except ValueError:
            place = []
        if len(place) != 3:
            raise typer.BadParameter(f"{text!r} is not a place: three numbers in metres are, such as --at 0.1,0,0.015")
        places.append(place)
    return places or None


def split_names(texts: Sequence[str] | None) -> list[str] | None:
    """Return names that stand between commas or in options of their own; None where there is no such option."""
    names = [name.strip() for text in texts or [] for name in text.split(",") if name.strip()]
    if texts and not names:
        raise InputError(
            "no name",
            where="--effects, --without",
            found=", ".join(map(repr, texts)),
            expected="names of effects, with commas between",
        )
    return names or None


def _stop(*_: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
