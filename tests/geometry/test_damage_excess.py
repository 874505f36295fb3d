"""The volume of beads whose solids are known, seen all round and with a side that was not seen."""

from functools import cache

import manifold3d
import numpy as np
import pytest

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.damage.damages import Damage, DamageKind, find_damages
from geometry.kernels.winding import winding_numbers
from geometry.types import Measurand, NotMeasured, Zone
from tests.geometry import repair_blades as blades


@cache
def nominal() -> Nominal:
    return prepare_nominal(blades.blade_mesh(), NominalSettings(z_min_mm=1.0))


def told(specimen: blades.Specimen) -> Damage:
    none = np.zeros(len(specimen.cloud), bool)
    (bead,) = find_damages(specimen.cloud, none, specimen.alignment, nominal(), specimen.twin)
    assert bead.kind is DamageKind.EXCESS
    return bead


def ball(radius_mm: float, at_mm: blades.Array) -> manifold3d.Manifold:
    return manifold3d.Manifold.sphere(radius_mm, 120).translate(tuple(at_mm))


def side_bead(height_mm: float, radius_mm: float) -> manifold3d.Manifold:
    """The cap of a ball on the suction side."""
    at_mm, normal = blades.suction_side_at(0.5, 20.0)
    return ball(radius_mm, at_mm - (radius_mm - height_mm) * normal) ^ ball(0.9 * radius_mm, at_mm)


BEADS = {
    "low": (Zone.SURFACE, lambda: side_bead(0.2, 4.0)),
    "high": (Zone.SURFACE, lambda: side_bead(0.8, 3.0)),
    "edge": (Zone.LEADING_EDGE, lambda: ball(0.9, blades.leading_edge_at(20.0))),
    "thick": (Zone.LEADING_EDGE, lambda: ball(2.0, blades.leading_edge_at(20.0))),
    "trailing": (Zone.TRAILING_EDGE, lambda: ball(0.7, blades.trailing_edge_at(20.0))),
}


def with_bead(name: str, noise_mm: float, seed: int) -> blades.Specimen:
    zone, bead = BEADS[name]
    return blades.specimen({zone: bead()}, noise_mm, np.random.default_rng(seed), 60.0, adds=True)


@pytest.mark.parametrize("name", BEADS)
@pytest.mark.parametrize("noise_mm", [0.004, 0.012])
def test_the_volume_of_a_bead_is_what_was_put_on(name: str, noise_mm: float) -> None:
    specimen = with_bead(name, noise_mm, seed=3)
    damage = told(specimen)
    assert damage.zone is BEADS[name][0]
    assert isinstance(damage.volume_mm3, Measurand)
    error_mm3 = damage.volume_mm3.value - specimen.removed_mm3[0]
    assert abs(error_mm3) < 2.0 * damage.volume_mm3.sigma
    assert abs(error_mm3) < 0.06 * specimen.removed_mm3[0]
    assert damage.volume_mm3.sigma < 0.2 * specimen.removed_mm3[0]


def test_a_side_that_was_not_seen_is_uncertainty_and_too_much_of_it_no_volume() -> None:
    """The scanner looks down: the underside of a thick bead is dark."""
    whole = with_bead("thick", 0.008, seed=5)
    volumes = []
    for dark_mm in (0.0, 18.3, 18.7):
        dark = (whole.on_break == 0) & (whole.cloud.points_mm[:, 2] < dark_mm)
        volumes.append(told(blades.without(whole, dark)).volume_mm3)
    seen, partly, hardly = volumes
    assert isinstance(seen, Measurand)
    assert isinstance(partly, Measurand)
    assert partly.sigma > 1.1 * seen.sigma
    assert abs(partly.value - whole.removed_mm3[0]) < 2.0 * partly.sigma
    assert hardly == NotMeasured(reason="a side of the metal in excess was not seen")


def test_a_closed_surface_winds_once_round_what_is_inside() -> None:
    """Against the solid angles of triangles (Van Oosterom and Strackee, 1983), one by one."""
    mesh = blades.mesh_of(manifold3d.Manifold.sphere(2.0, 48))
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces], 1, 0)
    places_mm = np.array([[0.0, 0.0, 0.0], [0.9, 0.8, -0.7], [0.0, 0.0, 3.0], [4.0, 1.0, 0.0]])
    found = winding_numbers(places_mm, (a + b + c) / 3.0, 0.5 * np.cross(b - a, c - a))
    half = [_solid_angle(a - place, b - place, c - place).sum() / (4.0 * np.pi) for place in places_mm]
    assert half == pytest.approx([1.0, 1.0, 0.0, 0.0], abs=1e-9)
    assert found == pytest.approx(half, abs=0.005)
    cut = (a + b + c)[:, 2] > 0.0
    open_ = winding_numbers(places_mm, ((a + b + c) / 3.0)[cut], 0.5 * np.cross(b - a, c - a)[cut])
    assert open_[0] == pytest.approx(0.5, abs=0.03)


def _solid_angle(a: blades.Array, b: blades.Array, c: blades.Array) -> blades.Array:
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    box = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return 2.0 * np.arctan2(box, la * lb * lc + dots)
