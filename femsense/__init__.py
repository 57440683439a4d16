"""femsense: an ordinary depth camera as a force sensor for soft robots.

The public names stand here; each is imported from its module when it is first used, so that `import femsense` costs nothing.

    >>> import femsense as fs
    >>> robot = fs.load_robot("four-leg")
    >>> recording = fs.load_recording("my-recording")
    >>> run = fs.estimate(robot, recording, fs.calibrate(robot, recording))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from femsense.calib.calibrate import calibrate
    from femsense.calib.calibration import Calibration
    from femsense.errors import DataError, FemsenseError, InputError, MissingDependency
    from femsense.fem.compliance import compliance
    from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
    from femsense.loop.improve import improve
    from femsense.loop.result import LoopResult
    from femsense.model import Robot
    from femsense.recording import Recording, load_recording
    from femsense.results import read_calibration, read_loop, read_run, write_calibration, write_loop, write_run
    from femsense.robot import load_robot, save_robot
    from femsense.sensing import Run, estimate
    from femsense.xr.export import export_glb

__version__ = "0.1.0"

__all__ = [
    "Calibration",
    "DataError",
    "Equilibrium",
    "FemsenseError",
    "InputError",
    "LoopResult",
    "MissingDependency",
    "Recording",
    "Robot",
    "Run",
    "__version__",
    "calibrate",
    "compliance",
    "estimate",
    "export_glb",
    "improve",
    "load_recording",
    "load_robot",
    "read_calibration",
    "read_loop",
    "read_run",
    "save_robot",
    "solve_equilibrium",
    "write_calibration",
    "write_loop",
    "write_run",
]

_HOMES = {
    "calib.calibrate": ("calibrate",),
    "calib.calibration": ("Calibration",),
    "errors": ("DataError", "FemsenseError", "InputError", "MissingDependency"),
    "fem.compliance": ("compliance",),
    "fem.equilibrium": ("Equilibrium", "solve_equilibrium"),
    "loop": ("LoopResult", "improve"),
    "model": ("Robot",),
    "recording": ("Recording", "load_recording"),
    "results": ("read_calibration", "read_loop", "read_run", "write_calibration", "write_loop", "write_run"),
    "robot": ("load_robot", "save_robot"),
    "sensing": ("Run", "estimate"),
    "xr.export": ("export_glb",),
}
_MODULE_OF = {name: f"femsense.{module}" for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'femsense' has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
