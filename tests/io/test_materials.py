"""The table of silicones, how its moduli are derived, and robots that name a material or have regions of another."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest
from helpers import block_mesh, write_block_robot

from femsense.core.errors import InputError
from femsense.fem.assembly import internal
from femsense.fem.body import make_body
from femsense.fem.mesh import TetMesh
from femsense.io.materials import SILICONES, hardness_modulus, neo_hookean_modulus, silicone
from femsense.io.robot_toml import load_robot, save_robot

SOFT = {"box_m": [[0.0, 0.0, 0.0], [0.05, 0.03, 0.03]], "young_modulus_pa": 50e3}


def test_the_modulus_of_a_stress_is_the_one_that_the_model_answers_with() -> None:
    """A bar of the neo-Hookean law at ν = 0.4999, stretched to twice its length, carries the stress that gave its modulus."""
    stress = 68947.57
    E = neo_hookean_modulus(stress, 2.0)
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    body = make_body(TetMesh(nodes, [[0, 1, 2, 3]]), young_modulus=E, poisson_ratio=0.4999, law="neo_hookean")
    side = 2.0**-0.5
    for _ in range(20):  # the width at which the sides carry nothing
        force = internal(body, nodes * [2.0, side, side]).forces
        ahead = internal(body, nodes * [2.0, side + 1e-7, side + 1e-7]).forces
        side -= force[2, 1] / ((ahead[2, 1] - force[2, 1]) / 1e-7)
    pull = internal(body, nodes * [2.0, side, side]).forces[1, 0] * 6.0  # V P ∇N with V = 1/6
    assert pull == pytest.approx(stress, rel=1e-3)


def test_a_small_stress_gives_hookes_modulus_and_hardness_that_of_gent() -> None:
    assert neo_hookean_modulus(1e-6 * 200e3, 1.0 + 1e-6) == pytest.approx(200e3, rel=1e-5)
    assert hardness_modulus(50.0) == pytest.approx(2.46e6, rel=0.01)


def test_every_silicone_has_a_source_and_a_spread_that_holds_its_modulus() -> None:
    assert len({material.name for material in SILICONES}) == len(SILICONES)
    for material in SILICONES:
        low, high = material.spread_pa
        assert 1e4 < low <= material.young_modulus_pa <= high < 1e7
        assert material.source and all(modulus.source and modulus.way for modulus in material.moduli)
        assert material.density_kg_m3 is None or 1000 < material.density_kg_m3 < 1300


def test_harder_silicones_of_a_family_are_stiffer() -> None:
    for family in (
        ("ecoflex-00-30", "ecoflex-00-50"),
        ("dragon-skin-10", "dragon-skin-20", "dragon-skin-30"),
        ("smooth-sil-940", "smooth-sil-945", "smooth-sil-950"),
    ):
        moduli = [silicone(name).young_modulus_pa for name in family]
        assert moduli == sorted(moduli)


def test_names_are_found_however_they_are_written_and_unknown_ones_listed() -> None:
    assert silicone("Dragon Skin 30") is silicone("dragon_skin-30")
    with pytest.raises(InputError, match=r"(?s)unknown material.*ecoflex-00-30 \| ecoflex-00-50"):
        silicone("ecoflex")


# robot.toml


def test_a_robot_of_a_named_silicone(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path / "a", material={"name": "ecoflex-00-30"}))
    known = silicone("ecoflex-00-30")
    assert robot.body.material.young_modulus[0] == known.young_modulus_pa
    assert (robot.body.material.poisson_ratio[0], robot.body.material.density) == (0.49, known.density_kg_m3)
    declared = {"name": "ecoflex-00-30", "young_modulus_pa": 90e3, "poisson_ratio": 0.45}
    assert load_robot(write_block_robot(tmp_path / "b", material=declared)).body.material.young_modulus[0] == 90e3


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"name": "rubber"}, ["unknown material", "'rubber'", "dragon-skin-10"]),
        ({"name": "sylgard-184"}, ["a required key is missing", "material.density_kg_m3"]),
    ],
)
def test_materials_that_cannot_be(tmp_path: Path, table: dict[str, object], words: list[str]) -> None:
    with pytest.raises(InputError) as error:
        load_robot(write_block_robot(tmp_path, material=table))
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_regions_have_their_own_modulus(tmp_path: Path, element: str) -> None:
    sphere = {"center_m": [0.1, 0.015, 0.015], "radius_m": 0.02, "young_modulus_pa": 300e3, "poisson_ratio": 0.3}
    robot = load_robot(write_block_robot(tmp_path / "a", mesh__element=element, regions=[SOFT, sphere]))
    mesh, material = robot.body.mesh, robot.body.material
    centroids = mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
    hard = np.linalg.norm(centroids - [0.1, 0.015, 0.015], axis=1) <= 0.02
    soft = ~hard & (centroids[:, 0] <= 0.05)
    assert hard.any() and soft.any() and not (hard | soft).all()
    np.testing.assert_array_equal(material.young_modulus, np.where(hard, 300e3, np.where(soft, 50e3, 150e3)))
    np.testing.assert_array_equal(material.poisson_ratio, np.where(hard, 0.3, 0.45))
    again = load_robot(save_robot(robot, tmp_path / "b"))
    np.testing.assert_array_equal(again.body.material.young_modulus, material.young_modulus)


def test_regions_can_be_cell_data_of_the_mesh_file(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, regions=[{"cells": "part", "value": 2, "young_modulus_pa": 20e3}])
    mesh = block_mesh()
    part = np.arange(len(mesh.tets)) % 3
    meshio.Mesh(mesh.nodes * 1e3, [("tetra", mesh.tets)], cell_data={"part": [part]}).write(folder / "block.vtu")
    np.testing.assert_array_equal(load_robot(folder).body.material.young_modulus, np.where(part == 2, 20e3, 150e3))


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ({"young_modulus_pa": 1e5}, ["a region is a box_m, or center_m with radius_m, or cells with value"]),
        ({"center_m": [0, 0, 0], "young_modulus_pa": 1e5}, ["a region is a box_m"]),
        ({"box_m": SOFT["box_m"]}, ["needs its own young_modulus_pa or poisson_ratio"]),
        ({**SOFT, "young_modulus_pa": -1.0}, ["regions[0].young_modulus_pa", "greater than 0"]),
        (
            {"box_m": [[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]], "poisson_ratio": 0.3},
            ["no element has its centroid in the region", "regions[0]"],
        ),
        ({"cells": "part", "value": 1, "poisson_ratio": 0.3}, ["no such cell data in the mesh file", "'part'"]),
    ],
)
def test_regions_that_cannot_be(tmp_path: Path, region: dict[str, object], words: list[str]) -> None:
    with pytest.raises(InputError) as error:
        load_robot(write_block_robot(tmp_path, regions=[region]))
    for word in words:
        assert word in str(error.value)
