"""What noise and the form of a part are said to do to its pose, against what they do to many."""

from functools import cache

import numpy as np
import pytest

from geometry.blade.nominal import NominalSettings, prepare_nominal
from geometry.registration.fit import Fit, fit_kept, information
from geometry.registration.form_effect import Surface, form_effect, required
from geometry.registration.uncertainty import certainty
from geometry.transforms import apply, log
from tests.geometry import blades

BLADE = blades.Blade()
SCREW = blades.Blade(taper=0.0, thickness_taper=0.0)  # its tip face alone holds the height
SIGMA_MM = 0.015


@cache
def nominal(blade=BLADE):
    return prepare_nominal(blades.mesh(blade), NominalSettings(z_min_mm=0.0, z_max_mm=blade.height_mm))


@cache
def exact(blade=BLADE, per_mm2=0.4):
    return nominal(blade).closest(blades.scan(blade, per_mm2, np.random.default_rng(1)).points_mm)


def effect_of(nominal_, moved_mm, found):
    return form_effect(nominal_, moved_mm, found, np.ones(len(moved_mm)), required(nominal_))


def fitted(residual_mm, blade=BLADE, per_mm2=0.4):
    """The twist that least squares gives points off the surface by `residual_mm`, and the stated parts."""
    twist, known, effect = fitted_to(exact(blade, per_mm2), residual_mm, blade)
    return twist, known, effect.form


def fitted_to(feet, residual_mm, blade=BLADE):
    points_mm = feet.points_mm + residual_mm[:, None] * feet.normals
    found = nominal(blade).closest(points_mm)
    start = Fit(T_nominal_scan=np.eye(4), found=found, weak=(), iterations=0, converged=False)
    fit = fit_kept(points_mm, start, np.ones(len(points_mm), bool), nominal(blade))
    moved_mm = apply(fit.T_nominal_scan, points_mm)
    known = information(nominal(blade), moved_mm, fit.found.normals, np.full(len(points_mm), SIGMA_MM))
    effect = effect_of(nominal(blade), moved_mm, fit.found)
    return log(fit.T_nominal_scan, nominal(blade).pivot_mm), known, effect


def scaled_errors(residuals, blade=BLADE):
    """Errors (runs, 6) along the motions of the stated covariance, in its sigmas."""
    scaled = []
    for residual_mm in residuals:
        twist, known, form = fitted(residual_mm, blade)
        stated = certainty(nominal(blade), known, form)
        scaled.append(np.linalg.solve(stated.twists, twist) / stated.sigma_mm)
    return np.array(scaled)


def test_noise_alone_is_stated_rightly_in_every_direction():
    rng = np.random.default_rng(2)
    errors = scaled_errors(rng.normal(scale=SIGMA_MM, size=len(exact().points_mm)) for _ in range(60))
    spread = np.sqrt(np.mean(errors**2, axis=0))
    assert ((spread > 0.75) & (spread < 1.25)).all()  # 200 draws: within 0.8 to 1.25 by the benchmark


def test_noise_alone_has_next_to_no_form():
    rng = np.random.default_rng(3)
    _, known, form = fitted(rng.normal(scale=SIGMA_MM, size=len(exact().points_mm)))
    assert np.trace(form) < 0.5 * np.trace(np.linalg.inv(known))


def test_the_form_is_stated_within_a_factor_of_a_few():
    """A smooth random form: what it does to the pose is far above the noise, and covered."""
    rng = np.random.default_rng(4)
    feet_mm, normals = exact().points_mm, exact().normals
    forms = [smooth_form(feet_mm, normals, rng) for _ in range(25)]
    residuals = [form + rng.normal(scale=SIGMA_MM, size=len(form)) for form in forms]
    spread = np.sqrt(np.mean(scaled_errors(residuals) ** 2, axis=0))
    assert ((spread > 0.15) & (spread < 2.5)).all()
    twists = np.array([fitted(residual)[0] for residual in residuals[:8]])
    noise_mm = np.sqrt(np.linalg.inv(fitted(residuals[0])[1])[3, 3])
    assert np.sqrt(np.mean(twists[:, 3] ** 2)) > 3.0 * noise_mm


def smooth_form(feet_mm, normals, rng):
    """A random form (n,) of a few waves of about 20 mm and more."""
    waves = rng.normal(scale=[0.08, 0.3, 0.08], size=(12, 3))
    phases, sizes = rng.uniform(0, 2 * np.pi, 12), rng.normal(scale=0.008, size=12)
    side = np.where(rng.random(12)[:, None] < 0.5, 1.0, np.sign(normals[:, 1] + 1e-12))
    return (sizes[:, None] * side * np.sin(waves @ feet_mm.T + phases[:, None])).sum(axis=0)


def unseen_errors(seen_of, draws=25, seed=8):
    """Errors (draws, 6) of the pose of what is seen (n,) from the whole part's, in stated sigmas."""
    rng, feet = np.random.default_rng(seed), exact()
    scaled = []
    for _ in range(draws):
        form = smooth_form(feet.points_mm, feet.normals, rng)
        seen = seen_of(feet.points_mm, feet.normals)
        whole, _, _ = fitted_to(feet, form)
        noise = rng.normal(scale=SIGMA_MM, size=int(seen.sum()))
        twist, known, effect = fitted_to(feet.of(seen), form[seen] + noise)
        stated = certainty(nominal(), known, effect.unseen)
        scaled.append(np.linalg.solve(stated.twists, twist - whole) / stated.sigma_mm)
    return np.array(scaled)


@pytest.mark.parametrize(
    "seen_of",
    [
        lambda points_mm, normals: points_mm[:, 2] < 80.0,
        lambda points_mm, normals: (normals[:, 1] > 0.0) | (points_mm[:, 0] > 12.0),
        lambda points_mm, normals: (points_mm[:, 2] % 20.0 < 14.0) | (normals[:, 1] < 0.0),
    ],
    ids=["no upper quarter", "one side in part", "patches of one side"],
)
def test_what_was_not_seen_of_the_form_is_stated(seen_of):
    """The pose of a part of the surface is as far from that of all of it as stated."""
    spread = np.sqrt(np.mean(unseen_errors(seen_of) ** 2, axis=0))
    assert ((spread > 0.2) & (spread < 2.5)).all()


def test_nothing_is_unseen_where_all_is_seen():
    rng = np.random.default_rng(9)
    feet = exact(per_mm2=5.0)
    form = smooth_form(feet.points_mm, feet.normals, rng)
    _, _, effect = fitted_to(feet, form + rng.normal(scale=SIGMA_MM, size=len(form)))
    assert np.trace(effect.unseen) < 0.01 * np.trace(effect.form)


def test_a_zone_of_which_nothing_can_be_seen_leaves_finite_numbers():
    feet = exact()
    nothing = Surface(points_mm=np.zeros((0, 3)), normals=np.zeros((0, 3)), shares=np.zeros(0))
    effect = form_effect(nominal(), feet.points_mm, feet, np.ones(len(feet.face)), nothing)
    assert np.isfinite(effect.unseen).all()
    assert np.isfinite(effect.form).all()


@pytest.mark.parametrize("waves", [3, 6, 12])
@pytest.mark.parametrize("along", ["chord", "span"])
def test_waves_are_stated_within_a_factor_of_a_few(along, waves):
    """Pure waves of the size of a form: their errors are within what is stated, and not far within."""
    rng = np.random.default_rng(5)
    x, _, z = exact().points_mm.T
    side = np.sign(exact().normals[:, 1] + 1e-12)
    place = x / BLADE.chord_mm if along == "chord" else z / BLADE.height_mm
    wall = np.abs(exact().normals[:, 2]) < 0.7
    residuals = []
    for _ in range(12):
        turn = 2.0 * np.pi * (waves * place + rng.random())
        form = 0.02 * np.sin(turn) * (side if rng.random() < 0.5 else 1.0) * wall
        residuals.append(form + rng.normal(scale=SIGMA_MM, size=len(form)))
    spread = np.sqrt(np.mean(scaled_errors(residuals) ** 2, axis=0))
    assert ((spread > 0.1) & (spread < 2.0)).all()


@pytest.mark.parametrize(("per_mm2", "noise_mm"), [(0.4, 0.001), (5.0, 0.1)])
def test_waves_on_the_end_face_that_holds_the_height_are_stated(per_mm2, noise_mm):
    """Its few points are no surer than the waves on them are high, however many lie on the walls."""
    rng = np.random.default_rng(7)
    found = exact(SCREW, per_mm2)
    lid = nominal(SCREW).tip_face[found.face]
    residuals = []
    for _ in range(12):
        turn = 2.0 * np.pi * (2.3 * found.points_mm[:, 0] / SCREW.chord_mm + rng.random())
        residuals.append(lid * 0.03 * np.sin(turn) + rng.normal(scale=noise_mm, size=len(lid)))
    fits = [fitted(residual, SCREW, per_mm2) for residual in residuals]
    off_mm = np.sqrt(np.mean([twist[5] ** 2 for twist, _, _ in fits]))
    stated_mm = np.sqrt(np.mean([form[5, 5] for _, _, form in fits]))
    assert off_mm > 0.001
    assert 0.3 < off_mm / stated_mm < 2.0


def test_flat_facets_are_no_surface():
    """A coarse nominal of the same blade: its facets lie inside, which no scatter of the residuals shows."""
    coarse = prepare_nominal(
        blades.mesh(BLADE, around=60, up=12), NominalSettings(z_min_mm=0.0, z_max_mm=BLADE.height_mm)
    )
    points_mm = exact().points_mm[exact().points_mm[:, 2] < 30.0]
    found = coarse.closest(points_mm)
    kept = ~coarse.end_face[found.face]
    form = effect_of(coarse, points_mm[kept], found.of(kept)).form
    assert np.sqrt(form[5, 5]) > 0.1


def test_a_free_motion_is_huge_and_finite():
    free = np.diag([1e6, 1e6, 0.0, 1e6, 1e6, 0.0])
    stated = certainty(nominal(), free, np.zeros((6, 6)))
    assert np.isfinite(stated.sigma_mm).all()
    assert (stated.sigma_mm[-2:] > 1e3).all()
    assert stated.sigma_mm[0] == pytest.approx(1e-3, rel=0.5)
