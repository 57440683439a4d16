"""Options of `femsense learn`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from femsense.core.options import Flag

if TYPE_CHECKING:
    from femsense.xr.proprioception.labelled import Labelled

Pair = tuple[Path, Path]


@dataclass(frozen=True, slots=True)
class LearnTask:
    """The files that a model is learnt from, and its bones."""

    pairs: tuple[Pair, ...] = ()
    """SENSORS.csv and MARKERS.csv of each recording."""
    test: Annotated[Pair | None, Flag("--test", "SENSORS MARKERS", "State the error on another recording, too.")] = None
    """The error of a corrected model is stated on it, too."""
    adapt: Annotated[Path | None, Flag("--adapt", "MODEL", "Correct this model by a few labelled frames of another day.")] = None
    """It keeps its bones."""
    end_to_end: Annotated[bool, Flag("--end-to-end", help="A second network from readings to bones.")] = False
    bones: Annotated[int, Flag("--bones", help="How many bones.")] = 8
    plane: Annotated[str | None, Flag("--plane", "X,Y,Z", "Normal of the plane in which the body bends.")] = None
    calibration: Annotated[Path | None, Flag("-c --calibration", "FILE", "Take a camera's markers into the robot's frame.")] = (
        None
    )
    in_robot_frame: Annotated[bool, Flag("--robot-frame", help="The markers are in the robot's frame already.")] = False

    @property
    def all(self) -> list[Path]:
        """Every file that is read."""
        more = [file for file in (self.adapt, self.calibration) if file is not None]
        return [*(file for pair in self.pairs for file in pair), *(self.test or ()), *more]

    def read(self) -> tuple[Labelled, Labelled | None]:
        """Return the recordings as one, and that of the test. Raises InputError."""
        from femsense.xr.proprioception.files import read_labelled
        from femsense.xr.proprioception.labelled import joined

        read = partial(read_labelled, calibration=self.calibration, in_robot_frame=self.in_robot_frame)
        data = joined([read(*pair) for pair in self.pairs]) if len(self.pairs) > 1 else read(*self.pairs[0])
        return data, None if self.test is None else read(*self.test)
