"""Meshes: refinement, orientation, surface, embedded points, node volumes and the block pattern."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from analytic import monomials, random_rotation
from helpers import block_mesh

from femsense.core.errors import InputError
from femsense.fem.closest_point import FACES
from femsense.fem.mesh import (
    EDGES,
    Embedding,
    TetMesh,
    barycentric,
    body_parts,
    closest_in_tet,
    closest_in_triangle,
    element_volumes,
    embed_points,
    oriented,
    refined,
    shape_slopes,
    shape_values,
    surface_triangles,
    to_linear,
    to_quadratic,
    triangle_normals,
    vertex_normals,
)
from femsense.fem.mesh_checks import check_mesh, hinged_parts
from femsense.fem.stencil import block_row_numbers, make_free_map, make_stencil

SIZE = (0.1, 0.03, 0.03)


def crooked(quadratic: bool = False, seed: int = 0) -> TetMesh:
    """Return a block with displaced nodes and straight edges."""
    mesh = block_mesh((3, 2, 2), SIZE)
    rng = np.random.default_rng(seed)
    mesh = TetMesh(mesh.nodes + rng.normal(0, 0.001, mesh.nodes.shape), mesh.tets)
    return to_quadratic(mesh) if quadratic else mesh


def inside_points(mesh: TetMesh, count: int = 40, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    element = rng.integers(0, len(mesh.tets), count)
    return np.einsum("pk,pkc->pc", rng.dirichlet(np.ones(4), count), mesh.nodes[mesh.tets[element, :4]])


def volume_inside(nodes: np.ndarray, triangles: np.ndarray) -> float:
    """Return the volume within a closed surface (divergence theorem)."""
    return float((nodes[triangles].mean(axis=1) * triangle_normals(nodes, triangles)).sum() / 3)


# Nodes and elements


@pytest.mark.parametrize("quadratic", [False, True])
def test_refinement_keeps_volume_orientation_and_surface(quadratic: bool) -> None:
    mesh = crooked(quadratic)
    fine = refined(mesh)
    assert len(fine.tets) == 8 * len(mesh.tets) and not fine.is_quadratic
    assert (element_volumes(fine) > 0).all()
    assert element_volumes(fine).sum() == pytest.approx(element_volumes(mesh).sum(), rel=1e-12)
    check_mesh(fine, "fine")  # neighbours fit together
    coarse = surface_triangles(to_linear(mesh))
    assert len(surface_triangles(fine)) == 4 * len(coarse)


def test_quadratic_and_back_is_the_same_mesh() -> None:
    mesh = crooked()
    quadratic = to_quadratic(mesh)
    np.testing.assert_array_equal(to_linear(quadratic).nodes, mesh.nodes)
    np.testing.assert_array_equal(to_linear(quadratic).tets, mesh.tets)
    np.testing.assert_array_equal(quadratic.nodes[: len(mesh.nodes)], mesh.nodes)
    assert to_quadratic(quadratic) is quadratic and to_linear(mesh) is mesh
    for k, (i, j) in enumerate(EDGES):
        middles = quadratic.nodes[quadratic.tets[:, [i, j]]].mean(axis=1)
        np.testing.assert_allclose(quadratic.nodes[quadratic.tets[:, 4 + k]], middles, atol=1e-15)


def test_orienting_mends_inverted_elements_and_keeps_mid_nodes_on_their_edges() -> None:
    mesh = crooked(quadratic=True)
    tets = mesh.tets.copy()
    swap = np.array([0, 2, 1, 3, 6, 5, 4, 7, 9, 8])
    tets[::3] = tets[::3][:, swap]
    broken = TetMesh(mesh.nodes, tets)
    assert (element_volumes(broken)[::3] < 0).all()
    mended = oriented(broken)
    assert (element_volumes(mended) > 0).all()
    for k, (i, j) in enumerate(EDGES):
        np.testing.assert_allclose(
            mended.nodes[mended.tets[:, 4 + k]], mended.nodes[mended.tets[:, [i, j]]].mean(axis=1), atol=1e-15
        )
    assert oriented(mended) is mended
    linear = TetMesh(mesh.nodes, tets[:, :4])
    assert (element_volumes(oriented(linear)) > 0).all()


@pytest.mark.parametrize("quadratic", [False, True])
def test_the_surface_is_closed_and_looks_outwards(quadratic: bool) -> None:
    mesh = crooked(quadratic)
    triangles = surface_triangles(mesh)
    assert volume_inside(mesh.nodes, triangles) == pytest.approx(element_volumes(mesh).sum(), rel=1e-12)
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert {tuple(s) for s in sides.tolist()} == {tuple(s[::-1]) for s in sides.tolist()}
    assert np.abs(triangle_normals(mesh.nodes, triangles).sum(axis=0)).max() < 1e-15


def test_vertex_normals_of_a_box_look_outwards_with_unit_length() -> None:
    mesh = block_mesh((2, 2, 2), (1.0, 1.0, 1.0))
    normals = vertex_normals(np.asarray(mesh.nodes), surface_triangles(mesh))
    outer = np.abs(mesh.nodes - 0.5).max(axis=1) > 0.49
    np.testing.assert_allclose(np.linalg.norm(normals[outer], axis=1), 1.0)
    assert (np.einsum("nc,nc->n", normals, mesh.nodes - 0.5)[outer] > 0.2).all()
    assert not normals[~outer].any()
    face = np.flatnonzero((np.abs(mesh.nodes - [1.0, 0.5, 0.5]) < 1e-9).all(axis=1))[0]
    np.testing.assert_allclose(normals[face], [1, 0, 0], atol=1e-12)


def test_faces_lie_opposite_their_corner_and_look_outwards() -> None:
    corner = np.vstack([np.zeros(3), np.eye(3)])
    for opposite, face in enumerate(FACES):
        a, b, c = corner[face]
        assert opposite not in face
        assert np.dot(np.cross(b - a, c - a), a - corner[opposite]) > 0


def test_parts_are_the_connected_pieces() -> None:
    a, b = block_mesh((1, 1, 1)), block_mesh((1, 1, 1), start=(1.0, 0.0, 0.0))
    both = TetMesh(np.vstack([a.nodes, b.nodes]), np.vstack([a.tets, b.tets + len(a.nodes)]))
    parts = body_parts(both)
    assert (parts == np.repeat([0, 1], len(a.nodes))).all() or (parts == np.repeat([1, 0], len(a.nodes))).all()


@pytest.mark.parametrize(("at", "parts"), [((1.0, 0.0, 0.0), 1), ((1.0, 1.0, 0.0), 2), ((1.0, 1.0, 1.0), 2)])
def test_parts_that_share_an_edge_or_a_corner_swing(at: tuple[float, float, float], parts: int) -> None:
    a, b = block_mesh((2, 2, 2), (1, 1, 1)), block_mesh((2, 2, 2), (1, 1, 1), start=at)
    nodes, same = np.unique(np.vstack([a.nodes, b.nodes]), axis=0, return_inverse=True)
    both = TetMesh(nodes, same.reshape(-1)[np.vstack([a.tets, b.tets + len(a.nodes)])])
    assert body_parts(both).max() == 0
    for mesh in (both, to_quadratic(both)):
        assert len(np.unique(hinged_parts(mesh))) == parts
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        check_mesh(both, "boxes")
    assert [str(note.message) for note in noted] == [
        "boxes: 2 parts of [48, 48] tetrahedra hang together by an edge or a corner alone and swing about it"
    ] * (parts - 1)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda x, t: (x, t[:, [1, 0, 2, 3]]), "inverted tetrahedra"),
        (lambda x, t: (x * [1, 1, 0], t), "without volume"),
        (lambda x, t: (np.vstack([x, [[9, 9, 9]]]), t), "belong to no tetrahedron"),
        (lambda x, t: (np.vstack([x, x + 5]), np.vstack([t, t + len(x)])), "2 parts"),
    ],
)
def test_meshes_that_cannot_serve(change: object, text: str) -> None:
    mesh = block_mesh((1, 1, 1))
    broken = TetMesh(*change(np.asarray(mesh.nodes), np.asarray(mesh.tets)))  # type: ignore[operator]
    with pytest.raises(InputError) as error:
        check_mesh(broken, "some.vtu")
    assert text in str(error.value) and "some.vtu" in str(error.value)


@pytest.mark.parametrize(
    ("nodes", "tets", "text"),
    [
        (np.zeros((4, 3)), [[0, 1, 2]], "wrong shape"),
        (np.zeros((4, 3)), [[0, 1, 2, 4]], "does not exist"),
        (np.zeros((4, 2)), [[0, 1, 2, 3]], "wrong shape"),
        (np.full((4, 3), np.nan), [[0, 1, 2, 3]], "finite"),
    ],
)
def test_arrays_that_are_no_mesh(nodes: np.ndarray, tets: list[list[int]], text: str) -> None:
    with pytest.raises(InputError, match=text):
        TetMesh(nodes, tets)  # type: ignore[arg-type]


# Shape functions


@pytest.mark.parametrize("quadratic", [False, True])
def test_shape_functions_are_one_at_their_node_and_sum_to_one(quadratic: bool) -> None:
    L = np.eye(4) if not quadratic else np.vstack([np.eye(4), np.eye(4)[EDGES].mean(axis=1)])
    np.testing.assert_allclose(shape_values(L, quadratic=quadratic), np.eye(len(L)), atol=1e-15)
    anywhere = np.random.default_rng(0).dirichlet(np.ones(4), 20)
    np.testing.assert_allclose(shape_values(anywhere, quadratic=quadratic).sum(axis=1), 1.0)


@pytest.mark.parametrize("quadratic", [False, True])
def test_shape_slopes_are_differences_of_the_shape_functions(quadratic: bool) -> None:
    L = np.random.default_rng(1).dirichlet(np.ones(4), 10)
    slopes = shape_slopes(L, quadratic=quadratic)
    for j in range(4):
        step = 1e-6 * np.eye(4)[j]
        difference = shape_values(L + step, quadratic=quadratic) - shape_values(L - step, quadratic=quadratic)
        np.testing.assert_allclose(slopes[:, :, j], difference / 2e-6, atol=1e-8)


# Embedded points


@pytest.mark.parametrize("quadratic", [False, True])
@pytest.mark.parametrize("rule", ["nearest_element", "nearest_centre"])
def test_embedded_points_follow_linear_fields_inside_and_outside(quadratic: bool, rule: str) -> None:
    mesh, rng = crooked(quadratic), np.random.default_rng(2)
    points = np.vstack([inside_points(mesh), rng.uniform(-0.02, 0.12, (30, 3))])
    at = embed_points(mesh, points, outside_rule=rule)
    A = rng.normal(0, 1, (3, 3))
    np.testing.assert_allclose(at.weights.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(at.positions(mesh.nodes @ A.T + 0.3), points @ A.T + 0.3, atol=1e-12)


def test_weights_that_are_rounding_are_none() -> None:
    mesh = crooked(quadratic=True)
    corners = mesh.nodes[mesh.tets[:, :4]]
    weights = np.abs(embed_points(mesh, corners.reshape(-1, 3)).weights)
    assert ((weights == 0.0) | (weights > 1e-12)).all() and (weights == 0.0).mean() > 0.5


def test_embedded_points_follow_quadratic_fields_in_quadratic_elements() -> None:
    mesh, rng = crooked(quadratic=True), np.random.default_rng(3)
    points, C = inside_points(mesh), rng.normal(0, 1, (10, 3))
    field = lambda x: np.array([monomials(p, True) @ C for p in x])  # noqa: E731
    np.testing.assert_allclose(embed_points(mesh, points).positions(field(mesh.nodes)), field(points), atol=1e-12)


@pytest.mark.parametrize("quadratic", [False, True])
def test_a_point_outside_follows_the_first_order_field_of_its_element(quadratic: bool) -> None:
    mesh, rng = crooked(quadratic), np.random.default_rng(4)
    x = mesh.nodes + rng.normal(0, 1e-3, mesh.nodes.shape)
    point = np.array([[0.05, 0.015, 0.045]])
    at = embed_points(mesh, point)
    foot = closest_in_tet(mesh.nodes[mesh.tets[at.element, :4]], point)
    tie = Embedding(mesh.tets[at.element], shape_values(foot, quadratic=quadratic), at.element, np.zeros(1))
    slope = barycentric(mesh, at.element, point) - foot
    gradient = np.einsum("pkl,pl,pkc->pc", shape_slopes(foot, quadratic=quadratic), slope, x[mesh.tets[at.element]])
    np.testing.assert_allclose(at.positions(x), tie.positions(x) + gradient, atol=1e-14)


def test_of_elements_that_are_as_near_rounding_does_not_choose() -> None:
    """A body that grows by nothing to speak of carries a load beside it with the same element:
    derivatives by its size hold on to that."""
    length, half = 0.1, 0.01
    mesh = block_mesh((7, 2, 2), (length, 2 * half, 2 * half), start=(0.0, -half, -half))
    beside = np.array(
        [[0.75 * length, 0.0, 1.03 * half], [3 / 7 * length, 0.0, 1.03 * half], [3 / 7 * length, -1.03 * half, 1.03 * half]]
    )
    scales = 1.0 + 1e-7 * np.arange(-20, 21)
    carriers = {tuple(embed_points(replace(mesh, nodes=mesh.nodes * s), beside).element) for s in scales}
    assert len(carriers) == 1


def test_distance_outside_is_that_to_the_box() -> None:
    mesh, rng = block_mesh((3, 2, 2), SIZE), np.random.default_rng(5)
    points = rng.uniform(-0.03, 0.13, (60, 3))
    distance = np.linalg.norm(np.maximum(np.maximum(-points, points - SIZE), 0), axis=1)
    np.testing.assert_allclose(embed_points(mesh, points).outside, distance, atol=1e-12)


def test_the_nearest_element_carries_a_marker_and_the_nearest_centre_a_cable() -> None:
    mesh, rng = crooked(), np.random.default_rng(6)
    points = rng.uniform(-0.03, 0.13, (40, 3))
    outside = embed_points(mesh, points).outside > 1e-6
    corners = mesh.nodes[mesh.tets]
    for point, element in zip(points[outside], embed_points(mesh, points).element[outside]):
        weights = closest_in_tet(corners, np.broadcast_to(point, (len(corners), 3)))
        distance = np.linalg.norm(np.einsum("pi,pic->pc", weights, corners) - point, axis=1)
        assert distance[element] == pytest.approx(distance.min(), abs=1e-12)
    chosen = embed_points(mesh, points[outside], outside_rule="nearest_centre").element
    centres = corners.mean(axis=1)
    assert (chosen == np.linalg.norm(points[outside][:, None] - centres, axis=2).argmin(axis=1)).all()


def test_spreading_forces_keeps_force_moment_and_work() -> None:
    mesh, rng = crooked(quadratic=True), np.random.default_rng(7)
    points, forces = rng.uniform(-0.01, 0.1, (20, 3)), rng.normal(0, 1, (20, 3))
    at = embed_points(mesh, points)
    nodal = at.spread(forces, len(mesh.nodes))
    np.testing.assert_allclose(nodal.sum(axis=0), forces.sum(axis=0), atol=1e-12)
    np.testing.assert_allclose(np.cross(mesh.nodes, nodal).sum(axis=0), np.cross(points, forces).sum(axis=0), atol=1e-12)
    u = rng.normal(0, 1, mesh.nodes.shape)
    assert (nodal * u).sum() == pytest.approx((forces * at.positions(u)).sum())


def test_part_of_an_embedding_is_the_embedding_of_a_part() -> None:
    mesh = crooked()
    points = inside_points(mesh, 6)
    whole = embed_points(mesh, points)
    np.testing.assert_array_equal(whole[2:4].positions(mesh.nodes), whole.positions(mesh.nodes)[2:4])
    np.testing.assert_array_equal(whole[3].positions(mesh.nodes)[0], whole.positions(mesh.nodes)[3])
    assert len(whole[np.array([True, False, True, False, False, True])]) == 3


def test_no_points_are_embedded_as_none() -> None:
    assert len(embed_points(crooked(), np.zeros((0, 3)))) == 0


# Closest points against brute force


@pytest.mark.parametrize("seed", range(3))
def test_closest_in_a_triangle_beats_every_sample_and_is_in_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners, points = rng.normal(0, 1, (40, 3, 3)), rng.normal(0, 2, (40, 3))
    corners[0, 2] = corners[0, 1]  # a needle
    weights = closest_in_triangle(corners, points)
    assert (weights >= -1e-12).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    found = np.linalg.norm(np.einsum("pi,pic->pc", weights, corners) - points, axis=1)
    g = np.linspace(0, 1, 41)
    sample = np.array([[a, b, 1 - a - b] for a in g for b in g if a + b <= 1 + 1e-12])
    best = np.linalg.norm(np.einsum("si,pic->psc", sample, corners) - points[:, None], axis=2).min(axis=1)
    assert (found <= best + 1e-12).all() and (best - found < 0.1).all()


@pytest.mark.parametrize("seed", range(3))
def test_closest_in_a_tetrahedron_beats_every_sample_and_is_in_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners, points = rng.normal(0, 1, (60, 4, 3)), rng.normal(0, 1.2, (60, 3))
    weights = closest_in_tet(corners, points)
    assert (weights >= -1e-12).all()
    found = np.linalg.norm(np.einsum("pi,pic->pc", weights, corners) - points, axis=1)
    g = np.linspace(0, 1, 15)
    sample = np.array([[a, b, c, 1 - a - b - c] for a in g for b in g for c in g if a + b + c <= 1 + 1e-12])
    best = np.linalg.norm(np.einsum("si,pic->psc", sample, corners) - points[:, None], axis=2).min(axis=1)
    assert (found <= best + 1e-12).all() and (best - found < 0.2).all()
    inside = np.einsum("pk,pkc->pc", rng.dirichlet(np.ones(4), 60), corners)
    np.testing.assert_allclose(np.einsum("pi,pic->pc", closest_in_tet(corners, inside), corners), inside, atol=1e-10)


# Stencil


@pytest.mark.parametrize("quadratic", [False, True])
def test_node_volumes_sum_to_the_volume_and_carry_its_centre(quadratic: bool) -> None:
    mesh = crooked(quadratic)
    stencil, _ = make_stencil(mesh)
    volumes = element_volumes(mesh)
    assert stencil.node_volume.sum() == pytest.approx(volumes.sum(), rel=1e-12)
    assert stencil.volumes.sum() == pytest.approx(volumes.sum(), rel=1e-12)
    centre = volumes @ mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
    np.testing.assert_allclose(stencil.node_volume @ mesh.nodes, centre, atol=1e-15)  # work of the weight is exact


def test_node_volumes_of_a_quadratic_element_are_those_of_the_books() -> None:
    stencil, _ = make_stencil(to_quadratic(TetMesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]])))
    np.testing.assert_allclose(stencil.node_volume[:4], -1 / 6 / 20, atol=1e-15)
    np.testing.assert_allclose(stencil.node_volume[4:], 1 / 6 / 5, atol=1e-15)


@pytest.mark.parametrize("quadratic", [False, True])
def test_gradients_reproduce_an_affine_map(quadratic: bool) -> None:
    mesh = crooked(quadratic)
    stencil, _ = make_stencil(mesh)
    F = random_rotation(np.random.default_rng(0)) * 1.3
    x = mesh.nodes @ F.T + 2.0
    found = np.einsum("mac,mqja->mqcj", x[stencil.tets], stencil.gradients)
    np.testing.assert_allclose(found, np.broadcast_to(F, found.shape), atol=1e-10)


def test_the_pattern_couples_nodes_of_an_element_and_of_a_clique_only() -> None:
    mesh = crooked()
    clique = np.array([[0, 20, 35]])
    stencil, slots = make_stencil(mesh, [clique])
    n = len(mesh.nodes)
    coupled = np.zeros((n, n), dtype=bool)
    for group in [*mesh.tets, *clique]:
        coupled[np.ix_(group, group)] = True
    rows, columns = block_row_numbers(stencil), stencil.block_columns
    assert (np.argwhere(np.triu(coupled)) == np.stack([rows, columns[:-1]], axis=1)).all() and columns[-1] == -1
    assert (stencil.tets == np.sort(mesh.tets, axis=1)).all()
    first, second = np.triu_indices(4)
    assert (rows[stencil.slots] == stencil.tets[:, first]).all() and (columns[stencil.slots] == stencil.tets[:, second]).all()
    for i, a in enumerate(clique[0]):
        for j, b in enumerate(clique[0]):
            place = slots[0][0, i, j]
            assert place == len(rows) if a > b else rows[place] == a and columns[place] == b


def test_the_free_map_leaves_out_fixed_nodes_and_finds_every_entry() -> None:
    mesh = crooked()
    stencil, _ = make_stencil(mesh)
    fixed = np.array([0, 5, 17])
    free = make_free_map(stencil, mesh, fixed)
    assert sorted(free.dofs.tolist()) == [3 * i + c for i in range(len(mesh.nodes)) if i not in fixed for c in range(3)]
    block, place = np.divmod(free.source, 9)
    row, column = 3 * block_row_numbers(stencil)[block] + place // 3, 3 * stencil.block_columns[block] + place % 3
    i = free.dofs[free.pattern.indices]
    j = free.dofs[np.repeat(np.arange(free.pattern.size), np.diff(free.pattern.indptr))]
    assert (((i == row) & (j == column)) | ((i == column) & (j == row))).all()
    assert (np.diff(free.pattern.indices)[np.diff(j) == 0] > 0).all()  # sorted within each column
