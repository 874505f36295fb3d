"""Repair patches against solids of known volume: analytic blades cut exactly, sampled at random."""

from dataclasses import replace
from functools import cache

import manifold3d
import numpy as np
import pytest

import geometry.repair.patches as repair_module
from geometry.blade.solid import check_solid, solid_normals
from geometry.damage.damages import DamageKind
from geometry.errors import BadInput
from geometry.repair.patches import (
    Patch,
    RepairSettings,
    RepairVolume,
    find_repairs,
    in_frame,
    to_scan_frame,
    with_allowance,
)
from geometry.transforms import apply, exp, inverse, rigid
from geometry.types import Cloud, Measurand, Mesh, Zone
from tests.geometry import repair_blades as blades


@cache
def scanned(name: str, noise_mm: float, seed: int = 0) -> blades.Specimen:
    zone, cutter = blades.CUTTERS[name]
    return blades.specimen({zone: cutter()}, noise_mm, np.random.default_rng(seed))


def repairs_of(specimen: blades.Specimen) -> RepairVolume:
    return find_repairs(specimen.twin, specimen.cloud, specimen.alignment, specimen.damages, RepairSettings())


@cache
def repaired(name: str, noise_mm: float) -> Patch:
    found = repairs_of(scanned(name, noise_mm))
    assert not found.failures
    (patch,) = found.patches
    return patch


def edges_of(mesh: Mesh) -> dict[tuple[int, int], int]:
    """How often each directed edge occurs."""
    counts: dict[tuple[int, int], int] = {}
    for a, b, c in mesh.faces.tolist():
        for edge in ((a, b), (b, c), (c, a)):
            counts[edge] = counts.get(edge, 0) + 1
    return counts


every_case = pytest.mark.parametrize(
    ("name", "noise_mm"),
    [(name, 0.015) for name in blades.CUTTERS] + [("tip corner", 0.0), ("pit", 0.0), ("shallow dent", 0.0)],
)


@every_case
def test_the_volume_is_the_metal_removed(name: str, noise_mm: float) -> None:
    truth = scanned(name, noise_mm).removed_mm3[0]
    volume = repaired(name, noise_mm).volume_mm3
    assert volume.value == pytest.approx(truth, rel=0.01 if truth >= 5.0 else 0.02)
    assert abs(volume.value - truth) <= 3.0 * volume.sigma


@every_case
def test_the_second_method_finds_it_too(name: str, noise_mm: float) -> None:
    truth = scanned(name, noise_mm).removed_mm3[0]
    assert repaired(name, noise_mm).volume_check_mm3 == pytest.approx(truth, rel=0.025)


@every_case
def test_the_patch_is_a_solid(name: str, noise_mm: float) -> None:
    patch = repaired(name, noise_mm)
    solid = blades.solid_of(patch.mesh)  # manifold3d's own opinion, asserted there
    assert patch.watertight
    assert solid.volume() == pytest.approx(patch.volume_mm3.value, rel=1e-6)
    edges = edges_of(patch.mesh)
    assert all(count == 1 and edges.get((b, a)) == 1 for (a, b), count in edges.items())


@pytest.mark.parametrize("name", blades.CUTTERS)
def test_the_patch_is_where_the_metal_was(name: str) -> None:
    zone, cutter = blades.CUTTERS[name]
    truth = blades.solid_of(blades.blade_mesh()) ^ cutter()
    patch = blades.solid_of(repaired(name, 0.015).mesh)
    beside = (patch - truth).volume() + (truth - patch).volume()
    assert beside <= 0.015 * truth.surface_area()
    assert repaired(name, 0.015).zone is zone


@pytest.mark.parametrize("name", blades.CUTTERS)
def test_its_outer_skin_is_exactly_the_twin(name: str) -> None:
    specimen, patch = scanned(name, 0.015), repaired(name, 0.015)
    twin = blades.solid_of(specimen.twin.mesh)
    assert (blades.solid_of(patch.mesh) - twin).volume() <= 1e-6
    outer = Mesh(vertices_mm=patch.mesh.vertices_mm, faces=patch.mesh.faces[patch.outer])
    from_twin = repair_module.Skin(specimen.twin.mesh).closest(outer.vertices_mm[np.unique(outer.faces)])
    assert np.abs(from_twin[0]).max() <= 1e-7


def test_the_broken_side_lies_on_the_scanned_surface() -> None:
    specimen, patch = scanned("tip corner", 0.015), repaired("tip corner", 0.015)
    vertices = patch.mesh.vertices_mm[np.unique(patch.mesh.faces[~patch.outer])]
    off_mm = repair_module.Skin(specimen.damaged).closest(vertices)[0]
    assert np.sqrt(np.mean(off_mm**2)) <= 0.012
    assert np.abs(off_mm).max() <= 0.15


@pytest.mark.parametrize(
    ("name", "seed"), [("tip corner", 0), ("tip corner", 1), ("pit", 2), ("edge nick", 3)]
)
def test_a_hole_in_the_broken_surface_is_never_bridged(name: str, seed: int) -> None:
    specimen = scanned(name, 0.015)
    points = specimen.cloud.points_mm
    middle = np.random.default_rng(seed).choice(points[specimen.on_break == 0])
    found = repairs_of(blades.without(specimen, np.linalg.norm(points - middle, axis=1) < 1.0))
    assert not found.patches
    assert "hole" in found.failures[0] or "open" in found.failures[0]
    assert found.volume_mm3.value == 0.0


def test_a_small_hole_is_bridged_and_reported() -> None:
    specimen = scanned("tip corner", 0.015)
    points = specimen.cloud.points_mm
    broken = points[specimen.on_break == 0]
    middle = broken[np.linalg.norm(broken - broken.mean(axis=0), axis=1).argmin()]
    found = repairs_of(blades.without(specimen, np.linalg.norm(points - middle, axis=1) < 0.6))
    (patch,) = found.patches
    assert 1.1 <= patch.broken_gap_mm <= 1.5
    assert patch.volume_mm3.value == pytest.approx(specimen.removed_mm3[0], rel=0.01)


def test_a_wall_unseen_up_to_its_rim_is_closed_by_the_sound_skin_beside_it() -> None:
    specimen = scanned("edge nick", 0.015)
    points = specimen.cloud.points_mm
    found = repairs_of(blades.without(specimen, (specimen.on_break == 0) & (points[:, 2] > 21.7)))
    (patch,) = found.patches
    assert 1.0 <= patch.broken_gap_mm <= 1.5
    assert patch.volume_mm3.value == pytest.approx(specimen.removed_mm3[0], rel=0.01)


def test_noise_at_the_rim_makes_no_break_deeper() -> None:
    errors = []
    for seed in range(2):
        specimen = scanned("shallow dent", 0.02, seed)
        (patch,) = repairs_of(specimen).patches
        errors.append(patch.volume_mm3.value / specimen.removed_mm3[0] - 1.0)
    assert abs(np.mean(errors)) <= 0.01


def test_a_scrap_of_a_dozen_points_has_a_patch_and_says_how_little_it_knows() -> None:
    ratios = []
    for seed in range(8):
        cutters = {Zone.SURFACE: blades.pit_cutter(0.2, 0.9)}
        scan = blades.specimen(cutters, 0.012, np.random.default_rng(seed), 25.0)
        found = find_repairs(scan.twin, scan.cloud, scan.alignment, scan.damages, RepairSettings())
        (patch,) = found.patches
        check_solid(patch.mesh)
        ratios.append((patch.volume_mm3.value - scan.removed_mm3[0]) / patch.volume_mm3.sigma)
    assert np.sqrt(np.mean(np.square(ratios))) < 1.3
    assert max(np.abs(ratios)) < 2.5


def test_no_damage_gives_no_patch() -> None:
    specimen = blades.specimen({}, 0.015, np.random.default_rng(0))
    found = repairs_of(specimen)
    assert found.patches == ()
    assert found.failures == {}
    assert found.volume_mm3 == Measurand(name="volume_mm3", value=0.0, sigma=0.0, unit="mm3")


def test_excess_and_deformation_need_no_patch() -> None:
    specimen = scanned("pit", 0.015)
    for kind in (DamageKind.EXCESS, DamageKind.DEFORMATION):
        other = replace(specimen, damages=(replace(specimen.damages[0], kind=kind),))
        found = repairs_of(other)
        assert found.patches == ()
        assert found.failures == {}


def test_sound_skin_flagged_by_mistake_fails_with_the_reason() -> None:
    specimen = blades.specimen({}, 0.015, np.random.default_rng(0))
    points = specimen.cloud.points_mm
    at, _ = blades.pressure_side_at(0.5, 20.0)
    blob = np.linalg.norm(points - at, axis=1) < 2.0
    wrong = replace(specimen, damages=(blades.damage_at(Zone.SURFACE, points, blob),))
    found = repairs_of(wrong)
    assert found.patches == ()
    assert "below the twin" in found.failures[0]


def test_a_second_opinion_that_differs_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    specimen = scanned("pit", 0.0)
    monkeypatch.setattr(repair_module, "volume_by_columns", lambda _broken, _skin: 10.0)
    found = repairs_of(specimen)
    assert found.patches == ()
    assert "disagree" in found.failures[0]


def test_a_hole_through_the_blade_cannot_be_checked_and_fails() -> None:
    at, normal = blades.pressure_side_at(0.45, 22.0)
    frame = np.column_stack([blades.frame_with_z(normal), at])
    drill = manifold3d.Manifold.cylinder(20.0, 1.5, 1.5, 90, True).transform(frame)
    found = repairs_of(blades.specimen({Zone.SURFACE: drill}, 0.0, np.random.default_rng(0)))
    assert found.patches == ()
    assert "wraps around" in found.failures[0]


def test_each_damage_gets_its_own_patch_and_the_total_is_their_sum() -> None:
    cutters = {
        Zone.TIP: blades.tip_corner_cutter(4.0),
        Zone.SURFACE: blades.pit_cutter(),
        Zone.LEADING_EDGE: blades.edge_nick_cutter(),
    }
    specimen = blades.specimen(cutters, 0.015, np.random.default_rng(4))
    found = repairs_of(specimen)
    assert [patch.damage for patch in found.patches] == [0, 1, 2]
    assert [patch.zone for patch in found.patches] == list(cutters)
    for patch, truth in zip(found.patches, specimen.removed_mm3, strict=True):
        assert patch.volume_mm3.value == pytest.approx(truth, rel=0.01)
    assert found.volume_mm3.value == pytest.approx(sum(p.volume_mm3.value for p in found.patches))


def test_one_damage_that_fails_leaves_the_others() -> None:
    cutters = {Zone.TIP: blades.tip_corner_cutter(4.0), Zone.SURFACE: blades.pit_cutter()}
    specimen = blades.specimen(cutters, 0.015, np.random.default_rng(4))
    points = specimen.cloud.points_mm
    middle = points[specimen.on_break == 0].mean(axis=0)
    found = repairs_of(blades.without(specimen, np.linalg.norm(points - middle, axis=1) < 1.2))
    assert set(found.failures) == {0}
    assert [patch.damage for patch in found.patches] == [1]


def test_the_order_of_the_points_does_not_matter() -> None:
    specimen = scanned("pit", 0.015)
    order = np.random.default_rng(5).permutation(len(specimen.cloud))
    rank = np.argsort(order)
    cloud = specimen.cloud
    shuffled = replace(
        specimen,
        cloud=cloud.of(order),
        damages=(replace(specimen.damages[0], points=rank[specimen.damages[0].points]),),
    )
    (patch,) = repairs_of(shuffled).patches
    assert patch.volume_mm3.value == pytest.approx(repaired("pit", 0.015).volume_mm3.value, rel=1e-4)


def test_repeated_points_change_little() -> None:
    specimen = scanned("pit", 0.015)
    cloud, count = specimen.cloud, len(specimen.cloud)
    twice = np.tile(np.arange(count), 3)
    points = specimen.damages[0].points
    repeated = replace(
        specimen,
        cloud=cloud.of(twice),
        damages=(
            replace(specimen.damages[0], points=np.concatenate([points + k * count for k in range(3)])),
        ),
    )
    (patch,) = repairs_of(repeated).patches
    assert patch.volume_mm3.value == pytest.approx(specimen.removed_mm3[0], rel=0.01)


def test_the_scan_may_lie_anywhere() -> None:
    specimen = scanned("edge nick", 0.015)
    c, s = np.cos(0.7), np.sin(0.7)
    T = rigid(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([120.0, -40.0, 15.0]))
    cloud = specimen.cloud
    moved = replace(
        specimen,
        cloud=Cloud(points_mm=apply(T, cloud.points_mm), sigma_mm=cloud.sigma_mm, view=cloud.view),
        alignment=replace(specimen.alignment, T_nominal_scan=inverse(T)),
    )
    (patch,) = repairs_of(moved).patches
    assert patch.volume_mm3.value == pytest.approx(repaired("edge nick", 0.015).volume_mm3.value, rel=1e-3)
    in_scan = to_scan_frame(patch.mesh, moved.alignment)
    np.testing.assert_allclose(in_scan.vertices_mm, apply(T, patch.mesh.vertices_mm), atol=1e-9)
    np.testing.assert_array_equal(in_scan.faces, patch.mesh.faces)


@pytest.mark.parametrize("name", ["tip corner", "pit"])
def test_a_twin_that_errs_within_its_sigma_is_covered_by_the_volume_s(name: str) -> None:
    specimen = scanned(name, 0.015)
    mesh = specimen.twin.mesh
    normals = solid_normals(mesh).vertex
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    for off_mm in (-0.01, 0.01):
        swollen = Mesh(vertices_mm=mesh.vertices_mm + off_mm * normals, faces=mesh.faces)
        twin = replace(specimen.twin, mesh=swollen, sigma_mm=np.full(len(normals), 0.01))
        (patch,) = repairs_of(replace(specimen, twin=twin)).patches
        error = patch.volume_mm3.value - specimen.removed_mm3[0]
        assert np.sign(error) == np.sign(off_mm)
        assert abs(error) <= 2.0 * patch.volume_mm3.sigma


def test_the_border_is_flush_with_a_true_twin() -> None:
    patch = repaired("tip corner", 0.015)
    assert isinstance(patch.border_step_mm, Measurand)
    assert isinstance(patch.border_angle_deg, Measurand)
    assert patch.border_step_mm.value <= 0.02
    assert patch.border_angle_deg.value <= 4.0 * patch.border_angle_deg.sigma  # the worst of a few hundred


def test_the_border_shows_a_twin_that_stands_proud() -> None:
    specimen = scanned("pit", 0.0)
    mesh = specimen.twin.mesh
    normals = solid_normals(mesh).vertex
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    proud = Mesh(vertices_mm=mesh.vertices_mm + 0.03 * normals, faces=mesh.faces)
    twin = replace(specimen.twin, mesh=proud, sigma_mm=np.full(len(normals), 0.03))
    (patch,) = repairs_of(replace(specimen, twin=twin)).patches
    assert isinstance(patch.border_step_mm, Measurand)
    assert patch.border_step_mm.value == pytest.approx(0.03, abs=0.006)


@pytest.mark.parametrize("name", ["tip corner", "pit", "edge nick"])
def test_an_allowance_grows_the_outer_skin_only(name: str) -> None:
    patch = repaired(name, 0.015)
    grown = blades.solid_of(with_allowance(patch, 0.3))
    plain = blades.solid_of(patch.mesh)
    a, b, c = np.moveaxis(patch.mesh.vertices_mm[patch.mesh.faces[patch.outer]], 1, 0)
    area_mm2 = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert 0.9 <= (grown.volume() - plain.volume()) / (0.3 * area_mm2) <= 1.5  # edges add to it
    assert (plain - grown).volume() <= 0.01 * plain.volume()
    assert with_allowance(patch, 0.0).vertices_mm == pytest.approx(patch.mesh.vertices_mm)


@pytest.mark.parametrize("name", ["tip corner", "pit", "edge nick"])
def test_a_patch_is_written_with_its_allowance_and_counted_without(name: str) -> None:
    specimen = scanned(name, 0.015)
    settings = RepairSettings(allowance_mm=0.25)
    (patch,) = find_repairs(
        specimen.twin, specimen.cloud, specimen.alignment, specimen.damages, settings
    ).patches
    assert patch.volume_mm3.value == repaired(name, 0.015).volume_mm3.value
    written = blades.solid_of(patch.written)
    assert patch.written_mm3.value == pytest.approx(written.volume(), rel=1e-6)
    assert written.volume() > patch.volume_mm3.value
    edges = edges_of(patch.written)
    assert all(count == 1 and edges.get((b, a)) == 1 for (a, b), count in edges.items())
    outer = np.unique(patch.mesh.faces[patch.outer])
    height_mm = repair_module.Skin(specimen.twin.mesh).closest(patch.written.vertices_mm[outer])[0]
    assert height_mm.min() > 0.24  # nowhere less than the allowance above the twin


@pytest.mark.parametrize("name", ["tip corner", "pit"])
def test_the_area_of_the_lost_skin_is_that_of_the_cut(name: str) -> None:
    _, cutter = blades.CUTTERS[name]
    whole = blades.solid_of(blades.blade_mesh()).as_original()
    lost = (whole ^ cutter()).to_mesh64()
    skin = np.asarray(lost.run_original_id) == whole.original_id()
    runs = np.asarray(lost.run_index) // 3
    faces = np.concatenate([np.arange(runs[i], runs[i + 1]) for i in np.flatnonzero(skin)])
    corner = np.asarray(lost.vert_properties)[:, :3][np.asarray(lost.tri_verts)[faces]]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = repaired(name, 0.015).area_mm2
    assert isinstance(area, Measurand)
    assert abs(area.value - 0.5 * np.linalg.norm(cross, axis=1).sum()) < 2.0 * area.sigma


def test_a_patch_in_another_frame_is_the_same_solid() -> None:
    patch = repaired("pit", 0.0)
    T = exp(np.array([0.3, -0.2, 1.1, 10.0, -4.0, 33.0]), np.zeros(3))
    moved = in_frame(patch.mesh, T)
    assert blades.solid_of(moved).volume() == pytest.approx(patch.volume_mm3.value, rel=1e-6)
    back = in_frame(moved, inverse(T))
    np.testing.assert_allclose(back.vertices_mm, patch.mesh.vertices_mm, atol=1e-9)
    with pytest.raises(BadInput, match="rigid"):
        in_frame(patch.mesh, 2.0 * np.eye(4))


def test_where_the_twin_is_a_guess_there_is_no_patch() -> None:
    specimen = scanned("pit", 0.0)
    unsure = replace(specimen.twin, sigma_mm=np.full_like(specimen.twin.sigma_mm, 0.6))
    found = repairs_of(replace(specimen, twin=unsure))
    assert not found.patches
    assert found.failures


def test_nonsense_is_refused() -> None:
    with pytest.raises(BadInput, match="allowance"):
        with_allowance(repaired("pit", 0.0), float("nan"))
    with pytest.raises(BadInput, match="settings"):
        RepairSettings(max_gap_mm=0.0)
    with pytest.raises(BadInput, match="settings"):
        RepairSettings(allowance_mm=-0.1)
