"""Surfaces as they come: what is mended, what is refused and with which words, cavities and separate bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from femsense.core.errors import InputError
from femsense.io.meshing.surface import ClosedSurface, repaired
from femsense.io.meshing.surface_queries import crossing_triangles, distance_to, wall_thickness, winding_number
from femsense.io.meshing.thinning import MOST_TRIANGLES, thinned

BOX = trimesh.creation.box((100, 30, 30))
TUBE = trimesh.creation.cylinder(10, 100, sections=32)
CAPSULE = trimesh.creation.capsule(80, 12, count=[24, 24])


def mended(*meshes: Any, **options: Any) -> ClosedSurface:
    mesh = trimesh.util.concatenate(list(meshes))
    return repaired(np.array(mesh.vertices), np.array(mesh.faces), **options)


def box(extents: tuple[float, float, float], *, at: tuple[float, float, float] = (0, 0, 0), inward: bool = False) -> Any:
    made = trimesh.creation.box(extents)
    made.apply_translation(at)
    if inward:
        made.invert()
    return made


def open_tube() -> tuple[np.ndarray, np.ndarray]:
    return np.array(TUBE.vertices), np.array(TUBE.faces)[np.abs(TUBE.face_normals[:, 2]) < 0.5]


def test_a_good_surface_stays_as_it_is() -> None:
    surface = mended(BOX)
    assert surface.done == () and surface.cavities == 0
    assert surface.volume == pytest.approx(9e4) and surface.area == pytest.approx(2 * (2 * 3000 + 900))


@pytest.mark.parametrize("spoil", ["inside out", "every third turned", "soup", "twice", "degenerate", "seam"])
def test_what_is_mended(spoil: str) -> None:
    points, triangles = np.array(BOX.vertices, dtype=float), np.array(BOX.faces)
    if spoil == "inside out":
        triangles = triangles[:, ::-1]
    elif spoil == "every third turned":
        triangles[::3] = triangles[::3, ::-1]
    elif spoil == "soup":
        points, triangles = points[triangles].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    elif spoil == "twice":
        triangles = np.vstack([triangles, triangles[3:5]])
    elif spoil == "degenerate":
        triangles = np.vstack([triangles, [[0, 0, 1]]])
    else:
        points = points[triangles].reshape(-1, 3) + np.random.default_rng(0).uniform(-2e-4, 2e-4, (36, 3))
        triangles = np.arange(36).reshape(-1, 3)
    surface = repaired(points, triangles)
    assert len(surface.triangles) == 12 and surface.volume == pytest.approx(9e4, rel=1e-4)
    said = {
        "inside out": "inside out",
        "every third turned": "4 of 12 triangles were turned",
        "twice": "2 triangles that stood twice",
        "degenerate": "1 triangles without area",
        "seam": "welded",
        "soup": "",
    }[spoil]
    assert said in " ".join(surface.done) and len(surface.done) == (spoil != "soup")


def test_small_holes_are_closed_and_said() -> None:
    keep = np.setdiff1d(np.arange(len(CAPSULE.faces)), [100, 101, 400])
    surface = repaired(np.array(CAPSULE.vertices), np.array(CAPSULE.faces)[keep])
    assert surface.volume == pytest.approx(CAPSULE.volume, rel=1e-3)
    assert surface.done[0].startswith("2 holes were closed; the longest border is 7.6")


def test_a_sheet_that_hangs_on_the_body_is_left_out() -> None:
    """A fin along an edge: two triangles whose open sides do not come round."""
    points, faces = np.array(BOX.vertices), np.array(BOX.faces)
    a, b = np.flatnonzero((points[:, 1] > 0) & (points[:, 2] > 0))
    fin = np.vstack([points, points[[a, b]] + [0, 0, 30]])
    surface = repaired(fin, np.vstack([faces, [[a, b, 9], [a, 9, 8]]]))
    assert surface.volume == pytest.approx(9e4) and surface.done == ("1 sheets of 2 triangles attached to the body were removed",)
    fin[8:] += [0, 0, 200]
    with pytest.raises(InputError, match="3 edges of one triangle that go round no hole"):
        repaired(fin, np.vstack([faces, [[a, b, 9], [a, 9, 8]]]))


def test_an_open_tube_is_refused_until_it_may_be_closed() -> None:
    with pytest.raises(InputError, match="the surface is open") as error:
        repaired(*open_tube(), unit="mm")
    assert "2 large holes of 2; the largest has a border of 62.73 mm around [0, " in str(error.value)
    assert "--close-holes" in str(error.value)
    assert repaired(*open_tube(), close_holes=True).volume == pytest.approx(TUBE.volume)


@pytest.mark.parametrize("inward", [True, False])
def test_an_inner_shell_is_a_cavity_whichever_way_it_faces(inward: bool) -> None:
    surface = mended(BOX, box((80, 10, 10), inward=inward))
    assert surface.cavities == 1 and surface.volume == pytest.approx(9e4 - 8e3)
    assert surface.done[-1] == "1 inner shells are kept as cavities"
    corners = surface.points[surface.triangles]
    np.testing.assert_allclose(
        winding_number(corners, np.array([[0.1, 0.2, 0.3], [45.0, 1.0, 2.0], [99.0, 0.0, 0.0]])), [0, 1, 0], atol=1e-9
    )
    filled = mended(BOX, box((80, 10, 10), inward=inward), fill_cavities=True)
    assert filled.cavities == 0 and filled.volume == pytest.approx(9e4) and "1 cavities were filled" in filled.done


def test_separate_bodies_are_named_and_one_can_be_taken() -> None:
    two = (BOX, box((20, 20, 20), at=(200, 0, 0)))
    with pytest.raises(InputError, match="several separate bodies") as error:
        mended(*two, unit="mm")
    assert "1: 100 × 30 × 30 mm around [0, 0, 0]; 2: 20 × 20 × 20 mm around [200, 0, 0]" in str(error.value)
    assert mended(*two, part=1).volume == pytest.approx(9e4) and mended(*two, part=2).volume == pytest.approx(8e3)
    with pytest.raises(InputError, match="no such part"):
        mended(*two, part=3)


def test_a_body_in_a_cavity_is_another_body() -> None:
    shells = (BOX, box((80, 10, 10)), box((10, 5, 5)))
    with pytest.raises(InputError, match="several separate bodies"):
        mended(*shells)
    assert mended(*shells, part=1).volume == pytest.approx(9e4 - 8e3)


@pytest.mark.parametrize(
    ("extents", "at"), [((20, 20, 60), (10, 0, 20)), ((20, 20, 20), (60, 0, 0))], ids=["crossing", "touching"]
)
def test_shells_that_meet_are_one_body(extents: tuple[float, float, float], at: tuple[float, float, float]) -> None:
    surface = mended(BOX, box(extents, at=at))
    assert len(surface.triangles) == 24 and surface.cavities == 0


def test_crossing_triangles_are_found() -> None:
    assert not len(crossing_triangles(np.array(CAPSULE.vertices), np.array(CAPSULE.faces)))
    both = trimesh.util.concatenate([BOX, box((20, 20, 60), at=(10, 0, 20))])
    pairs = crossing_triangles(np.array(both.vertices), np.array(both.faces))
    assert len(pairs) and ((pairs[:, 0] < 12) != (pairs[:, 1] < 12)).all()


def test_crumbs_are_left_out() -> None:
    surface = mended(BOX, box((0.1, 0.1, 0.1), at=(200, 0, 0)))
    assert len(surface.triangles) == 12 and surface.done == ("1 shells of negligible volume were removed",)


def test_many_bubbles_are_separated_and_too_many_pieces_are_refused() -> None:
    places = np.stack(np.meshgrid(np.linspace(-45, 45, 10), [-10, 0, 10], [-10, 0, 10]), axis=-1).reshape(-1, 3)
    surface = mended(BOX, *(box((2, 2, 2), at=tuple(place)) for place in places))
    assert surface.cavities == 90 and surface.volume == pytest.approx(9e4 - 90 * 8)
    with pytest.raises(InputError, match=r"(?s)too many pieces.*91 pieces of 12\.0 triangles"):
        mended(BOX, *(box((2, 2, 2), at=tuple(place)) for place in places), most_shells=50)


def test_what_encloses_nothing() -> None:
    with pytest.raises(InputError, match="encloses nothing"):
        mended(box((100, 30, 1e-12)))
    with pytest.raises(InputError, match="not finite"):
        repaired(np.array([[0, 0, 0], [1, 0, np.nan], [0, 1, 0], [0, 0, 1.0]]), np.array([[0, 1, 2]]))


def test_a_moebius_strip_has_one_side() -> None:
    turn = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    wide = np.array([-1.0, 1.0])
    radius = 10 + wide[None] * np.cos(turn / 2)[:, None]
    points = np.stack(
        [radius * np.cos(turn)[:, None], radius * np.sin(turn)[:, None], wide[None] * np.sin(turn / 2)[:, None]], axis=2
    )
    ahead = [(2 * k + 2, 2 * k + 3) if k < 19 else (1, 0) for k in range(20)]
    triangles = [t for k, (c, d) in enumerate(ahead) for t in ([2 * k, c, 2 * k + 1], [2 * k + 1, c, d])]
    with pytest.raises(InputError, match="only one side"):
        repaired(points.reshape(-1, 3), np.array(triangles))


def test_distances_and_walls() -> None:
    points, triangles = np.array(BOX.vertices, dtype=float), np.array(BOX.faces)
    np.testing.assert_allclose(distance_to(points, triangles, np.array([[0, 0, 20.0], [53, 19, 0], [0, 0, 14.0]])), [5, 5, 1])
    way = wall_thickness(points, triangles, np.array([[0.0, 0, 15], [0, 15, 0]]), np.array([[0.0, 0, -1], [0, -1, 0]]))
    np.testing.assert_allclose(way, 30.0, rtol=1e-5)


def test_a_fine_surface_is_thinned_within_its_tolerance() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=30.0)
    surface = mended(ball)
    thin, outliers = thinned(surface, tolerance=0.2, enough=1000)
    assert len(thin.triangles) <= 2000 and 0 < outliers <= 0.2
    assert thin.volume == pytest.approx(surface.volume, rel=0.01)
    assert f"thinned out from 20480 to {len(thin.triangles)} triangles" in thin.done
    distances = np.abs(np.linalg.norm(thin.points, axis=1) - 30.0)
    assert distances.max() <= 0.2
    assert thinned(surface, tolerance=1e-6, enough=1000) == (surface, 0.0)
    again, same = thinned(surface, tolerance=0.2, start=thin, enough=1000)
    assert again is thin and same == outliers


def test_a_scan_rougher_than_the_tolerance_is_thinned_all_the_same() -> None:
    ball = trimesh.creation.icosphere(subdivisions=6, radius=30.0)
    rough = np.array(ball.vertices) * (1.0 + 0.01 * np.random.default_rng(3).normal(size=(len(ball.vertices), 1)))
    surface = repaired(rough, np.array(ball.faces))
    thin, away = thinned(surface, tolerance=1e-3)
    assert len(surface.triangles) > 80_000 and len(thin.triangles) <= MOST_TRIANGLES and away > 1e-3
    assert thin.volume == pytest.approx(surface.volume, rel=0.01)
