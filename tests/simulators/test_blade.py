"""The closed form of the blade against its own mesh, quadrature, and the numbers it was given."""

import manifold3d
import numpy as np
import pytest

from simulators.blade import (
    BladeShape,
    Surface,
    Wear,
    blade_solid,
    section_curve,
    section_thetas,
    worn_surface,
)
from simulators.sections import centroid_mm, chord_mm, max_thickness_mm, orientation_deg
from simulators.solids import Floats, loop_area_mm2, slice_loops, to_manifold

STILL = np.eye(4)
SHAPE = BladeShape()


def area_by_quadrature(surface: Surface, z_mm: float) -> float:
    """Half the integral of x dy - y dx round the section; a periodic integrand needs no weights."""
    theta = np.linspace(0.0, 2.0 * np.pi, 20000, endpoint=False)
    points = surface(theta, np.full(len(theta), z_mm))[:, :2]
    wave = np.fft.fftfreq(len(theta), 1.0 / len(theta))[:, None]
    slope = np.fft.ifft(1j * wave * np.fft.fft(points, axis=0), axis=0).real
    cross = points[:, 0] * slope[:, 1] - points[:, 1] * slope[:, 0]
    return float(0.5 * cross.mean() * 2.0 * np.pi)


def volume_by_quadrature(surface: Surface) -> float:
    nodes, weights = np.polynomial.legendre.leggauss(24)
    half = 0.5 * SHAPE.span_mm
    return float(
        half
        * sum(w * area_by_quadrature(surface, half * (1.0 + x)) for x, w in zip(nodes, weights, strict=True))
    )


@pytest.mark.parametrize("wear", [None, Wear(wave_mm=0.0, bend_mm=0.3, untwist_deg=0.3, seed=3)])
def test_the_mesh_is_a_manifold_with_the_volume_of_the_sections(wear: Wear | None) -> None:
    surface = SHAPE.surface if wear is None else worn_surface(SHAPE, wear)
    solid = blade_solid(SHAPE, surface)
    manifold = to_manifold(solid)
    assert manifold.status() == manifold3d.Error.NoError
    assert manifold.genus() == 0
    assert manifold.volume() == pytest.approx(volume_by_quadrature(surface), rel=2e-4)


def test_the_overall_sizes_are_those_of_the_thesis() -> None:
    solid = blade_solid(SHAPE, SHAPE.surface)
    x, y, z = np.ptp(solid.vertices_mm, axis=0)
    assert z == 105.0
    assert 43.0 < x < 46.0
    assert 12.0 < y < 15.0
    assert centroid_mm(section_curve(SHAPE.surface, 0.0, STILL)) == pytest.approx([0.0, 0.0], abs=1e-6)


def test_the_edges_have_their_radii() -> None:
    step = np.array([-1e-3, 0.0, 1e-3])
    for theta, radius in ((0.0, SHAPE.le_radius_mm), (np.pi, SHAPE.te_radius_mm)):
        a, b, c = SHAPE.surface(theta + step, np.full(3, 50.0))[:, :2]
        twice_area = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
        sides = np.linalg.norm(b - a) * np.linalg.norm(c - b) * np.linalg.norm(c - a)
        assert sides / (2.0 * twice_area) == pytest.approx(radius, rel=0.02)


def test_the_sections_turn_by_the_twist() -> None:
    even = BladeShape(chord_taper=0.0, thickness_taper=0.0, twist_growth=0.0)
    bottom, top = (section_curve(even.surface, z, STILL) for z in (0.0, 8.4))
    assert orientation_deg(bottom, top) == pytest.approx(25.0 * 8.4 / 105.0, abs=1e-3)


def test_no_facet_leaves_the_surface_by_a_micrometre() -> None:
    surface = worn_surface(SHAPE, Wear(seed=1))
    theta, z = section_thetas(480), np.linspace(0.0, SHAPE.span_mm, 211)
    corner = surface(*np.meshgrid(theta, z))
    beside = np.roll(corner, -1, axis=1)
    middle_theta = 0.5 * (theta + np.append(theta[1:], 2.0 * np.pi))
    grid = np.meshgrid(middle_theta, 0.5 * (z[1:] + z[:-1]))
    true, step = surface(*grid), 1e-4
    normal = np.cross(surface(grid[0] + step, grid[1]) - true, surface(grid[0], grid[1] + step) - true)
    normal /= np.linalg.norm(normal, axis=-1)[..., None]
    for diagonal in (corner[:-1] + beside[1:], beside[:-1] + corner[1:]):
        assert np.abs(((0.5 * diagonal - true) * normal).sum(axis=-1)).max() < 1e-3


def test_a_slice_of_the_mesh_is_the_section_in_closed_form() -> None:
    solid = blade_solid(SHAPE, SHAPE.surface)
    (loop,) = slice_loops(solid, 52.3)
    curve = section_curve(SHAPE.surface, 52.3, STILL)
    assert loop_area_mm2(loop) == pytest.approx(loop_area_mm2(curve), rel=2e-4)
    assert centroid_mm(loop) == pytest.approx(centroid_mm(curve), abs=5e-4)
    assert max_thickness_mm(loop) == pytest.approx(max_thickness_mm(curve), abs=2e-3)


def test_the_thesis_wear_is_a_few_hundredths() -> None:
    wear = Wear(seed=5)
    theta = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    offset = wear.offset_mm(*np.meshgrid(theta, np.linspace(0.0, 1.0, 200)))
    assert 0.01 < np.abs(offset).mean() < 0.03
    assert 0.06 < np.abs(offset).max() < 0.11


def test_a_thicker_blade_is_thicker_by_twice_the_offset() -> None:
    thick = worn_surface(SHAPE, Wear(wave_mm=0.0, bump_mm=0.0, thicker_mm=0.05))
    old, new = (section_curve(surface, 60.0, STILL) for surface in (SHAPE.surface, thick))
    assert max_thickness_mm(new) - max_thickness_mm(old) == pytest.approx(0.1, abs=1e-4)
    assert chord_mm(new) - chord_mm(old) == pytest.approx(0.1, abs=1e-4)


def test_bending_and_untwisting_move_a_section_as_stated() -> None:
    bent = worn_surface(SHAPE, Wear(wave_mm=0.0, bump_mm=0.0, bend_mm=0.4, untwist_deg=0.5))
    old, new = (section_curve(surface, 84.0, STILL) for surface in (SHAPE.surface, bent))
    share = (84.0 / 105.0) ** 2
    assert centroid_mm(new) - centroid_mm(old) == pytest.approx([0.0, 0.4 * share], abs=1e-6)
    assert orientation_deg(old, new) == pytest.approx(-0.5 * share, abs=1e-4)


def test_a_section_follows_a_tilted_blade() -> None:
    tilt = np.radians(0.5)
    T = np.eye(4)
    T[1:3, 1:3] = [[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]
    T[2, 3] = 0.7
    curve: Floats = section_curve(SHAPE.surface, 50.0, T)
    (loop,) = slice_loops(blade_solid(SHAPE, SHAPE.surface).moved(T), 50.0)
    assert centroid_mm(curve) == pytest.approx(centroid_mm(loop), abs=5e-4)


def test_a_rounded_tip_loses_its_edge_and_stays_closed() -> None:
    shape = BladeShape(tip_rounding_mm=0.25)
    solid = blade_solid(shape, shape.surface)
    sharp = blade_solid(SHAPE, SHAPE.surface)
    assert to_manifold(solid).genus() == 0
    perimeter = 2.0 * 39.5  # of a thin section about 38.3 mm long
    lost = (1.0 - np.pi / 4.0) * 0.25**2 * perimeter
    assert sharp.volume_mm3 - solid.volume_mm3 == pytest.approx(lost, rel=0.1)
    assert solid.vertices_mm[:, 2].max() == 105.0


@pytest.mark.parametrize("bad", [{"chord_mm": 0.0}, {"span_mm": float("nan")}, {"tip_rounding_mm": 0.5}])
def test_a_shape_that_cannot_be_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="blade"):
        BladeShape(**bad)
