"""From files to files: the work of the commands between their arguments and their answers, with resuming."""

from __future__ import annotations

import contextlib
import importlib
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import femsense
from femsense.app.input_checks import warn_of_pictures
from femsense.calib.files import read_calibration
from femsense.core.errors import DataError, FemsenseError, InputError
from femsense.core.parallel import beside
from femsense.core.text import one_line
from femsense.io.checkpoint import UNFINISHED
from femsense.io.files import file_hash
from femsense.io.folder_lock import only_writer
from femsense.io.provenance import finished, recording_input
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.loop.files import check_loop_folder, loop_inputs, read_loop, write_loop
from femsense.report.text import model_error
from femsense.sensing.run_files import check_run_folder, read_run, run_inputs, write_run

if TYPE_CHECKING:
    from femsense.loop.improve import ImproveOptions
    from femsense.sensing.options import SensingOptions
    from femsense.sensing.types import Run

Progress = Callable[..., None]
Say = Callable[[str], None]


def estimate_into(
    folder: str | Path,
    robot: str | Path,
    recording: str | Path,
    *,
    say: Say,
    calibration: str | Path | None = None,
    at: Sequence[Sequence[float]] | None = None,
    options: SensingOptions | None = None,
    again: bool = False,
    progress: Progress | None = None,
) -> Run:
    """Estimate a recording into a folder, or return the run in it if it was made from the same input.

    Arguments:
        folder: of the run.
        robot, recording: folders (or the name of a robot).
        say: called with a line on each step besides the estimate.
        calibration: calibration.json; None calibrates first.
        at: places of contact at rest [m], shape (k, 3).
        options: of `estimate`.
        again: repeat the computation even if the result exists.
        progress: called with (frames done, frames in all).

    Raises:
        FemsenseError: bad input, a folder that holds something else or that another command is writing into, or data that allow no result.
    """
    from femsense.calib.calibrate import calibrate
    from femsense.calib.given import check_given
    from femsense.sensing.pipeline import estimate

    check_run_folder(folder)
    body, frames = load_robot(robot), load_recording(recording)
    warn_of_pictures(body, frames)
    given = None if calibration is None else read_calibration(calibration)
    inputs = run_inputs(body, frames, given, at=at, options=options)
    if not again and finished(folder, inputs):
        say(f"{folder} contains this result already (--again repeats it)")
        return read_run(folder, robot=body)
    if given is None:
        say(f"no calibration given: calibrating first, into {Path(folder) / 'calibration.json'}")
    with only_writer(folder):
        used = calibrate(body, frames, correct=bool(options and options.correct)) if given is None else given
        if not used.settled:
            raise DataError(f"the calibration is not to be used: {used.status}")
        if given is not None:
            check_given(body, frames, given)
        elif said := model_error(used):
            say(f"residual of the calibration {1e3 * used.rms_m:.3f} mm, error of the model {said}")
        began = time.perf_counter()
        run = estimate(body, frames, used, at=at, options=options, progress=progress, keep=_kept(folder, inputs))
        write_run(run, folder, inputs=inputs, seconds=time.perf_counter() - began, calibration=used)
    return run


def improve_into(
    folder: str | Path,
    robot: str | Path,
    recordings: Sequence[str | Path],
    *,
    say: Say,
    validation: Sequence[str | Path] = (),
    effects: Sequence[str] | None = None,
    without: Sequence[str] | None = None,
    options: ImproveOptions | None = None,
    again: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Close the loop into a folder, or return the loop in it if it was made from the same input.

    Arguments:
        folder: gets loop.json, robot.toml and the mesh.
        robot: a folder, or the name of a robot.
        recordings: on which effects are found; validation: on which they are tested.
        say: called with a line on each step besides the loop.
        effects, without: names of effects to try, or not to try.
        options: of `improve`; its checkpoint is set here.
        again: repeat the computation even if the result exists.
        progress: as of `improve`.

    Returns:
        the content of loop.json.

    Raises:
        FemsenseError: bad input, a folder that holds something else or that another command is writing into, or data that allow no result.
    """
    from femsense.loop.improve import ImproveOptions, improve

    check_loop_folder(folder)
    how = options or ImproveOptions()
    twice = {Path(path).resolve() for path in recordings} & {Path(path).resolve() for path in validation}
    if twice:
        raise InputError(
            "a recording is fitted and judged on",
            where="--validation",
            found=str(min(twice)),
            expected="another recording",
            hint="without --validation whole sweeps are held out",
        )
    body = load_robot(robot)
    check_loop_folder(folder, body)
    train, test = [load_recording(path) for path in recordings], [load_recording(path) for path in validation]
    own = {str(file): file_hash(Path(file)) for file in how.user_effects if Path(file).is_file()}
    inputs = loop_inputs(body, train, test, effects=effects, without=without, user_effects=own, measured=how.measured)
    inputs["options"] |= {"correct": True} if how.correct else {}
    inputs |= {"references": [recording_input(twin) for twin in how.references]} if how.references else {}
    _require_different([*inputs["recordings"], *inputs["validation"], *inputs.get("references", [])])
    if not again and finished(folder, inputs):
        say(f"{folder} contains this result already (--again repeats it)")
        return read_loop(folder)
    with only_writer(folder):
        with beside(load_pages):
            loop = improve(
                body,
                train,
                validation=test,
                effects=effects,
                without=without,
                progress=progress,
                options=replace(how, keep=_kept(folder, inputs)),
            )
        write_loop(loop, folder, inputs=inputs)
    return read_loop(folder)


def _require_different(recordings: Sequence[Mapping[str, Any]]) -> None:
    """Raise InputError where two recordings have the same content: it would count twice."""
    seen = dict[str, str]()
    for one in recordings:
        if one["sha256"] in seen:
            raise InputError(
                "the same recording is given twice",
                where=one["path"],
                found=f"the content of {seen[one['sha256']]}",
                expected="different recordings",
            )
        seen[one["sha256"]] = one["path"]


def _kept(folder: str | Path, inputs: Mapping[str, Any]) -> tuple[Path, dict[str, Any]]:
    """Return the checkpoint file of a killed command, and the inputs that it belongs to."""
    return Path(folder) / UNFINISHED, {**inputs, "version": femsense.__version__}


def load_pages(load: Callable[[str], object] = importlib.import_module) -> None:
    """Load the packages that draw pages, which takes a second; an installation without them has no pages.
    `load` imports a module by its name."""
    with contextlib.suppress(ImportError):
        for name in ("femsense.report", "matplotlib.figure", "matplotlib.backends.backend_svg"):
            load(name)


def loop_page(folder: str | Path, *, say: Say, write: Callable[[str | Path], Path] | None = None) -> Path | None:
    """Return report.html of a folder with loop.json, written where it is missing or older; None where this installation cannot.

    Arguments:
        folder: what the loop wrote.
        say: called with the reason if there is no page.
        write: writes the page of a folder; None: `femsense.report.write_report`.
    """
    page, loop = Path(folder) / "report.html", Path(folder) / "loop.json"
    if page.is_file() and page.stat().st_mtime_ns >= loop.stat().st_mtime_ns:
        return page
    return written_page(folder, say=say, write=write)


def written_page(folder: str | Path, *, say: Say, write: Callable[[str | Path], Path] | None = None) -> Path | None:
    """Write report.html of a folder of results and return it; None where this installation cannot. Arguments as of `loop_page`."""
    try:
        from femsense.report import write_report

        return (write or write_report)(folder)
    except (ImportError, FemsenseError) as error:
        say(f"no report: {one_line(error)}")
        return None


def simulate_into(folder: str | Path, robot: str | Path, script: str | Path, *, progress: Progress | None = None) -> Path:
    """Write the recording of a script; return its folder. A run that was stopped goes on where it stopped.

    Raises:
        InputError: where the folder holds anything but a simulated recording, or another command is writing into it. FemsenseError: as `simulate`.
    """
    from femsense.io.provenance import robot_input
    from femsense.rig.script import read_script
    from femsense.rig.simulate import simulate
    from femsense.rig.truth_files import check_place

    target = Path(folder).expanduser()
    check_place(target)
    body, table = load_robot(robot), read_script(script)
    meshes = [Path(script).parent / item.mesh for item in table.objects if item.mesh is not None]
    inputs = {
        "robot": robot_input(body),
        "script": table.model_dump(),
        "meshes": [file_hash(file) for file in meshes if file.is_file()],
    }
    with only_writer(target):
        return simulate(body, script, target, progress=progress, keep=_kept(target, inputs))


def script_plan(
    robot: str | Path, script: str | Path, *, noise: float, folder: str | Path | None = None
) -> tuple[dict[str, Any], str]:
    """Return the effects that the experiment of a script could identify, and the forces where it has clouds, as tables and as text.

    Arguments:
        robot, script: folder or name, and file.
        noise: of a marker's coordinate [m].
        folder: gets the map of forces (forces.csv, forces.glb, forces.png) where the script has clouds; None: nothing is written.
    """
    from femsense.loop.design.advice import identifiability_text
    from femsense.loop.design.documents import identifiability_document
    from femsense.loop.design.planner import identifiability_of_script
    from femsense.rig.camera import pose_of
    from femsense.rig.force_map import force_map
    from femsense.rig.force_map_files import check_force_map, force_document, force_text, write_force_map
    from femsense.rig.scene_checks import warn_of_script
    from femsense.rig.script import read_script

    body, table = load_robot(robot), read_script(script)
    warn_of_script(table, body, Path(script))
    if folder is not None:
        check_force_map(folder)
    identifiability = identifiability_of_script(body, table, Path(script), noise=noise)
    document, text = identifiability_document(identifiability), identifiability_text(identifiability)
    if table.clouds.kind == "none":
        if folder is not None:
            warnings.warn(f"nothing is written to {folder}: a map of forces needs [clouds] in the script", stacklevel=2)
        return document, text
    found = force_map(body, table, Path(script))
    files = [] if folder is None else write_force_map(found, Path(folder), pose_of(next(iter(table.views.values()))))
    written = "".join(f"\nwritten: {file}" for file in files)
    forces = {**force_document(found), "files": [str(file) for file in files]}
    return {**document, "forces": forces}, f"{text}\n\n{force_text(found)}{written}"


def plan_into(
    file: str | Path | None,
    robot: str | Path,
    *,
    given: str | Path | None,
    noise: float,
    frames: int,
    control: str,
    progress: Progress | None = None,
) -> tuple[dict[str, Any], str]:
    """Propose an experiment; write it as a script where a file is named. Return it as plain tables and as text.

    Arguments:
        file: script to write; one with `-far` in its name is written next to it for a second distance of the camera.
        robot: a folder, or the name of a robot.
        given: a recording that exists; None starts from nothing.
        noise: of a marker's coordinate [m].
        frames: budget.
        control: "tension" or "displacement"; a given recording declares it.
        progress: called with (items done, items in all).

    Raises:
        FemsenseError: bad input, or a robot without an equilibrium.
    """
    from femsense.io.files import check_target, write_toml
    from femsense.io.own_files import SCRIPT
    from femsense.loop.design.advice import proposal_text
    from femsense.loop.design.documents import proposal_document
    from femsense.loop.design.planner import plan_experiment

    if file is not None and Path(file).suffix != ".toml":
        raise InputError("not the name of a script", where="-o", found=str(file), expected="a file that ends in .toml")
    if file is not None:
        check_target(file, folder=False, kind=SCRIPT)
    recording = None if given is None else load_recording(given)
    proposal = plan_experiment(load_robot(robot), control=control, noise=noise, frames=frames, given=recording, progress=progress)
    files = []
    for name, script in proposal.scripts().items() if file is not None else ():
        target = Path(str(file))
        target = target.with_stem(target.stem + name)
        check_target(target, folder=False, kind=SCRIPT)
        write_toml(target, script, comment="written by femsense improve --plan")
        files.append(str(target))
    text = proposal_text(proposal) + "".join(
        f"\n\nwritten: {f} (femsense simulate ROBOT {f} -o RECORDING tries it)" for f in files
    )
    return {**proposal_document(proposal), "scripts": files}, text
