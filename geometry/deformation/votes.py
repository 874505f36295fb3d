"""What scan points say of the moved nominal: how far off they lie, which are sound, and their means."""

from dataclasses import dataclass, replace

import numpy as np

from geometry.blade.nominal import Closest
from geometry.deformation.freeform import Freeform
from geometry.deformation.ground import Ground
from geometry.deformation.offset import Nodes
from geometry.errors import CannotFitTwin
from geometry.kernels.graph import dilate, group_medians, grow
from geometry.robust import spread
from geometry.scan.neighbourhood import next_to
from geometry.types import Bools, Floats, Ints

NO_NOISE_MM = 1e-5  # least scatter believed
FLATTEST = 6.0  # a break runs along the skin for at most so many times its depth
WITHIN, FLAT = 2.0, 0.1  # so many times the scatter, or so much of `damage_mm`, is as flat as skin


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Scan points against the nominal moved by the free form."""

    near: Closest  # on the nominal
    along_mm: Floats  # (n,) signed, along the normal
    owner: Ints  # (n,) nearest node; -1 none
    usable: Bools  # (n,) straight above a foot on the airfoil

    def after(self, change: Freeform, nodes: Nodes) -> "Found":
        """The same points after a small change of the free form, taken at the node of each."""
        lower_mm = change.along(nodes.points_mm, nodes.normals)
        return replace(self, along_mm=self.along_mm - lower_mm[self.owner])


def compare(points_mm: Floats, field: Freeform | None, ground: Ground) -> Found:
    """Points pulled back by the free form, as it is where they are, and compared with the nominal.

    Swelling goes along the normals and moves no foot. The search for the foot is a full one: from a foot that
    the moved blade's other side had before, a walk would not find its way round a thin edge.
    """
    shift_mm = np.zeros_like(points_mm) if field is None else field.shift(points_mm)[0]
    pulled_mm = points_mm - shift_mm
    near = ground.nominal.closest(pulled_mm)
    above_mm = np.einsum("nj,nj->n", pulled_mm - near.points_mm, near.normals)
    aside_mm = np.sqrt(np.maximum(near.distance_mm**2 - above_mm**2, 0.0))
    along_mm = above_mm
    if field is not None:
        along_mm = above_mm + np.einsum("nj,nj->n", shift_mm, near.normals)
        along_mm -= field.along(near.points_mm, near.normals)
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
    bend_per_mm: Floats  # (nodes,) how much it turns for each millimetre
    along_mm: Floats  # (nodes,) mean
    noise_mm: float  # scatter of the points about their node


def gather(found: Found, chosen: Bools, owner: Ints, nodes: Nodes) -> Votes:
    """The chosen points on their nodes; `owner` (n,) is the node of each, -1 none."""
    chosen = chosen & (owner >= 0)
    owner, along_mm = owner[chosen], found.along_mm[chosen]
    feet_mm, normals = found.near.points_mm[chosen], found.near.normals[chosen]
    size = len(nodes.points_mm)
    count = np.bincount(owner, minlength=size).astype(np.float64)
    values = (along_mm, *feet_mm.T, *normals.T, np.einsum("nj,nj->n", feet_mm, feet_mm))
    mean = [np.bincount(owner, v, minlength=size) / np.maximum(count, 1.0) for v in values]
    many = count[owner] >= 3.0
    if not many.any():
        raise CannotFitTwin("too few sound points on the airfoil")
    freedom = np.sqrt(count / np.maximum(count - 1.0, 1.0))
    scatter_mm = (along_mm - mean[0][owner]) * freedom[owner]
    centre_mm, middle = np.column_stack(mean[1:4]), np.column_stack(mean[4:7])
    extent_mm2 = np.maximum(mean[7] - (centre_mm**2).sum(axis=1), 1e-6)
    turned = np.maximum(1.0 - (middle**2).sum(axis=1), 0.0)
    return Votes(
        count=count,
        centre_mm=centre_mm,
        normals=middle,
        bend_per_mm=np.where(count >= 3.0, np.sqrt(turned / extent_mm2), 0.0),
        along_mm=mean[0],
        noise_mm=max(spread(scatter_mm[many]), NO_NOISE_MM),
    )


def ripple_mm(votes: Votes, graph: Ints) -> float:
    """Standard deviation of what the means of the nodes show beyond their noise.

    Neighbours share ripple and no noise, but not all of the ripple; a node's own square has all of it, but
    noise must be taken off: through much noise the first tells more, through little the second.
    """
    held = votes.count >= 3.0
    mean_mm = np.where(held, votes.along_mm, 0.0)
    own_mm2 = mean_mm[held] ** 2 - votes.noise_mm**2 / votes.count[held]
    sure_mm2 = own_mm2.mean() - own_mm2.std() / np.sqrt(len(own_mm2))
    pairs = (graph >= 0) & held[:, None] & held[graph]
    shared_mm2 = (mean_mm[:, None] * mean_mm[graph])[pairs].sum() / max(int(pairs.sum()), 1)
    return float(np.sqrt(max(sure_mm2, shared_mm2, NO_NOISE_MM**2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bins:
    """Means of the few points that lie together: all that a field which is smooth between nodes asks of
    them."""

    feet_mm: Floats  # (bins, 3)
    normals: Floats  # (bins, 3) unit
    along_mm: Floats  # (bins,)
    sigma_mm: Floats  # (bins,) of that mean
    count: Floats  # (bins,) points
    scatter_mm2: float  # mean square of the points about their bin


def binned(found: Found, chosen: Bools, sigma_mm: Floats, nodes: Nodes) -> Bins:
    """The chosen points by the octants about their nodes; each counts by its sigma (chosen,)."""
    feet_mm, normals, owner = found.near.points_mm[chosen], found.near.normals[chosen], found.owner[chosen]
    side = (feet_mm > nodes.points_mm[owner]) @ np.array([1, 2, 4])
    weight, along_mm = 1.0 / sigma_mm**2, found.along_mm[chosen]
    key, size = 8 * owner + side, 8 * len(nodes.points_mm)
    total = np.bincount(key, weight, minlength=size)
    used = total > 0.0
    values = (along_mm, *feet_mm.T, *normals.T)
    mean = [np.bincount(key, weight * v, minlength=size)[used] / total[used] for v in values]
    look = np.column_stack(mean[4:])
    at = (np.cumsum(used) - 1)[key]
    return Bins(
        feet_mm=np.column_stack(mean[1:4]),
        normals=look / np.linalg.norm(look, axis=1, keepdims=True),
        along_mm=mean[0],
        sigma_mm=1.0 / np.sqrt(total[used]),
        count=np.bincount(at).astype(np.float64),
        scatter_mm2=float(np.mean((along_mm - mean[0][at]) ** 2)),
    )


def screen(found: Found, ground: Ground, damage_mm: float, rings: int) -> Bools:
    """Which points (n,) lie on sound surface: their node does not stand out, nor they of it.

    A node stands out where its median is deeper than `damage_mm` and far from the common run of nodes, or
    joins one that does and is half as deep; so do `rings` of nodes around, for a hollow runs out flat.
    """
    chosen = found.usable
    median_mm, some = group_medians(found.owner[chosen], found.along_mm[chosen], len(ground.nodes.points_mm))
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


def skin_at_rims(points_mm: Floats, sound: Bools, found: Found, nodes: Nodes, damage_mm: float) -> Bools:
    """The sound points (n,) without those that a break may have left on the rim of what is not sound.

    A break's own points pass for skin while they lie less than `damage_mm` deep; that is as wide as a break
    takes to get so deep, and as far as to the first point that does. There only points well within the
    scatter about their node count.
    """
    if not sound.any():
        return sound
    spacing_mm = np.sqrt(nodes.area_mm2[np.unique(found.owner[sound])].sum() / sound.sum())
    rim = next_to(points_mm, ~sound, spacing_mm + FLATTEST * damage_mm)
    median_mm, _ = group_medians(found.owner[sound], found.along_mm[sound], len(nodes.points_mm))
    apart_mm = np.abs(found.along_mm - median_mm[found.owner])
    flat = apart_mm <= max(WITHIN * spread(apart_mm[sound]), FLAT * damage_mm)
    return np.asarray(sound & (flat | ~rim))
