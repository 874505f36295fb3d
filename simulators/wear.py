"""A blade after service: its form in the nominal frame, where "in the frame" means the best fit.

A worn blade has no marks of its design frame left. Its truth is therefore given after the rigid motion
that fits the undamaged airfoil to the nominal best, in least squares along the normal.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from simulators.airfoils import Airfoil, airfoil_loop, find_airfoil
from simulators.blade import BladeShape, Wear, blade_solid, section_curve, worn_surface
from simulators.sections import SectionSizes, SectionTruth, compare, sizes
from simulators.solids import Floats, Solid, face_normals, vertex_normals

Section = Callable[[float], Floats]  # z_mm -> closed curve (m, 2), counter-clockwise
MODES = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WornBlade:
    """The undamaged blade after service, nominal frame. `form_mm`: largest deviation along the normal, of
    metal that is bent its largest distance."""

    airfoil: Airfoil
    section: Section
    form_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NominalBlade:
    """A part number: the nominal airfoil, its sections, and its closed form where there is one."""

    name: str
    airfoil: Airfoil
    section: Section
    shape: BladeShape | None

    @property
    def scale(self) -> float:
        """Its chord over that of the thesis' blade."""
        return self.airfoil.chord_mm / 41.5


def thesis_nominal(
    shape: BladeShape, z_min_mm: float | None = None, z_max_mm: float | None = None
) -> NominalBlade:
    """The nominal of a closed form; the airfoil begins 6 mm above the root face, which is clamped."""
    solid = blade_solid(shape, shape.surface)
    return NominalBlade(
        name="SIM-R1",
        airfoil=find_airfoil(solid, 6.0 if z_min_mm is None else z_min_mm, z_max_mm),
        section=lambda z_mm: section_curve(shape.surface, z_mm, np.eye(4)),
        shape=shape,
    )


def mesh_nominal(name: str, solid: Solid, z_min_mm: float | None, z_max_mm: float | None) -> NominalBlade:
    """The nominal of any closed blade mesh."""
    return NominalBlade(
        name=name,
        airfoil=find_airfoil(solid, z_min_mm, z_max_mm),
        section=lambda z_mm: airfoil_loop(solid, z_mm),
        shape=None,
    )


def worn_blade(nominal: NominalBlade, wear: Wear) -> WornBlade:
    """The nominal after service."""
    if nominal.shape is None:
        return _worn_mesh(nominal, wear)
    return _worn_shape(nominal, nominal.shape, wear)


def _worn_shape(nominal: NominalBlade, shape: BladeShape, wear: Wear) -> WornBlade:
    surface = worn_surface(shape, wear)
    solid = blade_solid(shape, surface)
    T, form_mm = best_fit(nominal.airfoil, solid)
    return WornBlade(
        airfoil=_refound(nominal.airfoil, solid.moved(T)),
        section=lambda z_mm: section_curve(surface, z_mm, T),
        form_mm=form_mm,
    )


def _worn_mesh(nominal: NominalBlade, wear: Wear) -> WornBlade:
    warped = warp(nominal.airfoil, wear)
    T, form_mm = best_fit(nominal.airfoil, warped)
    fitted = warped.moved(T)
    return WornBlade(
        airfoil=_refound(nominal.airfoil, fitted),
        section=lambda z_mm: airfoil_loop(fitted, z_mm),
        form_mm=form_mm,
    )


def _refound(nominal: Airfoil, solid: Solid) -> Airfoil:
    top = float(solid.vertices_mm[:, 2].max())
    tip = nominal.z_max_mm == float(nominal.solid.vertices_mm[:, 2].max())
    return find_airfoil(solid, nominal.z_min_mm, top if tip else nominal.z_max_mm)


def best_fit(nominal: Airfoil, worn: Solid) -> tuple[Floats, float]:
    """The motion (4x4) that fits `worn` to the nominal, and the largest deviation left along the normal.

    `worn` has the nominal's faces, displaced. Linear least squares over the faces between z_min and the
    tip with its face, weighted by area; displacements are small beside the radii of curvature.
    """
    normals, areas = face_normals(nominal.solid)
    centres = nominal.solid.vertices_mm[nominal.solid.faces].mean(axis=1)
    used = (centres[:, 2] > nominal.z_min_mm) & (centres[:, 2] <= nominal.z_max_mm) & (areas > 0.0)
    gap = worn.vertices_mm[worn.faces[used]].mean(axis=1) - centres[used]
    along = np.einsum("ij,ij->i", gap, normals[used])
    rows = np.concatenate([np.cross(centres[used], normals[used]), normals[used]], axis=1)
    weighted = rows * areas[used, None]
    twist = np.linalg.solve(weighted.T @ rows, weighted.T @ along)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(-twist[:3]).as_matrix()
    T[:3, 3] = -T[:3, :3] @ twist[3:]
    return T, float(np.abs(along - rows @ twist).max())


def warp(airfoil: Airfoil, wear: Wear) -> Solid:
    """The solid after the same kinds of wear as smooth displacements of space above `z_min`.

    The waves and bumps of a closed form follow its parameters; a mesh has none, so that here they are
    plane waves of random direction, short ones of `wave_mm` and long ones of `bump_mm`.
    """
    points = airfoil.solid.vertices_mm
    height = np.clip((points[:, 2] - airfoil.z_min_mm) / airfoil.span_mm, 0.0, None)
    rise = np.clip(height / 0.3, 0.0, 1.0)
    rise = rise**2 * (3.0 - 2.0 * rise)
    rng = np.random.default_rng([wear.seed, 13])
    field = _waves(points, wear.wave_mm, 0.3 * airfoil.chord_mm, rng)
    field += _waves(points, wear.bump_mm, 1.2 * airfoil.chord_mm, rng)
    field += wear.thicker_mm * vertex_normals(airfoil.solid)
    return Solid(vertices_mm=wear.bent(points + rise[:, None] * field, height), faces=airfoil.solid.faces)


def _waves(points_mm: Floats, amplitude_mm: float, length_mm: float, rng: np.random.Generator) -> Floats:
    total = np.zeros_like(points_mm)
    for _ in range(MODES):
        number = rng.normal(size=3)
        number *= 2.0 * np.pi / length_mm / np.linalg.norm(number)
        push = rng.normal(size=3)
        push *= amplitude_mm / MODES**0.5 / np.linalg.norm(push)
        total += np.sin(points_mm @ number + rng.uniform(0.0, 2.0 * np.pi))[:, None] * push
    return total


def section_truths(
    nominal: NominalBlade, worn: WornBlade, z_mm: tuple[float, ...]
) -> tuple[SectionTruth, ...]:
    """The true measurands of the inspected sections: the worn, undamaged blade against the nominal."""
    truths = []
    for z in z_mm:
        curve, le_mm, nominal_sizes = _nominal_section(nominal, z)
        truths.append(compare(z, curve, nominal_sizes, worn.section(z), le_mm))
    return tuple(truths)


@lru_cache(maxsize=32)
def _nominal_section(nominal: NominalBlade, z_mm: float) -> tuple[Floats, Floats, SectionSizes]:
    """The same for every part of the part number: curve, leading-edge point (2,), sizes."""
    curve = nominal.section(z_mm)
    le_mm = nominal.airfoil.edge_points_mm(z_mm)[0][:2]
    return curve, le_mm, sizes(curve, le_mm)
