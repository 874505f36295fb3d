"""The nominal drawn onto the sound scan, stiff at first (thesis 5.4.3).

Every point of the sampled nominal has its own affine transformation, tied to those of its neighbours. It is
drawn to the local quadric of its nearest scan point, the less the more points share that scan point, and
never across the medial sheet. The ties are relaxed step by step.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.deformation.offset import Nodes
from geometry.errors import BadInput, CannotFitTwin
from geometry.kernels.stiff_quadric import feet_on_quadrics, fit_quadrics
from geometry.kernels.stiff_sheet import crosses_sheet
from geometry.thesis.cad_points import pitch_of, sample_cad
from geometry.thesis.medial_axis import medial_sheet
from geometry.thesis.region_growing import RegionGrowingSettings
from geometry.thesis.stiffness import Stiffness, factor_patches, prepare_stiffness, solve_stiff
from geometry.types import Bools, Floats, Ints

CANDIDATES, SECTORS, PER_SECTOR = 30, 8, 2  # of a scan point's neighbourhood, as in the registration
CANDIDATE_REACH = 4.0  # point spacings within which they are sought
ALIKE = 0.6  # cosine of the normals beyond which a neighbour is round the edge: no height field reaches there
TIE_REACH, TIES = 2.5, 9  # spacings within which a CAD point is tied to at most so many others
SOLVED = 0.1  # of the inner threshold: how far the equations are solved
SEEN_REACH = 1.5  # spacings of the scan: a CAD point with no scan point so near is not seen
START_REACH = 3.0  # CAD spacings: before it moves, a CAD point with no scan point so near has none
SHARERS = 3  # CAD points that may share a scan point and still be seen by it


@dataclass(frozen=True, slots=True, kw_only=True)
class ThesisTwinSettings:
    """The thesis' parameters (5.4.3.3): stiffness alpha_0, its coefficient r, thresholds delta_1, delta_2."""

    nodes: int = 20_000  # points of the sampled nominal; fewer where the scan is coarser
    regions: RegionGrowingSettings = field(default_factory=RegionGrowingSettings)
    stiffness: float = 100.0
    relaxation: float = 0.75
    settled_mm: float = 1e-5  # change of the weighted error that ends the work at one stiffness
    settled: float = 5e-3  # norm of the change of all transformations that ends the registration
    most_steps: int = 150
    level_steps: int = 10  # at one stiffness; correspondences may alternate for ever
    patches: int = 1000  # of the solver
    min_supported: float = 0.3  # of the nodes; with fewer near sound points there is no twin
    seed: int = 0  # of the scan's thinning

    def __post_init__(self) -> None:
        if not (self.nodes >= 500 and self.patches >= 1 and min(self.most_steps, self.level_steps) >= 1):
            raise BadInput(f"thesis twin: {self} asks for too few nodes, patches or steps")
        if not (self.stiffness > 0.0 and 0.0 < self.relaxation < 1.0):
            raise BadInput(f"thesis twin: {self} has no falling stiffness")
        if not (self.settled_mm > 0.0 and self.settled > 0.0):
            raise BadInput(f"thesis twin: {self} never settles")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ground:
    """The sampled nominal, its ties, and the sheet between its sides."""

    nodes: Nodes
    stiffness: Stiffness
    sheet: Floats  # (sections, columns, 3)
    pitch_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """The sound scan points with their local quadrics."""

    points_mm: Floats
    pitch_mm: float
    tree: cKDTree
    thin_tree: cKDTree  # of as many of the points as keep the spacing of the CAD points
    frames: Floats
    coefficients: Floats
    reach_mm: Floats


def prepare(
    sound_mm: Floats, nominal: Nominal, settings: ThesisTwinSettings, rng: np.random.Generator
) -> tuple[Ground, Surface]:
    """CAD points and scan points at one spacing."""
    scan_pitch_mm = pitch_of(sound_mm)
    area_mm2 = float(nominal.samples.area_mm2.sum())
    pitch_mm = max(scan_pitch_mm, float(np.sqrt(area_mm2 / settings.nodes)))
    wanted = max(CANDIDATES, round(len(sound_mm) * (scan_pitch_mm / pitch_mm) ** 2))
    thin_tree = cKDTree(rng.permutation(sound_mm)[:wanted])
    nodes, patch = _nodes(nominal, pitch_mm, area_mm2, settings.patches)
    ties, _ = nodes.near(nodes.points_mm, nodes.normals, TIE_REACH, TIES + 1)
    ground = Ground(
        nodes=nodes,
        stiffness=prepare_stiffness(nodes.points_mm, ties[:, 1:], patch),
        sheet=medial_sheet(nominal),
        pitch_mm=pitch_mm,
    )
    return ground, _quadrics(sound_mm, thin_tree, nominal, scan_pitch_mm)


def _nodes(nominal: Nominal, pitch_mm: float, area_mm2: float, patches: int) -> tuple[Nodes, Ints]:
    """CAD points on the airfoil, those of one patch together, and the patch of each: a cell and a facing."""
    sampled = sample_cad(nominal, nominal.airfoil_face, pitch_mm)
    points_mm, normals = sampled.points_mm, sampled.normals
    within = (points_mm[:, 2] >= nominal.z_min_mm) & (points_mm[:, 2] <= nominal.z_max_mm)
    points_mm, normals = points_mm[within], normals[within]
    axis = np.abs(normals).argmax(axis=1)
    facing = 2 * axis + (normals[np.arange(len(normals)), axis] > 0.0)
    cell = np.floor((points_mm - points_mm.min(axis=0)) / np.sqrt(area_mm2 / patches)).astype(np.int64)
    _, patch = np.unique(np.column_stack([cell, facing]), axis=0, return_inverse=True)
    order = np.argsort(patch, kind="stable")
    nodes = Nodes(
        points_mm=points_mm[order],
        normals=normals[order],
        area_mm2=np.full(len(order), area_mm2 / len(order)),
        spacing_mm=sampled.spacing_mm,
    )
    return nodes, patch[order]


def _quadrics(points_mm: Floats, thin_tree: cKDTree, nominal: Nominal, pitch_mm: float) -> Surface:
    """The balanced local quadric of each scan point; points round a thin edge take no part in it."""
    normals = nominal.closest(points_mm).normals
    cloud = Nodes(points_mm=points_mm, normals=normals, area_mm2=np.ones(len(normals)), spacing_mm=pitch_mm)
    candidates, _ = cloud.near(points_mm, normals, CANDIDATE_REACH, CANDIDATES)
    alike = np.einsum("nkj,nj->nk", normals[candidates], normals) >= ALIKE
    candidates = np.where(alike, candidates, -1)
    frames, coefficients, reach_mm = fit_quadrics(points_mm, normals, candidates, SECTORS, PER_SECTOR)
    return Surface(
        points_mm=points_mm,
        pitch_mm=pitch_mm,
        tree=cKDTree(points_mm),
        thin_tree=thin_tree,
        frames=frames,
        coefficients=coefficients,
        reach_mm=reach_mm,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pairs:
    """What each CAD point is drawn to."""

    targets_mm: Floats  # (n, 3)
    weights: Floats  # (n,) 0 where there is no correspondence
    distance_mm: Floats  # (n,) to the nearest scan point
    sharers: Ints  # (n,) CAD points with the same nearest scan point, at equal spacing of both


def _correspond(moved_mm: Floats, ground: Ground, surface: Surface) -> _Pairs:
    """Point-to-surface correspondences with their weights (eq. 5.3) under the medial constraint."""
    distance_mm, nearest = surface.tree.query(moved_mm)
    _, claimed = surface.thin_tree.query(moved_mm)
    sharers = np.bincount(claimed)[claimed]
    feet_mm = feet_on_quadrics(
        moved_mm, nearest, surface.points_mm, surface.frames, surface.coefficients, surface.reach_mm
    )
    usable = np.isfinite(feet_mm).all(axis=1)
    usable &= ~crosses_sheet(surface.points_mm[nearest], moved_mm, ground.sheet)
    return _Pairs(
        targets_mm=np.where(usable[:, None], feet_mm, moved_mm),
        weights=np.where(usable, -np.expm1(-((1.0 / sharers) ** 2)), 0.0),
        distance_mm=distance_mm,
        sharers=sharers,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matched:
    motions: Floats  # (nodes, 4, 3) transposed transformations
    moved_mm: Floats  # (nodes, 3)
    pairs: _Pairs
    steps: int
    converged: bool


def relax(ground: Ground, surface: Surface, settings: ThesisTwinSettings) -> Matched:
    """The two loops: at one stiffness until the weighted error settles (delta_1), then at the next (eq. 5.7),
    until a lower stiffness leaves the transformations where they were (delta_2)."""
    stiffness = ground.stiffness
    motions = np.zeros((len(stiffness.places), 4, 3))
    motions[:, :3] = np.eye(3)
    pairs = _correspond(ground.nodes.points_mm, ground, surface)
    alpha, steps = settings.stiffness, 0
    while steps < settings.most_steps:
        level = _settle(motions, pairs, alpha, ground, surface, settings)
        change = float(np.linalg.norm(level.motions - motions))
        motions, pairs, steps = level.motions, level.pairs, steps + level.steps
        if change < settings.settled:
            break
        alpha *= settings.relaxation
    return Matched(
        motions=motions,
        moved_mm=_moved(stiffness, motions),
        pairs=pairs,
        steps=steps,
        converged=level.settled and change < settings.settled,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Level:
    """The state at one stiffness."""

    motions: Floats  # (nodes, 4, 3)
    pairs: _Pairs
    steps: int
    settled: bool


def _settle(
    motions: Floats,
    pairs: _Pairs,
    alpha: float,
    ground: Ground,
    surface: Surface,
    settings: ThesisTwinSettings,
) -> _Level:
    """The inner loop: solve, move, find the correspondences anew, at one stiffness."""
    stiffness = ground.stiffness
    patches = factor_patches(stiffness, alpha, pairs.weights)
    before_mm, settled, steps = np.inf, False, 0
    while steps < settings.level_steps and not settled:
        if not pairs.weights.any():
            raise CannotFitTwin("no CAD point corresponds to a scan point")
        motions, _ = solve_stiff(
            stiffness,
            patches,
            alpha,
            pairs.weights,
            pairs.targets_mm,
            motions,
            SOLVED * settings.settled_mm,
        )
        moved_mm = _moved(stiffness, motions)
        error_mm = _weighted_rms(moved_mm, pairs)
        pairs = _correspond(moved_mm, ground, surface)
        settled = abs(before_mm - error_mm) < settings.settled_mm
        before_mm, steps = error_mm, steps + 1
    return _Level(motions=motions, pairs=pairs, steps=steps, settled=settled)


def _moved(stiffness: Stiffness, motions: Floats) -> Floats:
    return np.asarray(np.einsum("na,nad->nd", stiffness.places, motions))


def _weighted_rms(moved_mm: Floats, pairs: _Pairs) -> float:
    """Root mean square distance of the pairs, each by its weight: the thesis' RMS_we."""
    square_mm2 = np.sum((moved_mm - pairs.targets_mm) ** 2, axis=1)
    return float(np.sqrt(pairs.weights @ square_mm2 / pairs.weights.sum()))


def seen_by(matched: Matched, surface: Surface) -> Bools:
    """CAD points (n,) that have a scan point of their own nearby."""
    pairs = matched.pairs
    near = pairs.distance_mm <= SEEN_REACH * surface.pitch_mm
    return np.asarray(near & (pairs.sharers <= SHARERS) & (pairs.weights > 0.0))


def check_held(held: Bools, settings: ThesisTwinSettings) -> None:
    if not held.mean() >= settings.min_supported:
        raise CannotFitTwin(f"sound points hold {held.mean():.0%} of the airfoil")
