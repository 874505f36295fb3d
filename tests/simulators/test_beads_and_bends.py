"""Metal put on and metal bent, on blades whose shape is known."""

from functools import cache

import numpy as np
import pytest

from simulators.beads import edge_bead, side_bead
from simulators.bends import Bend, bent
from simulators.blade import Wear
from simulators.damage_solids import break_off
from simulators.presets import nominal_blade
from simulators.solids import to_manifold
from simulators.wear import WornBlade, worn_blade


@cache
def worn() -> WornBlade:
    return worn_blade(nominal_blade(None), Wear(wave_mm=0.0, bump_mm=0.0))


@pytest.mark.parametrize("height_mm", [0.2, 1.0])
def test_a_bead_on_a_side_is_half_an_ellipsoid(height_mm: float) -> None:
    airfoil = worn().airfoil
    after, (truth,) = break_off(airfoil, [side_bead(airfoil, 0.5, 0.5, height_mm, 2.0)])
    assert (truth.zone, truth.kind) == ("surface", "excess")
    assert truth.volume_mm3 == pytest.approx(after.volume_mm3 - airfoil.solid.volume_mm3, rel=1e-9)
    assert truth.volume_mm3 == pytest.approx(2.0 / 3.0 * np.pi * 2.0**2 * height_mm, rel=0.25)
    assert truth.depth_mm == pytest.approx(height_mm, abs=0.01)
    assert truth.area_mm2 == pytest.approx(np.pi * 2.0**2, rel=0.1)


@pytest.mark.parametrize("zone", ["leading_edge", "trailing_edge"])
def test_a_bead_on_an_edge_stands_out_of_it(zone: str) -> None:
    airfoil = worn().airfoil
    after, (truth,) = break_off(airfoil, [edge_bead(airfoil, zone, 0.5, 0.8, 1.5)])  # type: ignore[arg-type]
    assert (truth.zone, truth.kind) == (zone, "excess")
    assert truth.depth_mm == pytest.approx(0.8, abs=0.03)
    assert truth.volume_mm3 == pytest.approx(after.volume_mm3 - airfoil.solid.volume_mm3, rel=1e-9)
    assert truth.z_high_mm - truth.z_low_mm == pytest.approx(3.0, abs=0.2)
    assert to_manifold(after).genus() == 0


def test_a_bend_moves_metal_and_neither_takes_nor_adds_any() -> None:
    bend = Bend(length_mm=10.0, chord_fraction=0.6, depth_mm=0.8)
    after, truth = bent(nominal_blade(None), worn(), bend)
    before = worn().airfoil.solid
    assert (truth.zone, truth.kind, truth.volume_mm3) == ("tip", "deformation", 0.0)
    assert after.airfoil.solid.volume_mm3 == pytest.approx(before.volume_mm3, rel=2e-4)
    assert 0.6 < truth.depth_mm < 0.8  # the round end of the edge moves along itself, too
    assert truth.z_low_mm > worn().airfoil.z_max_mm - 10.5
    assert after.form_mm == pytest.approx(truth.depth_mm, abs=0.01)  # hardly worn: off the nominal as well
    low_mm, high_mm = truth.z_low_mm - 1.0, truth.z_high_mm - 0.5
    assert after.section(low_mm) == pytest.approx(worn().section(low_mm))
    assert np.abs(after.section(high_mm)[:, 1].max() - worn().section(high_mm)[:, 1].max()) > 0.1
