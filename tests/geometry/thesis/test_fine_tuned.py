"""The thesis' registration: each equation against a slow twin, and the whole against plain ICP."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geometry.blade.nominal import NominalSettings, prepare_nominal
from geometry.errors import BadInput, CannotRegister
from geometry.kernels.hausdorff import average_hausdorff
from geometry.registration.coarse import CoarseSettings, find_pose
from geometry.thesis.cad_points import pitch_of, sample_cad
from geometry.thesis.fine_tuned import (
    ThesisRegisterSettings,
    corner_of_l_curve,
    mask_thesis,
    min_max,
    register_thesis,
)
from geometry.transforms import apply, check_rigid, inverse, rigid
from geometry.types import Cloud
from tests.geometry import blades

BLADE = blades.Blade()
SIGMA_MM = 0.01
FEW = ThesisRegisterSettings(points=20_000)


@cache
def nominal():
    return prepare_nominal(
        blades.mesh(BLADE), NominalSettings(z_min_mm=0.0, z_max_mm=BLADE.height_mm, sample_mm=0.7)
    )


def pose(seed):
    rng = np.random.default_rng(seed)
    return rigid(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-50, 50, 3))


def seen_from(scan, T_nominal_scan):
    points_mm = apply(inverse(T_nominal_scan), scan.points_mm)
    count = len(points_mm)
    return Cloud(points_mm=points_mm, sigma_mm=np.full(count, SIGMA_MM), view=np.zeros(count, np.int64))


@cache
def case():
    """A scan with a deep dent and a cut tip, the cloud as seen, and its thesis alignment."""
    rng = np.random.default_rng(5)
    scan = blades.with_form_error(blades.scan(BLADE, 2.0, rng), 0.02)
    scan = blades.with_dent(scan, BLADE.point(np.array([4.5]), np.array([50.0]))[0], 8.0, 1.6)
    scan = blades.with_noise(blades.with_tip_cut(scan, BLADE, 12.0, rng), SIGMA_MM, rng)
    cloud = seen_from(scan, pose(5))
    return scan, cloud, register_thesis(cloud, nominal(), FEW)


def plain_icp(cloud, T, steps=200):
    """Nearest of the same CAD points and the best rigid motion, until the error settles; all pairs kept."""
    cad_mm = sample_cad(nominal(), ~nominal().end_face, pitch_of(cloud.points_mm)).points_mm
    tree, before = cKDTree(cad_mm), np.inf
    for _ in range(steps):
        distance, nearest = tree.query(apply(T, cloud.points_mm))
        if abs(before - np.sqrt(np.mean(distance**2))) < 1e-6:
            break
        before = np.sqrt(np.mean(distance**2))
        target, mean = cad_mm[nearest].mean(0), cloud.points_mm.mean(0)
        R, _ = Rotation.align_vectors(cad_mm[nearest] - target, cloud.points_mm - mean)
        T = rigid(R.as_matrix(), target - R.as_matrix() @ mean)
    return T


def sectional_change_mm(scan, cloud, T):
    """Largest change of a sectional root mean square deviation against the true pose: the thesis' measure."""
    deviations = [np.abs(nominal().closest(apply(t, cloud.points_mm)).distance_mm) for t in (T, pose(5))]
    slabs = [np.abs(scan.points_mm[:, 2] - z) < 1.0 for z in np.linspace(5.0, 75.0, 15)]
    found, true = (np.array([np.sqrt(np.mean(d[slab] ** 2)) for slab in slabs]) for d in deviations)
    return np.abs(found - true).max()


def test_the_fine_tuned_pose_beats_plain_icp():
    scan, cloud, alignment = case()
    check_rigid(alignment.T_nominal_scan, "alignment")
    coarse = find_pose(cloud.points_mm, nominal(), CoarseSettings())
    plain_mm = sectional_change_mm(scan, cloud, plain_icp(cloud, coarse.T_nominal_scan))
    tuned_mm = sectional_change_mm(scan, cloud, alignment.T_nominal_scan)
    assert tuned_mm < 0.9 * plain_mm  # half of it at the density of the thesis
    assert tuned_mm < 0.006


def test_the_alignment_says_what_it_is_worth():
    scan, _, alignment = case()
    assert alignment.method == "thesis"
    assert alignment.converged
    assert alignment.runner_up_ratio > 1.5
    assert alignment.noise_mm == pytest.approx(np.hypot(SIGMA_MM, 0.01), rel=0.3)  # noise and form error
    assert 0.7 < alignment.inlier_fraction < 1.0 - 0.5 * np.mean(scan.depth_mm > 0.3)
    assert 0.8 < alignment.explained_fraction < 1.0
    assert alignment.weak_directions == ()
    assert np.linalg.eigvalsh(alignment.information).min() > 0.0


def test_deep_damage_is_cut_off_and_little_else():
    scan, cloud, alignment = case()
    mask = mask_thesis(cloud, alignment, nominal())
    assert mask[scan.depth_mm > 0.5].mean() > 0.95
    assert mask[scan.depth_mm == 0.0].mean() < 0.12


def test_hausdorff_distances_against_a_slow_twin():
    """Eq. 3.5, neighbourhood by neighbourhood, with holes in them and curvatures not known."""
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(60, 3)), rng.normal(size=(50, 3))
    ka, kb = rng.normal(size=60), rng.normal(size=50)
    ka[:5], kb[3] = np.nan, np.nan
    na, nb = rng.integers(0, 60, (60, 7)), rng.integers(0, 50, (50, 6))
    na[rng.uniform(size=na.shape) < 0.2] = -1
    nb[7] = -1
    partner = rng.integers(0, 50, 60)
    euclidean, curvature = average_hausdorff(a, ka, na, b, kb, nb, partner)
    for i in range(60):
        mine, others = na[i][na[i] >= 0], nb[partner[i]][nb[partner[i]] >= 0]
        for found, distance in (
            (euclidean[i], np.linalg.norm(a[mine][:, None] - b[others][None], axis=2)),
            (curvature[i], _known(np.abs(ka[mine][:, None] - kb[others][None]))),
        ):
            if 0 in distance.shape:
                assert np.isnan(found)
            else:
                both = np.concatenate([distance.min(axis=1), distance.min(axis=0)])
                assert found == pytest.approx(both.mean(), rel=1e-12)


def _known(distance):
    rows, columns = ~np.isnan(distance).all(axis=1), ~np.isnan(distance).all(axis=0)
    return distance[rows][:, columns]


def test_min_max_against_its_definition():
    values = np.array([3.0, np.nan, -1.0, 7.0])
    np.testing.assert_allclose(min_max(values), [0.5, np.nan, 0.0, 1.0])
    np.testing.assert_array_equal(min_max(np.full(4, 2.0)), np.zeros(4))


@pytest.mark.parametrize("seed", range(5))
def test_the_corner_of_the_l_curve_against_a_slow_twin(seed):
    rng = np.random.default_rng(seed)
    values = np.concatenate([rng.uniform(0.0, 0.1, 400), rng.uniform(0.1, 1.5, 40)])
    ascending = sorted(values)
    low, high, last = ascending[0], ascending[-1], len(values) - 1
    scaled = [low + index * (high - low) / last for index in range(len(values))]  # eq. 3.8
    apart = [np.hypot(x - high, y - low) for x, y in zip(scaled, ascending, strict=True)]
    assert corner_of_l_curve(rng.permutation(values)) == ascending[int(np.argmin(apart))]
    assert 0.05 < corner_of_l_curve(values) < 0.5


def test_cad_points_are_as_dense_as_the_scan_and_even():
    pitch_mm = 0.9
    nodes = sample_cad(nominal(), nominal().airfoil_face, pitch_mm)
    area_mm2 = nominal().samples.area_mm2.sum()
    assert len(nodes.points_mm) == pytest.approx(area_mm2 / pitch_mm**2, rel=0.25)
    assert np.abs(nominal().closest(nodes.points_mm).distance_mm).max() < 1e-9
    gap_mm, _ = cKDTree(nodes.points_mm).query(nominal().samples.points_mm)
    assert gap_mm.max() < 1.5 * pitch_mm


def test_the_pitch_of_a_scan_is_that_of_its_density():
    cloud = blades.scan(BLADE, 4.0, np.random.default_rng(2))
    assert pitch_of(cloud.points_mm) == pytest.approx(0.5, rel=0.1)


def test_too_few_points_and_points_on_a_line_are_refused():
    scan, _, _ = case()
    few = blades.Scan(
        points_mm=scan.points_mm[:100], normals=scan.normals[:100], depth_mm=scan.depth_mm[:100]
    )
    with pytest.raises(CannotRegister):
        register_thesis(seen_from(few, pose(1)), nominal(), FEW)
    line = np.column_stack([np.linspace(0.0, 50.0, 500), np.zeros(500), np.zeros(500)])
    flat = Cloud(points_mm=line, sigma_mm=np.full(500, 0.01), view=np.zeros(500, np.int64))
    with pytest.raises(CannotRegister):
        register_thesis(flat, nominal(), FEW)


@pytest.mark.parametrize(("hidden_mm", "most_mm"), [(0.0, 0.2), (7.0, 0.5)])
def test_what_a_fixture_hides_does_not_draw_the_scan_along_the_span(hidden_mm, most_mm):
    """Pairs of points alone hold this blade along its span: with the whole nominal it slid by 2.8."""
    held = prepare_nominal(
        blades.mesh(BLADE), NominalSettings(z_min_mm=8.0, z_max_mm=BLADE.height_mm, sample_mm=0.7)
    )
    rng = np.random.default_rng(6)
    scan = blades.with_noise(blades.scan(BLADE, 4.0, rng), SIGMA_MM, rng)
    points_mm = scan.points_mm[scan.points_mm[:, 2] > hidden_mm]
    T_nominal_scan = pose(6)
    cloud = Cloud(
        points_mm=apply(inverse(T_nominal_scan), points_mm),
        sigma_mm=np.full(len(points_mm), SIGMA_MM),
        view=np.zeros(len(points_mm), np.int64),
    )
    found = register_thesis(cloud, held, FEW)
    moved_mm = apply(found.T_nominal_scan, cloud.points_mm) - points_mm
    assert np.abs(moved_mm[:, 2]).max() < most_mm


@pytest.mark.parametrize("wrong", [{"points": 10}, {"close_mm": 0.0}, {"icp_steps": 0}])
def test_settings_that_contradict_themselves_are_refused(wrong):
    with pytest.raises(BadInput):
        replace(FEW, **wrong)
