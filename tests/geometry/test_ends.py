"""Where a scan stops: sharp ends at both rims hold it, anything else does not."""

from functools import cache

import numpy as np
import pytest

from geometry.blade.nominal import NominalSettings, prepare_nominal
from geometry.registration.ends import on_rim, rims, scan_ends, without_strays
from geometry.registration.fit import Fit
from geometry.registration.register import register
from geometry.registration.settled import held_by_ends
from geometry.transforms import apply, inverse, rigid
from geometry.types import Cloud
from tests.geometry import blades

SCREW = blades.Blade(taper=0.0, thickness_taper=0.0)
SIGMA_MM = 0.02
T_TRUE = rigid(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([30.0, -20.0, 10.0]))


@cache
def nominal():
    return prepare_nominal(blades.mesh(SCREW), NominalSettings(z_min_mm=0.0, z_max_mm=SCREW.height_mm))


def open_scan(seed, per_mm2=3.0, sigma_mm=SIGMA_MM):
    """The walls alone, with noise in every direction, as scans of a blade without its tip face are."""
    rng = np.random.default_rng(seed)
    scan = blades.scan(SCREW, per_mm2, rng, tip_face=False)
    return scan.points_mm + rng.normal(scale=sigma_mm, size=scan.points_mm.shape)


def ends_of(points_mm):
    found = nominal().closest(points_mm)
    return scan_ends(points_mm, np.ones(len(points_mm), bool), found, nominal())


def registered(points_mm):
    count = len(points_mm)
    cloud = Cloud(
        points_mm=apply(inverse(T_TRUE), points_mm),
        sigma_mm=np.full(count, SIGMA_MM),
        view=np.zeros(count, np.int64),
    )
    alignment = register(cloud, nominal())
    samples_mm = nominal().samples.points_mm
    moved_mm = apply(alignment.T_nominal_scan @ inverse(T_TRUE), samples_mm) - samples_mm
    return alignment, float(np.linalg.norm(moved_mm, axis=1).max())


def test_rims_run_round_both_ends():
    bottom, tip = rims(nominal())
    assert (bottom.low_mm, bottom.high_mm) == (0.0, 0.0)
    assert tip.low_mm == pytest.approx(105.0)
    around = np.linspace(0.0, 2.0 * np.pi, 50)
    edge_mm = SCREW.point(around, np.full(50, 105.0))
    assert on_rim(nominal(), edge_mm).all()
    assert not on_rim(nominal(), edge_mm - [0.0, 0.0, 0.2]).any()


@pytest.mark.parametrize("shift_mm", [-0.3, 0.0, 0.4])
def test_both_ends_tell_how_far_a_scan_slid(shift_mm):
    ends = ends_of(open_scan(1) + np.array([0.0, 0.0, shift_mm]))
    assert len(ends) == 2
    for end in ends:
        assert abs(end.off_mm - shift_mm) < 4.0 * end.sigma_mm
        assert end.sigma_mm < 0.03


def test_ends_are_as_certain_as_they_say():
    scaled = np.array(
        [[end.off_mm / end.sigma_mm for end in ends_of(open_scan(seed))] for seed in range(2, 22)]
    )
    assert 0.5 < np.sqrt(np.mean(scaled**2)) < 1.3


def test_an_end_is_told_in_one_place_wherever_the_scan_lies():
    points_mm = open_scan(48, 1.5)
    slides_mm = np.array([-0.03, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03])
    along = np.array([0.0, 0.0, 1.0])
    told_mm = [[end.off_mm for end in ends_of(points_mm + slide * along)] for slide in slides_mm]
    assert np.ptp(np.array(told_mm) - slides_mm[:, None], axis=0).max() < 0.002  # two apart: 0.014


def test_a_short_scan_has_no_ends():
    points_mm = open_scan(30)
    assert ends_of(points_mm[points_mm[:, 2] < 104.7]) == ()


@pytest.mark.parametrize(("seed", "per_mm2"), [(31, 3.0), *((seed, 6.0) for seed in range(31, 36))])
def test_a_ragged_scan_has_no_ends(seed, per_mm2):
    points_mm = open_scan(seed, per_mm2)
    ragged = points_mm[:, 2] < 104.7 + 0.3 * np.sin(0.7 * points_mm[:, 0])
    assert ends_of(points_mm[ragged]) == ()


def test_few_points_make_no_sharp_end_ragged():
    """Of two hundred, a few that noise pushed aside make a wider blur likelier, but no sharp one unlikely."""
    both = [len(ends_of(open_scan(seed, 2.0, 0.03))) == 2 for seed in range(50, 80)]
    assert np.mean(both) >= 0.95


def test_no_single_point_decides_where_a_scan_stops():
    """Nearer to the last point than its noise no end is told: without that point both stay where they are."""
    for seed in range(100, 120):
        points_mm = open_scan(seed)
        fewer_mm = np.delete(points_mm, np.argmax(points_mm[:, 2]), axis=0)
        both = zip(ends_of(points_mm), ends_of(fewer_mm), strict=True)
        moved_mm = [whole.off_mm - fewer.off_mm for whole, fewer in both]
        assert np.abs(moved_mm).max() < 0.012


def test_a_seen_tip_face_needs_no_end():
    scan = blades.scan(SCREW, 3.0, np.random.default_rng(32))
    assert ends_of(scan.points_mm) == ()


def tip_and_walls(on_tip):
    """Points of the walls, and behind them so many of the tip face; their feet, and which lie on the tip."""
    scan = blades.scan(SCREW, 3.0, np.random.default_rng(35))
    tip = np.flatnonzero(scan.normals[:, 2] > 0.9)
    points_mm = scan.points_mm[
        np.concatenate([np.setdiff1d(np.arange(len(scan.points_mm)), tip), tip[:on_tip]])
    ]
    found = nominal().closest(points_mm)
    on_lid = nominal().tip_face[found.face] & ~on_rim(nominal(), found.points_mm)
    return found, on_lid


@pytest.mark.parametrize(
    ("on_tip", "beside_damage", "rests"), [(3, 0, False), (200, 0, True), (200, 197, False)]
)
def test_a_tip_face_counts_where_enough_of_it_is_clear_of_damage(on_tip, beside_damage, rests):
    found, on_lid = tip_and_walls(on_tip)
    sound, clear = np.ones(len(on_lid), bool), np.ones(len(on_lid), bool)
    clear[len(clear) - beside_damage :] = False
    resting = without_strays(sound, clear, found, nominal())
    assert resting[~on_lid].all()
    assert resting[on_lid].all() if rests else not resting[on_lid].any()


def test_a_worn_wall_that_slid_past_its_end_is_no_tip_face():
    points_mm = open_scan(36)
    worn_mm = points_mm - 0.15 * nominal().closest(points_mm).normals * [1.0, 1.0, 0.0]
    assert len(ends_of(worn_mm + np.array([0.0, 0.0, 0.4]))) == 2


def test_a_screw_is_held_by_its_ends():
    alignment, off_mm = registered(open_scan(33))
    assert alignment.weak_directions == ()
    assert off_mm < 0.03
    sigma_mm = np.sqrt(np.linalg.inv(alignment.information)[5, 5])
    assert 0.003 < sigma_mm < 0.03


def slid(points_mm, slide_mm):
    """The fit that ends make of a scan that lies so far along the screw."""
    turn = np.deg2rad(SCREW.twist_deg) / SCREW.height_mm * slide_mm
    c, s = np.cos(turn), np.sin(turn)
    start = rigid(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([0.0, 0.0, slide_mm]))
    found = nominal().closest(apply(start, points_mm))
    count = len(points_mm)
    cloud = Cloud(points_mm=points_mm, sigma_mm=np.full(count, SIGMA_MM), view=np.zeros(count, np.int64))
    fit = Fit(T_nominal_scan=start, found=found, weak=(), iterations=0, converged=False)
    return held_by_ends(cloud, fit, np.ones(count, bool), np.ones(count, bool), nominal()).fit


def test_ends_hold_a_scan_where_they_are_however_far_it_slid():
    points_mm = open_scan(37)
    here = slid(points_mm, 0.0)
    for slide_mm in (-0.4, 0.3):
        there = slid(points_mm, slide_mm)
        apart_mm = apply(there.T_nominal_scan, points_mm[:1]) - apply(here.T_nominal_scan, points_mm[:1])
        assert np.linalg.norm(apart_mm) < 0.002
        assert there.converged


def test_of_two_ends_that_are_apart_the_surer_one_holds_more():
    points_mm = open_scan(38, 6.0)
    points_mm = points_mm[points_mm[:, 2] < 104.95]
    top = np.flatnonzero(points_mm[:, 2] > 103.0)
    points_mm = np.delete(points_mm, top[np.arange(len(top)) % 4 > 0], axis=0)
    bottom, tip = ends_of(apply(slid(points_mm, 0.0).T_nominal_scan, points_mm))
    assert bottom.sigma_mm < 0.8 * tip.sigma_mm
    assert -bottom.off_mm / tip.off_mm == pytest.approx((bottom.sigma_mm / tip.sigma_mm) ** 2, rel=0.1)


def test_ends_that_still_move_the_scan_have_not_converged(monkeypatch):
    monkeypatch.setattr("geometry.registration.settled.LOOKS", 1)
    points_mm = open_scan(37)
    assert slid(points_mm, 0.0).converged
    assert not slid(points_mm, -0.4).converged


def test_a_screw_cut_short_slides_but_never_confidently():
    points_mm = open_scan(34, 1.5)
    alignment, _ = registered(points_mm[points_mm[:, 2] < 103.0])
    assert len(alignment.weak_directions) == 1
