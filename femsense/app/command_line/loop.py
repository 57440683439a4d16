"""Closing the loop: `improve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import Json, OneRobot, required, split_names
from femsense.app.command_line.several import Dask, Jobs, Memory, several
from femsense.core.errors import InputError


def improve(
    context: typer.Context,
    robot: OneRobot = None,
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
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            "--reference",
            metavar="RECORDING …",
            help="The same inputs without what is asked for (a weight, say): what the model misses there is taken off.",
            show_default=False,
        ),
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
    correct: Annotated[
        bool,
        typer.Option("--correct", help="Also learn an empirical correction of what is left, judged on held-out data: no cause."),
    ] = False,
    again: Annotated[bool, typer.Option("--again", help="Compute even where OUT holds this result already.")] = False,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            metavar="N",
            min=0,
            help="Threads that work; by default one a core, four at most. With --jobs: processes.",
            show_default=False,
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
    jobs: Jobs = None,
    dask: Dask = None,
    memory: Memory = None,
    json: Json = False,
) -> Answer:
    """Find what the model lacks and write the better robot."""
    from femsense.app.commands import improve_into, loop_page, plan_into
    from femsense.core.parallel import set_workers
    from femsense.io.recording_folder import load_recording
    from femsense.loop.improve import ImproveOptions
    from femsense.report.loop.document import Loop
    from femsense.report.loop.text import loop_text

    if (many := several(context, recordings, one_each=False)) is not None:
        return many
    robot = required(context, robot, "'ROBOT'", "argument")
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
        with progress_bar("plan") as progress:
            return Answer(
                *plan_into(output, robot, given=given, noise=1e-3 * noise, frames=frames, control=actuation, progress=progress)
            )
    recordings = required(context, recordings, "'RECORDING...'", "argument")
    output = required(context, output, "'-o' / '--output'", "option")
    with progress_bar("improve") as progress:
        document = improve_into(
            output,
            robot,
            recordings,
            validation=validation or [],
            effects=split_names(effects),
            without=split_names(without),
            options=ImproveOptions(
                user_effects=user_effect or [],
                measured=measured,
                correct=correct,
                references=[load_recording(path) for path in reference or []],
            ),
            again=again,
            say=say,
            progress=progress,
        )
    page = loop_page(output, say=say)
    text = f"{loop_text(Loop.model_validate(document))}\n\nwritten: {output}" + (
        f"\nlook at it: {page}" if page is not None else ""
    )
    return Answer({"folder": str(output), **document}, text)
