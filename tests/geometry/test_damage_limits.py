"""The detection limits of tip and edges: closed forms, and losses of just that depth are found."""

import manifold3d
import numpy as np
import pytest

from geometry.damage.detection import HOLLOW_SPACINGS, SHOWN, detection_limit, edge_limit_mm, tip_limit_mm
from geometry.damage.regions import RegionSettings, find_regions, stand_off
from geometry.types import Measurand, Zone
from tests.geometry import repair_blades as blades
from tests.geometry.test_damage_depth import nominal

PER_MM2, NOISE_MM = 25.0, 0.01
EDGES = {Zone.LEADING_EDGE: blades.leading_edge_at, Zone.TRAILING_EDGE: blades.trailing_edge_at}


def test_the_limit_at_a_round_edge_solves_its_equation() -> None:
    radius, hollow, across = 3.0, 0.05, 2.0
    rod = blades.mesh_of(manifold3d.Manifold.cylinder(20.0, radius, radius, 2000))
    limit = edge_limit_mm(blades.twin_of(rod, np.ones(1, bool), 0.01), hollow, across)
    loss = np.linspace(1e-4, radius, 100_000)
    strip = 2.0 * np.sqrt(2.0 * radius * loss - loss**2)
    mean = SHOWN * np.minimum(2.0 / 3.0 * loss, 0.25 * strip) * np.minimum(strip / across, 1.0)
    assert limit == pytest.approx(loss[np.argmax(mean >= hollow)], rel=0.05)


def test_a_sharper_edge_and_a_thinner_scan_must_lose_more() -> None:
    slab, rod = (
        blades.twin_of(blades.mesh_of(solid), np.ones(1, bool), 0.01)
        for solid in (
            manifold3d.Manifold.cylinder(20.0, 0.5, 0.5, 200).scale((8.0, 2.0, 1.0)),
            manifold3d.Manifold.cylinder(20.0, 4.0, 4.0, 400),
        )
    )
    assert edge_limit_mm(slab, 0.05, 1.0) > edge_limit_mm(rod, 0.05, 1.0)
    assert edge_limit_mm(slab, 0.05, 2.0) > edge_limit_mm(slab, 0.05, 1.0)


def test_where_the_tip_is_wide_its_limit_is_that_of_a_face() -> None:
    twin = blades.twin_of(blades.blade_mesh(1.0), np.ones(1, bool), 0.01)
    wide, thin = (tip_limit_mm(twin, 0.05, across, length) for across, length in ((0.3, 4.0), (2.0, 1.0)))
    assert wide == pytest.approx(0.05 / SHOWN)
    assert thin > 1.5 * wide


def filed(at: blades.Array, inward: blades.Array, depth_mm: float, length_mm: float) -> manifold3d.Manifold:
    """A round file that reaches so deep into the part at a place, over such a length."""
    radius = (0.5 * length_mm) ** 2 / (2.0 * depth_mm)
    axis = np.array([-inward[1], inward[0], 0.0]) if inward[2] == 0.0 else np.array([0.0, 1.0, 0.0])
    file = manifold3d.Manifold.cylinder(12.0, radius, radius, 600, True)
    return file.transform(np.column_stack([blades.frame_with_z(axis), at + (depth_mm - radius) * inward]))


def losses(
    limit_mm: dict[Zone, float], length_mm: float
) -> list[tuple[Zone, blades.Array, manifold3d.Manifold]]:
    """Zones and places of losses, and the files that make them: three at each edge, two at the tip."""
    made = []
    for zone, place in EDGES.items():
        for z_mm in (8.0, 20.0, 32.0):
            chord = blades.trailing_edge_at(z_mm) - blades.leading_edge_at(z_mm)
            inward = chord / np.linalg.norm(chord) * (1.0 if zone is Zone.LEADING_EDGE else -1.0)
            made.append((zone, place(z_mm), filed(place(z_mm), inward, limit_mm[zone], length_mm)))
    for share in (0.3, 0.6):
        sides = [side(share, blades.SPAN_MM)[0] for side in (blades.pressure_side_at, blades.suction_side_at)]
        middle, down = 0.5 * (sides[0] + sides[1]), np.array([0.0, 0.0, -1.0])
        made.append((Zone.TIP, middle, filed(middle, down, limit_mm[Zone.TIP], length_mm)))
    return made


def found_at(
    shares: float, per_mm2: float, noise_mm: float, seed: int
) -> tuple[dict[Zone, float], dict[Zone, list[bool]], int]:
    """Depths of so many limits, which losses of just that depth are found, and what else is told."""
    whole = blades.specimen({}, noise_mm, np.random.default_rng([seed, 0]), per_mm2)
    limits = detection_limit(whole.cloud, whole.alignment, nominal(), whole.twin).depth_mm
    depth_mm = {zone: shares * limit.value for zone, limit in limits.items() if isinstance(limit, Measurand)}
    length_mm = HOLLOW_SPACINGS / np.sqrt(per_mm2)
    made = losses(depth_mm, length_mm)
    cut = manifold3d.Manifold.batch_boolean([file for _, _, file in made], manifold3d.OpType.Add)
    scanned = blades.specimen({Zone.TIP: cut}, noise_mm, np.random.default_rng([seed, 1]), per_mm2)
    field = stand_off(scanned.cloud, scanned.alignment, nominal(), scanned.twin, RegionSettings())
    regions = find_regions(field, nominal(), RegionSettings())
    told = np.array([field.scan_mm[region.points].mean(axis=0) for region in regions]).reshape(-1, 3)
    near = np.linalg.norm(told[:, None] - np.array([at for _, at, _ in made]), axis=2) < 0.5 * length_mm
    zones: dict[Zone, list[bool]] = {zone: [] for zone in (*EDGES, Zone.TIP)}
    for (zone, _, _), hit in zip(made, near.any(axis=0), strict=True):
        zones[zone].append(bool(hit))
    return depth_mm, zones, int((~near.any(axis=1)).sum())


def test_losses_as_deep_as_the_limit_are_found_at_edges_and_tip() -> None:
    _, found, strange = found_at(1.0, PER_MM2, NOISE_MM, 0)
    assert all(all(hits) for hits in found.values())
    assert strange == 0
