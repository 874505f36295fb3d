"""Simulated parts as the cell sees them, and the chain of the product over their views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from time import process_time

import numpy as np

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.damage.damages import Damage, find_damages
from geometry.damage.skin import Skin
from geometry.deformation.twin import Twin, TwinSettings, fit_twin
from geometry.registration.alignment import Alignment
from geometry.registration.fit import Fit, felt, fit_kept
from geometry.registration.register import RegisterSettings, mask_damage, neighbours_of, register
from geometry.repair.patches import RepairSettings, RepairVolume, find_repairs
from geometry.scan.calibrate import AxisCalibration
from geometry.scan.clean import clean
from geometry.scan.fuse import fuse
from geometry.scan.neighbourhood import surface_shares
from geometry.scan.overlap import refine_axis
from geometry.transforms import apply, inverse
from geometry.types import Bools, Cloud, Floats, Mesh, View
from simulators.calibration_file import SIGMA_AXIS_OFFSET_MM, SIGMA_AXIS_TILT_DEG, calibrated_axis
from simulators.cutters import Cut
from simulators.optics import OpticsSettings
from simulators.parts import SimPart, assemble
from simulators.presets import rig_of, service_wear
from simulators.recipe import SIGMA_MM, recipe_of
from simulators.rig import Rig
from simulators.solids import Solid
from simulators.wear import NominalBlade, WornBlade, worn_blade

VIEWS = 12

Cutter = Callable[[WornBlade, np.random.Generator], Cut]
Axis = Callable[[Rig, int], AxisCalibration]  # rig, seed -> the axis as it is believed to stand


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Capture:
    """One simulated part as the cell saw it."""

    part: SimPart
    worn: WornBlade
    views: tuple[View, ...]
    axis: AxisCalibration


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inspected:
    """What the chain made of the views."""

    cloud: Cloud
    mask: Bools
    alignment: Alignment
    twin: Twin
    damages: tuple[Damage, ...]
    repairs: RepairVolume
    cpu_s: float


@cache
def nominal_of(blade: NominalBlade) -> Nominal:
    """The nominal of a simulated part number, prepared as its plan says."""
    recipe = recipe_of(blade)
    settings = NominalSettings(
        z_min_mm=recipe.z_min_mm,
        z_max_mm=recipe.z_max_mm,
        tip_mm=5.0 * recipe.scale,
        edge_mm=3.0 * recipe.scale,
    )
    return prepare_nominal(mesh_of(blade.airfoil.solid), settings)


def exact_axis(rig: Rig, _seed: int) -> AxisCalibration:
    """The axis as it truly stands, known without doubt."""
    return AxisCalibration(T_scanner_table0=rig.T_scanner_table0, sigma_offset_mm=0.0, sigma_tilt_deg=0.0)


def believed_axis(rig: Rig, seed: int) -> AxisCalibration:
    """The axis as the calibration of a simulated cell gives it."""
    return AxisCalibration(
        T_scanner_table0=calibrated_axis(rig, seed),
        sigma_offset_mm=SIGMA_AXIS_OFFSET_MM,
        sigma_tilt_deg=SIGMA_AXIS_TILT_DEG,
    )


def capture(
    blade: NominalBlade,
    cutters: Sequence[Cutter],
    noise_mm: float,
    seed: int,
    axis_of: Axis = believed_axis,
    pitch_mm: float | None = None,
) -> Capture:
    """A worn blade with these damages, in twelve views; pixels of `pitch_mm`, or those of the product."""
    rng = np.random.default_rng([seed, 2])
    worn = worn_blade(blade, service_wear(blade, rng))
    part = assemble(
        blade,
        worn,
        [cutter(worn, rng) for cutter in cutters],
        preset="custom",
        serial=f"SIM-{seed}",
        seed=seed,
        optics=OpticsSettings(noise_normal_mm=noise_mm),
        rng=rng,
    )
    rig = rig_of(blade, seed, pitch_mm)
    return Capture(part=part, worn=worn, views=seen(part, rig, seed), axis=axis_of(rig, seed))


def seen(part: SimPart, rig: Rig, seed: int) -> tuple[View, ...]:
    rng, scanner = np.random.default_rng([seed, 3]), part.before(rig)
    angles_deg = [360.0 * i / VIEWS for i in range(VIEWS)]
    images = [scanner.capture(angle_deg, rng).reshape(-1, 3) for angle_deg in angles_deg]
    return tuple(
        View(index=i, angle_deg=angle_deg, points_mm=image[np.isfinite(image[:, 0])])
        for i, (angle_deg, image) in enumerate(zip(angles_deg, images, strict=True))
    )


def inspect(taken: Capture, nominal: Nominal, noise_mm: float) -> Inspected:
    """The chain of the product, from views to patches. Raises `CannotMeasure` where it stops."""
    start_s = process_time()
    sigma_mm = max(noise_mm, SIGMA_MM)
    refined = refine_axis(taken.views, taken.axis, sigma_mm)
    cloud = clean(fuse(taken.views, refined.axis, sigma_mm))
    alignment = register(cloud, nominal)
    mask = mask_damage(cloud, alignment, nominal)
    twin = fit_twin(cloud, mask, alignment, nominal, TwinSettings())
    damages = find_damages(cloud, mask, alignment, nominal, twin)
    repairs = find_repairs(twin, cloud, alignment, damages, RepairSettings())
    return Inspected(
        cloud=cloud,
        mask=mask,
        alignment=alignment,
        twin=twin,
        damages=damages,
        repairs=repairs,
        cpu_s=process_time() - start_s,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """A scan and what is true of each of its points."""

    T_true: Floats
    worn: Skin  # undamaged, nominal frame
    off_mm: Floats  # (points,) from the undamaged surface, negative inside
    within_mm: float  # is sound metal

    @property
    def sound(self) -> Bools:
        return np.asarray(np.abs(self.off_mm) <= self.within_mm)


def known_of(taken: Capture, cloud: Cloud) -> Known:
    """The truth of a cloud; what lies within five sigmas of noise of the worn skin is sound."""
    T_true, worn = inverse(taken.part.T_table_part), Skin(mesh_of(taken.worn.airfoil.solid))
    off_mm, _, _ = worn.closest(apply(T_true, cloud.points_mm))
    noise_mm = taken.part.optics.noise_normal_mm
    return Known(T_true=T_true, worn=worn, off_mm=off_mm, within_mm=5.0 * max(noise_mm, 0.002))


def mesh_of(solid: Solid) -> Mesh:
    """The mesh of a simulated solid."""
    return Mesh(vertices_mm=solid.vertices_mm, faces=solid.faces)


def known_pose(cloud: Cloud, known: Known, nominal: Nominal) -> Floats:
    """Least squares over the points that damage did not touch, from the true pose."""
    found = nominal.closest(apply(known.T_true, cloud.points_mm))
    start = Fit(T_nominal_scan=known.T_true, found=found, weak=(), iterations=0, converged=False)
    kept = known.sound & felt(nominal, found)
    shares = kept * surface_shares(cloud.points_mm, neighbours_of(cloud, RegisterSettings()))
    return fit_kept(cloud.points_mm, start, shares, nominal, steps=20, close_mm=1e-7).T_nominal_scan


def displacement_mm(T: Floats, T_other: Floats, nominal: Nominal) -> float:
    """Largest displacement of the nominal's surface between two poses of a scan."""
    moved_mm = apply(T @ inverse(T_other), nominal.samples.points_mm) - nominal.samples.points_mm
    return float(np.linalg.norm(moved_mm, axis=1).max())
