"""What scan points say of the moved nominal: how far off they lie, which are sound, and their means."""

from dataclasses import dataclass, replace

import numpy as np

from geometry.blade.nominal import Closest
from geometry.deformation.freeform import Freeform
from geometry.deformation.ground import Ground
from geometry.deformation.offset import Nodes
from geometry.errors import CannotFitTwin
from geometry.kernels.graph import dilate, grow
from geometry.robust import spread
from geometry.types import Bools, Floats, Ints

NO_NOISE_MM = 1e-5  # least scatter believed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Scan points against the nominal moved by the free form."""

    near: Closest  # on the nominal
    along_mm: Floats  # (n,) signed, along the normal
    owner: Ints  # (n,) nearest node; -1 none
    usable: Bools  # (n,) straight above a foot on the airfoil

    def after(self, before: Freeform, now: Freeform) -> "Found":
        """The same points against the nominal moved by a free form that is hardly another."""
        feet = (self.near.points_mm, self.near.normals)
        return replace(self, along_mm=self.along_mm + before.along(*feet) - now.along(*feet))


def compare(points_mm: Floats, field: Freeform | None, ground: Ground, foot: Closest) -> Found:
    """Points pulled back by the free form, as it is at their `foot`, and compared with the nominal."""
    near, moved_mm = foot, np.zeros_like(points_mm)
    if field is not None:
        pulled_mm = points_mm - field.displacement(foot.points_mm, foot.normals)
        near = ground.nominal.closest_from(pulled_mm, foot.face)
        moved_mm = field.displacement(near.points_mm, near.normals)
    along_mm = np.einsum("nj,nj->n", points_mm - moved_mm - near.points_mm, near.normals)
    aside_mm = np.sqrt(np.maximum(near.distance_mm**2 - along_mm**2, 0.0))
    owner = ground.nodes.owner(near.points_mm, near.normals)
    return Found(
        near=near,
        along_mm=along_mm,
        owner=owner,
        usable=(aside_mm <= 0.5 * np.abs(along_mm) + 0.02) & (owner >= 0),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Votes:
    """Chosen points gathered on their nodes; zeros where a node has none."""

    count: Floats  # (nodes,)
    centre_mm: Floats  # (nodes, 3) mean foot
    normals: Floats  # (nodes, 3) mean normal, shorter than 1 where the surface turns
    along_mm: Floats  # (nodes,) mean
    noise_mm: float  # scatter of the points about their node


def gather(found: Found, chosen: Bools, owner: Ints, nodes: Nodes) -> Votes:
    """The chosen points on their nodes; `owner` (n,) is the node of each, -1 none."""
    chosen = chosen & (owner >= 0)
    owner, along_mm = owner[chosen], found.along_mm[chosen]
    size = len(nodes.points_mm)
    count = np.bincount(owner, minlength=size).astype(np.float64)
    values = (along_mm, *found.near.points_mm[chosen].T, *found.near.normals[chosen].T)
    mean = [np.bincount(owner, v, minlength=size) / np.maximum(count, 1.0) for v in values]
    many = count[owner] >= 3.0
    if not many.any():
        raise CannotFitTwin("too few sound points on the airfoil")
    freedom = np.sqrt(count / np.maximum(count - 1.0, 1.0))
    scatter_mm = (along_mm - mean[0][owner]) * freedom[owner]
    return Votes(
        count=count,
        centre_mm=np.column_stack(mean[1:4]),
        normals=np.column_stack(mean[4:]),
        along_mm=mean[0],
        noise_mm=max(spread(scatter_mm[many]), NO_NOISE_MM),
    )


def screen(found: Found, ground: Ground, damage_mm: float, rings: int) -> Bools:
    """Which points (n,) lie on sound surface: their node does not stand out, nor they of it.

    A node stands out where its median is deeper than `damage_mm` and far from the common run of nodes, or
    joins one that does and is half as deep; so do `rings` of nodes around, for a hollow runs out flat.
    """
    chosen = found.usable
    median_mm, some = _medians(found.owner[chosen], found.along_mm[chosen], len(ground.nodes.points_mm))
    if not some.any():
        raise CannotFitTwin("no sound points on the airfoil")
    depth_mm = np.abs(median_mm)
    high_mm = max(damage_mm, 5.0 * spread(median_mm[some]))
    out = grow(depth_mm > high_mm, depth_mm > 0.5 * high_mm, ground.graph)
    for _ in range(rings):
        out = dilate(out, ground.graph)
    apart_mm = np.abs(found.along_mm - median_mm[found.owner])
    single_mm = max(damage_mm, 5.0 * spread(apart_mm[chosen]))
    return np.asarray(chosen & ~out[found.owner] & (apart_mm <= single_mm))


def _medians(owner: Ints, values: Floats, size: int) -> tuple[Floats, Bools]:
    """Lower median (size,) of the values of each owner, and whether there are any."""
    order = np.lexsort((values, owner))
    count = np.bincount(owner, minlength=size)
    last = np.cumsum(count)
    some = count > 0
    medians = np.zeros(size)
    medians[some] = values[order[(last - count + (count - 1) // 2)[some]]]
    return medians, some
