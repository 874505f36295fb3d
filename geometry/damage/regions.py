"""Where the scan leaves the twin: connected regions of scan points, and the skin that each has lost."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.damage.local_shape import pieces
from geometry.damage.skin import skin_of
from geometry.deformation.twin import Twin
from geometry.errors import BadInput
from geometry.kernels.graph import dilate, grow, neighbourhood_mean, neighbourhood_median
from geometry.registration.alignment import Alignment
from geometry.scan.neighbourhood import nearest_of
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Ints

SKIN_SPACINGS = 3.0  # skin farther than this many point spacings from every sound point has lost its cover
DEEP = 3.0  # sigmas off the twin at which a single point lies on a break, or another layer, for certain
LINK_SPACINGS = 4.0  # longer links than this many point spacings, and than `join_mm`, join nothing
NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionSettings:
    """When points that stand off the twin make a region.

    Distances are means over a neighbourhood, in units of their standard deviation: noise of the mean and
    sigma of the twin. A region begins at `high`, and reaches down to `low`; down to `skirt` where it runs
    out gently.
    """

    neighbours: int = 16
    high: float = 6.0
    low: float = 3.0
    skirt: float = 2.0
    floor_mm: float = 0.008  # least standard deviation: what the scanner's own errors do not average out
    least_points: int = 12
    fewest_points: int = (
        4  # are a region, where each stands for so much surface that they equal `least_points`
    )
    join_mm: float = 1.0  # metal nearer than this to other such metal, or to the skin, belongs to it

    def __post_init__(self) -> None:
        if not (0.0 < self.skirt <= self.low <= self.high and min(self.neighbours, self.fewest_points) >= 4):
            raise BadInput(f"regions: {self} contradicts itself")
        if not (self.floor_mm > 0.0 and self.join_mm > 0.0):
            raise BadInput(f"regions: {self} contradicts itself")
        if self.fewest_points > self.least_points:
            raise BadInput(f"regions: {self} contradicts itself")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Field:
    """The scan against the twin, nominal frame. Distances are signed, positive outside."""

    scan_mm: Floats  # (n, 3)
    neighbours: Ints  # (n, k), -1 none
    spacing_mm: float  # between neighbouring points
    local_mm: Floats  # (n,) that spacing about each point
    noise_mm: float  # of a single point
    height_mm: Floats  # (n,) distance of each point
    smooth_mm: Floats  # (n,) mean distance over the neighbourhood
    sigma_mm: Floats  # (n,) of that mean
    on_airfoil: Bools  # (n,) nearest to required surface
    skin_mm: Floats  # (s, 3) the samples of the required surface on the twin

    @property
    def off_skin(self) -> Bools:
        """Which points (n,) lie off the twin for certain, each by itself."""
        return np.asarray(np.abs(self.height_mm) > DEEP * np.hypot(self.noise_mm, self.sigma_mm))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Region:
    """Points on one side of the twin, connected, and the samples of the skin above that nothing covers."""

    points: Ints  # indices into the scan
    lost: Ints  # indices into the nominal's samples
    missing: bool  # else excess


def stand_off(
    cloud: Cloud, alignment: Alignment, nominal: Nominal, twin: Twin, settings: RegionSettings
) -> Field:
    """How far each scan point lies off the twin, and how certain that is."""
    scan_mm = apply(alignment.T_nominal_scan, cloud.points_mm)
    neighbours = nearest_of(cloud, min(settings.neighbours + 1, len(cloud)))
    distance_mm, _, face = skin_of(twin.mesh).closest(scan_mm)
    twin_sigma_mm = twin.sigma_mm[twin.mesh.faces[face]].mean(axis=1)
    noise_mm = noise_of(cloud, twin)
    mean_sigma_mm = noise_mm / np.sqrt(neighbours.shape[1])
    return Field(
        scan_mm=scan_mm,
        neighbours=neighbours,
        spacing_mm=spacing_of(cloud, neighbours),
        local_mm=local_spacing_of(cloud, neighbours),
        noise_mm=noise_mm,
        height_mm=distance_mm,
        smooth_mm=neighbourhood_mean(distance_mm, neighbours[:, 1:]),
        sigma_mm=np.sqrt(np.maximum(mean_sigma_mm, settings.floor_mm) ** 2 + twin_sigma_mm**2),
        on_airfoil=nominal.airfoil_face[twin.nominal_face[face]],
        skin_mm=_on_twin(nominal, twin),
    )


def noise_of(cloud: Cloud, twin: Twin) -> float:
    """Noise (mm) of a single point: what the sound ones show, and no less than a third of what is stated."""
    return max(twin.noise_mm, float(np.median(cloud.sigma_mm)) / 3.0)


def spacing_of(cloud: Cloud, neighbours: Ints) -> float:
    """Spacing (mm) of the points, from the farthest of their neighbours (n, k; -1 none)."""
    return float(np.median(_spacings(cloud, neighbours)))


def local_spacing_of(cloud: Cloud, neighbours: Ints) -> Floats:
    """Spacing (n,) (mm) of the points about each point: what most of its neighbours (n, k; -1 none) have, for
    few points that lie apart tell nothing of a surface."""
    everywhere = np.ones(len(cloud), np.bool_)
    return neighbourhood_median(_spacings(cloud, neighbours), neighbours, everywhere)


def _spacings(cloud: Cloud, neighbours: Ints) -> Floats:
    """Spacing (n,) about each point, from the farthest of its neighbours (n, k; itself first, -1 none)."""
    squares_mm2, known = np.zeros(len(cloud)), np.zeros(len(cloud))
    for other in neighbours.T:
        there = other >= 0
        apart_mm = cloud.points_mm[np.where(there, other, 0)] - cloud.points_mm
        squares_mm2 = np.maximum(squares_mm2, np.where(there, np.einsum("ij,ij->i", apart_mm, apart_mm), 0.0))
        known += there
    return np.asarray(np.sqrt(np.pi * squares_mm2 / np.maximum(known, 1.0)))


def find_regions(field: Field, nominal: Nominal, settings: RegionSettings) -> list[Region]:
    """The regions of missing and of excess metal on the airfoil, each with the skin that it has lost.

    What stands over the skin is metal of the blade only where it comes near it: a clamp or a reflection
    beside the blade is no damage.
    """
    absent = _connected(-field.smooth_mm, -field.height_mm, field, settings)
    excess = [
        points
        for points in _connected(field.smooth_mm, field.height_mm, field, settings)
        if field.height_mm[points].min() <= settings.join_mm
    ]
    groups = [(points, True) for points in absent] + [(points, False) for points in excess]
    lost = _lost_skin(field, groups, nominal)
    merged = _merged(list(zip(absent, lost, strict=False)), field, nominal, settings.join_mm)
    regions = [Region(points=points, lost=skin, missing=True) for points, skin in merged]
    regions += [Region(points=points, lost=NONE, missing=False) for points in excess]
    return sorted(regions, key=lambda region: -len(region.points))


def _connected(mean_mm: Floats, own_mm: Floats, field: Field, settings: RegionSettings) -> list[Ints]:
    """Index sets of the points whose mean stands off by `high` sigmas, with what hangs together above `low`.

    Next to a deep break the means reach past its border: sound points among them are given back, and points
    that the means of their sound neighbours hide are taken in. A shallow hollow runs out gently: there most
    of a neighbourhood stands off, and noise says no more of a single point.
    """
    sigmas = np.where(field.on_airfoil, mean_mm / field.sigma_mm, 0.0)
    certain, likely = sigmas > settings.high, sigmas > settings.low
    perhaps = (sigmas > settings.skirt) & ~certain
    most_mm = neighbourhood_median(own_mm, field.neighbours, perhaps)
    gentle = perhaps & (most_mm > settings.skirt * field.sigma_mm)
    reached = grow(certain, likely | gentle, field.neighbours)
    proven = field.on_airfoil & (own_mm > settings.low * np.maximum(field.noise_mm, field.sigma_mm))
    wider = dilate(reached, field.neighbours) & proven
    chosen = np.flatnonzero(wider | (reached & (gentle | (own_mm > 0.5 * mean_mm))))
    labels = _labels(chosen, field, max(LINK_SPACINGS * field.spacing_mm, settings.join_mm))
    groups = [chosen[labels == label] for label in np.unique(labels)]
    return [group for group in groups if _is_region(group, field, settings)]


def _is_region(points: Ints, field: Field, settings: RegionSettings) -> bool:
    """Whether they are `least_points`, or where the scan is thin, stand for as much surface as so many do."""
    if len(points) < settings.fewest_points:
        return False
    usual = float(np.sum((field.local_mm[points] / field.spacing_mm) ** 2))
    return len(points) >= settings.least_points or usual >= settings.least_points


def _labels(chosen: Ints, field: Field, link_mm: float) -> Ints:
    """Component (k,) of each chosen point over the neighbour graph, whose longer links join nothing."""
    neighbours = field.neighbours[chosen]
    place = np.full(len(field.scan_mm), -1, np.int64)
    place[chosen] = np.arange(len(chosen))
    apart_mm = np.linalg.norm(field.scan_mm[neighbours] - field.scan_mm[chosen, None], axis=2)
    near = np.where((neighbours >= 0) & (apart_mm <= link_mm), place[neighbours], -1)
    row = np.repeat(np.arange(len(chosen)), near.shape[1])
    linked = near.ravel() >= 0
    graph = coo_array(
        (np.ones(int(linked.sum()), np.int8), (row[linked], near.ravel()[linked])), shape=(len(chosen),) * 2
    )
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _lost_skin(field: Field, groups: list[tuple[Ints, bool]], nominal: Nominal) -> list[Ints]:
    """For each group, the samples of the required surface that no sound point covers, and whose nearest
    scan point is in it or whose patch of uncovered skin borders on it."""
    owner = np.full(len(field.scan_mm), -1, np.int64)
    for index, (points, _) in enumerate(groups):
        owner[points] = index
    sound = np.flatnonzero(owner < 0)
    reach_mm = max(SKIN_SPACINGS * field.spacing_mm, nominal.settings.sample_mm)
    sound_mm = np.asarray(
        cKDTree(field.scan_mm[sound]).query(field.skin_mm, distance_upper_bound=reach_mm)[0]
    )
    bare = np.flatnonzero(~np.isfinite(sound_mm))
    if not (len(bare) and groups):
        return [NONE for _ in groups]
    patch = pieces(field.skin_mm[bare], 2.5 * nominal.settings.sample_mm)
    damaged = np.flatnonzero(owner >= 0)
    distance_mm, nearest = cKDTree(field.scan_mm[damaged]).query(field.skin_mm[bare])
    nearest_owner = owner[damaged[nearest]]
    apart_mm = np.full(patch.max() + 1, np.inf)
    np.minimum.at(apart_mm, patch, distance_mm)
    bordering = apart_mm[patch] <= 2.0 * reach_mm
    lost = [bare[bordering & (nearest_owner == group)] for group in range(len(groups))]
    loose = np.flatnonzero((sound_mm > field.spacing_mm) & np.isfinite(sound_mm))
    return [
        _to_the_border(samples, loose, field.skin_mm, nominal) if len(samples) else NONE for samples in lost
    ]


def _to_the_border(lost: Ints, loose: Ints, skin_mm: Floats, nominal: Nominal) -> Ints:
    """The lost samples and those beside them that lie farther than a point spacing from sound points."""
    apart_mm = np.asarray(cKDTree(skin_mm[lost]).query(skin_mm[loose])[0])
    return np.concatenate([lost, loose[apart_mm <= 1.5 * nominal.settings.sample_mm]])


def _on_twin(nominal: Nominal, twin: Twin) -> Floats:
    """The samples of the required surface (s, 3) moved onto the twin."""
    undeformed = cKDTree(twin.mesh.vertices_mm - twin.displacement_mm)
    near = np.asarray(undeformed.query(nominal.samples.points_mm)[1])
    return nominal.samples.points_mm + twin.displacement_mm[near]


def _merged(
    groups: list[tuple[Ints, Ints]], field: Field, nominal: Nominal, join_mm: float
) -> list[tuple[Ints, Ints]]:
    """The groups of missing metal, those joined whose broken surfaces or lost skins come near each other."""
    if not groups:
        return []
    solids = [
        cKDTree(np.concatenate([field.scan_mm[points], nominal.samples.points_mm[skin]]))
        for points, skin in groups
    ]
    pairs = [
        (i, j)
        for i in range(len(groups))
        for j in range(i)
        if solids[i].count_neighbors(solids[j], join_mm) > 0
    ]
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(pairs), np.int8), (rows, columns)), shape=(len(groups),) * 2)
    labels = connected_components(graph, directed=False)[1]
    return [
        (
            np.sort(np.concatenate([groups[i][0] for i in np.flatnonzero(labels == label)])),
            np.unique(np.concatenate([groups[i][1] for i in np.flatnonzero(labels == label)])),
        )
        for label in np.unique(labels)
    ]
