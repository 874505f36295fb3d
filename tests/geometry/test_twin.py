"""The twin against blades in closed form, and on a real blade's mesh."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import manifold3d
import numpy as np
import pytest

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.blade.read import read_nominal
from geometry.blade.solid import check_solid
from geometry.deformation.ground import prepare_ground
from geometry.deformation.twin import Twin, TwinSettings, fit_twin, settled
from geometry.deformation.votes import compare, screen, skin_at_rims
from geometry.errors import CannotFitTwin
from geometry.transforms import apply, exp, inverse
from geometry.types import Bools, Floats, Measurand, Mesh
from tests.geometry import twin_blades as blades
from tests.geometry.airfoils import cloud_of
from tests.geometry.poses import in_place

TURBINE = Path(__file__).parents[3] / "shared/data/turbineblade/turbineblade.ply"


@cache
def nominal(unstructured: bool = False) -> Nominal:
    vertices, faces = blades.solid(0.7, turn=0.12)
    if unstructured:
        body = manifold3d.Manifold(manifold3d.Mesh64(vertices, faces.astype(np.uint64))).simplify(0.0008)
        thinned = body.to_mesh64()
        vertices = np.array(thinned.vert_properties)[:, :3]
        faces = np.array(thinned.tri_verts).astype(np.int64)
    return prepare_nominal(Mesh(vertices_mm=vertices, faces=faces), NominalSettings(z_min_mm=2.0))


@dataclass(frozen=True)
class Case:
    """A fitted twin beside its truth; `lost` are vertices over removed metal, `sound` the others."""

    twin: Twin
    scan: blades.Scan
    error_mm: Floats
    sound: Bools
    lost: Bools
    tip: Bools


@cache
def fitted(shape: str, noise_mm: float, unstructured: bool = False) -> Case:
    truth = blades.Truth(blades.SHAPES[shape])
    cuts = (blades.tip_corner(), blades.pit(truth, 1.5 * np.pi, 48.0, 1.5, 3.2))
    scan = blades.scan(truth, cuts, pitch_mm=0.5, noise_mm=noise_mm)
    twin = fit_twin(
        cloud_of(scan.points, max(noise_mm, 0.001)),
        scan.label > 0,
        in_place(),
        nominal(unstructured),
        TwinSettings(),
    )
    before = twin.mesh.vertices_mm - twin.displacement_mm
    side = (before[:, 2] < blades.SPAN_MM - 1e-3) & (before[:, 2] > 2.0)
    gone = np.logical_or.reduce([cut.gone(before) for cut in cuts])
    return Case(
        twin=twin,
        scan=scan,
        error_mm=np.where(side, truth.distance(twin.mesh.vertices_mm), 0.0),
        sound=side & ~gone,
        lost=side & gone,
        tip=before[:, 2] > blades.SPAN_MM - 1e-9,
    )


def test_the_twin_is_the_undamaged_blade() -> None:
    case = fitted("service", 0.0)
    assert np.abs(case.error_mm[case.sound]).mean() < 0.001  # 0.02 mm before; facets alone make 0.0006
    assert np.abs(case.error_mm[case.lost]).mean() < 0.005
    assert np.abs(case.error_mm[case.lost]).max() < 0.02
    assert case.twin.converged


@pytest.mark.parametrize("shape", ["service", "thick", "bend", "droop"])
def test_every_form_of_wear_is_followed_through_noise(shape: str) -> None:
    case = fitted(shape, 0.01)
    assert np.abs(case.error_mm[case.sound]).mean() < 0.0015
    assert np.abs(case.error_mm[case.lost]).mean() < 0.02
    assert case.twin.noise_mm == pytest.approx(0.01, rel=0.05)
    assert case.twin.converged


def test_a_strong_bend_does_not_pull_the_thin_edge_aside() -> None:
    """At first feet lie on the wrong side of the trailing edge, which must not shape what runs on over the
    lost corner beyond it."""

    def bent(points: Floats) -> Floats:
        s = points[..., 2] / blades.SPAN_MM
        turn = np.radians(0.236) * s
        x, y, c, si = points[..., 0], points[..., 1], np.cos(turn), np.sin(turn)
        return np.stack([c * x - si * y, si * x + c * y + 0.381 * s**2, points[..., 2]], -1)

    truth = blades.Truth(blades.Shape(blades.ripple, bent))
    cut = blades.tip_corner()
    scan = blades.scan(truth, (cut,), pitch_mm=0.45, seed=1)
    twin = fit_twin(cloud_of(scan.points, 0.001), scan.label > 0, in_place(), nominal(), TwinSettings())
    before = twin.mesh.vertices_mm - twin.displacement_mm
    side = (before[:, 2] < blades.SPAN_MM - 1e-3) & (before[:, 2] > 2.0)
    lost = np.flatnonzero(side & cut.gone(before))
    error_mm = truth.distance(twin.mesh.vertices_mm[lost])
    assert np.abs(error_mm).max() < 0.05
    assert np.sqrt(np.mean((error_mm / twin.sigma_mm[lost]) ** 2)) < 2.0


def test_sigma_is_honest_where_seen_and_where_not() -> None:
    for shape in ("service", "bend", "thick"):
        case = fitted(shape, 0.01)
        for where, low, high in ((case.sound, 0.4, 1.5), (case.lost, 0.2, 2.0)):
            ratio = case.error_mm[where] / case.twin.sigma_mm[where]
            assert low < np.sqrt(np.mean(ratio**2)) < high
        lost, sound = (case.twin.sigma_mm[w].mean() for w in (case.lost, case.sound))
        assert lost > 2.0 * sound


@pytest.mark.parametrize("noise_mm", [0.0, 0.01])
def test_a_break_tells_little_of_the_skin_beside_it(noise_mm: float) -> None:
    truth = blades.Truth(blades.Shape(blades.ripple))
    scan = blades.scan(truth, (blades.tip_corner(),), pitch_mm=0.2, noise_mm=noise_mm)
    ground = prepare_ground(nominal(), 9000, 400)
    found = compare(scan.points, None, ground)
    sound = screen(found, ground, 0.03, 0)
    skin = skin_at_rims(scan.points, sound, found, ground.nodes, 0.03)
    broken = scan.label > 0
    assert not (skin & ~sound).any()
    pulls_mm = np.abs(found.along_mm)
    assert pulls_mm[skin & broken].sum() < 0.3 * pulls_mm[sound & broken].sum()
    assert (skin & ~broken).sum() > 0.995 * (sound & ~broken).sum()


def test_the_ends_do_not_slide() -> None:
    case = fitted("bend", 0.01)
    seen_tip = case.tip & case.twin.supported
    assert seen_tip.any()
    assert np.abs(case.twin.mesh.vertices_mm[seen_tip, 2] - blades.SPAN_MM).max() < 0.006


def test_what_is_gone_has_no_support() -> None:
    case = fitted("service", 0.01)
    assert case.twin.supported[case.sound].mean() > 0.98
    assert case.twin.supported[case.lost].mean() < 0.15
    assert case.twin.sound[case.scan.label > 0].mean() < 0.02
    assert case.twin.sound[case.scan.label == 0].mean() > 0.97


def test_form_is_the_largest_deviation_of_the_sound_surface() -> None:
    case = fitted("service", 0.01)
    form = case.twin.form_mm
    assert isinstance(form, Measurand)
    assert abs(form.value - 0.0838) < 3.0 * form.sigma + 0.001  # of the closed form, over the sound part


def test_the_twin_is_a_solid_on_the_faces_of_the_nominal() -> None:
    twin = fitted("service", 0.0).twin
    check_solid(twin.mesh)
    given = nominal().mesh
    before = (twin.mesh.vertices_mm - twin.displacement_mm)[twin.mesh.faces].mean(axis=1)
    face = given.vertices_mm[given.faces[twin.nominal_face]]
    normal = np.cross(face[:, 1] - face[:, 0], face[:, 2] - face[:, 0])
    height = np.einsum("nj,nj->n", before - face[:, 0], normal) / np.linalg.norm(normal, axis=1)
    assert np.abs(height).max() < 1e-9


def test_an_unstructured_nominal_gives_the_same_twin() -> None:
    case = fitted("service", 0.01, unstructured=True)
    check_solid(case.twin.mesh)
    assert np.abs(case.error_mm[case.sound]).mean() < 0.0025
    assert np.abs(case.error_mm[case.lost]).mean() < 0.02


def test_the_frame_of_the_scan_does_not_matter() -> None:
    case = fitted("service", 0.01)
    T = exp(np.array([0.4, -1.1, 2.0, 30.0, -80.0, 12.0]), np.zeros(3))
    moved = cloud_of(apply(inverse(T), case.scan.points), 0.01)
    twin = fit_twin(moved, case.scan.label > 0, in_place(T), nominal(), TwinSettings())
    np.testing.assert_allclose(twin.mesh.vertices_mm, case.twin.mesh.vertices_mm, atol=5e-4)


def test_without_enough_sound_points_there_is_no_twin() -> None:
    case = fitted("service", 0.01)
    cloud = cloud_of(case.scan.points, 0.01)
    with pytest.raises(CannotFitTwin):
        fit_twin(cloud, np.ones(len(cloud), np.bool_), in_place(), nominal(), TwinSettings())
    low = case.scan.points[case.scan.points[:, 2] < 20.0]
    with pytest.raises(CannotFitTwin):
        fit_twin(cloud_of(low, 0.01), np.zeros(len(low), np.bool_), in_place(), nominal(), TwinSettings())
    few = cloud_of(case.scan.points[:3], 0.01)
    with pytest.raises(CannotFitTwin):
        fit_twin(few, np.zeros(3, np.bool_), in_place(), nominal(), TwinSettings())


@pytest.mark.skipif(not TURBINE.is_file(), reason="the real turbine blade is not here")
def test_a_real_blade_with_platform_and_root() -> None:
    """Its mesh, moved by a known smooth field along its normals, is scanned down to where the tip is cut."""
    given = prepare_nominal(read_nominal(TURBINE, "mm"), NominalSettings())
    vertices, faces = given.mesh.vertices_mm, given.mesh.faces
    normals = given.closest(vertices).normals
    s = (vertices[:, 2] - given.z_min_mm) / (given.z_max_mm - given.z_min_mm)
    moved_mm = 0.03 * np.sin(2.2 * s + 0.3) * np.cos(vertices[:, 0] / 7.0) + 0.015 * np.sin(
        vertices[:, 1] / 5.0
    )
    true = vertices + moved_mm[:, None] * normals
    rng = np.random.default_rng(3)
    corners = true[faces[given.airfoil_face]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(area), 50_000, p=area / area.sum())]
    points = np.einsum("nc,ncj->nj", rng.dirichlet([1.0, 1.0, 1.0], len(chosen)), chosen)
    cut_mm = given.z_max_mm - 1.5
    points = points[(points[:, 2] < cut_mm) & (points[:, 2] > given.z_min_mm)]
    points += rng.normal(0.0, 0.005, points.shape)
    twin = fit_twin(
        cloud_of(points, 0.005),
        np.zeros(len(points), np.bool_),
        in_place(),
        given,
        replace(TwinSettings(), draws=16),
    )
    check_solid(twin.mesh)
    error_mm = np.einsum("nj,nj->n", twin.mesh.vertices_mm[: len(true)] - true, normals)
    on_airfoil = np.zeros(len(true), np.bool_)
    on_airfoil[np.unique(faces[given.airfoil_face])] = True
    sound, lost = on_airfoil & (true[:, 2] < cut_mm), on_airfoil & (true[:, 2] >= cut_mm)
    assert np.abs(error_mm[sound]).mean() < 0.001
    assert np.abs(error_mm[lost]).mean() < 0.02
    off = ~on_airfoil
    assert twin.sigma_mm[: len(true)][off].mean() > 10.0 * twin.sigma_mm[: len(true)][sound].mean()
    assert not twin.supported[: len(true)][off].any() or twin.supported[: len(true)][off].mean() < 0.01
    assert np.linalg.norm(twin.displacement_mm[: len(true)][off], axis=1).max() < 0.3


@pytest.mark.parametrize(
    ("share", "moved_mm", "rests"),
    [
        (0.0, 0.0, True),
        (0.0005, 0.011, True),
        (0.003, 0.011, True),
        (0.0005, 0.05, False),
        (0.01, 0.011, False),
        (1.0, 0.005, True),
    ],
)
def test_rounds_settle_though_a_place_at_a_rim_comes_and_goes(share, moved_mm, rests):
    """Of 20,000 sound points some move, beside damage that begins at 0.03 mm."""
    moved = np.where(np.arange(20_000) < share * 20_000, moved_mm, 0.0)
    assert settled(moved, 0.03) is rests


def test_without_points_nothing_moves():
    assert settled(np.zeros(0), 0.03)
