"""Damage as exact solid subtraction or addition, with the volume and depth of each.

What a cutter removes is its intersection with the blade, and what it adds is the rest of it, so volume and
depth belong to the very mesh that is scanned.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Literal

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
    kind: Literal["missing", "excess", "deformation"] = "missing"
    volume_mm3: float  # 0 of metal that is bent
    depth_mm: float
    area_mm2: float  # of the lost, covered or bent skin
    centroid_mm: tuple[float, float, float]
    z_low_mm: float
    z_high_mm: float

    def __post_init__(self) -> None:
        changed = self.volume_mm3 > 0.0 or self.kind == "deformation"
        if not (isfinite(self.depth_mm) and self.depth_mm > 0.0 and changed):
            raise NotASolid(f"{self.zone}: a cutter that changes nothing")


def break_off(airfoil: Airfoil, cuts: Sequence[Cut]) -> tuple[Solid, tuple[DamageTruth, ...]]:
    """The airfoil's solid after all cuts, and the truth of each. Cuts must not overlap.

    Raises `NotASolid` when a cut misses the blade or severs it in two.
    """
    blade = to_manifold(airfoil.solid)
    chips = []
    for cut in cuts:
        blade = blade.as_original()
        cutter = to_manifold(cut.cutter)
        rest = blade + cutter if cut.adds else blade - cutter
        chip = cutter - blade if cut.adds else blade ^ cutter
        chips.append((cut, chip, rest, blade.original_id()))
        blade = rest
    if len(blade.decompose()) != 1:
        raise NotASolid("a damage severs the blade")
    truths = tuple(_truth(airfoil, *chip) for chip in chips)
    return from_manifold(blade) if cuts else airfoil.solid, truths


def _truth(
    airfoil: Airfoil, cut: Cut, changed: manifold3d.Manifold, rest: manifold3d.Manifold, blade_id: int
) -> DamageTruth:
    """The truth of the metal that a cutter took or added, beside what the blade is afterwards."""
    skin = _faces_from(changed, blade_id)
    if not len(skin):
        raise NotASolid(f"{cut.zone}: the cutter misses the blade")
    chip = from_manifold(changed)
    skin_mm = chip.vertices_mm[chip.faces[skin]]
    fracture = chip.vertices_mm[np.unique(np.delete(chip.faces, skin, axis=0))]
    heights = chip.vertices_mm[:, 2]
    return DamageTruth(
        zone=cut.zone,
        kind="excess" if cut.adds else "missing",
        volume_mm3=float(changed.volume()),
        depth_mm=_depth_mm(airfoil, cut, rest, skin_mm, fracture),
        area_mm2=_area_mm2(skin_mm),
        centroid_mm=_centroid_mm(chip),
        z_low_mm=float(heights.min()),
        z_high_mm=float(heights.max()),
    )


def _depth_mm(
    airfoil: Airfoil, cut: Cut, rest: manifold3d.Manifold, skin_mm: Floats, fracture_mm: Floats
) -> float:
    if cut.adds:
        return farthest_apart_mm(skin_mm, fracture_mm)
    if cut.zone == "tip":
        return float(airfoil.solid.vertices_mm[:, 2].max() - fracture_mm[:, 2].min())
    if cut.zone == "surface":
        return _normal_depth_mm(skin_mm, fracture_mm)
    after = from_manifold(rest)
    levels = np.linspace(fracture_mm[:, 2].min(), fracture_mm[:, 2].max(), EDGE_SLICES + 2)[1:-1]
    return max(_edge_loss_mm(airfoil, cut.zone, after, float(z)) for z in levels)


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
    return _farthest_mm(skin_mm[larger], fracture_mm, _below_mm)


def farthest_apart_mm(skin_mm: Floats, points_mm: Floats) -> float:
    """The largest distance of points (n, 3) from the skin (m, 3, 3)."""
    return _farthest_mm(skin_mm, points_mm, _apart_mm)


def _farthest_mm(
    skin_mm: Floats, fracture_mm: Floats, distances_mm: Callable[[Floats, Floats], Floats]
) -> float:
    """The largest of the distances of the points from the skin (m, 3, 3).

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
        deepest_mm = max(deepest_mm, float(distances_mm(skin_mm, fracture_mm[some]).max()))
    return deepest_mm


def _below_mm(skin_mm: Floats, points_mm: Floats) -> Floats:
    """Distances (n,) of points along the normal of the triangle (m, 3, 3) that is nearest to each: beside the
    rim a point is far from the skin, but not deep."""
    nearest, gaps = _nearest(skin_mm, points_mm)
    normals = _cross(skin_mm[nearest])
    return np.asarray(np.abs((gaps * normals).sum(axis=1)) / np.linalg.norm(normals, axis=1))


def _apart_mm(skin_mm: Floats, points_mm: Floats) -> Floats:
    """Distances (n,) of points from the triangles (m, 3, 3)."""
    return np.asarray(np.linalg.norm(_nearest(skin_mm, points_mm)[1], axis=1))


def _nearest(skin_mm: Floats, points_mm: Floats) -> tuple[Ints, Floats]:
    """The triangle (m, 3, 3) nearest to each point (n,), and the way (n, 3) to it."""
    triangles_mm = np.repeat(skin_mm[None], len(points_mm), axis=0).reshape(-1, 3, 3)
    points = np.repeat(points_mm, len(skin_mm), axis=0)
    gaps = (trimesh.triangles.closest_point(triangles_mm, points) - points).reshape(len(points_mm), -1, 3)
    nearest = np.linalg.norm(gaps, axis=2).argmin(axis=1)
    return nearest, gaps[np.arange(len(points_mm)), nearest]


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
