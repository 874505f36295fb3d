"""Metal that is bent: a corner of the tip folded out of the blade's sheet, nothing lost and nothing added."""

from dataclasses import dataclass, replace

import numpy as np

from simulators.airfoils import Airfoil, airfoil_loop
from simulators.damage_solids import DamageTruth, farthest_apart_mm
from simulators.solids import Floats, Solid, face_normals, from_manifold, to_manifold
from simulators.wear import NominalBlade, WornBlade

PITCH = 0.012  # of the chord: sides of triangles of bent metal, at most
FELT_MM = 0.01  # metal that moved by less is none of the bend


@dataclass(frozen=True, slots=True, kw_only=True)
class Bend:
    """The corner of tip and trailing edge, bent out of its sheet toward the suction side by `depth_mm`.

    It hinges on a straight line from `chord_fraction` of the chord at the tip to `length_mm` below the tip at
    the trailing edge.
    """

    length_mm: float
    chord_fraction: float
    depth_mm: float


def bent(nominal: NominalBlade, worn: WornBlade, bend: Bend) -> tuple[WornBlade, DamageTruth]:
    """The blade after the bend, its edges still those from before, and the truth of the bend."""
    airfoil = worn.airfoil
    before = _finely(airfoil)
    push_mm = _push_mm(airfoil, bend, before.vertices_mm)
    after = replace(before, vertices_mm=before.vertices_mm + push_mm)
    moved = np.linalg.norm(push_mm, axis=1) > FELT_MM
    skin = moved[before.faces].all(axis=1)
    bent_mm = after.vertices_mm[moved]
    x, y, z = bent_mm.mean(axis=0)
    truth = DamageTruth(
        zone="tip",
        kind="deformation",
        volume_mm3=0.0,
        depth_mm=farthest_apart_mm(before.vertices_mm[before.faces[skin]], bent_mm),
        area_mm2=float(face_normals(before)[1][skin].sum()),
        centroid_mm=(float(x), float(y), float(z)),
        z_low_mm=float(bent_mm[:, 2].min()),
        z_high_mm=float(bent_mm[:, 2].max()),
    )
    changed = WornBlade(
        airfoil=replace(airfoil, solid=after),
        section=lambda z_mm: airfoil_loop(after, z_mm) if z_mm >= truth.z_low_mm else worn.section(z_mm),
        form_mm=max(
            worn.form_mm, farthest_apart_mm(_skin_mm(nominal.airfoil.solid, truth.z_low_mm), bent_mm)
        ),
    )
    return changed, truth


def _skin_mm(solid: Solid, above_mm: float) -> Floats:
    """The triangles (m, 3, 3) that reach above a height."""
    corners_mm: Floats = solid.vertices_mm[solid.faces]
    return corners_mm[corners_mm[:, :, 2].max(axis=1) > above_mm - 1.0]


def _finely(airfoil: Airfoil) -> Solid:
    return from_manifold(to_manifold(airfoil.solid).refine_to_length(PITCH * airfoil.chord_mm))


def _push_mm(airfoil: Airfoil, bend: Bend, points_mm: Floats) -> Floats:
    """How far (n, 3) metal moves out of the corner's sheet: with the square of its way beyond the hinge."""
    frame, f = airfoil.frame(airfoil.z_max_mm), bend.chord_fraction
    corner = airfoil.edge_points_mm(airfoil.z_max_mm)[1]
    start = 0.5 * (frame.pressure_point_mm(f) + frame.suction_point_mm(f))
    end = airfoil.edge_points_mm(airfoil.z_max_mm - bend.length_mm)[1]
    across = np.cross(end - start, corner - start)
    across *= np.sign(across[:2] @ frame.toward_suction) / np.linalg.norm(across)
    beyond = np.cross(across, end - start)
    share = np.clip((points_mm - start) @ beyond / ((corner - start) @ beyond), 0.0, None)
    push: Floats = bend.depth_mm * share[:, None] ** 2 * across
    return push
