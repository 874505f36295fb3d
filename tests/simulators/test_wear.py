"""The best fit that gives a worn blade its frame, and space warps of meshes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simulators.airfoils import airfoil_loop, find_airfoil
from simulators.blade import BladeShape, Wear, blade_solid
from simulators.solids import to_manifold
from simulators.wear import WornBlade, best_fit, mesh_nominal, section_truths, thesis_nominal, worn_blade

NOMINAL = thesis_nominal(BladeShape())


def test_a_small_motion_is_taken_back() -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([1e-4, -2e-4, 3e-4]).as_matrix()
    T[:3, 3] = [0.01, 0.02, -0.015]
    back, form_mm = best_fit(NOMINAL.airfoil, NOMINAL.airfoil.solid.moved(T))
    assert back @ T == pytest.approx(np.eye(4), abs=3e-5)
    assert form_mm < 5e-5


def test_wear_without_size_is_the_nominal() -> None:
    worn = worn_blade(NOMINAL, Wear(wave_mm=0.0, bump_mm=0.0))
    assert worn.airfoil.solid.vertices_mm == pytest.approx(NOMINAL.airfoil.solid.vertices_mm, abs=1e-9)
    (truth,) = section_truths(NOMINAL, worn, (60.0,))
    assert max(truth.deviations().values()) < 1e-6


def test_a_worn_blade_lies_in_its_best_fit() -> None:
    worn = worn_blade(NOMINAL, Wear(bend_mm=0.2, untwist_deg=0.2, seed=4))
    again, form_mm = best_fit(NOMINAL.airfoil, worn.airfoil.solid)
    assert again == pytest.approx(np.eye(4), abs=2e-3)
    assert form_mm == pytest.approx(worn.form_mm, rel=0.02)


def test_the_section_truth_agrees_with_a_slice_of_the_worn_mesh() -> None:
    wear = Wear(bump_mm=0.06, bend_mm=0.1, untwist_deg=-0.1, seed=8)
    worn = worn_blade(NOMINAL, wear)
    (closed,) = section_truths(NOMINAL, worn, (70.0,))
    mesh = mesh_nominal("SIM-MESH", NOMINAL.airfoil.solid, 6.0, None)
    cut = WornBlade(
        airfoil=worn.airfoil,
        section=lambda z_mm: airfoil_loop(worn.airfoil.solid, z_mm),
        form_mm=worn.form_mm,
    )
    (sliced,) = section_truths(mesh, cut, (70.0,))
    assert sliced.position_x_mm == pytest.approx(closed.position_x_mm, abs=5e-4)
    assert sliced.position_y_mm == pytest.approx(closed.position_y_mm, abs=5e-4)
    assert sliced.orientation_deg == pytest.approx(closed.orientation_deg, abs=2e-3)
    assert sliced.actual.max_thickness_mm == pytest.approx(closed.actual.max_thickness_mm, abs=2e-3)


def test_a_warped_mesh_stays_closed_and_keeps_what_is_below() -> None:
    solid = blade_solid(BladeShape(), BladeShape().surface, around=240, along=106)
    nominal = mesh_nominal("SIM-MESH", solid, 20.0, None)
    worn = worn_blade(nominal, Wear(bump_mm=0.05, bend_mm=0.1, untwist_deg=0.1, seed=2))
    assert to_manifold(worn.airfoil.solid).genus() == 0
    assert 0.01 < worn.form_mm < 0.2
    moved = np.linalg.norm(worn.airfoil.solid.vertices_mm - solid.vertices_mm, axis=1)
    assert moved.max() < 0.5


def test_the_airfoil_of_a_plain_blade_is_found_without_help() -> None:
    airfoil = find_airfoil(blade_solid(BladeShape(), BladeShape().surface, around=240, along=106))
    assert airfoil.z_min_mm == pytest.approx(5.25, abs=0.01)
    assert airfoil.z_max_mm == 105.0
    frame = airfoil.frame(50.0)
    assert frame.le_mm[0] < -19.0 < 19.0 < frame.te_mm[0]
    assert frame.suction_point_mm(0.5)[1] > frame.pressure_point_mm(0.5)[1]
