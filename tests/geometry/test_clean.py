"""Cleaning takes what was put in and leaves what belongs."""

import numpy as np
import pytest

from geometry.errors import BadInput
from geometry.kernels.neighbours import k_nearest
from geometry.scan.clean import CleanSettings, clean
from geometry.scan.neighbourhood import nearest_of, surface_shares
from geometry.types import Cloud
from tests.geometry import blades

BLADE = blades.Blade()


def cloud_of(points_mm, sigma_mm=0.015):
    count = len(points_mm)
    return Cloud(points_mm=points_mm, sigma_mm=np.full(count, sigma_mm), view=np.arange(count))


def kept_of(dirty_mm, **settings):
    """A flag a point: the view numbers tell which survived."""
    kept = clean(cloud_of(dirty_mm), CleanSettings(**settings))
    assert np.array_equal(kept.points_mm, dirty_mm[kept.view])
    return np.isin(np.arange(len(dirty_mm)), kept.view)


def scanned(rng, per_mm2=5.0):
    scan = blades.scan(BLADE, per_mm2, rng)
    return blades.with_noise(blades.with_tip_cut(scan, BLADE, 8.0, rng), 0.015, rng)


def test_a_good_scan_keeps_nearly_all_its_points_and_its_edges():
    scan = scanned(np.random.default_rng(1))
    kept = kept_of(scan.points_mm)
    assert kept.mean() > 0.999
    z = scan.points_mm[:, 2]
    le = BLADE.point(np.zeros(len(z)), np.clip(z, 0, 105))
    near_le = np.linalg.norm(scan.points_mm - le, axis=1) < 0.5
    cut_rim = np.isinf(scan.depth_mm)
    assert kept[near_le].mean() > 0.995
    assert kept[cut_rim].mean() > 0.995


def test_flying_pixels_clusters_and_spikes_go():
    rng = np.random.default_rng(2)
    good = scanned(rng).points_mm
    flying = rng.uniform([-30, -20, 0], [30, 20, 110], (300, 3))
    flying = flying[[np.linalg.norm(good - p, axis=1).min() > 1.5 for p in flying]]
    cluster = np.array([0.0, 40.0, 50.0]) + rng.normal(scale=0.3, size=(20, 3))
    chosen = rng.choice(len(good), 200, replace=False)
    spikes = good[chosen] + rng.choice([-1, 1], (200, 1)) * [0.0, 0.4, 0.0]
    strays = np.concatenate([flying, cluster, spikes])
    kept = kept_of(np.concatenate([good, strays]))
    added = kept[len(good) :]
    assert added[: len(flying)].mean() < 0.02
    assert not added[len(flying) : len(flying) + 20].any()
    assert added[-200:].mean() < 0.25  # at the edges and on the tip 0.4 mm sideways is still metal
    assert kept[: len(good)].mean() > 0.995


def test_thinning_keeps_real_points_evenly_within_the_budget():
    rng = np.random.default_rng(3)
    dense = np.column_stack([rng.uniform(0, 10, (20_000, 2)), rng.normal(scale=0.01, size=20_000)])
    crowded = np.column_stack([rng.uniform(0, 2, (20_000, 2)), rng.normal(scale=0.01, size=20_000)])
    points = np.concatenate([dense, crowded])
    kept = clean(cloud_of(points), CleanSettings(most_points=4000))
    assert 3000 < len(kept) <= 4000
    assert np.array_equal(points[kept.view], kept.points_mm)
    share = np.mean((kept.points_mm[:, :2] < 2.0).all(axis=1))
    assert share == pytest.approx(0.04, abs=0.02)  # of the area, not of the points


def test_order_of_the_points_does_not_matter():
    rng = np.random.default_rng(4)
    points = scanned(rng, per_mm2=1.0).points_mm
    shuffled = points[rng.permutation(len(points))]
    a, b = (clean(cloud_of(p), CleanSettings(most_points=3000)).points_mm for p in (points, shuffled))
    assert {tuple(p) for p in a} == {tuple(p) for p in b}


def test_the_neighbours_that_come_along_are_the_nearest():
    rng = np.random.default_rng(6)
    good = scanned(rng, per_mm2=2.0).points_mm
    kept = clean(cloud_of(np.concatenate([good, rng.uniform([-60, 20, 0], [60, 60, 100], (50, 3))])))
    nearest, expected = nearest_of(kept, 17), k_nearest(kept.points_mm, 17)[1]
    whole = (nearest >= 0).all(axis=1)
    assert whole.mean() > 0.99
    distances = np.linalg.norm(kept.points_mm[nearest] - kept.points_mm[:, None], axis=2)
    assert np.abs(distances - expected)[whole].max() < 1e-12
    assert (nearest[:, 0] == np.arange(len(kept))).all()
    assert np.array_equal(nearest_of(kept, 5), k_nearest(kept.points_mm, 5)[0])


def test_a_handful_of_points_is_returned_as_it_is():
    few = cloud_of(np.random.default_rng(5).normal(size=(10, 3)))
    assert len(clean(few)) == 10


@pytest.mark.parametrize(
    "wrong", [{"neighbours": 2}, {"most_points": 0}, {"sparse_ratio": 1.0}, {"outlier_sigmas": 0.0}]
)
def test_settings_that_contradict_themselves_are_refused(wrong):
    with pytest.raises(BadInput, match="clean"):
        CleanSettings(**wrong)


def test_points_share_the_surface_they_lie_on():
    """One half of a sheet four times as dense as the other, also where every third point was taken out."""
    rng = np.random.default_rng(4)
    points_mm = np.column_stack([rng.uniform(0.0, 40.0, (40_000, 2)), np.zeros(40_000)])
    points_mm = points_mm[(points_mm[:, 0] < 20.0) | (rng.random(40_000) < 0.25)]
    nearest = k_nearest(points_mm, 17)[0]
    gone = np.arange(len(points_mm)) % 3 == 0
    for known in (nearest, np.where(gone[nearest], -1, nearest)):
        shares = surface_shares(points_mm, known)
        dense, sparse = (shares[part].mean() for part in (points_mm[:, 0] < 19.0, points_mm[:, 0] > 21.0))
        assert shares.mean() == pytest.approx(1.0)
        assert sparse / dense == pytest.approx(4.0, rel=0.1)
