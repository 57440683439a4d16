"""femsense: an ordinary depth camera as a force sensor for soft robots.

The public names stand here, once, as type checkers read them; each is imported from its module when it is first used, so that `import femsense`
costs next to nothing.

    >>> import femsense as fs
    >>> robot = fs.load_robot("four-leg")
    >>> recording = fs.load_recording("my-recording")
    >>> run = fs.estimate(robot, recording, fs.calibrate(robot, recording))
"""

from __future__ import annotations

import ast
from importlib import import_module
from pkgutil import get_data
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from femsense.calib.calibrate import calibrate
    from femsense.calib.calibration import Calibration
    from femsense.calib.files import read_calibration, write_calibration
    from femsense.control.follow import Follower
    from femsense.control.motion import Motion, WallContact
    from femsense.control.reach import reach
    from femsense.control.search import ReachOptions
    from femsense.core.errors import DataError, FemsenseError, InputError, MissingDependency
    from femsense.fem.blocks import block_mesh
    from femsense.fem.body import BodyModel, make_body, tie_cable
    from femsense.fem.compliance import compliance
    from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
    from femsense.fem.mesh import TetMesh, embed_points
    from femsense.fem.realtime.tracker import Tracker
    from femsense.io.mesh_files import write_mesh
    from femsense.io.recording_folder import load_recording, save_recording
    from femsense.io.robot_toml import load_robot, robot_names, save_robot
    from femsense.loop.files import read_loop, write_loop
    from femsense.loop.improve import ImproveOptions, improve
    from femsense.loop.result.loop_result import LoopResult
    from femsense.model.camera import Camera
    from femsense.model.effects import EFFECTS, Effect, apply_effects, find_effect
    from femsense.model.recording import Recording, make_recording, select_frames
    from femsense.model.recording_arrays import recording_from_arrays
    from femsense.model.recording_parts import (
        About,
        Drives,
        LoadRows,
        MarkerRows,
        RestMarkers,
        Timeline,
        Tool,
        UnnamedRows,
        Views,
    )
    from femsense.model.robot import Robot
    from femsense.report.plot_run import plot_run
    from femsense.report.write import write_report
    from femsense.rig.simulate import simulate
    from femsense.sensing.comparison import Comparison, compare
    from femsense.sensing.options import SensingOptions
    from femsense.sensing.pipeline import estimate
    from femsense.sensing.run_files import read_run, run_inputs, write_run
    from femsense.sensing.types import ContactForce, Run
    from femsense.xr.armature import Armature, ArmatureOptions, local_poses, make_armature
    from femsense.xr.export import export_glb
    from femsense.xr.notebook import show_run
    from femsense.xr.proprioception.drift import adapt, drift
    from femsense.xr.proprioception.labelled import labelled
    from femsense.xr.proprioception.learn import LearnOptions, learn
    from femsense.xr.proprioception.model import ProprioceptiveModel
    from femsense.xr.proprioception.model_file import load_model, save_model
    from femsense.xr.user_skin import read_skin

__version__ = "0.2.0"

__all__ = [
    "EFFECTS",
    "About",
    "Armature",
    "ArmatureOptions",
    "BodyModel",
    "Calibration",
    "Camera",
    "Comparison",
    "ContactForce",
    "DataError",
    "Drives",
    "Effect",
    "Equilibrium",
    "FemsenseError",
    "Follower",
    "ImproveOptions",
    "InputError",
    "LearnOptions",
    "LoadRows",
    "LoopResult",
    "MarkerRows",
    "MissingDependency",
    "Motion",
    "ProprioceptiveModel",
    "ReachOptions",
    "Recording",
    "RestMarkers",
    "Robot",
    "Run",
    "SensingOptions",
    "TetMesh",
    "Timeline",
    "Tool",
    "Tracker",
    "UnnamedRows",
    "Views",
    "WallContact",
    "__version__",
    "adapt",
    "apply_effects",
    "block_mesh",
    "calibrate",
    "compare",
    "compliance",
    "drift",
    "embed_points",
    "estimate",
    "export_glb",
    "find_effect",
    "improve",
    "labelled",
    "learn",
    "load_model",
    "load_recording",
    "load_robot",
    "local_poses",
    "make_armature",
    "make_body",
    "make_recording",
    "plot_run",
    "reach",
    "read_calibration",
    "read_loop",
    "read_run",
    "read_skin",
    "recording_from_arrays",
    "robot_names",
    "run_inputs",
    "save_model",
    "save_recording",
    "save_robot",
    "select_frames",
    "show_run",
    "simulate",
    "solve_equilibrium",
    "tie_cable",
    "write_calibration",
    "write_loop",
    "write_mesh",
    "write_report",
    "write_run",
]


def _modules() -> dict[str, str]:
    """Return the module of each public name, as the imports for type checkers above declare it."""
    imports = (node for node in ast.walk(ast.parse(get_data(__name__, "__init__.py") or b"")) if isinstance(node, ast.ImportFrom))
    return {name.name: node.module for node in imports if node.module for name in node.names if name.name in __all__}


_MODULE_OF = _modules()


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'femsense' has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
