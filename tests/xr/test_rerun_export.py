"""A run as a Rerun recording, read back by Rerun's own reader."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from small_run import write_run_with_a_cloud

from femsense.core.errors import MissingDependency
from femsense.fem.mesh import surface_triangles
from femsense.sensing.types import Run
from femsense.xr.rerun_export import export_rerun

pytest.importorskip("rerun.chunk")
CALIBRATION = """{"format": "femsense-calibration-1", "status": "converged", "rms_m": 0.0, "history": [],
"T_robot_camera": [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]],
"cable_tension_n": {}, "cable_displacement_m": {}, "marker_rms_m": {}, "std": {}}"""


@pytest.fixture
def made(tmp_path: Path) -> tuple[Path, Run, np.ndarray]:
    folder, run, points = write_run_with_a_cloud(tmp_path)
    (folder / "calibration.json").write_text(CALIBRATION)
    return folder, run, points


def logged(file: Path, entity: str, component: str) -> list[object]:
    """Return what was logged of one component, in the order of time."""
    from rerun.chunk import RrdReader

    rows = []
    for chunk in RrdReader(str(file)).stream():
        table = chunk.to_record_batch().to_pydict()
        if chunk.entity_path == entity and component in table:
            times = table.get("time", [None] * chunk.num_rows)
            rows += [(at, value) for at, value in zip(times, table[component]) if value]
    return [value for _, value in sorted(rows, key=lambda row: (row[0] is not None, row[0]))]


def test_the_body_forces_clouds_and_values_are_what_the_run_holds(made: tuple[Path, Run, np.ndarray], tmp_path: Path) -> None:
    folder, run, points = made
    report = export_rerun(folder, tmp_path / "run.rrd")
    assert (report.frames, report.clouds, report.contacts) == (3, 1, 3)
    file = tmp_path / "run.rrd"
    corners = [np.array(logged(file, "/world/body", f"Mesh3D:{name}")[2]) for name in ("vertex_positions", "triangle_indices")]
    wanted = np.asarray(run.states.nodes_m[2], dtype=float)[surface_triangles(run.robot.body.mesh)]
    np.testing.assert_allclose(corners[0][corners[1]], wanted, atol=1e-6)
    start, along = (np.array(logged(file, "/world/forces", f"Arrows3D:{name}")[-1]) for name in ("origins", "vectors"))
    contact = run.contacts[2]
    np.testing.assert_allclose(start[0] + along[0], contact.position_m, atol=1e-6)
    np.testing.assert_allclose(np.cross(along[0], contact.force_n_xyz), 0.0, atol=1e-6)
    np.testing.assert_array_equal(np.array(logged(file, "/world/camera/cloud", "Points3D:positions")[0]), points)
    assert logged(file, "/tension/top", "Scalars:scalars")[-1] == [2.0]
    assert any("no equilibrium" in text[0] for text in logged(file, "/log", "TextLog:text"))


def test_a_missing_package_gives_the_line_that_installs_it(
    made: tuple[Path, Run, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependency, match=r"femsense\[rerun\]"):
        export_rerun(made[0], tmp_path / "run.rrd")
    assert not (tmp_path / "run.rrd").exists()
