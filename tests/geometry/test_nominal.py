"""The prepared nominal against closed forms: analytic blade, box, and files of every kind and fault."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from geometry.blade.nominal import ZONE_ORDER, NominalSettings, prepare_nominal
from geometry.blade.read import read_nominal
from geometry.blade.solid import check_solid, volume_mm3
from geometry.errors import BadInput, BadMesh
from geometry.types import Mesh, Zone
from tests.geometry import blades

BLADE = blades.Blade()
REAL = Path(__file__).parents[3] / "shared" / "data" / "turbineblade" / "turbineblade.ply"
BOX_MM = np.array([40.0, 4.0, 100.0])


@cache
def nominal():
    return prepare_nominal(blades.mesh(BLADE), NominalSettings(z_min_mm=0.0, z_max_mm=105.0))


@cache
def box():
    shape = trimesh.creation.box(extents=BOX_MM)
    return prepare_nominal(Mesh(vertices_mm=shape.vertices, faces=shape.faces), NominalSettings())


def box_distance(points):
    """Signed distance to the box, closed form."""
    q = np.abs(points) - BOX_MM / 2
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)


def test_signed_distance_to_a_box_is_exact_inside_outside_and_off_every_edge():
    points = np.random.default_rng(1).uniform(-0.8, 0.8, (20_000, 3)) * BOX_MM
    found = box().closest(points)
    assert np.abs(found.distance_mm - box_distance(points)).max() < 1e-5  # float32 may pick a rival face
    assert np.quantile(np.abs(found.distance_mm - box_distance(points)), 0.99) < 1e-12
    assert np.abs(box_distance(found.points_mm)).max() < 1e-12


def test_normals_stay_sharp_at_the_edges_of_a_box():
    found = box().closest(np.random.default_rng(2).uniform(-0.5, 0.5, (500, 3)) * BOX_MM * [0.99, 1.2, 0.99])
    assert np.abs(np.sort(np.abs(found.normals), axis=1) - [0.0, 0.0, 1.0]).max() < 1e-12


def test_distance_and_normal_off_the_analytic_blade():
    rng = np.random.default_rng(3)
    t, z = rng.uniform(0, 2 * np.pi, 5000), rng.uniform(2, 103, 5000)
    normals, _ = BLADE.normal(t, z)
    off = rng.uniform(-0.2, 0.2, 5000)
    found = nominal().closest(BLADE.point(t, z) + off[:, None] * normals)
    assert np.abs(found.distance_mm - off).max() < 0.004  # chords of the facets
    assert np.rad2deg(np.arccos(np.clip(np.einsum("nj,nj->n", found.normals, normals), -1, 1))).max() < 3.0


def test_walking_from_a_nearby_face_finds_the_same_as_searching():
    rng = np.random.default_rng(4)
    t, z = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(0, 105, 3000)
    points = BLADE.point(t, z)
    before = nominal().closest(points)
    moved = points + rng.normal(scale=0.02, size=points.shape)
    walked, searched = nominal().closest_from(moved, before.face), nominal().closest(moved)
    apart = np.abs(walked.distance_mm - searched.distance_mm)
    assert np.quantile(apart, 0.99) < 1e-12
    assert apart.max() < 1e-4  # a rival face beyond the neighbours


@pytest.mark.parametrize("z", [0.0, 7.0, 52.5, 98.0, 105.0])
def test_section_is_the_analytic_outline_from_its_trailing_edge(z):
    section = nominal().section(z)
    t = np.linspace(0, 2 * np.pi, 20_001)[:-1]
    truth = BLADE.point(t, np.full(len(t), z))[:, :2]
    exact_area = 0.5 * abs(
        np.sum(truth[:, 0] * np.roll(truth[:, 1], -1) - np.roll(truth[:, 0], -1) * truth[:, 1])
    )
    x, y = section.curve_mm.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert area == pytest.approx(exact_area, rel=2e-4)  # positive: counter-clockwise
    assert section.te_index == 0
    assert np.linalg.norm(section.curve_mm[0] - truth[10_000]) < 0.15
    assert np.linalg.norm(section.curve_mm[section.le_index] - truth[0]) < 0.25
    steps = np.linalg.norm(np.roll(section.curve_mm, -1, axis=0) - section.curve_mm, axis=1)
    assert steps.max() <= min(0.05, section.perimeter_mm / 2000) + 1e-12
    assert section.arc_mm[-1] + steps[-1] == pytest.approx(section.perimeter_mm)


def test_section_normals_point_out_and_across_the_curve():
    section = nominal().section(52.5)
    assert np.abs(np.linalg.norm(section.normals, axis=1) - 1.0).max() < 1e-12
    along = np.roll(section.curve_mm, -1, axis=0) - np.roll(section.curve_mm, 1, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    right_of_it = np.column_stack([along[:, 1], -along[:, 0]])
    assert np.einsum("nj,nj->n", right_of_it, section.normals).min() > 0.99


def test_sides_of_a_section():
    section = nominal().section(0.0)
    x, y = section.curve_mm.T
    middle = np.abs(x) < 10.0
    assert (section.side[middle & (y > 2.0)] == 1).all()  # the camber bows to +y: suction
    assert (section.side[middle & (y < 0.5)] == 3).all()
    from_te = np.hypot(*(section.curve_mm - section.curve_mm[0]).T)
    from_le = np.hypot(*(section.curve_mm - section.curve_mm[section.le_index]).T)
    assert ((section.side == 2) == (from_te <= 3.0)).all()
    assert ((section.side == 0) == (from_le <= 3.0)).all()


def test_edge_lines_follow_the_analytic_edges():
    for line, t in ((nominal().le_line_mm, 0.0), (nominal().te_line_mm, np.pi)):
        truth = BLADE.point(np.full(len(line), t), line[:, 2])
        assert np.linalg.norm(line - truth, axis=1).max() < 0.25
        assert (np.diff(line[:, 2]) > 0).all()
        assert line[[0, -1], 2] == pytest.approx([0.0, 105.0])


def test_zones_of_points_whose_place_is_known():
    z = np.full(1, 50.0)
    le, te, back = (BLADE.point(np.array([t]), z)[0] for t in (0.0, np.pi, 1.5))
    points = np.array(
        [le, te, back, [*back[:2], 101.0], [*back[:2], -0.5], [0.0, 1.0, 105.02], [*le[:2], 104.0]]
    )
    names = [ZONE_ORDER[i] for i in nominal().zone_of(points)]
    assert names == [
        Zone.LEADING_EDGE, Zone.TRAILING_EDGE, Zone.SURFACE, Zone.TIP, Zone.OUTSIDE, Zone.TIP, Zone.TIP
    ]  # fmt: skip


def test_samples_cover_the_required_surface_evenly():
    samples = nominal().samples
    t, z = np.meshgrid(2 * np.pi * np.arange(800) / 800, (np.arange(200) + 0.5) * 105 / 200)
    _, density = BLADE.normal(t.ravel(), z.ravel())
    side_mm2 = density.mean() * 2 * np.pi * 105
    assert samples.area_mm2[~samples.tip_face].sum() == pytest.approx(side_mm2, rel=2e-3)
    top = nominal().section(105.0).curve_mm
    top_mm2 = 0.5 * np.sum(top[:, 0] * np.roll(top[:, 1], -1) - np.roll(top[:, 0], -1) * top[:, 1])
    assert samples.area_mm2[samples.tip_face].sum() == pytest.approx(top_mm2, rel=0.02)
    probe = BLADE.point(t.ravel()[::37], z.ravel()[::37])
    gap = np.array([np.linalg.norm(samples.points_mm - p, axis=1).min() for p in probe[:600]])
    assert gap.max() < 1.0
    assert (samples.zone != ZONE_ORDER.index(Zone.OUTSIDE)).all()


def test_default_span_of_a_plain_blade_starts_just_above_its_root():
    prepared = prepare_nominal(blades.mesh(BLADE, around=200, up=40), NominalSettings())
    assert 0.0 < prepared.z_min_mm < 1.0
    assert prepared.z_max_mm == 105.0


@pytest.mark.parametrize(("low", "high"), [(-5.0, 105.0), (0.0, 120.0), (60.0, 40.0)])
def test_a_span_outside_the_nominal_is_refused(low, high):
    with pytest.raises(BadInput, match="airfoil from z"):
        prepare_nominal(blades.mesh(BLADE, 100, 20), NominalSettings(z_min_mm=low, z_max_mm=high))


def test_a_span_that_ends_below_the_tip_has_no_tip():
    settings = NominalSettings(z_min_mm=10.0, z_max_mm=60.0)
    prepared = prepare_nominal(blades.mesh(BLADE, 200, 40), settings)
    assert not prepared.tip_face.any()
    assert prepared.samples.points_mm[:, 2].max() <= 60.0
    above = BLADE.point(np.array([1.5, 1.5]), np.array([70.0, 103.0]))
    assert [ZONE_ORDER[i] for i in prepared.zone_of(above)] == [Zone.OUTSIDE, Zone.OUTSIDE]


def test_a_plane_that_misses_the_mesh_is_refused():
    with pytest.raises(BadInput, match="outside the nominal"):
        nominal().section(120.0)


def test_platform_and_root_of_a_real_blade_are_not_airfoil():
    if not REAL.exists():
        pytest.skip(f"no real blade at {REAL}")
    prepared = prepare_nominal(read_nominal(REAL, "mm"), NominalSettings())
    assert 120.5 < prepared.z_min_mm < 123.0  # the fillet of the platform ends between these heights
    assert prepared.z_max_mm == pytest.approx(148.860, abs=1e-3)
    assert prepared.le_line_mm[:, 0].max() < -9.0  # the thick end
    assert prepared.te_line_mm[:, 0].min() > 9.0
    platform = prepared.mesh.vertices_mm[prepared.mesh.vertices_mm[:, 2] < 119.0][::50]
    assert (prepared.zone_of(platform) == ZONE_ORDER.index(Zone.OUTSIDE)).all()


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "3mf"])
@pytest.mark.parametrize("units", ["mm", "inch"])
def test_files_of_every_format_give_the_same_solid(tmp_path, ending, units):
    solid = blades.mesh(BLADE, 40, 8)
    path = tmp_path / f"nominal.{ending}"
    trimesh.Trimesh(solid.vertices_mm, solid.faces, process=False).export(path)
    mesh = read_nominal(path, units)
    scale = {"mm": 1.0, "inch": 25.4}[units]
    assert volume_mm3(mesh) == pytest.approx(scale**3 * volume_mm3(solid), rel=1e-5)
    assert len(mesh.vertices_mm) == len(solid.vertices_mm)


def _broken(kind, solid):
    vertices, faces = solid.vertices_mm.copy(), solid.faces.copy()
    if kind == "open":
        faces = faces[1:]
    elif kind == "flipped":
        faces[5] = faces[5][::-1]
    elif kind == "inside out":
        faces = faces[:, ::-1]
    elif kind == "not finite":
        vertices[3, 1] = np.nan
    elif kind == "flat":
        vertices[:, 2] = 0.0
    return vertices, faces


@pytest.mark.parametrize("kind", ["open", "flipped", "inside out", "not finite", "flat"])
def test_what_is_no_solid_is_refused_by_name(tmp_path, kind):
    path = tmp_path / "bad.ply"
    trimesh.Trimesh(*_broken(kind, blades.mesh(BLADE, 20, 4)), process=False).export(path)
    with pytest.raises(BadMesh, match=r"bad\.ply: ") as fault:
        read_nominal(path, "mm")
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "3mf"])
@pytest.mark.parametrize("content", [b"", b"rubbish\n" * 40, b"\x00" * 500, None])
def test_damaged_files_are_refused_by_name(tmp_path, ending, content):
    path = tmp_path / f"bad.{ending}"
    if content is None:
        trimesh.Trimesh(*_broken("", blades.mesh(BLADE, 20, 4)), process=False).export(path)
        content = path.read_bytes()[: path.stat().st_size // 2]
    path.write_bytes(content)
    with pytest.raises(BadMesh, match=rf"bad\.{ending}: ") as fault:
        read_nominal(path, "mm")
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("name", ["missing.stl", "blade.docx"])
def test_missing_and_foreign_files_are_refused(tmp_path, name):
    with pytest.raises(BadMesh, match=name):
        read_nominal(tmp_path / name, "mm")


def test_two_solids_that_share_an_edge_are_refused():
    shape = trimesh.creation.box(extents=[1, 1, 1])
    twice = Mesh(
        vertices_mm=np.concatenate([shape.vertices, shape.vertices]),
        faces=np.concatenate([shape.faces, shape.faces]),
    )
    with pytest.raises(BadMesh, match="more than two faces"):
        check_solid(twice)
