"""Damages on a straight prism, whose sections, edges and normals are known."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage.measure import points_in_poly

from simulators.airfoils import Airfoil, find_airfoil
from simulators.blade import BladeShape, blade_solid
from simulators.cutters import Cut, edge_nick, eroded_edge, pit, tip_corner, tip_loss
from simulators.damage_solids import break_off
from simulators.solids import Floats, NotASolid, Solid, loop_area_mm2, slice_loops, to_manifold

LENGTH_MM, HALF_CHORD_MM = 60.0, 15.0


def prism_surface(theta: Floats, z_mm: Floats) -> Floats:
    """Nose toward -x and fatter, bulging toward +y."""
    x = -HALF_CHORD_MM * np.cos(theta)
    y = -2.0 * np.sin(theta) * (1.0 + 0.3 * np.cos(theta)) + 0.006 * (HALF_CHORD_MM**2 - x**2)
    return np.stack(np.broadcast_arrays(x, y, z_mm), axis=-1)


@cache
def prism() -> Airfoil:
    solid = blade_solid(BladeShape(span_mm=LENGTH_MM), prism_surface, around=240, along=61)
    return find_airfoil(solid, 3.0)


def new_vertices(before: Solid, after: Solid) -> Floats:
    """The vertices that the damage made: not those of the blade, and below its skin."""
    distance = cKDTree(before.vertices_mm).query(after.vertices_mm)[0]
    return after.vertices_mm[distance > 1e-9]


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_the_edges_of_the_prism_are_found() -> None:
    airfoil = prism()
    assert airfoil.le_mm[:, 0] == pytest.approx(-HALF_CHORD_MM, abs=0.02)
    assert airfoil.te_mm[:, 0] == pytest.approx(HALF_CHORD_MM, abs=0.02)
    assert airfoil.frame(30.0).toward_suction == pytest.approx([0.0, 1.0], abs=0.01)


def test_what_is_removed_is_what_is_missing() -> None:
    airfoil = prism()
    cuts = [
        tip_corner(airfoil, 9.0, 0.6, rng()),
        edge_nick(airfoil, "leading_edge", 0.5, 1.5, 6.0, rng()),
        edge_nick(airfoil, "trailing_edge", 0.3, 1.0, 5.0, rng()),
        pit(airfoil, 0.4, 0.5, 0.8, 2.5, rng()),
    ]
    after, truths = break_off(airfoil, cuts)
    lost = airfoil.solid.volume_mm3 - after.volume_mm3
    assert sum(truth.volume_mm3 for truth in truths) == pytest.approx(lost, rel=1e-9)
    assert [truth.zone for truth in truths] == ["tip", "leading_edge", "trailing_edge", "surface"]
    assert to_manifold(after).genus() == 0
    heights = np.linspace(0.01, LENGTH_MM - 0.01, 100)
    areas = [sum(loop_area_mm2(loop) for loop in slice_loops(after, float(z))) for z in heights]
    assert np.trapezoid(areas, heights) == pytest.approx(after.volume_mm3, rel=2e-3)


def test_a_lost_tip_is_area_times_depth() -> None:
    airfoil = prism()
    after, (truth,) = break_off(airfoil, [tip_loss(airfoil, 7.0, rng())])
    area = loop_area_mm2(slice_loops(airfoil.solid, 30.0)[0])
    assert truth.volume_mm3 == pytest.approx(7.0 * area, rel=0.1)
    assert truth.depth_mm == pytest.approx(LENGTH_MM - new_vertices(airfoil.solid, after)[:, 2].min())
    assert truth.z_high_mm == LENGTH_MM
    assert truth.depth_mm == pytest.approx(7.0, abs=1.2)


def test_a_broken_corner_leaves_the_leading_half_of_the_tip() -> None:
    airfoil = prism()
    after, (truth,) = break_off(airfoil, [tip_corner(airfoil, 9.0, 0.6, rng())])
    at_tip = after.vertices_mm[after.vertices_mm[:, 2] == LENGTH_MM]
    assert at_tip[:, 0].min() == pytest.approx(-HALF_CHORD_MM, abs=0.02)
    assert at_tip[:, 0].max() == pytest.approx(-HALF_CHORD_MM + 0.6 * 30.0, abs=1.5)
    assert truth.depth_mm == pytest.approx(9.0, abs=1.2)
    assert truth.centroid_mm[0] > 5.0


@pytest.mark.parametrize(("zone", "sign"), [("leading_edge", 1.0), ("trailing_edge", -1.0)])
def test_the_depth_of_a_nick_is_how_far_the_edge_went_back(zone: str, sign: float) -> None:
    airfoil = prism()
    cut = edge_nick(airfoil, zone, 0.5, 1.5, 6.0, rng())  # type: ignore[arg-type]
    after, (truth,) = break_off(airfoil, [cut])
    heights = np.linspace(truth.z_low_mm, truth.z_high_mm, 100)[1:-1]
    edges = [(sign * slice_loops(after, float(z))[0][:, 0]).min() for z in heights]
    assert truth.depth_mm == pytest.approx(max(edges) + HALF_CHORD_MM, abs=0.02)
    assert truth.depth_mm == pytest.approx(1.5, abs=0.15)
    assert truth.z_high_mm - truth.z_low_mm == pytest.approx(6.0, abs=0.6)


@pytest.mark.parametrize(("zone", "sign"), [("leading_edge", 1.0), ("trailing_edge", -1.0)])
def test_an_eroded_edge_goes_back_evenly_and_runs_out_at_both_ends(zone: str, sign: float) -> None:
    airfoil = prism()
    cut = eroded_edge(airfoil, zone, (0.2, 0.8), 0.6, rng())  # type: ignore[arg-type]
    after, (truth,) = break_off(airfoil, [cut])
    heights = np.linspace(14.5, 48.5, 35)
    lost = np.array([(sign * slice_loops(after, float(z))[0][:, 0]).min() for z in heights]) + HALF_CHORD_MM
    assert lost[10:-10] == pytest.approx(0.6, abs=0.1)
    assert lost[[0, -1]] == pytest.approx(0.0, abs=0.15)
    assert truth.depth_mm == pytest.approx(lost.max(), abs=0.03)
    assert np.abs(np.diff(lost)).max() < 0.15
    assert truth.z_high_mm - truth.z_low_mm == pytest.approx(0.58 * (LENGTH_MM - 3.0), abs=1.5)


def fat_surface(theta: Floats, z_mm: Floats) -> Floats:
    """A thick nose that dives: its upper side rises as fast as it goes back."""
    x = -HALF_CHORD_MM * np.cos(theta)
    y = -3.0 * np.sin(theta) * (1.0 + 0.3 * np.cos(theta)) + 0.02 * (HALF_CHORD_MM**2 - x**2)
    return np.stack(np.broadcast_arrays(x, y, z_mm), axis=-1)


@pytest.mark.parametrize("depth_mm", [0.3, 0.8])
def test_an_eroded_edge_has_no_undercut_however_thick_it_is(depth_mm: float) -> None:
    solid = blade_solid(BladeShape(span_mm=LENGTH_MM), fat_surface, around=240, along=61)
    airfoil = find_airfoil(solid, 3.0)
    after, _ = break_off(airfoil, [eroded_edge(airfoil, "leading_edge", (0.2, 0.8), depth_mm, rng())])
    le, te = airfoil.edge_points_mm(30.0)
    outward = (le - te)[:2] / np.linalg.norm(le - te)
    left = slice_loops(after, 30.0)[0]
    worn = left[cKDTree(slice_loops(airfoil.solid, 30.0)[0]).query(left)[0] > 0.05]
    assert len(worn) > 10
    for step_mm in (0.1, 0.3, 1.0, 2.0):
        assert not points_in_poly(worn + step_mm * outward, left).any()


@pytest.mark.parametrize(("depth_mm", "radius_mm"), [(0.8, 2.5), (0.15, 1.0), (0.1, 2.0)])
@pytest.mark.parametrize("seed", range(1, 7))
def test_the_depth_of_a_pit_is_normal_to_the_surface(depth_mm: float, radius_mm: float, seed: int) -> None:
    """The rough rim of a shallow one leaves islands of skin that are lost, too: from none is it deep."""
    airfoil = prism()
    after, (truth,) = break_off(airfoil, [pit(airfoil, 0.5, 0.5, depth_mm, radius_mm, rng(seed))])
    theta, z = np.meshgrid(np.linspace(0.3, 2.8, 1500), np.linspace(26.0, 37.0, 600))
    skin = cKDTree(prism_surface(theta, z).reshape(-1, 3))
    depth = skin.query(new_vertices(airfoil.solid, after))[0].max()
    assert truth.depth_mm == pytest.approx(depth, abs=0.004)
    assert truth.depth_mm == pytest.approx(depth_mm, rel=0.15)
    assert truth.centroid_mm[1] < 1.0  # on the hollow side


def test_a_hole_is_as_deep_as_the_metal_is_thick() -> None:
    airfoil = prism()
    _, (truth,) = break_off(airfoil, [pit(airfoil, 0.5, 0.5, 9.0, 5.0, rng())])
    loop = slice_loops(airfoil.solid, 30.0)[0]
    middle = loop[np.abs(loop[:, 0]) < 0.3]
    assert truth.depth_mm == pytest.approx(np.ptp(middle[:, 1]), rel=0.15)


def test_a_pit_that_pierces_is_deep_from_the_side_that_it_came_from() -> None:
    """From the small skin lost on the other side its wide wall is farther than the metal is thick."""
    airfoil = prism()
    _, (truth,) = break_off(airfoil, [pit(airfoil, 0.5, 0.5, 4.3, 5.0, rng())])
    loop = slice_loops(airfoil.solid, 30.0)[0]
    thickest = np.ptp(loop[np.abs(loop[:, 0]) < 0.3, 1])
    assert truth.depth_mm == pytest.approx(thickest, abs=0.18)


def test_equal_seeds_break_alike_and_others_do_not() -> None:
    airfoil = prism()
    made = [break_off(airfoil, [pit(airfoil, 0.5, 0.5, 0.8, 2.5, rng(seed))])[1][0] for seed in (3, 3, 4)]
    assert made[0] == made[1]
    assert made[0].volume_mm3 != made[2].volume_mm3


def test_a_cut_that_misses_or_severs_is_refused() -> None:
    airfoil = prism()
    away = np.eye(4)
    away[2, 3] = LENGTH_MM
    with pytest.raises(NotASolid, match="misses"):
        break_off(airfoil, [Cut(zone="tip", cutter=tip_loss(airfoil, 7.0, rng()).cutter.moved(away))])
    deep = edge_nick(airfoil, "leading_edge", 0.5, 40.0, 8.0, rng())
    with pytest.raises(NotASolid, match="severs"):
        break_off(airfoil, [deep])
