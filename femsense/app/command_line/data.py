"""What makes robots and recordings: `import`, `mesh`, `simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import Json, OneRobot, argument, filled, option, required
from femsense.app.command_line.several import Dask, Jobs, Memory, Workers, only, several


def import_(
    context: typer.Context,
    source: Annotated[
        list[str] | None,
        argument("SOURCE…", "A bag, a motion capture, a folder of images or clouds; several (or NAME=SOURCE) are cameras."),
    ] = None,
    output: Annotated[Path | None, option("-o --output", "RECORDING", "The folder to write.")] = None,
    format: Annotated[str | None, option("--format", "NAME", "If the guess is wrong; see femsense docs importing.")] = None,
    topic: Annotated[list[str] | None, option("--topic", "NAME", "What to take, where there is a choice.")] = None,
    map_: Annotated[
        list[str] | None, option("--map", "NAME=TARGET", "Such as motor1=cable_north*4.6, 3=tip.x, /ft=load@X,Y,Z.")
    ] = None,
    unit: Annotated[str | None, option("--unit", "m|cm|mm|in|ft", "Of lengths.")] = None,
    up: Annotated[str | None, option("--up", "x|y|z", "The vertical axis; it is turned to z.")] = None,
    clock: Annotated[str, option("--clock", "auto|header|record", "Which time stamps of a bag.")] = "auto",
    rate: Annotated[float | None, option("--rate", "HZ", "Where the source has no times.")] = None,
    base: Annotated[str | None, option("--base", "FRAME", "Frame of a bag's transforms that is the robot's.")] = None,
    shift: Annotated[list[str] | None, option("--shift", "CAMERA=S", "Seconds to add to a camera's times.")] = None,
    depth_unit: Annotated[
        float | None, option("--depth-unit", "M", "Metres in one unit of depth images, if it is another.")
    ] = None,
    every: Annotated[int, option("--every", "N", "Take one of so many frames.", min=1)] = 1,
    free: Annotated[
        list[str] | None, option("--free", "FROM:TO", "Seconds after the first frame; nothing touches the robot.")
    ] = None,
    inputs: Annotated[str | None, option("--inputs", "tension|displacement", "What the cables' values are.")] = None,
    zero: Annotated[str | None, option("--zero", "absolute|unknown", "What they count from.")] = None,
    actuation: Annotated[Path | None, option("--actuation", "FILE", "A CSV file with the inputs over time.")] = None,
    offset: Annotated[float | None, option("--offset", "S", "The frames' time minus that file's; else from motion.")] = None,
    again: Annotated[bool, option("--again", help="Import even where RECORDING holds an import.")] = False,
    jobs: Jobs = None,
    workers: Workers = None,
    dask: Dask = None,
    memory: Memory = None,
    json: Json = False,
) -> Answer:
    """Make a recording of what other programs recorded."""
    from femsense.app.import_command import columns_named, free_named, import_into, import_text, shifts_named
    from femsense.io.importers.frames import Options

    if (many := several(context, source, one_each=False)) is not None:
        return many
    source = required(context, source or None, "'SOURCE…'", "argument")
    output = required(context, output, "'-o' / '--output'", "option")
    said = {"columns": columns_named(map_ or []), "shifts": shifts_named(shift or []), "free": free_named(free or [])}
    options = filled(Options, locals(), topics=tuple(topic or ()), **said)
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
        Path, argument("SURFACE", "Triangles around the body (STL, OBJ, PLY, OFF), STEP, or a line with radii (TOML).")
    ],
    output: Annotated[Path, option("-o --output", "ROBOT", "The robot's folder; its robot.toml is kept where there is one.")],
    unit: Annotated[
        str | None, option("--unit", "m|cm|mm", "Unit of the surface file; required but for STEP, which says it.")
    ] = None,
    size_mm: Annotated[float | None, option("--size", "MM", "Wanted edge length.")] = None,
    most_tets: Annotated[
        int | None, option("--max-tets", "N", "Not more tetrahedra than this (2000; more for thin walls).", min=6)
    ] = None,
    tolerance_mm: Annotated[float | None, option("--tolerance", "MM", "How far the mesh may leave the surface.")] = None,
    element: Annotated[str, option("--element", "tet4|tet10", "For a new robot.toml.")] = "tet10",
    close_holes: Annotated[bool, option("--close-holes", help="Close large holes too, by flat caps.")] = False,
    fill_cavities: Annotated[bool, option("--fill-cavities", help="Take inner shells as solid, not as chambers.")] = False,
    part: Annotated[int | None, option("--part", "N", "Which of several bodies; 1 is the largest.", min=1)] = None,
    again: Annotated[bool, option("--again", help="Fill even where ROBOT holds this mesh already.")] = False,
    json: Json = False,
) -> Answer:
    """Fill a surface with tetrahedra; start a robot."""
    from femsense.io.meshing.filling import MeshOptions
    from femsense.io.meshing.robot_from_surface import mesh_into, mesh_text

    if surface.suffix.lower() == ".toml":
        return _line_mesh(surface, output, size=size_mm, most=most_tets, again=again)
    options = filled(MeshOptions, locals())
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
    robot: OneRobot = None,
    scripts: Annotated[list[Path] | None, argument("SCRIPT…", "What the virtual rig does (TOML); several are many jobs.")] = None,
    output: Annotated[
        Path | None, option("-o --output", "RECORDING", "The recording to write; with --plan a folder for the map of forces.")
    ] = None,
    plan: Annotated[bool, option("--plan", help="Say what this experiment could show; record nothing.")] = False,
    noise: Annotated[float, option("--noise", "MM", "With --plan: noise of each coordinate of a marker.", min=0.0)] = 0.2,
    jobs: Jobs = None,
    workers: Workers = None,
    dask: Dask = None,
    memory: Memory = None,
    json: Json = False,
) -> Answer:
    """Record on the virtual rig, with the truth beside it."""
    from femsense.app.commands import script_plan, simulate_into

    if (many := several(context, scripts)) is not None:
        return many
    robot, script = required(context, robot, "'ROBOT'", "argument"), only(context, scripts)
    if plan:
        return Answer(*script_plan(robot, script, noise=1e-3 * noise, folder=output))
    output = required(context, output, "'-o' / '--output'", "option")
    with progress_bar("simulate") as progress:
        simulate_into(output, robot, script, progress=progress)
    return Answer({"recording": str(output)}, f"recording: {output}\nlook at it: femsense inspect {output}")
