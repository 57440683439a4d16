"""Bodies along a line: sections, stiffness against beam theory, channels, chambers, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lines import SILICONE, written

from femsense.app.cli import run
from femsense.core.errors import InputError
from femsense.fem.body import make_body
from femsense.fem.chambers import chamber_volume
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import element_volumes, embed_points, to_quadratic
from femsense.fem.mesh_checks import check_mesh
from femsense.fem.sections import cut_section
from femsense.io.mesh_files import radius_ratio
from femsense.io.meshing.line_body import LineBody, mesh_line, place
from femsense.io.meshing.line_file import line_of, read_line
from femsense.io.meshing.robot_from_line import line_into, line_text
from femsense.io.robot_toml import load_robot

TUBE = {"radius_mm": 5.0, "bore_mm": 3.0}
CONE = ({"radius_mm": 6.0}, {"radius_mm": 3.0})


def line(tmp_path: Path, *sections: Any, **more: Any) -> LineBody:
    path = written(tmp_path, *sections, **more)
    return line_of(read_line(path), path)


def second(area: float, inner: float) -> float:
    return np.pi / 4 * (area**4 - inner**4)


@pytest.mark.parametrize(
    ("sections", "volume", "bending"),
    [
        ((TUBE, TUBE), np.pi * (25 - 9) * 100, second(5, 3)),
        (CONE, np.pi * 100 / 3 * (36 + 18 + 9), second(4.5, 0)),
        (({"width_mm": 8.0, "height_mm": 4.0},) * 2, 3200.0, 8 * 4**3 / 12),
        (({"area_mm2": 60.0, "second_moment_mm4": [900.0, 400.0]},) * 2, 6000.0, 400.0),
    ],
    ids=["tube", "cone", "rectangle", "equal section"],
)
def test_volume_and_second_moment(tmp_path: Path, sections: tuple[Any, ...], volume: float, bending: float) -> None:
    mesh, _ = mesh_line(line(tmp_path, *sections))
    check_mesh(mesh, "body")
    assert element_volumes(mesh).sum() * 1e9 == pytest.approx(volume, rel=1e-6)
    cut = cut_section(mesh, np.ones(len(mesh.tets)), np.array([0.0, 0.0, -0.05]), np.array([0.0, 0.0, 1.0]))
    assert cut is not None
    assert cut.bending[0] * 1e12 == pytest.approx(bending, rel=0.004)
    assert radius_ratio(mesh).min() > 0.09


@pytest.mark.parametrize(
    "sections", [(TUBE, TUBE), CONE, ({"width_mm": 8.0, "height_mm": 6.0},) * 2], ids=["tube", "cone", "bar"]
)
def test_bends_as_beam_theory_says(tmp_path: Path, sections: tuple[Any, ...]) -> None:
    body_line = line(tmp_path, *sections)
    mesh, along = mesh_line(body_line, most_tets=1500)
    fine = to_quadratic(mesh)
    body = make_body(fine, clamped=fine.nodes[:, 2] > -1e-9, young_modulus=200e3, poisson_ratio=0.3, density=0.0)
    end = np.flatnonzero(along > 0.0999)
    forces = np.zeros_like(fine.nodes)
    forces[end, 1] = 1e-5 / len(end)
    moved = solve_equilibrium(body, nodal_forces=forces).positions - fine.nodes
    s = np.linspace(0.0, 0.1, 4001)
    where = [
        cut_section(mesh, np.full(len(mesh.tets), 200e3), np.array([0, 0, -a]), np.array([0, 0, 1.0]))
        for a in np.linspace(0.001, 0.099, 25)
    ]
    stiff = np.interp(s, np.linspace(0.001, 0.099, 25), [cut.bending[0] for cut in where if cut])
    expected = 1e-5 * np.trapezoid((0.1 - s) ** 2 / stiff, s)
    assert moved[end, 1].mean() == pytest.approx(expected, rel=0.03)


def test_a_channel_is_subdivided_until_the_answer_stands_still(tmp_path: Path) -> None:
    tendon = {"name": "t", "distance_mm": [4.0, 2.0], "angle_deg": -90.0, "max_tension_n": 0.15}
    source = written(tmp_path, *CONE, tendons=[tendon, tendon | {"name": "u", "angle_deg": 90.0}])
    report = line_into(tmp_path / "robot", source, most_tets=700)
    tried, other = report["tendons"]
    assert tried["points"] == other["points"] > 8
    assert tried["change"] < 0.005
    assert f"{tried['points']} points in its channel" in line_text(report)
    robot = load_robot(tmp_path / "robot")
    path = robot.body.cables[0].path
    assert len(path) == tried["points"] and path.outside.max() < 1e-9
    np.testing.assert_allclose(path.positions(robot.body.mesh.nodes)[[0, -1]], [[0, 2e-3, -0.1], [0, 4e-3, 0]], atol=1e-9)
    state = solve_equilibrium(robot.body, tension={"t": 0.15})
    assert state.positions[:, 1].max() > 0.01 and state.positions[:, 1].min() > -0.01  # towards the tendon


def test_chambers_have_the_volume_that_was_asked_for(tmp_path: Path) -> None:
    beside = [
        {"name": f"c{i}", "from_mm": 10.0, "to_mm": 90.0, "radius_mm": 1.2, "distance_mm": 3.5, "angle_deg": 120.0 * i}
        for i in range(3)
    ]
    line_into(tmp_path / "three", written(tmp_path, {"radius_mm": 6.0}, {"radius_mm": 6.0}, chambers=beside), most_tets=4000)
    robot = load_robot(tmp_path / "three")
    assert robot.body.chamber_names == ("c0", "c1", "c2")
    for chamber in robot.body.chambers:
        assert chamber_volume(chamber, robot.body.mesh.nodes) * 1e9 == pytest.approx(np.pi * 1.2**2 * 80, rel=0.03)
    pushed = solve_equilibrium(robot.body, pressure={"c0": 2e3}).positions - robot.body.mesh.nodes
    assert pushed[robot.body.mesh.nodes[:, 2] < -0.099][:, 0].mean() < -1e-4  # away from the chamber on +x


def test_bellows_around_a_chamber(tmp_path: Path) -> None:
    source = written(
        tmp_path,
        {"radius_mm": 10.0},
        {"radius_mm": 10.0},
        bellows=[{"from_mm": 20.0, "to_mm": 80.0, "count": 3, "depth_mm": 4.0}],
        chambers=[{"name": "c", "from_mm": 10.0, "to_mm": 90.0, "wall_mm": 2.0}],
    )
    line_into(tmp_path / "robot", source, most_tets=3000)
    robot = load_robot(tmp_path / "robot")
    inside = 20 * 8**2 + 60 * (6**2 + 0.5 * 2**2)  # radius 8 mm, and 6 + 2 cos where it is folded
    assert chamber_volume(robot.body.chambers[0], robot.body.mesh.nodes) * 1e9 == pytest.approx(np.pi * inside, rel=0.04)
    straight = line(
        tmp_path,
        {"radius_mm": 10.0},
        {"radius_mm": 10.0},
        chambers=[{"name": "c", "from_mm": 10.0, "to_mm": 90.0, "wall_mm": 2.0}],
    )
    lengths = []
    for body_line in (straight, line_of(read_line(source), source)):
        mesh = to_quadratic(mesh_line(body_line, most_tets=3000)[0])
        lengths.append(mesh.nodes[:, 2].min())
    assert lengths == pytest.approx([-0.1, -0.1])


def test_a_curved_line_carries_its_sections_and_channels(tmp_path: Path) -> None:
    angles = np.linspace(0.0, np.pi / 2, 9)
    arc = [{"at_mm": [50 - 50 * np.cos(a), 0.0, -50 * np.sin(a)], "radius_mm": 6.0} for a in angles]
    body_line = line(tmp_path, *arc)
    mesh, _ = mesh_line(body_line)
    check_mesh(mesh, "arc")
    assert element_volumes(mesh).sum() * 1e9 == pytest.approx(np.pi * 36 * 50 * np.pi / 2, rel=0.02)
    channel = np.array([place(body_line, s, 4e-3, np.pi) for s in np.linspace(0, body_line.length, 20)])
    assert embed_points(mesh, channel).outside.max() < 1e-9
    np.testing.assert_allclose(np.linalg.norm(channel - [0.05, 0, 0], axis=1), 0.054, rtol=0.01)


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"sections": [{"at_mm": [0.0, 0.0, 0.0]}, {"at_mm": [0.0, 0.0, 9.0], "radius_mm": 2.0}]}, "a section has radius_mm"),
        ({"tendons": [{"name": "t", "distance_mm": 1.0, "end_mm": 300.0}]}, "beyond the end of the line"),
        ({"tendons": [{"name": "t", "distance_mm": 1.0, "end_mm": 20.0, "start_mm": 40.0}]}, "begins behind its end"),
        ({"chambers": [{"name": "c", "from_mm": 10.0, "to_mm": 90.0, "radius_mm": 7.0}]}, "the hole leaves no wall"),
        (
            {"chambers": [{"name": "c", "from_mm": 10.0, "to_mm": 90.0, "radius_mm": 2.0, "distance_mm": 5.0}]},
            "chambers leave no wall",
        ),
        ({"chambers": [{"name": "c", "from_mm": 10.0, "to_mm": 90.0, "radius_mm": 3.0, "distance_mm": 2.0}]}, "crosses it"),
        ({"angle_zero": [0.0, 0.0, 1.0]}, "points along the line"),
        ({"radius": 3.0}, "unknown key"),
    ],
)
def test_what_makes_no_body_is_refused(tmp_path: Path, more: dict[str, Any], text: str) -> None:
    sections = more.pop("sections", [{"at_mm": [0.0, 0.0, -100.0 * i], "radius_mm": 6.0} for i in range(2)])
    source = written(tmp_path, *sections, **more)
    with pytest.raises(InputError, match=text):
        line_into(tmp_path / "robot", source)
    assert not (tmp_path / "robot" / "robot.toml").exists()


def test_sections_that_no_body_can_have(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no section of this area bends so easily"):
        line(tmp_path, *({"area_mm2": 60.0, "second_moment_mm4": 100.0},) * 2)
    with pytest.raises(InputError, match="a step of the outline"):
        line(tmp_path, {"radius_mm": 5.0}, {"radius_mm": 4.0, "at_mm": [0.0, 0.0, 0.0]})
    with pytest.raises(InputError, match="a hole that ends in a point"):
        line(tmp_path, TUBE, {"radius_mm": 5.0})
    with pytest.raises(InputError, match="a larger --max-tets"):
        mesh_line(line(tmp_path, *CONE), most_tets=200)


def test_the_command_makes_a_robot_and_inspect_warns_of_few_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tendon = {"name": "t", "distance_mm": [4.0, 2.0], "points": 4, "max_tension_n": 0.15}
    marker = {"name": "tip", "along_mm": 110.0}
    source = written(
        tmp_path, *CONE, tendons=[tendon], markers=[marker], clamp={"ends": "both"}, gravity={"vector_m_s2": [0.0, 0.0, -9.81]}
    )
    assert run(["inspect", str(source)]) == 0
    assert "a body along a line" in capsys.readouterr().out
    assert run(["mesh", str(source), "-o", str(tmp_path / "robot"), "--max-tets", "700"]) == 0
    robot = load_robot(tmp_path / "robot")
    assert robot.marker_points.tolist() == [[0.0, 0.0, -0.11]]
    assert set(np.round(robot.body.mesh.nodes[robot.body.clamped, 2], 6)) == {0.0, -0.1}
    assert robot.body.material.density == SILICONE["density_kg_m3"]
    assert run(["mesh", str(source), "-o", str(tmp_path / "robot"), "--max-tets", "700"]) == 0
    assert "contains this robot already" in capsys.readouterr().err
    (tmp_path / "robot" / "mesh.vtu").unlink()
    assert run(["mesh", str(source), "-o", str(tmp_path / "robot"), "--max-tets", "700"]) == 0
    assert load_robot(tmp_path / "robot").body.mesh.nodes.shape == robot.body.mesh.nodes.shape
    assert run(["inspect", str(tmp_path / "robot")]) == 0
    assert "between points 0 and 1 of its path" in capsys.readouterr().out
    (tmp_path / "robot" / "mesh.json").unlink()
    assert run(["mesh", str(source), "-o", str(tmp_path / "robot")]) == 2
