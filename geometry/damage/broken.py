"""The broken surface of one damage: which scan points lie on it, its local shape, which way it faces."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from geometry.errors import CannotRepair
from geometry.kernels.implicit_solid import closest_on_triangles, triangle_cells
from geometry.types import Bools, Floats, Ints, Mesh

MAX_CELLS = 2_000_000
FIT_POINTS = 24  # points of one local quadric
SUPPORT = 2.5  # skin farther than this many point spacings from every sound point is lost or unseen


class Skin:
    """The surface of a closed mesh, asked for signed distances (positive outside)."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.triangles_mm = mesh.vertices_mm[mesh.faces]
        a, b, c = np.moveaxis(self.triangles_mm, 1, 0)
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1)
        self.area_mm2 = 0.5 * length
        self.normals = cross / np.maximum(length, 1e-300)[:, None]
        self.low_mm, self.high_mm = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)
        extent_mm = np.maximum(self.high_mm - self.low_mm, 1e-6)
        edge_mm = 2.0 * float(np.median(np.linalg.norm(b - a, axis=1)))
        self._cell_mm = max(edge_mm, float(np.cbrt(np.prod(extent_mm) / MAX_CELLS)))
        x, y, z = np.ceil(extent_mm / self._cell_mm).astype(int)
        self._cells = (max(int(x), 1), max(int(y), 1), max(int(z), 1))
        self._start, self._member = triangle_cells(self.triangles_mm, self.low_mm, self._cell_mm, self._cells)

    def closest(self, points_mm: Floats) -> tuple[Floats, Floats, Ints]:
        """Signed distance (n,), closest point (n, 3) and its face (n,) for every point (n, 3)."""
        order = self._by_cell(points_mm)  # neighbours ask the same triangles: they lie in the cache
        back = np.argsort(order)
        distance_mm, feet_mm, face = closest_on_triangles(
            np.ascontiguousarray(points_mm[order]),
            self.triangles_mm,
            self.normals,
            self._start,
            self._member,
            self.low_mm,
            self._cell_mm,
            self._cells,
        )
        return distance_mm[back], feet_mm[back], face[back]

    def _by_cell(self, points_mm: Floats) -> Ints:
        """An order of the points in which those of one cell follow each other."""
        x, y, z = (
            np.clip((points_mm - self.low_mm) / self._cell_mm, 0, np.array(self._cells) - 1).astype(int).T
        )
        return np.asarray(np.argsort((x * self._cells[1] + y) * self._cells[2] + z, kind="stable"))

    def samples(self, pitch_mm: float, low_mm: Floats, high_mm: Floats) -> tuple[Floats, Floats]:
        """Points (n, 3) spread evenly over the faces in a box, pitch squared each, and their normals."""
        corner = self.triangles_mm
        face = np.flatnonzero((corner.max(axis=1) >= low_mm).all(1) & (corner.min(axis=1) <= high_mm).all(1))
        area = np.cumsum(self.area_mm2[face])
        count = int(area[-1] / pitch_mm**2) if len(face) else 0
        index = np.arange(count)
        own = face[np.searchsorted(area, (index + 0.5) * pitch_mm**2)]
        u, v = index * 0.7548776662466927 % 1.0, index * 0.5698402909980532 % 1.0  # R2 sequence, Roberts 2018
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        a, b, c = np.moveaxis(corner[own], 1, 0)
        points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        within = ((points >= low_mm) & (points <= high_mm)).all(axis=1)
        return points[within], self.normals[own[within]]


@lru_cache(maxsize=2)
def skin_of(mesh: Mesh) -> Skin:
    """The skin of a mesh, made once for all steps that ask it."""
    return Skin(mesh)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """The scan in the nominal frame, split by the damage masks."""

    points_mm: Floats  # (n, 3)
    sigma_mm: Floats  # (n,)
    flagged: Bools  # (n,) in any damage
    twin_sigma_mm: float  # of the twin's skin where sound points support it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rim:
    """Scan points on the sound skin near the break, evened out."""

    points_mm: Floats  # (r, 3) as scanned
    feet_mm: Floats  # (r, 3) on the twin
    normals: Floats  # (r, 3) of the twin there

    def clear_of(self, break_mm: Floats, least_mm: float) -> tuple[Floats, Floats, Floats]:
        """Feet, normals and heights above the twin of the points at least so far from the break."""
        clear = cKDTree(break_mm).query(self.points_mm)[0] >= least_mm
        height_mm = ((self.points_mm - self.feet_mm) * self.normals).sum(axis=1)
        return self.feet_mm[clear], self.normals[clear], height_mm[clear]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BrokenSurface:
    """The oriented broken surface of one damage as local quadrics, and the skin that is gone above it."""

    raw_mm: Floats  # (k, 3) the scan points on it
    sigma_mm: float  # of those points, along the normal
    rim: Rim
    points_mm: Floats  # (n, 3) evened out and denoised
    frames: Floats  # (n, 3, 3) rows: two tangents, outward normal (away from metal)
    bending: Floats  # (n, 3) second derivatives uu, uv, vv
    spacing_mm: Floats  # (n,) of those points
    lost_mm: Floats  # (l, 3) samples of the lost skin
    lost_reach_mm: float  # all lost skin lies within this of a sample
    film_mm: float  # skin within this of the twin counts as sound

    @property
    def area_mm2(self) -> float:
        return float((self.spacing_mm**2).sum())

    @property
    def facing(self) -> Floats:
        """The way out: mean outward normal (3,), as long as the surface is flat (1) or wraps around (0)."""
        weight = self.spacing_mm**2 / self.area_mm2
        return np.asarray((self.frames[:, 2] * weight[:, None]).sum(axis=0))


def find_broken_surface(
    skin: Skin, scan: Scan, flagged: Ints, film_sigmas: float, max_gap_mm: float, min_points: int
) -> BrokenSurface:
    """The broken surface under the points `flagged` as one damage.

    Points on it lie provably below the twin. Raises `CannotRepair` if there are fewer than `min_points`,
    or if inside cannot be told from outside.
    """
    pitch_mm = _spacing(scan.points_mm[flagged])
    near = _points_near(scan, flagged, 3.0 * pitch_mm)
    deep = _deep(skin, scan, near, film_sigmas)
    if deep.sum() < min_points:
        raise CannotRepair(f"{deep.sum()} scan points lie provably below the twin, {min_points} are needed")
    raw_mm, sigma_mm = scan.points_mm[near[deep]], float(np.median(scan.sigma_mm[near[deep]]))
    sound_mm = _sound_points(scan, near[~deep], raw_mm)
    points_mm, frames, bending = _local_quadrics(_thinned(raw_mm, 6.0 * sigma_mm))
    spacing_mm = _spacings(points_mm)
    lost_pitch_mm = float(np.clip(np.sqrt((spacing_mm**2).sum()) / 15.0, 0.1, 1.0))
    support_mm = min(SUPPORT * pitch_mm, 0.5 * max_gap_mm)
    lost_mm, lost_normals = _lost_skin(skin, raw_mm, sound_mm, lost_pitch_mm, support_mm)
    inward = _outward_sign(points_mm, frames[:, 2], _towards(points_mm, lost_mm, lost_normals)) < 0.0
    frames[inward, 1:] *= -1.0
    bending[np.ix_(inward, np.array([0, 2]))] *= -1.0
    return BrokenSurface(
        raw_mm=raw_mm,
        sigma_mm=sigma_mm,
        rim=_rim(skin, raw_mm, sound_mm, max_gap_mm, 6.0 * sigma_mm),
        points_mm=points_mm,
        frames=frames,
        bending=bending,
        spacing_mm=spacing_mm,
        lost_mm=lost_mm,
        lost_reach_mm=1.5 * lost_pitch_mm + pitch_mm,
        film_mm=film_sigmas * float(np.hypot(sigma_mm, scan.twin_sigma_mm)),
    )


def _rim(skin: Skin, raw_mm: Floats, sound_mm: Floats, width_mm: float, cell_mm: float) -> Rim:
    """The sound points within `width_mm` of the break."""
    points_mm = sound_mm[_within(sound_mm, raw_mm, width_mm)]
    if len(points_mm):
        points_mm = _thinned(points_mm, cell_mm)
    _, feet_mm, face = skin.closest(points_mm)
    return Rim(points_mm=points_mm, feet_mm=feet_mm, normals=skin.normals[face])


def _within(points_mm: Floats, others_mm: Floats, reach_mm: float) -> Ints:
    """Indices of the points that have one of the others within reach."""
    low, high = others_mm.min(axis=0) - reach_mm, others_mm.max(axis=0) + reach_mm
    boxed = np.flatnonzero(((points_mm >= low) & (points_mm <= high)).all(axis=1))
    distance_mm, _ = cKDTree(others_mm).query(points_mm[boxed], distance_upper_bound=reach_mm)
    return boxed[np.isfinite(distance_mm)]


def frames_along(normals: Floats) -> Floats:
    """Right-handed frames (n, 3, 3) whose rows are two tangents and the normal."""
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=1)


def _spacings(points_mm: Floats) -> Floats:
    """Spacing (n,) of the points round each: the side of the square that is each one's share."""
    count = min(8, len(points_mm) - 1)
    distance_mm, _ = cKDTree(points_mm).query(points_mm, count + 1)
    return np.asarray(np.maximum(distance_mm[:, -1], 1e-6) * np.sqrt(np.pi / count))


def _spacing(points_mm: Floats) -> float:
    if len(points_mm) < 3:
        raise CannotRepair(f"{len(points_mm)} scan points on the damage")
    return float(np.median(_spacings(points_mm)))


def _points_near(scan: Scan, flagged: Ints, reach_mm: float) -> Ints:
    """Indices of the flagged points, and of those within reach of one that no damage claims."""
    free = _within(scan.points_mm, scan.points_mm[flagged], reach_mm)
    return np.concatenate([flagged, free[~scan.flagged[free]]])


def _deep(skin: Skin, scan: Scan, near: Ints, film_sigmas: float) -> Bools:
    """Which of the points `near` lie below the twin by more than `film_sigmas` of both uncertainties.

    Chance alone takes a few sound points that deep, but not two of the six neighbours as well.
    """
    depth_mm = -skin.closest(scan.points_mm[near])[0]
    deep = depth_mm > film_sigmas * np.hypot(scan.sigma_mm[near], scan.twin_sigma_mm)
    _, index = cKDTree(scan.points_mm[near]).query(scan.points_mm[near], min(7, len(near)))
    return np.asarray(deep & (deep[index[:, 1:]].sum(axis=1) >= 2))


def _sound_points(scan: Scan, shallow: Ints, raw_mm: Floats) -> Floats:
    """Points of the skin round the damage: no mask flags them, or they prove to lie on the twin."""
    margin_mm = 2.0 + float(np.linalg.norm(np.ptp(raw_mm, axis=0)))
    low, high = raw_mm.min(axis=0) - margin_mm, raw_mm.max(axis=0) + margin_mm
    sound = ~scan.flagged
    sound[shallow] = True
    boxed = ((scan.points_mm >= low) & (scan.points_mm <= high)).all(axis=1)
    return scan.points_mm[sound & boxed]


def _thinned(points_mm: Floats, cell_mm: float) -> Floats:
    """The mean of the points in each occupied cell: repeated points gain no weight."""
    cell = np.floor((points_mm - points_mm.min(axis=0)) / cell_mm).astype(np.int64)
    _, group, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(group.ravel(), points_mm[:, i]) for i in range(3)]
    return np.column_stack(sums) / count[:, None]


def _local_quadrics(points_mm: Floats) -> tuple[Floats, Floats, Floats]:
    """Feet (n, 3), frames (n, 3, 3) and bending (n, 3) of least-squares quadrics at the points.

    The first frame is the principal axes of the neighbours, the second the quadric's own tangent plane.
    """
    distance_mm, index = cKDTree(points_mm).query(points_mm, min(FIT_POINTS, len(points_mm)))
    off = points_mm[index] - points_mm[:, None]
    weight = np.maximum(1.0 - (distance_mm / (1.2 * distance_mm[:, -1:])) ** 2, 0.0) ** 2
    mean = (weight[..., None] * off).sum(axis=1, keepdims=True) / weight.sum(axis=1)[:, None, None]
    spread = np.einsum("nk,nki,nkj->nij", weight, off - mean, off - mean)
    frames = np.linalg.eigh(spread)[1].transpose(0, 2, 1)[:, ::-1].copy()
    for _ in range(2):
        u, v, height = np.moveaxis(np.einsum("nij,nkj->nki", frames, off), 2, 0)
        design = np.stack([np.ones_like(u), u, v, 0.5 * u * u, u * v, 0.5 * v * v], -1)
        normal = np.einsum("nk,nki,nkj->nij", weight, design, design)
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        right = np.einsum("nk,nki,nk->ni", weight, design, height)
        fit = np.linalg.solve(normal + ridge, right[..., None])[..., 0]
        feet_mm = points_mm + fit[:, :1] * frames[:, 2]
        frames = _tilted(frames, fit[:, 1:3])
    return feet_mm, frames, fit[:, 3:]


def _tilted(frames: Floats, slope: Floats) -> Floats:
    """Frames whose normals are those of surfaces with that slope (n, 2) in the old ones."""
    normal = frames[:, 2] - slope[:, :1] * frames[:, 0] - slope[:, 1:] * frames[:, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = frames[:, 0] - (frames[:, 0] * normal).sum(1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=1)


def _lost_skin(
    skin: Skin, raw_mm: Floats, sound_mm: Floats, pitch_mm: float, support_mm: float
) -> tuple[Floats, Floats]:
    """Samples, and their normals, of the twin's skin that is lost, from the break on.

    Lost is what has no sound point near it, or lies nearer to the broken surface.
    """
    margin_mm = 2.0 + float(np.linalg.norm(np.ptp(raw_mm, axis=0)))
    points, normals = skin.samples(pitch_mm, raw_mm.min(axis=0) - margin_mm, raw_mm.max(axis=0) + margin_mm)
    touch_mm = support_mm + 2.0 * pitch_mm
    to_break_mm = cKDTree(raw_mm).query(points, distance_upper_bound=touch_mm)[0]
    bare = np.ones(len(points), bool)
    if len(sound_mm):
        bare = cKDTree(sound_mm).query(points)[0] > np.minimum(to_break_mm, support_mm)
    points, normals = points[bare], normals[bare]
    pairs = cKDTree(points).query_pairs(2.0 * pitch_mm, output_type="ndarray")
    _, piece = connected_components(_graph(pairs, np.ones(len(pairs)), len(points)), directed=False)
    touching = np.isfinite(to_break_mm[bare])
    kept = np.isin(piece, np.unique(piece[touching]))
    if not kept.any():
        raise CannotRepair("no skin is missing above the broken surface")
    return points[kept], normals[kept]


def _graph(pairs: Ints, weights: Floats, count: int) -> coo_array:
    return coo_array((weights, (pairs[:, 0], pairs[:, 1])), shape=(count, count))


def _outward_sign(points_mm: Floats, normals: Floats, sky: Floats) -> Floats:
    """For each normal (n, 3), +1 if it points away from metal and -1 if into it.

    Consistent over the neighbour graph (Hoppe et al., 1992: along the minimum spanning tree of 1 - |n n'|);
    each connected piece as a whole looks towards the lost skin, whose direction from each point is `sky`.
    """
    _, index = cKDTree(points_mm).query(points_mm, min(9, len(points_mm)))
    pairs = np.column_stack([np.repeat(index[:, 0], index.shape[1] - 1), index[:, 1:].ravel()])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    weight = 1.0 + 1e-3 - np.abs((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1))
    tree = minimum_spanning_tree(_graph(pairs, weight, len(points_mm)).tocsr())
    sign = np.zeros(len(points_mm))
    for first in range(len(points_mm)):
        if sign[first] == 0.0:
            piece, parent = breadth_first_order(tree, first, directed=False)
            _spread_sign(sign, normals, piece, parent)
            vote = float((sign[piece] * (normals[piece] * sky[piece]).sum(axis=1)).mean())
            if not abs(vote) > 0.1:
                raise CannotRepair("the broken surface does not show which side of it is metal")
            sign[piece] *= np.sign(vote)
    return sign


def _spread_sign(sign: Floats, normals: Floats, piece: Ints, parent: Ints) -> None:
    sign[piece[0]] = 1.0
    for node in piece[1:]:
        before = parent[node]
        sign[node] = sign[before] * (1.0 if normals[node] @ normals[before] >= 0.0 else -1.0)


def _towards(points_mm: Floats, lost_mm: Floats, lost_normals: Floats) -> Floats:
    """Mean direction (n, 3), unit, of the lost skin seen from each point, weighted by solid angle."""
    distance_mm = np.maximum(cdist(points_mm, lost_mm), 1e-3)
    across = np.abs((lost_mm * lost_normals).sum(axis=1) - points_mm @ lost_normals.T)
    weight = across / distance_mm**4
    mean = weight @ lost_mm - weight.sum(axis=1)[:, None] * points_mm
    return np.asarray(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12))
