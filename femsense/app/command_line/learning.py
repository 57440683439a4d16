"""From sensors in the body to its shape: `learn`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from femsense.app.command_line.answer import Answer, progress_bar
from femsense.app.command_line.parameters import Json


def learn(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="SENSORS.csv MARKERS.csv …",
            help="time_s and a column for each sensor; frame,marker,x_m,y_m,z_m. Two files a recording.",
            show_default=False,
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MODEL", help="The ONNX file.", show_default=False)],
    test: Annotated[
        tuple[Path, Path] | None,
        typer.Option(metavar="SENSORS MARKERS", help="State the error on another recording, too.", show_default=False),
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
    calibration: Annotated[
        Path | None,
        typer.Option(
            "-c", "--calibration", metavar="FILE", help="Take a camera's markers into the robot's frame.", show_default=False
        ),
    ] = None,
    robot_frame: Annotated[bool, typer.Option("--robot-frame", help="The markers are in the robot's frame already.")] = False,
    json: Json = False,
) -> Answer:
    """Learn markers and bones from sensors in the body."""
    from femsense.app.learn_command import LearnFiles, learn_into, pairs_of

    with progress_bar("learn") as progress:
        document, text = learn_into(
            LearnFiles(pairs_of(files), test, adapt, calibration, robot_frame),
            output,
            end_to_end=end_to_end,
            bones=bones,
            plane=plane,
            progress=progress,
        )
    return Answer(document, text)
