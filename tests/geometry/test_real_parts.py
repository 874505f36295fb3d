"""Real parts as nominals, worn and damaged, from views to patches: a slice of `benchmarks.real_parts`."""

from functools import cache, partial

import numpy as np
import pytest

from geometry.blade.solid import check_solid
from geometry.registration.register import register
from geometry.scan.clean import clean
from geometry.scan.fuse import fuse
from geometry.transforms import apply, inverse
from geometry.types import Zone
from simulators.cutters import Cut, edge_nick, pit
from simulators.recipe import SIGMA_MM
from simulators.solids import loop_area_mm2, slice_loops, to_manifold
from simulators.wear import WornBlade
from tests.geometry import real_parts as real
from tests.geometry.captures import (
    Capture,
    Inspected,
    capture,
    displacement_mm,
    exact_axis,
    inspect,
    known_of,
    known_pose,
    nominal_of,
)

pytestmark = pytest.mark.skipif(not real.present(), reason="the real parts are not beside the project")

NOISE_MM = 0.01
PIXEL_MM = 0.45  # by the scale of the part


def nick(scale: float, worn: WornBlade, rng: np.random.Generator) -> Cut:
    return edge_nick(worn.airfoil, "leading_edge", 0.65, 1.5 * scale, 8.0 * scale, rng)


def hollow(scale: float, worn: WornBlade, rng: np.random.Generator) -> Cut:
    return pit(worn.airfoil, 0.4, 0.5, 1.2 * scale, 4.0 * scale, rng)


@cache
def inspected() -> tuple[Capture, Inspected]:
    """The turbine blade, worn, with a nick and a pit in proportion to its chord."""
    blade = real.turbine()
    cutters = [partial(cutter, blade.scale) for cutter in (nick, hollow)]
    taken = capture(blade, cutters, NOISE_MM, 1, exact_axis, PIXEL_MM * blade.scale)
    return taken, inspect(taken, nominal_of(blade), NOISE_MM)


@pytest.mark.parametrize("name", list(real.ROWS))
def test_a_lofted_row_is_a_solid_whose_sections_are_the_profiles(name: str) -> None:
    """Points of the inner profiles, which the mesh was not cut at, lie on it to the sagitta of its facets."""
    blade = real.row(name)
    assert to_manifold(blade.airfoil.solid).volume() > 1000.0
    sections = [
        slice_loops(blade.airfoil.solid, z) for z in np.linspace(5.0, blade.airfoil.z_max_mm - 1.0, 9)
    ]
    assert all(len(loops) == 1 and loop_area_mm2(loops[0]) > 40.0 for loops in sections)
    profiles_mm = real.read_profiles(real.ROWS[name])
    inner_mm = profiles_mm[1:-1].reshape(-1, 3) - real.origin_mm(profiles_mm)
    assert np.abs(nominal_of(blade).closest(inner_mm).distance_mm).max() < 0.003


def test_the_pose_is_that_of_the_fit_that_knows_the_damage() -> None:
    taken, found = inspected()
    nominal, known = nominal_of(real.turbine()), known_of(taken, found.cloud)
    T = found.alignment.T_nominal_scan
    assert not found.alignment.weak_directions
    assert displacement_mm(T, known_pose(found.cloud, known, nominal), nominal) < 0.003
    assert displacement_mm(T, known.T_true, nominal) < 0.03
    assert found.mask[known.off_mm < -0.05].mean() > 0.97
    assert found.mask[known.sound].mean() < 0.03


def test_a_thin_scan_with_its_tip_seen_does_not_slide_down_the_span() -> None:
    """A row of nearly constant section: only tip and root tell where along the screw it stands."""
    blade = real.row("stator 1")
    cutters = [
        lambda worn, rng: edge_nick(
            worn.airfoil, "leading_edge", 0.65, 1.2 * blade.scale, 6.0 * blade.scale, rng
        ),
        lambda worn, rng: pit(worn.airfoil, 0.4, 0.5, 1.0 * blade.scale, 3.5 * blade.scale, rng),
    ]
    taken = capture(blade, cutters, NOISE_MM, 1, exact_axis, 0.7 * min(1.0, blade.scale + 0.05))
    cloud = clean(fuse(taken.views, taken.axis, SIGMA_MM))
    T = register(cloud, nominal_of(blade)).T_nominal_scan
    assert displacement_mm(T, known_of(taken, cloud).T_true, nominal_of(blade)) < 0.05


def test_the_twin_lies_on_the_worn_part() -> None:
    taken, found = inspected()
    known = known_of(taken, found.cloud)
    back = known.T_true @ inverse(found.alignment.T_nominal_scan)
    before_mm = found.twin.mesh.vertices_mm - found.twin.displacement_mm
    seen_mm, drawn_mm = (
        np.abs(known.worn.closest(np.ascontiguousarray(vertices[found.twin.supported]))[0])
        for vertices in (apply(back, found.twin.mesh.vertices_mm), before_mm)
    )
    assert seen_mm.mean() < 0.002
    assert 3.0 * seen_mm.mean() < drawn_mm.mean()


def test_the_patches_hold_the_metal_that_was_taken() -> None:
    taken, found = inspected()
    assert not found.repairs.failures
    volumes = {patch.zone: patch for patch in found.repairs.patches}
    assert set(volumes) == {Zone.LEADING_EDGE, Zone.SURFACE}
    for truth in taken.part.damages:
        patch = volumes[Zone(truth.zone)]
        check_solid(patch.mesh)
        assert patch.volume_mm3.value == pytest.approx(truth.volume_mm3, rel=0.03)
        assert abs(patch.volume_mm3.value - truth.volume_mm3) < 4.0 * patch.volume_mm3.sigma
