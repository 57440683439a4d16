"""What gives way to a result: nothing, or a file of the same kind that femsense wrote; never what it is made from."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import changed, write_block_robot
from small_run import write_run_with_a_cloud

from femsense.app.commands import script_plan
from femsense.app.learn_command import learn_into
from femsense.app.learn_options import LearnTask
from femsense.core.errors import InputError
from femsense.io.files import check_target, write_text, write_toml
from femsense.io.own_files import GLB, MODEL, RUN, SCRIPT, VIEW, check_files, check_replaceable
from femsense.loop.files import check_loop_folder
from femsense.report import write_report
from femsense.rig.force_map_files import check_force_map
from femsense.sensing.run_files import check_run_folder, read_run, write_run
from femsense.xr.export import export_glb
from femsense.xr.mcap_export import export_mcap
from femsense.xr.rerun_export import export_rerun

OTHER = "frame,time_s,mine\n0,0.0,1\n"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run_with_a_cloud(tmp_path_factory.mktemp("run"))[0]


def _export(run: Path, target: Path) -> None:
    export_glb(run, target, bones=2)


def _report(run: Path, target: Path) -> None:
    write_report(run, target)


@pytest.mark.parametrize(
    ("name", "write", "needs"),
    [
        ("a.glb", _export, "numpy"),
        ("a.usdz", _export, "pxr"),
        ("a.mcap", export_mcap, "mcap_ros2"),
        ("a.rrd", export_rerun, "rerun"),
        ("a.html", _report, "numpy"),
    ],
)
def test_a_file_gives_way_to_its_kind_alone(
    run: Path, tmp_path: Path, name: str, write: Callable[[Path, Path], object], needs: str
) -> None:
    pytest.importorskip(needs)
    target = tmp_path / name
    write(run, target)
    write(run, target)
    target.write_text("")
    write(run, target)
    target.write_text(OTHER)
    with pytest.raises(InputError, match="another file would be replaced\n  found:    a file that begins with b'frame,time_s"):
        write(run, target)
    assert target.read_text() == OTHER


def test_a_run_gives_way_and_other_files_of_its_names_do_not(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    write_run(read_run(run), copy, inputs={})
    for name in RUN:
        other = tmp_path / name.split(".")[0]
        other.mkdir()
        (other / name).write_text(OTHER)
        with pytest.raises(InputError, match=f"{name}: another file would be replaced"):
            check_run_folder(other)


@pytest.mark.parametrize("name", ["loop.json", "correction.json"])
def test_a_loop_replaces_no_other_file(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text('{"mine": 1}')
    with pytest.raises(InputError, match="another file would be replaced"):
        check_loop_folder(tmp_path)


def test_a_page_replaces_no_other_mesh(tmp_path: Path) -> None:
    (tmp_path / "robot.glb").write_bytes(b'glTF{"asset":{"generator":"Blender"}}')
    with pytest.raises(InputError, match=r"robot\.glb: another file would be replaced"):
        check_files(tmp_path, VIEW)


@pytest.mark.parametrize("name", ["forces.csv", "forces.glb", "forces.png"])
def test_a_map_of_forces_replaces_no_other_file(tmp_path: Path, name: str) -> None:
    check_force_map(tmp_path / "new")
    (tmp_path / name).write_text(OTHER)
    with pytest.raises(InputError, match=f"{name}: another file would be replaced"):
        check_force_map(tmp_path)


def test_a_map_of_forces_is_refused_at_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="a file stands where a folder is to be written"):
        check_force_map(tmp_path / "file")


def test_nothing_is_made_from_what_it_replaces(run: Path, tmp_path: Path) -> None:
    model = tmp_path / "m.onnx"
    model.write_bytes(b"\x08\x08\x12\x08femsense")
    check_replaceable(model, MODEL, [tmp_path / "other"])
    (tmp_path / "link").symlink_to(model)
    with pytest.raises(InputError, match="would replace its own "):
        check_target(tmp_path / "link", folder=False, kind=MODEL, inputs=[model])
    for name in ("s.csv", "m.csv"):
        (tmp_path / name).write_text(OTHER)
        with pytest.raises(InputError, match="would replace its own "):
            learn_into(LearnTask(((tmp_path / "s.csv", tmp_path / "m.csv"),)), tmp_path / name)


def test_a_pipe_is_no_file_of_femsense(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "robot.glb")
    with pytest.raises(InputError, match="no file exists there"):
        check_replaceable(tmp_path / "robot.glb", GLB)


def test_a_script_of_a_person_is_kept(tmp_path: Path) -> None:
    write_toml(tmp_path / "plan.toml", {"seed": 1}, comment="written by femsense improve --plan")
    check_target(tmp_path / "plan.toml", folder=False, kind=SCRIPT)
    write_toml(tmp_path / "mine.toml", {"seed": 1})
    with pytest.raises(InputError, match="another file would be replaced"):
        check_target(tmp_path / "mine.toml", folder=False, kind=SCRIPT)


def test_a_plan_without_clouds_says_that_nothing_is_written(tmp_path: Path) -> None:
    from rig_scripts import SCRIPT as EXPERIMENT

    robot = write_block_robot(tmp_path / "robot")
    write_toml(tmp_path / "s.toml", changed(EXPERIMENT, {"contacts": []}))
    with pytest.warns(UserWarning, match=r"nothing is written to .*: a map of forces needs \[clouds\]"):
        script_plan(robot, tmp_path / "s.toml", noise=1e-4, folder=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_pipe_is_waited_for_and_that_is_said(tmp_path: Path) -> None:
    pipe, read = tmp_path / "pipe", list[str]()
    os.mkfifo(pipe)
    reader = threading.Timer(0.3, lambda: read.append(pipe.read_text()))
    reader.start()
    with pytest.warns(UserWarning, match="pipe is a pipe without a reader: waiting for one"):
        write_text(pipe, "all of it")
    reader.join()
    assert read == ["all of it"] and pipe.is_fifo()


@pytest.mark.filterwarnings("error")
def test_a_pipe_that_is_read_gets_all_at_once(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_text(pipe, "all of it")
    assert os.read(reader, 100) == b"all of it"
    os.close(reader)
