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
    from femsense.calib.files import read_calibration, write_calibration
    from femsense.core.errors import DataError, FemsenseError, InputError, MissingDependency
    from femsense.fem.compliance import compliance
    from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
    from femsense.io.recording_folder import load_recording
    from femsense.io.robot_toml import load_robot, save_robot
    from femsense.loop.files import read_loop, write_loop
    from femsense.loop.improve import improve
    from femsense.loop.result import LoopResult
    from femsense.model.recording import Recording
    from femsense.model.robot import Robot
    from femsense.sensing.pipeline import estimate
    from femsense.sensing.run_files import read_run, write_run
    from femsense.sensing.types import Run
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
    "calib.files": ("read_calibration", "write_calibration"),
    "core.errors": ("DataError", "FemsenseError", "InputError", "MissingDependency"),
    "fem.compliance": ("compliance",),
    "fem.equilibrium": ("Equilibrium", "solve_equilibrium"),
    "io.recording_folder": ("load_recording",),
    "io.robot_toml": ("load_robot", "save_robot"),
    "loop.files": ("read_loop", "write_loop"),
    "loop.improve": ("improve",),
    "loop.result": ("LoopResult",),
    "model.recording": ("Recording",),
    "model.robot": ("Robot",),
    "sensing.pipeline": ("estimate",),
    "sensing.run_files": ("read_run", "write_run"),
    "sensing.types": ("Run",),
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
