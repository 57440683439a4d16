"""loop.json and the improved robot, written and read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from femsense.core.errors import InputError
from femsense.io.files import plain, write_json
from femsense.io.mesh_files import mesh_companions
from femsense.io.own_files import LOOP
from femsense.io.provenance import recording_input, robot_input, versions
from femsense.io.result_folder import check_folder, read_document, results_folder
from femsense.io.robot_toml import robot_document, save_robot
from femsense.io.tables import validated
from femsense.loop.result.loop_result import FORMAT, SavedLoop

if TYPE_CHECKING:
    from femsense.loop.result.loop_result import LoopResult
    from femsense.model.recording import Recording
    from femsense.model.robot import Robot


def loop_inputs(robot: Robot, recordings: Sequence[Recording], validation: Sequence[Recording], **options: Any) -> dict[str, Any]:
    """Return the inputs of a closed loop as a table; see `run_inputs`."""
    return {
        "robot": robot_input(robot),
        "recordings": [recording_input(recording) for recording in recordings],
        "validation": [recording_input(recording) for recording in validation],
        "options": plain(options),
    }


# Loops


def write_loop(loop: LoopResult, folder: str | Path, *, inputs: Mapping[str, Any] | None = None) -> Path:
    """Write the result of `improve`: the improved robot, then loop.json.

    Arguments:
        loop: result of `improve`.
        folder: created if missing; its other files are kept.
        inputs: dict of the inputs of the search, which loop.json records. Default: none.

    Returns:
        the path of the folder.

    Raises:
        InputError: the folder is not writable, or contains another kind of result.
    """
    check_loop_folder(folder, loop.declared)
    with results_folder(folder, "loop.json") as part:
        declared = (loop.declared.document or {}).get("effects", [])
        improved = replace(loop.declared, name=loop.robot.name, correction=loop.robot.correction)
        save_robot(improved, part, effects=[*declared, *loop.entries])
        write_json(part / "loop.json", {**loop.document(), "inputs": inputs or {}, "versions": versions()})
    return Path(folder)


def check_loop_folder(folder: str | Path, robot: Robot | None = None) -> None:
    """Raise InputError if a loop cannot be written to a folder.

    Refused are a recording, a run, a robot that no loop wrote, a file, and a folder whose own files have the names of the results.

    Arguments:
        folder: where the loop is to be written.
        robot: the declared robot; its own folder is refused, and another mesh of the same name is not replaced.
    """
    root = Path(folder).expanduser()
    own = (root / "loop.json").is_file()
    check_folder(root, ("recording.toml", "run.json") if own else ("recording.toml", "run.json", "robot.toml"), LOOP)
    if robot is None:
        return
    if robot.folder is not None and root.exists() and root.samefile(robot.folder):
        raise InputError("the result would replace the robot that it is made from", where=root, hint="another -o")
    mesh = str(robot_document(robot)["mesh"]["file"])
    files = [mesh] if robot.folder is None else [file.name for file in mesh_companions(robot.folder / mesh)]
    foreign = [] if own else [name for name in files if (root / Path(name).name).exists()]
    if foreign:
        raise InputError(
            "another mesh would be replaced",
            where=root,
            found=", ".join(foreign),
            expected="a folder of its own",
            hint="another -o",
        )


def read_loop(path: str | Path) -> dict[str, Any]:
    """Read loop.json, the result of `improve`.

    Arguments:
        path: the file, or the folder that contains it.

    Returns:
        a dict with the content of the file: `verdict`, `effects` with parameters and standard deviations, held-out errors [m], … All keys are in
        docs/formats/results.md.

    Raises:
        InputError: the file is missing or of another kind.
    """
    file = Path(path).expanduser()
    return read_document(file / "loop.json" if file.is_dir() else file, FORMAT)


def saved_loop(document: Mapping[str, Any], file: str | Path = "loop.json") -> SavedLoop:
    """Return the content of loop.json as its type. Raises InputError, with the key and the value, if it is malformed."""
    return validated(SavedLoop, document, Path(file))
