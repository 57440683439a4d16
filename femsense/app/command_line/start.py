"""Where one starts: `demo`, `inspect`, `doctor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import Json


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where the results go.")] = Path("femsense-demo"),
    json: Json = False,
) -> Answer:
    """Run the whole chain on a recording that comes along."""
    from femsense.app.demo.demo import demo_text, run_demo

    with progress_bar("demo") as progress:
        document = run_demo(output, say=say, progress=progress)
    return Answer(document, demo_text(document))


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
        from femsense.app.accuracy.assess import expected_duration

        say(expected_duration())
        with progress_bar("accuracy") as progress:
            report = inspect_accuracy(path, progress=progress)
    else:
        if robot is not None:
            say("comparing with the robot, and finding the camera's pose to state the forces that it resolves")
        report = inspect_path(path, robot=robot)
    return Answer(report, describe(report), exit_status=2 if report["problems"] else 0)


def doctor(json: Json = False) -> Answer:
    """Check the installation."""
    from femsense.app.doctor import diagnose, doctor_text

    document = diagnose()
    return Answer(document, doctor_text(document), exit_status=0 if document["ok"] else 2)
