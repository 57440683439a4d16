"""The command line as a user meets it: exit statuses, JSON alone on standard output, messages, resuming, being stopped."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import tomli_w
import typer
from helpers import write_block_robot, write_small_recording
from rig_scripts import SCRIPT
from small_run import make_run

import femsense
from femsense.app import cli
from femsense.app.command_line.answer import Answer, label_and_clock
from femsense.app.command_line.parameters import split_names
from femsense.app.commands import loop_page
from femsense.core.errors import DataError, InputError
from femsense.io.files import PART_PREFIX
from femsense.io.folder_lock import lock_of, only_writer
from femsense.io.robot_toml import load_robot
from femsense.sensing.run_files import write_run
from femsense.xr.view import PAGE

COMMANDS = tuple(cli.COMMANDS)
ROOT = Path(femsense.__file__).parents[1]


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A robot that warns of nothing."""
    return write_block_robot(tmp_path / "robot", cells=(3, 1, 1), cables=None)


@pytest.fixture
def recording(tmp_path: Path, robot: Path) -> Path:
    """Three frames of that robot at rest under its weight, seen from its own frame; in the last one its tip is held up."""
    from femsense.fem.equilibrium import solve_equilibrium
    from femsense.fem.mesh import embed_points
    from femsense.io.robot_toml import load_robot

    body = load_robot(robot)
    mesh = body.body.mesh
    tip = embed_points(mesh, np.array([[0.1, 0.015, 0.015]])).spread(np.array([[0.0, 0.0, 0.3]]), len(mesh.nodes))
    rows = ["frame,marker,x_m,y_m,z_m"]
    for frame, forces in enumerate((None, None, tip)):
        state = solve_equilibrium(body.body, nodal_forces=forces)
        places = body.markers.positions(state.positions)
        rows += [f"{frame},{name},{x!r},{y!r},{z!r}" for name, (x, y, z) in zip(body.marker_names, places.tolist())]
    return write_small_recording(
        tmp_path / "recording", frames_csv="frame,time_s,free\n0,0.0,1\n1,0.5,1\n2,1.0,0\n", markers_csv="\n".join(rows) + "\n"
    )


class Spoken:
    """What a command said."""

    def __init__(self, status: int, out: str, err: str) -> None:
        self.status, self.out, self.err = status, out, err

    @property
    def json(self) -> Any:
        return json.loads(self.out)


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a command in this process."""
    monkeypatch.delenv("FEMSENSE_DEBUG", raising=False)

    def run_command(*arguments: object, **given: Any) -> Spoken:
        status = cli.run([str(argument) for argument in arguments], **given)
        said = capfd.readouterr()
        assert "Traceback" not in said.out + said.err
        return Spoken(status, said.out, said.err)

    return run_command


def command(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    words = [sys.executable, "-m", "femsense", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False, **options)


def program_of(work: Callable[[], Any]) -> typer.Typer:
    """Return a program whose command `work` does this."""
    program = typer.Typer(callback=lambda: None, pretty_exceptions_enable=False)

    @program.command("work")
    def command_of(json: Annotated[bool, typer.Option("--json")] = False) -> Any:
        return work()

    return program


def failing(error: BaseException) -> typer.Typer:
    """Return a program whose command `work` meets an error."""

    def fail() -> None:
        raise error

    return program_of(fail)


# Help and usage


def test_help_names_every_command_in_one_line_each(run: Any) -> None:
    said = run("--help")
    assert said.status == 0 and said.err == ""
    lines = said.out.split("Commands:")[1].splitlines()
    assert [line.split()[0] for line in lines if line.startswith("  ")][: len(COMMANDS)] == list(COMMANDS)
    assert COMMANDS[:4] == ("demo", "inspect", "import", "mesh") and COMMANDS[-1] == "doctor"
    assert not any("..." in line for line in lines) and max(map(len, said.out.splitlines())) <= 80
    assert run().out == said.out


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_has_help_and_json(run: Any, name: str) -> None:
    said = run(name, "--help")
    assert said.status == 0 and f"Usage: femsense {name}" in said.out and "--json" in said.out


@pytest.mark.parametrize("name", COMMANDS)
def test_each_help_ends_with_an_example_of_options_that_exist(run: Any, name: str) -> None:
    said = run(name, "--help").out
    example = cli.COMMANDS[name][1]
    assert said.splitlines()[-1].strip() == example
    assert example.startswith(f"femsense {name}")
    assert not [word for word in example.split() if word.startswith("-") and f"{word} " not in said and f"{word}," not in said]


def test_version(run: Any) -> None:
    assert run("--version").out == f"femsense {femsense.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["calibratte"], "No such command 'calibratte'. Did you mean 'calibrate'? See: femsense --help"),
        (["calibrate", "robot"], "Missing argument 'RECORDING'. See: femsense calibrate --help"),
        (["estimate", "a", "b"], "Missing option '-o' / '--output'. See: femsense estimate --help"),
        (["improve", "robot"], "Missing argument 'RECORDING'. See: femsense improve --help"),
        (["improve", "robot", "a"], "Missing option '-o' / '--output'. See: femsense improve --help"),
        (["simulate", "robot", "a"], "Missing option '-o' / '--output'. See: femsense simulate --help"),
        (["inspect", "--nonsense", "x"], "No such option: --nonsense"),
        (["estimate", "a", "b", "-o", "c", "--at", "1,2"], "'1,2' is not a place: three numbers in metres are"),
        (["estimate", "a", "b", "-o", "c", "--at", "x,y,z"], "'x,y,z' is not a place"),
        (["estimate", "a", "b", "-o", "c", "--push"], "--push applies to the points of --at, and none is given"),
        (["view", "x", "--port", "-1"], "'--port': Input should be greater than or equal to 0"),
    ],
)
def test_wrong_usage_is_one_clear_line(run: Any, arguments: list[str], message: str) -> None:
    said = run(*arguments)
    assert said.status == 2 and said.out == ""
    assert message in said.err and said.err.count("\n") == 1 and said.err.startswith("femsense: ")


def test_a_plan_refuses_what_it_cannot_do(run: Any, robot: Path) -> None:
    assert "expected: a file that ends in .toml" in run("improve", robot, "--plan", "-o", "plan").err
    assert "'force' is not one of 'tension', 'displacement'" in run("improve", robot, "--plan", "--actuation", "force").err


@pytest.mark.parametrize(
    ("words", "spread"),
    [
        ("improve r a b --validation c d -o out", "improve r a b --validation c --validation d -o out"),
        ("estimate --at -0.1,0,0 -.2,0,0 --json", "estimate --at -0.1,0,0 --at -.2,0,0 --json"),
        ("inspect a --json", "inspect a --json"),
    ],
)
def test_an_option_takes_several_values(words: str, spread: str) -> None:
    assert cli.repeat_options(words.split()) == spread.split()


# JSON


def test_json_is_alone_on_standard_output_whatever_libraries_print(tmp_path: Path) -> None:
    code = (
        "import ctypes, femsense.app.inspect as i, os, sys\nfrom femsense.app import cli\nreal = i.inspect_path\n"
        "def noisy(path, **_):\n    print('python says')\n    ctypes.CDLL(None).printf(b'C says\\n')\n    os.write(1, "
        "b'the system says\\n')\n"
        "    return real(path, **_)\n"
        f"i.inspect_path = noisy\nsys.exit(cli.run(['inspect', {str(write_block_robot(tmp_path))!r}, '--json']))"
    )
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False, env=buffered)
    assert done.returncode == 0 and json.loads(done.stdout)["kind"] == "robot"
    assert all(word in done.stderr for word in ("python says", "C says", "the system says"))


def test_errors_are_one_json_object_too(run: Any, tmp_path: Path) -> None:
    said = run("inspect", tmp_path / "none", "--json")
    assert (
        said.status == 2
        and said.json["exit_status"] == 2
        and "nothing there" in said.json["error"]
        and said.json["warnings"] == []
    )
    said = run("calibrate", "--json")
    assert said.status == 2 and "Missing argument" in said.json["error"]


def test_backslashes_of_another_system_are_explained(run: Any, tmp_path: Path) -> None:
    (tmp_path / "rec").mkdir()
    said = run("inspect", f"{tmp_path}\\rec", "--json")
    assert said.status == 2 and f"did you mean '{tmp_path}/rec'? Between folders stands /" in said.json["error"]
    assert "Between folders stands /" in run("calibrate", "four-leg", r"D:\data\push", "--json").json["error"]
    assert "Between folders" not in run("inspect", tmp_path / "none", "--json").json["error"]


def test_warnings_are_one_line_each_and_stand_in_the_json(run: Any, tmp_path: Path, recording: Path) -> None:
    soft = write_block_robot(tmp_path / "soft", cells=(3, 1, 1), cables=None, material__young_modulus_pa=900.0, gravity=None)
    said = run("calibrate", soft, recording, "-o", tmp_path / "c.json", "--json")
    assert any("softer than any silicone" in note for note in said.json["warnings"])
    lines = [line for line in said.err.splitlines() if "softer" in line]
    assert len(lines) == 1 and lines[0].startswith("warning: ") and "stacklevel" not in said.err


def test_warnings_of_libraries_that_mean_nothing_to_users_are_not_shown(run: Any) -> None:
    def warned() -> Answer:
        warnings.warn("dividing by zero", RuntimeWarning, stacklevel=2)
        warnings.warn("old", DeprecationWarning, stacklevel=2)
        for _ in range(2):
            warnings.warn("look\n  here", UserWarning, stacklevel=2)
        return Answer({}, "done")

    said = run("work", program=program_of(warned))
    assert said.err == "warning: look here\n" and said.out == "done\n"


# Errors


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (
            InputError("wrong unit", where="robot.toml", found="inch", expected="mm", hint="mm"),
            2,
            "robot.toml: wrong unit\n  found:    inch",
        ),
        (DataError("too few markers"), 1, "femsense: too few markers\n"),
        (ImportError("libGL.so.1: cannot open shared object file", name="open3d"), 2, "femsense doctor lists what is missing"),
        (PermissionError(13, "Permission denied", "/place"), 2, "femsense: /place: Permission denied\n"),
        (RuntimeError("two\nlines"), 2, "internal error: RuntimeError: two lines; the details are in "),
        (KeyError("x"), 2, "internal error: KeyError: 'x'"),
        (KeyboardInterrupt(), 130, "femsense: stopped without half-written files; the same command continues\n"),
    ],
)
def test_every_error_is_a_message_and_an_exit_status(
    run: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: BaseException, status: int, text: str
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    said = run("work", program=failing(error))
    assert said.status == status and said.out == "" and text in said.err
    assert run("work", "--json", program=failing(error)).json["exit_status"] == status


def test_details_of_an_internal_error_stand_in_a_file(run: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    said = run("work", program=failing(ZeroDivisionError("oh")))
    (file,) = tmp_path.glob("femsense-error-*.txt")
    assert str(file) in said.err and said.err.count("\n") == 1
    assert "Traceback" in file.read_text() and "ZeroDivisionError: oh" in file.read_text()


def test_debugging_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FEMSENSE_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        cli.run(["work"], program=failing(ZeroDivisionError("oh")))


@pytest.mark.parametrize("name", ["robot.toml", "recording.toml", "frames.csv", "markers.csv", "block.vtu"])
@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00garbage", b"a = [\n", b"[1,2]"])
def test_broken_input_never_shows_a_traceback(
    run: Any, robot: Path, recording: Path, tmp_path: Path, name: str, content: bytes
) -> None:
    broken = (robot if (robot / name).exists() else recording) / name
    broken.write_bytes(content)
    for said in (
        run("calibrate", robot, recording, "-o", tmp_path / "c.json"),
        run("estimate", robot, recording, "-o", tmp_path / "run"),
    ):
        assert said.status == 2 and "internal error" not in said.err and name in said.err
    assert run("inspect", broken.parent).status == 2
    assert not (tmp_path / "c.json").exists() and not (tmp_path / "run").exists()


def test_a_broken_robot_in_a_process_of_its_own(robot: Path) -> None:
    (robot / "robot.toml").write_text('format = "femsense-robot-1"\nnam = "x"\n', encoding="utf-8")
    done = command("calibrate", robot, "nowhere")
    assert done.returncode == 2 and done.stdout == "" and "unknown key" in done.stderr and "did you mean 'name'?" in done.stderr


# The chain


def test_inspect(run: Any, robot: Path, tmp_path: Path) -> None:
    said = run("inspect", "arm")
    assert said.status == 0 and "a robot" in said.out and "nothing is wrong with it" in said.out
    said = run("inspect", robot)
    assert said.status == 0 and "linear tetrahedra make this body too stiff" in said.out and "nothing is wrong" not in said.out
    assert run("inspect", tmp_path).status == 2


def test_calibrate_estimate_export(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    said = run("calibrate", robot, recording, "-o", tmp_path / "c.json")
    assert said.status == 0 and "status" in said.out and f"written: {tmp_path / 'c.json'}" in said.out
    said = run(
        "estimate", robot, recording, "-c", tmp_path / "c.json", "-o", tmp_path / "run", "--at", "0.1,0.015,0.015", "--json"
    )
    assert said.status == 0 and said.json["frames_ok"] == 3
    assert {path.name for path in (tmp_path / "run").iterdir()} == {
        "contacts.csv",
        "frames.csv",
        "states.npz",
        "run.json",
        "calibration.json",
    }
    from femsense.sensing.run_files import read_run

    by_frame = {contact.frame: contact.force_n_xyz for contact in read_run(tmp_path / "run").contacts}
    np.testing.assert_allclose(by_frame[2], [0.0, 0.0, 0.3], atol=0.03)
    assert 0 not in by_frame  # a force of nothing is no contact
    said = run("export", tmp_path / "run", "-o", tmp_path / "new" / "robot.glb", "--json")
    assert said.status == 0 and said.json["frames"] == 3 and (tmp_path / "new" / "robot.glb").read_bytes()[:4] == b"glTF"
    assert run("inspect", tmp_path / "run").status == 0
    said = run("export", tmp_path / "run", "-o", tmp_path / "new" / "robot.fbx")
    assert said.status == 2 and ".glb or .usdz" in said.err and not (tmp_path / "new" / "robot.fbx").exists()


def test_without_a_calibration_one_is_made_and_said(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    said = run("estimate", robot, recording, "-o", tmp_path / "run", "--at", "0.1,0.015,0.015")
    assert said.status == 0 and "no calibration given: calibrating first" in said.err
    from femsense.calib.files import read_calibration

    assert read_calibration(tmp_path / "run").status == "converged"


def test_an_error_of_the_model_is_said_where_estimate_calibrates(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    table, body = recording / "recording.toml", robot / "robot.toml"
    table.write_text("marker_noise_m = 1e-6\n" + table.read_text(encoding="utf-8"), encoding="utf-8")
    body.write_text(body.read_text(encoding="utf-8").replace("= 150000.0", "= 40e3"), encoding="utf-8")
    said = run("estimate", robot, recording, "-o", tmp_path / "run", "--at", "0.1,0.015,0.015")
    assert said.status == 0 and "error of the model" in said.err


def test_a_second_run_computes_nothing(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    arguments = ("estimate", robot, recording, "-o", tmp_path / "run", "--at", "0.1,0.015,0.015")
    first = run(*arguments)
    before = (tmp_path / "run" / "run.json").read_bytes()
    again = run(*arguments)
    assert "contains this result already" in again.err and again.out == first.out and again.status == 0
    assert (tmp_path / "run" / "run.json").read_bytes() == before
    assert "contains this result already" not in run(*arguments, "--again").err
    assert (tmp_path / "run" / "run.json").read_bytes() != before
    (tmp_path / "run" / "contacts.csv").unlink()
    assert "contains this result already" not in run(*arguments).err and (tmp_path / "run" / "contacts.csv").is_file()


def test_data_that_allow_no_result_are_status_1(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    (recording / "frames.csv").write_text("frame,time_s,free\n0,0.0,0\n1,0.5,0\n2,1.0,0\n", encoding="utf-8")
    said = run("calibrate", robot, recording, "-o", tmp_path / "c.json")
    assert said.status == 1 and "no frame is free" in said.err and not (tmp_path / "c.json").exists()


def test_a_calibration_that_has_not_settled_is_not_used(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    file = tmp_path / "c.json"
    assert run("calibrate", robot, recording, "-o", file).status == 0
    file.write_text(file.read_text().replace('"status": "converged', '"status": "not settled'), encoding="utf-8")
    said = run("estimate", robot, recording, "-c", file, "-o", tmp_path / "run", "--at", "0.1,0.015,0.015")
    assert said.status == 1 and "not settled" in said.err


def test_results_are_not_written_over_the_input(run: Any, robot: Path, recording: Path) -> None:
    before = {path: path.read_bytes() for path in (*robot.iterdir(), *recording.iterdir())}
    for output in (robot, recording):
        said = run("estimate", robot, recording, "-o", output, "--at", "0.1,0.015,0.015")
        assert said.status == 2 and "another -o" in said.err
    assert run("simulate", robot, "script.toml", "-o", robot).status == 2
    assert run("improve", robot, recording, "-o", robot).status == 2
    assert {path: path.read_bytes() for path in (*robot.iterdir(), *recording.iterdir())} == before


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such locks")
def test_two_commands_never_write_one_folder_at_once(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "script.toml").write_text(tomli_w.dumps({**SCRIPT, "contacts": []}), encoding="utf-8")
    (tmp_path / "table.csv").write_text("time,tip_x,tip_y,tip_z\n0.0,0,0,90\n0.1,1,0,90\n", encoding="utf-8")
    with only_writer(tmp_path / "out"):
        for words in (
            ("estimate", robot, recording, "--at", "0.1,0.015,0.015"),
            ("improve", robot, recording),
            ("simulate", write_block_robot(tmp_path / "pulled"), tmp_path / "script.toml"),
            ("import", tmp_path / "table.csv", "--unit", "mm", "--inputs", "tension"),
        ):
            said = run(*words, "-o", tmp_path / "out")
            assert said.status == 2 and "another command is writing into this folder" in said.err, said.err
        assert not (tmp_path / "out").exists()
    assert run("estimate", robot, recording, "--at", "0.1,0.015,0.015", "-o", tmp_path / "out").status == 0


def test_unknown_effects_are_refused_with_a_hint(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    said = run("improve", robot, recording, "-o", tmp_path / "out", "--effects", "frction,creep")
    assert said.status == 2 and "unknown effect" in said.err and not (tmp_path / "out").exists()


def test_what_would_be_ignored_is_refused(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    for options, text in (
        (("--plan",), "--plan takes no recordings"),
        (("-o", tmp_path / "out", "--validation", recording), "a recording is fitted and judged on"),
        (("-o", tmp_path / "out", recording), "the same recording is given twice"),
        (("-o", tmp_path / "out", "--reference", recording), "the same recording is given twice"),
        (("-o", tmp_path / "out", "--effects", "creep", "--without", "creep"), "no effect is left to try"),
        (("-o", tmp_path / "out", "--effects", ""), "no name"),
        (("-o", tmp_path / "out", "--effects", "cable_slack"), "none of these effects can act here"),
    ):
        said = run("improve", robot, recording, *options)
        assert said.status == 2 and text in said.err


def test_an_effect_of_ones_own_that_is_not_there_is_said(run: Any, robot: Path, recording: Path, tmp_path: Path) -> None:
    said = run("improve", robot, recording, "-o", tmp_path / "out", "--user-effect", tmp_path / "magnet.py")
    assert said.status == 2 and "magnet.py: no such file" in said.err and not (tmp_path / "out").exists()


@pytest.mark.parametrize(("names", "parsed"), [(None, None), (["a,b"], ["a", "b"]), (["a", " b ,"], ["a", "b"])])
def test_names(names: list[str] | None, parsed: list[str] | None) -> None:
    assert split_names(names) == parsed


def free_port() -> int:
    """Return a port that nobody listens at, and that the system hands to nobody by itself."""
    for port in np.random.default_rng().permutation(np.arange(20_000, 32_000)).tolist():
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise OSError("no port is free")


@pytest.mark.skipif(not (PAGE / "index.html").is_file(), reason="the page is not built")
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_view_says_where_and_ends(run: Any, robot: Path, tmp_path: Path) -> None:
    write_run(make_run(load_robot(robot)), tmp_path / "run", inputs={})
    port = free_port()
    url, answered = f"http://127.0.0.1:{port}/", list[int]()

    def look_and_stop() -> None:
        for _ in range(200):
            with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=5.0) as page:
                answered.append(page.status)
                break
            time.sleep(0.05)
        time.sleep(1.0)  # the page answers before the command has printed where, and waits
        os.kill(os.getpid(), signal.SIGINT)

    looking = threading.Thread(target=look_and_stop)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits that it is ignored
    try:
        looking.start()
        said = run("view", tmp_path / "run", "--port", port, "--no-browser", "--json")
        looking.join()
    finally:
        signal.signal(signal.SIGINT, before)
    assert said.status == 0, said.err + said.out
    assert said.json["url"] == url and answered == [200]
    with socket.socket() as free:
        assert free.connect_ex(("127.0.0.1", port)) != 0  # nobody answers any more


# Being stopped


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopping_leaves_nothing_half_written(tmp_path: Path, robot: Path, recording: Path, number: int) -> None:
    code = (
        "import signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits that it is ignored\n"
        "from femsense.app.cli import main\nmain()"
    )
    words: Sequence[str] = ["estimate", str(robot), str(recording), "-o", str(tmp_path / "run"), "--at", "0.1,0.015,0.015"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    def half_written() -> list[Path]:
        return [path for path in tmp_path.iterdir() if PART_PREFIX in path.name and path != lock_of(tmp_path / "run")]

    for _ in range(5):  # it writes for a few milliseconds, and may be done before it is halted
        with subprocess.Popen(
            [sys.executable, "-c", code, *words], stderr=subprocess.PIPE, text=True, env=environment, cwd=tmp_path
        ) as process:
            assert process.stderr is not None
            while not half_written() and process.poll() is None:
                time.sleep(1e-4)
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.02)
            caught = bool(half_written())
            process.send_signal(number)
            process.send_signal(signal.SIGCONT)
            said = process.stderr.read()
        if caught:
            break
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
    assert caught, said
    assert process.returncode == 130
    assert said.endswith("femsense: stopped without half-written files; the same command continues\n")
    assert not (tmp_path / "run").exists() and not half_written()


@pytest.mark.skipif(shutil.which("head") is None, reason="no head")
def test_a_closed_pipe_is_no_error(robot: Path) -> None:
    line = f"{sys.executable} -m femsense inspect {robot} | head -c 1"
    done = subprocess.run(line, shell=True, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.stderr == ""


def test_the_page_of_a_loop_is_written_once_and_again_when_the_loop_is_newer(tmp_path: Path) -> None:
    written: list[Path] = []

    def write(folder):
        written.append(Path(folder))
        (Path(folder) / "report.html").write_text("page")
        return Path(folder) / "report.html"

    loop, page = tmp_path / "loop.json", tmp_path / "report.html"
    loop.write_text("{}")
    assert loop_page(tmp_path, say=print, write=write) == page
    assert loop_page(tmp_path, say=print, write=write) == page
    assert len(written) == 1
    os.utime(loop, ns=(page.stat().st_mtime_ns + 10**9,) * 2)
    assert loop_page(tmp_path, say=print, write=write) == page
    assert len(written) == 2
    page.unlink()

    def refuse(folder):
        raise InputError("nothing to show", where=folder)

    said: list[str] = []
    assert loop_page(tmp_path, say=said.append, write=refuse) is None
    assert "nothing to show" in said[0]


def test_how_far_the_work_is_stands_apart_from_what_is_done() -> None:
    assert label_and_clock("refitting payload (at the tip) (40%, about 3 min left)") == (
        "refitting payload (at the tip)",
        "40%, about 3 min left",
    )
    assert label_and_clock("reading (2 files)") == ("reading (2 files)", "")
