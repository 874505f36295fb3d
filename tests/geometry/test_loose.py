"""Motions that are called loose: by what was not seen, or by form where the whole surface feels none."""

import numpy as np
import pytest

from geometry.registration.form_effect import FormEffect, Surface, required
from geometry.registration.loose import left_to_form, loose_motions
from geometry.registration.uncertainty import certainty
from tests.geometry.test_form_effect import BLADE, SCREW, SIGMA_MM, exact, fitted_to, nominal, smooth_form

LOOSE_MM = 0.3
CERTAIN = 1e8 * np.eye(6)
LEAD_MM = BLADE.height_mm / np.deg2rad(BLADE.twist_deg)


def worn(seen):
    """What is stated of a blade worn by 0.25 mm (rms), of which points are seen (n,)."""
    feet, rng = exact(), np.random.default_rng(11)
    form_mm = 13.0 * smooth_form(feet.points_mm, feet.normals, rng)
    noise_mm = rng.normal(scale=SIGMA_MM, size=len(form_mm))
    _, known, effect = fitted_to(feet.of(seen), (form_mm + noise_mm)[seen])
    return known, effect


def walls(blade):
    whole = required(nominal(blade))
    wall = np.abs(whole.normals[:, 2]) < 0.9
    return Surface(points_mm=whole.points_mm[wall], normals=whole.normals[wall], shares=whole.shares[wall])


def slid(blade):
    """A form that slides a pose by a millimetre along the screw."""
    twist = np.array([0.0, 0.0, 1.0 / LEAD_MM, 0.0, 0.0, 1.0])
    centre_mm = np.array([*nominal(blade).pivot_mm[:2], 0.0])
    twist[3:] += np.cross(twist[:3], centre_mm)
    return FormEffect(form=np.outer(twist, twist), unseen=np.zeros((6, 6)))


def test_a_worn_blade_seen_all_over_has_its_best_fit():
    known, effect = worn(np.ones(len(exact().face), bool))
    assert certainty(nominal(), known, effect.form).sigma_mm[-1] > LOOSE_MM
    assert loose_motions(nominal(), known, effect, required(nominal()), LOOSE_MM) == []


def test_the_same_blade_seen_in_part_does_not_know_it():
    known, effect = worn(exact().points_mm[:, 2] < 60.0)
    assert loose_motions(nominal(), known, effect, required(nominal()), LOOSE_MM)


def test_a_screw_is_left_to_the_form_unless_a_face_holds_it():
    assert np.linalg.matrix_rank(left_to_form(nominal(SCREW), walls(SCREW)), tol=1e-6) == 1
    assert not left_to_form(nominal(SCREW), required(nominal(SCREW))).any()
    (twist,) = loose_motions(nominal(SCREW), CERTAIN, slid(SCREW), walls(SCREW), LOOSE_MM)
    assert abs(twist[5] / twist[2]) == pytest.approx(LEAD_MM, rel=0.1)
    assert loose_motions(nominal(SCREW), CERTAIN, slid(SCREW), required(nominal(SCREW)), LOOSE_MM) == []


def test_a_pose_that_noise_leaves_open_is_loose_all_over():
    nothing = FormEffect(form=np.zeros((6, 6)), unseen=np.zeros((6, 6)))
    assert len(loose_motions(nominal(), 1e-3 * CERTAIN, nothing, required(nominal()), LOOSE_MM)) == 0
    assert len(loose_motions(nominal(), 1e-9 * CERTAIN, nothing, required(nominal()), LOOSE_MM)) == 6


def test_of_a_surface_that_is_none_all_is_left_to_form():
    nothing = Surface(points_mm=np.zeros((0, 3)), normals=np.zeros((0, 3)), shares=np.zeros(0))
    assert left_to_form(nominal(), nothing) == pytest.approx(np.eye(6))
