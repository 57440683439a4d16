"""Closing the loop: `improve`."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.adapter import command
from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import RobotPath, argument, missing, option, split_names
from femsense.app.command_line.several import Dask, Memory, Several, spread_over
from femsense.core.errors import InputError
from femsense.io.importers.options import Inputs
from femsense.loop.options import SearchOptions


@command(Several.TOGETHER)
def improve(
    context: typer.Context,
    robot: RobotPath,
    *,
    recordings: Annotated[list[Path] | None, argument("RECORDING", "Recordings in which effects are searched.")] = None,
    output: Annotated[Path | None, option("-o --output", "OUT", "The folder to write; with --plan a script (TOML).")] = None,
    validation: Annotated[
        list[Path] | None, option("--validation", "RECORDING …", "Recordings on which they are tested.")
    ] = None,
    reference: Annotated[
        list[Path] | None,
        option(
            "--reference",
            "RECORDING …",
            "A recording of the same inputs without the load in question (a weight, say); its residual is subtracted.",
        ),
    ] = None,
    effects: Annotated[list[str] | None, option("--effects", "NAME,…", "Try these effects only.")] = None,
    without: Annotated[list[str] | None, option("--without", "NAME,…", "Do not try these effects.")] = None,
    search: SearchOptions,
    again: Annotated[bool, option("--again", help="Repeat the computation even if OUT contains its result.")] = False,
    workers: Annotated[
        int | None,
        option(
            "--workers",
            "N",
            "Number of threads, and of processes for many recordings; 0: this process; default: one per core.",
            min=0,
        ),
    ] = None,
    plan: Annotated[
        bool, option("--plan", help="Propose what to record, so that effects can be distinguished; needs no RECORDING.")
    ] = False,
    given: Annotated[Path | None, option("--given", "RECORDING", "With --plan: existing recordings.")] = None,
    noise: Annotated[float, option("--noise", "MM", "With --plan: noise of each coordinate of a marker.", min=0.0)] = 0.2,
    frames: Annotated[int, option("--frames", "N", "With --plan: largest number of new frames.", min=1)] = 60,
    actuation: Annotated[Inputs, option("--actuation", help="With --plan: quantity of the cable inputs.")] = Inputs.tension,
    dask: Dask = None,
    memory: Memory = None,
) -> Answer:
    """Find the effects that the model lacks; write a better robot."""
    from femsense.app.commands import improve_into, loop_page, plan_into
    from femsense.core.parallel import set_workers
    from femsense.io.recording_folder import load_recording
    from femsense.loop.files import saved_loop
    from femsense.loop.improve import ImproveOptions
    from femsense.many.jobs import expanded
    from femsense.report.loop.text import loop_text

    set_workers(workers or None)
    if plan and recordings:
        raise InputError(
            "--plan takes no recordings",
            where="--plan",
            found=str(recordings[0]),
            expected="ROBOT alone",
            hint="--given RECORDING plans in addition to an existing one",
        )
    if plan:
        with progress_bar("plan") as progress:
            return Answer(
                *plan_into(output, robot, given=given, noise=1e-3 * noise, frames=frames, control=actuation, progress=progress)
            )
    if not recordings:
        raise missing(context, "recordings")
    if output is None:
        raise missing(context, "output")
    recordings = expanded(recordings)
    references = [load_recording(path) for path in reference or []]
    options = ImproveOptions(**asdict(search), references=references)
    with (
        progress_bar("improve") as progress,
        spread_over(len(recordings), options.effort.recordings, workers, dask, memory) as spread,
    ):
        document = improve_into(
            output,
            robot,
            recordings,
            validation=validation or [],
            effects=split_names(effects),
            without=split_names(without),
            options=replace(options, spread=spread),
            again=again,
            say=say,
            progress=progress,
        )
    page = loop_page(output, say=say)
    text = f"{loop_text(saved_loop(document))}\n\nwritten: {output}" + (f"\nlook at it: {page}" if page is not None else "")
    return Answer({"folder": str(output), **document}, text)
