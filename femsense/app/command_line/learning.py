"""From sensors in the body to its shape: `learn`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from femsense.app.command_line.adapter import command
from femsense.app.command_line.answer import Answer, progress_bar
from femsense.app.command_line.parameters import argument, option
from femsense.app.learn_options import LearnTask


@command()
def learn(
    files: Annotated[
        list[Path],
        argument(
            "SENSORS.csv MARKERS.csv …",
            "time_s and a column for each sensor; frame,marker,x_m,y_m,z_m. Two files a recording.",
        ),
    ],
    output: Annotated[Path, option("-o --output", "MODEL", "The ONNX file.")],
    task: LearnTask,
) -> Answer:
    """Learn markers and bones from sensors in the body."""
    from femsense.app.learn_command import learn_into, pairs_of

    with progress_bar("learn") as progress:
        document, text = learn_into(replace(task, pairs=pairs_of(files)), output, progress=progress)
    return Answer(document, text)
