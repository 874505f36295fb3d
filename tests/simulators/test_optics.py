"""The scanner before plates and posts whose pictures are known, and before the blade."""

from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from simulators.blade import BladeShape, blade_solid
from simulators.optics import BlindSpot, OpticsSettings, StructuredLight
from simulators.rig import Rig, about_z, apply, inverse, rig_around
from simulators.solids import Floats, face_normals

QUIET = OpticsSettings(noise_normal_mm=0.0, flying=0.0, dropout=0.0)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def small_rig(seat_mm: float = -100.0) -> Rig:
    return rig_around(radius_mm=25.0, low_mm=0.0, high_mm=40.0, pitch_mm=0.4, seat_mm=seat_mm, seed=2)


def before(mesh: trimesh.Trimesh, rig: Rig, settings: OpticsSettings = QUIET) -> StructuredLight:
    return StructuredLight(np.array(mesh.vertices), np.array(mesh.faces), np.eye(4), rig, settings)


def on_table(image: Floats, rig: Rig, angle_deg: float) -> Floats:
    seen = image[np.isfinite(image[..., 0])]
    return apply(inverse(rig.T_scanner_table0 @ about_z(angle_deg)), seen)


def box(extents: tuple[float, float, float], centre: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents=extents)
    mesh.apply_translation(centre)
    return mesh


@pytest.mark.parametrize("angle_deg", [0.0, 37.0, 251.0])
def test_points_lie_on_the_part_in_float64_whatever_the_angle(angle_deg: float) -> None:
    rig = small_rig()
    image = before(box((30.0, 10.0, 40.0), (2.0, -1.0, 20.0)), rig).capture(angle_deg, rng())
    assert image.shape == (rig.rows, rig.columns, 3)
    assert image.dtype == np.float64
    points = on_table(image, rig, angle_deg)
    off = np.abs(points - [2.0, -1.0, 20.0]) - [15.0, 5.0, 20.0]
    assert len(points) > 2000
    assert np.abs(off.max(axis=1)).max() < 1e-9


def test_a_positive_angle_turns_the_part_counter_clockwise_seen_from_above() -> None:
    rig = small_rig()
    post = before(box((2.0, 2.0, 10.0), (10.0, 0.0, 20.0)), rig)
    places = []
    for angle_deg in (0.0, 30.0):
        image = post.capture(angle_deg, rng())
        places.append(apply(inverse(rig.T_scanner_table0), image[np.isfinite(image[..., 0])]).mean(axis=0))
    heading = np.degrees(np.arctan2([p[1] for p in places], [p[0] for p in places]))
    assert heading[1] - heading[0] == pytest.approx(30.0, abs=4.0)


def test_the_pixel_pitch_on_the_part_is_as_stated() -> None:
    rig = small_rig()
    image = before(box((60.0, 60.0, 1.0), (0.0, 0.0, 20.0)), rig).capture(0.0, rng())
    step = np.linalg.norm(np.diff(image[rig.rows // 2], axis=0), axis=1)
    assert np.nanmedian(step) == pytest.approx(rig.pitch_mm, rel=0.05)


@pytest.mark.parametrize("sigma_mm", [0.01, 0.05])
def test_the_noise_along_the_normal_grows_with_incidence_from_the_stated_value(sigma_mm: float) -> None:
    rig = small_rig()
    settings = OpticsSettings(noise_normal_mm=sigma_mm, flying=0.0, dropout=0.0)
    image = before(box((50.0, 50.0, 1.0), (0.0, 0.0, 20.5)), rig, settings).capture(0.0, rng())
    points = on_table(image, rig, 0.0)
    camera = apply(inverse(rig.T_scanner_table0), rig.camera_mm[None])[0]
    top = points[(np.abs(points[:, 2] - 21.0) < 0.4) & (np.abs(points[:, :2]).max(axis=1) < 24.0)]
    toward = camera - top
    secant = np.linalg.norm(toward, axis=1) / toward[:, 2]
    stated = sigma_mm * (1.0 + 0.25 * (secant - np.sqrt(2.0)))
    error = top[:, 2] - 21.0
    assert (error / stated).std() == pytest.approx(1.0, abs=0.03)
    assert error.mean() == pytest.approx(0.0, abs=4.0 * sigma_mm / np.sqrt(len(error)))
    bearing = toward / np.linalg.norm(toward, axis=1)[:, None]
    off_ray = np.linalg.norm(np.cross(error[:, None] * bearing, bearing), axis=1)
    assert off_ray.max() < 1e-12


def hits_box(start: Floats, end: Floats, low: Floats, high: Floats) -> np.ndarray:
    """Which segments meet an axis-parallel box (slabs)."""
    way = end - start
    with np.errstate(divide="ignore"):
        a, b = (low - start) / way, (high - start) / way
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return (enter < leave) & (leave > 0.0) & (enter < 1.0)


def test_what_the_projector_does_not_reach_is_not_measured() -> None:
    rig = small_rig()
    post_low, post_high = np.array([-2.0, -2.0, 1.0]), np.array([2.0, 2.0, 21.0])
    scene = trimesh.util.concatenate(
        [box((50.0, 50.0, 1.0), (0.0, 0.0, 0.5)), box((4.0, 4.0, 20.0), (0.0, 0.0, 11.0))]
    )
    image = before(scene, rig).capture(0.0, rng())
    T_table_scanner = inverse(rig.T_scanner_table0)
    camera, projector = apply(T_table_scanner, np.array([rig.camera_mm, rig.projector_mm]))
    directions = rig.directions().reshape(-1, 3) @ T_table_scanner[:3, :3].T
    floor = camera + directions * ((1.0 - camera[2]) / directions[:, 2])[:, None]
    measured = np.isfinite(image[..., 0]).reshape(-1)
    onto_floor = (np.abs(floor[:, :2]).max(axis=1) < 24.9) & ~hits_box(
        camera + 0.0 * floor, floor, post_low, post_high
    )
    lift = floor + np.array([0.0, 0.0, 1e-6])
    near = hits_box(lift, projector + 0.0 * floor, post_low - 0.05, post_high + 0.05)
    deep = hits_box(lift, projector + 0.0 * floor, post_low + 0.05, post_high - 0.05)
    assert (onto_floor & deep).sum() > 200
    assert not measured[onto_floor & deep].any()
    assert measured[onto_floor & ~near].all()


def test_steep_surfaces_are_not_measured() -> None:
    rig = small_rig()
    ball = trimesh.creation.icosphere(subdivisions=5, radius=15.0)
    ball.apply_translation([0.0, 0.0, 20.0])
    points = on_table(before(ball, rig).capture(0.0, rng()), rig, 0.0)
    eyes = apply(inverse(rig.T_scanner_table0), np.array([rig.camera_mm, rig.projector_mm]))
    normal = (points - [0.0, 0.0, 20.0]) / 15.0
    for eye in eyes:
        toward = (eye - points) / np.linalg.norm(eye - points, axis=1)[:, None]
        incidence_deg = np.degrees(np.arccos(np.einsum("ij,ij->i", toward, normal)))
        assert incidence_deg.max() < 72.0 + 2.0  # the ball has facets
        assert incidence_deg.max() > 55.0


def test_flying_points_are_few_and_dropouts_are_holes() -> None:
    rig = small_rig()
    scene = trimesh.util.concatenate(
        [box((50.0, 50.0, 1.0), (0.0, 0.0, 0.5)), box((4.0, 4.0, 20.0), (0.0, 0.0, 11.0))]
    )
    whole = np.isfinite(before(scene, rig).capture(0.0, rng())[..., 0])
    settings = OpticsSettings(noise_normal_mm=0.0, flying=0.2, dropout=0.05)
    image = before(scene, rig, settings).capture(0.0, rng())
    kept = np.isfinite(image[..., 0])
    assert (kept & ~whole).sum() == 0
    assert kept.sum() / whole.sum() == pytest.approx(0.95, abs=0.01)
    points = on_table(image, rig, 0.0)
    on_floor = np.abs(points[:, 2] - 1.0) < 1e-6
    on_post = np.abs(np.abs(points[:, :2]).max(axis=1) - 2.0) < 1e-6
    on_top = np.abs(points[:, 2] - 21.0) < 1e-6
    in_air = ~(on_floor | on_post | on_top) & (points[:, 2] > 1.0)
    assert 3 < in_air.sum() < 100


def test_equal_generators_give_equal_pictures() -> None:
    rig = small_rig()
    scanner = before(box((30.0, 10.0, 40.0), (0.0, 0.0, 20.0)), rig, OpticsSettings())
    first, again, other = (scanner.capture(10.0, rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(first, again, equal_nan=True)
    assert not np.array_equal(first, other, equal_nan=True)


@cache
def blade_views() -> tuple[Floats, Floats]:
    """Points of eight views of the nominal blade, part frame, and the pose they were taken in."""
    solid = blade_solid(BladeShape(), BladeShape().surface)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [0.5, -0.3, 40.0], degrees=True).as_matrix()
    T[:3, 3] = [0.4, -0.3, 15.0]
    rig = rig_around(radius_mm=27.0, low_mm=20.0, high_mm=120.0, pitch_mm=0.3, seat_mm=20.0, seed=1)
    settings = OpticsSettings(
        noise_normal_mm=0.012, flying=0.0, blind=(BlindSpot(centre_mm=(0.0, 4.0, 60.0), radius_mm=5.0),)
    )
    scanner = StructuredLight(solid.vertices_mm, solid.faces, T, rig, settings)
    clouds = [on_table(scanner.capture(45.0 * k, rng(k)), rig, 45.0 * k) for k in range(8)]
    return apply(inverse(T), np.concatenate(clouds)), T


def test_the_blade_is_seen_with_its_tip_face_and_without_its_root() -> None:
    points, T = blade_views()
    assert apply(T, points)[:, 2].min() > 20.0 - 0.2
    on_tip = np.abs(points[:, 2] - 105.0) < 0.05
    well_inside = np.abs(points[:, 1] - 0.03 * points[:, 0]) < 4.0
    assert (on_tip & well_inside).sum() > 1000
    assert points[:, 2].max() < 105.2


def test_a_blind_spot_stays_empty() -> None:
    points, _ = blade_views()
    gap = np.linalg.norm(points - [0.0, 4.0, 60.0], axis=1)
    assert gap.min() > 4.8
    assert (gap < 7.0).sum() > 50


def test_the_noise_on_the_blade_is_as_stated_along_the_normal() -> None:
    points, _ = blade_views()
    solid = blade_solid(BladeShape(), BladeShape().surface)
    flank = points[(points[:, 2] < 100.0) & (np.abs(points[:, 0]) < 15.0)][::20]
    normals, _ = face_normals(solid)
    centres = solid.vertices_mm[solid.faces].mean(axis=1)
    wall = np.abs(normals[:, 2]) < 0.5
    from scipy.spatial import cKDTree

    face = cKDTree(centres[wall]).query(flank)[1]
    error = np.einsum("ij,ij->i", flank - centres[wall][face], normals[wall][face])
    assert error.std() == pytest.approx(0.012, rel=0.08)
    assert abs(error.mean()) < 0.001


@pytest.mark.parametrize(
    "bad", [{"noise_normal_mm": -1.0}, {"max_incidence_deg": 90.0}, {"dropout": float("nan")}]
)
def test_settings_that_cannot_be_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="optics"):
        OpticsSettings(**bad)


def test_a_rig_that_is_not_rigid_is_refused() -> None:
    with pytest.raises(ValueError, match="rigid"):
        Rig(
            T_scanner_table0=2.0 * np.eye(4),
            standoff_mm=300.0,
            baseline_mm=80.0,
            pitch_mm=0.2,
            rows=10,
            columns=10,
            seat_mm=0.0,
        )
