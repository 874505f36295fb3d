"""Damage as exact solid subtraction, with the volume and depth of each.

What a cutter removes is its intersection with the blade, so volume and depth belong to the very mesh that
is scanned.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import manifold3d
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from simulators.airfoils import Airfoil, airfoil_loop
from simulators.cutters import Cut, ZoneName
from simulators.solids import Floats, Ints, NotASolid, Solid, from_manifold, to_manifold

EDGE_SLICES = 41
AT_ONCE = 40  # fracture points whose depth is computed


@dataclass(frozen=True, slots=True, kw_only=True)
class DamageTruth:
    """One damage as it was made, nominal frame."""

    zone: ZoneName
    volume_mm3: float
    depth_mm: float
    area_mm2: float  # of the lost skin
    centroid_mm: tuple[float, float, float]
    z_low_mm: float
    z_high_mm: float

    def __post_init__(self) -> None:
        if not (isfinite(self.depth_mm) and self.depth_mm > 0.0 and self.volume_mm3 > 0.0):
            raise NotASolid(f"{self.zone}: a cutter that removes nothing")


def break_off(airfoil: Airfoil, cuts: Sequence[Cut]) -> tuple[Solid, tuple[DamageTruth, ...]]:
    """The airfoil's solid after all cuts, and the truth of each. Cuts must not overlap.

    Raises `NotASolid` when a cut misses the blade or severs it in two.
    """
    blade = to_manifold(airfoil.solid)
    chips = []
    for cut in cuts:
        blade = blade.as_original()
        cutter = to_manifold(cut.cutter)
        rest = blade - cutter
        chips.append((cut.zone, blade ^ cutter, rest, blade.original_id()))
        blade = rest
    if len(blade.decompose()) != 1:
        raise NotASolid("a damage severs the blade")
    truths = tuple(_truth(airfoil, *chip) for chip in chips)
    return from_manifold(blade) if cuts else airfoil.solid, truths


def _truth(
    airfoil: Airfoil, zone: ZoneName, removed: manifold3d.Manifold, rest: manifold3d.Manifold, blade_id: int
) -> DamageTruth:
    if removed.is_empty():
        raise NotASolid(f"{zone}: the cutter misses the blade")
    chip = from_manifold(removed)
    skin = _faces_from(removed, blade_id)
    fracture = chip.vertices_mm[np.unique(np.delete(chip.faces, skin, axis=0))]
    heights = chip.vertices_mm[:, 2]
    return DamageTruth(
        zone=zone,
        volume_mm3=float(removed.volume()),
        depth_mm=_depth_mm(airfoil, zone, rest, chip.vertices_mm[chip.faces[skin]], fracture),
        area_mm2=_area_mm2(chip.vertices_mm[chip.faces[skin]]),
        centroid_mm=_centroid_mm(chip),
        z_low_mm=float(heights.min()),
        z_high_mm=float(heights.max()),
    )


def _depth_mm(
    airfoil: Airfoil, zone: ZoneName, rest: manifold3d.Manifold, skin_mm: Floats, fracture_mm: Floats
) -> float:
    if zone == "tip":
        return float(airfoil.solid.vertices_mm[:, 2].max() - fracture_mm[:, 2].min())
    if zone == "surface":
        return _normal_depth_mm(skin_mm, fracture_mm)
    after = from_manifold(rest)
    levels = np.linspace(fracture_mm[:, 2].min(), fracture_mm[:, 2].max(), EDGE_SLICES + 2)[1:-1]
    return max(_edge_loss_mm(airfoil, zone, after, float(z)) for z in levels)


def _faces_from(removed: manifold3d.Manifold, blade_id: int) -> Ints:
    mesh = removed.to_mesh64()
    starts = np.array(mesh.run_index, dtype=np.int64) // 3
    runs = [
        np.arange(a, b)
        for a, b, source in zip(starts[:-1], starts[1:], mesh.run_original_id, strict=True)
        if source == blade_id
    ]
    return np.concatenate(runs) if runs else np.zeros(0, dtype=np.int64)


def _edge_loss_mm(airfoil: Airfoil, zone: ZoneName, after: Solid, z_mm: float) -> float:
    """How far along the chord the edge of one section lies behind where it was."""
    le, te = airfoil.edge_points_mm(z_mm)
    inward = (te - le)[:2] if zone == "leading_edge" else (le - te)[:2]
    edge = le if zone == "leading_edge" else te
    rest = airfoil_loop(after, z_mm) - edge[:2]
    return float((rest @ inward).min() / np.linalg.norm(inward))


def _normal_depth_mm(skin_mm: Floats, fracture_mm: Floats) -> float:
    """From the lost skin (m, 3, 3), the distance of the fracture point that is farthest from it; where the
    metal is pierced, from that of the side that has lost more: a hole is as deep as the metal is thick."""
    cross = _cross(skin_mm)
    area = np.linalg.norm(cross, axis=1)
    axis = np.linalg.eigh((cross / np.maximum(area, 1e-300)[:, None]).T @ cross)[1][:, -1]
    above = cross @ axis > 0.0
    larger = above if area[above].sum() >= area[~above].sum() else ~above
    return _depth_below_mm(skin_mm[larger], fracture_mm)


def _depth_below_mm(skin_mm: Floats, fracture_mm: Floats) -> float:
    """Along the normal of the skin next to it: beside the rim a point is far from the skin, but not deep.

    No point is deeper than it is far from the middle of a triangle: those that are no farther than the
    deepest so far need no closer look.
    """
    farthest_mm = cKDTree(skin_mm.mean(axis=1)).query(fracture_mm)[0]
    order = np.argsort(-farthest_mm)
    deepest_mm = 0.0
    for first in range(0, len(order), AT_ONCE):
        some = order[first : first + AT_ONCE]
        if farthest_mm[some[0]] <= deepest_mm:
            break
        deepest_mm = max(deepest_mm, float(_below_mm(skin_mm, fracture_mm[some]).max()))
    return deepest_mm


def _below_mm(skin_mm: Floats, points_mm: Floats) -> Floats:
    """Distances (n,) of points along the normal of the triangle (m, 3, 3) that is nearest to each."""
    triangles_mm = np.repeat(skin_mm[None], len(points_mm), axis=0).reshape(-1, 3, 3)
    points = np.repeat(points_mm, len(skin_mm), axis=0)
    gaps = (trimesh.triangles.closest_point(triangles_mm, points) - points).reshape(len(points_mm), -1, 3)
    nearest = np.linalg.norm(gaps, axis=2).argmin(axis=1)
    normals = _cross(skin_mm[nearest])
    along = (gaps[np.arange(len(points_mm)), nearest] * normals).sum(axis=1)
    return np.asarray(np.abs(along) / np.linalg.norm(normals, axis=1))


def _cross(triangles_mm: Floats) -> Floats:
    a, b, c = np.moveaxis(triangles_mm, 1, 0)
    return np.cross(b - a, c - a)


def _area_mm2(triangles_mm: Floats) -> float:
    return float(0.5 * np.linalg.norm(_cross(triangles_mm), axis=1).sum())


def _centroid_mm(chip: Solid) -> tuple[float, float, float]:
    origin = chip.vertices_mm.mean(axis=0)
    a, b, c = (chip.vertices_mm - origin)[chip.faces.T]
    six_volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    x, y, z = origin + ((a + b + c) * six_volumes[:, None]).sum(axis=0) / (4.0 * six_volumes.sum())
    return float(x), float(y), float(z)
