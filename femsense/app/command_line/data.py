"""What makes robots and recordings: `import`, `mesh`, `simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import Json, RobotPath, required


def import_(
    source: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE…",
            help="A bag, a motion capture, a folder of images or clouds; several (or NAME=SOURCE) are cameras.",
            show_default=False,
        ),
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
    unit: Annotated[str | None, typer.Option("--unit", metavar="m|cm|mm|in|ft", help="Of lengths.", show_default=False)] = None,
    up: Annotated[
        str | None, typer.Option("--up", metavar="x|y|z", help="The vertical axis; it is turned to z.", show_default=False)
    ] = None,
    clock: Annotated[str, typer.Option("--clock", metavar="auto|header|record", help="Which time stamps of a bag.")] = "auto",
    rate: Annotated[
        float | None, typer.Option("--rate", metavar="HZ", help="Where the source has no times.", show_default=False)
    ] = None,
    base: Annotated[
        str | None,
        typer.Option("--base", metavar="FRAME", help="Frame of a bag's transforms that is the robot's.", show_default=False),
    ] = None,
    shift: Annotated[
        list[str] | None,
        typer.Option("--shift", metavar="CAMERA=S", help="Seconds to add to a camera's times.", show_default=False),
    ] = None,
    depth_unit: Annotated[
        float | None,
        typer.Option(
            "--depth-unit", metavar="M", help="Metres in one unit of depth images, if it is another.", show_default=False
        ),
    ] = None,
    every: Annotated[int, typer.Option("--every", metavar="N", min=1, help="Take one of so many frames.")] = 1,
    free: Annotated[
        list[str] | None,
        typer.Option(
            "--free", metavar="FROM:TO", help="Seconds after the first frame; nothing touches the robot.", show_default=False
        ),
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
    from femsense.app.import_command import columns_named, free_named, import_into, import_text, shifts_named
    from femsense.io.importers.frames import Options

    shifts, spans = shifts_named(shift or []), free_named(free or [])
    options = Options(
        format, tuple(topic or ()), columns_named(map_ or []), unit, depth_unit, up, clock, rate, base, shifts, every, spans
    )
    with progress_bar("import") as progress:
        document = import_into(
            output,
            source,
            options,
            say=say,
            inputs=inputs,
            zero=zero,
            actuation=actuation,
            offset=offset,
            again=again,
            progress=progress,
        )
    text = f"{import_text(output, document)}\n\nwritten: {output}\nlook at it: femsense inspect {output}"
    return Answer({"recording": str(output), **document}, text)


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
    most: Annotated[
        int | None,
        typer.Option(
            "--max-tets",
            metavar="N",
            min=6,
            help="Not more tetrahedra than this (2000; more for thin walls).",
            show_default=False,
        ),
    ] = None,
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
    from femsense.io.meshing.filling import MeshOptions
    from femsense.io.meshing.robot_from_surface import mesh_into, mesh_text

    if surface.suffix.lower() == ".toml":
        return _line_mesh(surface, output, size=size, most=most, again=again)
    options = MeshOptions(unit, size, most, tolerance, element, close_holes, fill_cavities, part)
    with progress_bar("mesh") as progress:
        document = mesh_into(output, surface, options, say=say, again=again, progress=progress)
    text = f"{mesh_text(document)}\n\nwritten: {output}\nlook at it: femsense inspect {output}"
    return Answer(document, text)


def _line_mesh(source: Path, output: Path, *, size: float | None, most: int | None, again: bool) -> Answer:
    """Make a robot of a line with radii."""
    from femsense.io.meshing.robot_from_line import line_into, line_text

    with progress_bar("mesh") as progress:
        document = line_into(output, source, most_tets=most or 2000, along_mm=size, say=say, again=again, progress=progress)
    return Answer(document, f"{line_text(document)}\n\nwritten: {output}\nlook at it: femsense inspect {output}")


def simulate(
    context: typer.Context,
    robot: RobotPath,
    script: Annotated[Path, typer.Argument(metavar="SCRIPT", help="What the virtual rig does (TOML).", show_default=False)],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="RECORDING",
            help="The recording to write; with --plan a folder for the map of forces.",
            show_default=False,
        ),
    ] = None,
    plan: Annotated[bool, typer.Option("--plan", help="Say what this experiment could show; record nothing.")] = False,
    noise: Annotated[
        float, typer.Option("--noise", metavar="MM", min=0.0, help="With --plan: noise of each coordinate of a marker.")
    ] = 0.2,
    json: Json = False,
) -> Answer:
    """Record on the virtual rig, with the truth beside it."""
    from femsense.app.commands import script_plan, simulate_into

    if plan:
        return Answer(*script_plan(robot, script, noise=1e-3 * noise, folder=output))
    output = required(context, output, "'-o' / '--output'", "option")
    with progress_bar("simulate") as progress:
        simulate_into(output, robot, script, progress=progress)
    return Answer({"recording": str(output)}, f"recording: {output}\nlook at it: femsense inspect {output}")
