"""Commands that make robots and recordings: `import`, `mesh`, `simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.adapter import command
from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import RobotPath, argument, missing, option
from femsense.app.command_line.several import Several
from femsense.io.importers.options import InputOptions, Options
from femsense.io.meshing.options import MeshOptions


@command(Several.TOGETHER)
def import_(
    source: Annotated[
        list[str],
        argument("SOURCE…", "A bag, a motion capture, a folder of images or clouds; several (or NAME=SOURCE) are cameras."),
    ],
    output: Annotated[Path, option("-o --output", "RECORDING", "The folder to write.")],
    options: Options,
    driven: InputOptions,
    again: Annotated[bool, option("--again", help="Repeat an import into RECORDING.")] = False,
) -> Answer:
    """Convert a recording of another program."""
    from femsense.app.import_command import import_into, import_text

    with progress_bar("import") as progress:
        document = import_into(output, source, options, driven=driven, say=say, again=again, progress=progress)
    text = f"{import_text(output, document)}\n\nwritten: {output}\nlook at it: femsense inspect {output}"
    return Answer({"recording": str(output), **document}, text)


@command()
def mesh(
    surface: Annotated[
        Path, argument("SURFACE", "Triangles around the body (STL, OBJ, PLY, OFF), STEP, or a line with radii (TOML).")
    ],
    output: Annotated[Path, option("-o --output", "ROBOT", "Folder of the robot; an existing robot.toml is kept.")],
    options: MeshOptions,
    again: Annotated[bool, option("--again", help="Repeat the meshing even if ROBOT contains its result.")] = False,
) -> Answer:
    """Fill a surface with tetrahedra and write a robot folder."""
    with progress_bar("mesh") as progress:
        if surface.suffix.lower() == ".toml":
            from femsense.io.meshing.robot_from_line import line_into, line_text

            most, along = options.most_tets or 2000, options.size_mm
            document = line_into(output, surface, most_tets=most, along_mm=along, say=say, again=again, progress=progress)
            text = line_text(document)
        else:
            from femsense.io.meshing.robot_from_surface import mesh_into, mesh_text

            document = mesh_into(output, surface, options, say=say, again=again, progress=progress)
            text = mesh_text(document)
    return Answer(document, f"{text}\n\nwritten: {output}\nlook at it: femsense inspect {output}")


@command(Several.EACH)
def simulate(
    context: typer.Context,
    robot: RobotPath,
    scripts: Annotated[list[Path], argument("SCRIPT…", "Script of the virtual rig (TOML); several paths are several jobs.")],
    output: Annotated[
        Path | None, option("-o --output", "RECORDING", "The recording to write; with --plan a folder for the map of forces.")
    ] = None,
    plan: Annotated[bool, option("--plan", help="Predict what this experiment can show, without recording.")] = False,
    noise: Annotated[float, option("--noise", "MM", "With --plan: noise of each coordinate of a marker.", min=0.0)] = 0.2,
) -> Answer:
    """Simulate a recording with its ground truth on the virtual rig."""
    from femsense.app.commands import script_plan, simulate_into

    if plan:
        return Answer(*script_plan(robot, scripts[0], noise=1e-3 * noise, folder=output))
    if output is None:
        raise missing(context, "output")
    with progress_bar("simulate") as progress:
        simulate_into(output, robot, scripts[0], progress=progress)
    return Answer({"recording": str(output)}, f"recording: {output}\nlook at it: femsense inspect {output}")
