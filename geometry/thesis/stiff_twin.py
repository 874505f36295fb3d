"""The damage-free twin after thesis chapter 5: the nominal drawn onto the sound scan, stiff at first.

Every point of the sampled nominal has its own affine transformation, tied to those of its neighbours. It is
drawn to the local quadric of its nearest scan point, the less the more points share that scan point, and
never across the medial sheet. The ties are relaxed step by step.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from geometry.broken import Skin
from geometry.errors import BadInput, CannotFitTwin
from geometry.kernels.stiff_quadric import TERMS, feet_on_quadrics, fit_quadrics
from geometry.kernels.stiff_sheet import crosses_sheet
from geometry.kernels.thinplate import linear_weights
from geometry.mask import robust_sigma
from geometry.nominal import Nominal
from geometry.offset import Nodes
from geometry.refine import Refined, refine
from geometry.register import Alignment, variance_along
from geometry.solid import solid_normals
from geometry.thesis.cad_points import pitch_of, sample_cad
from geometry.thesis.medial_axis import medial_sheet
from geometry.thesis.region_growing import RegionGrowingSettings, grow_damage
from geometry.thesis.stiffness import Stiffness, factor_patches, prepare_stiffness, solve_stiff
from geometry.transforms import apply
from geometry.twin import Twin
from geometry.types import Bools, Cloud, Floats, Ints, Measurand, Measured, Mesh, NotMeasured

CANDIDATES, SECTORS, PER_SECTOR = 30, 8, 2  # of a scan point's neighbourhood, as in the registration
FITTED = TERMS / (1 + SECTORS * PER_SECTOR)  # share of the noise that a quadric takes up
CANDIDATE_REACH = 4.0  # point spacings within which they are sought
ALIKE = 0.6  # cosine of the normals beyond which a neighbour is round the edge: no height field reaches there
TIE_REACH, TIES = 2.5, 9  # spacings within which a CAD point is tied to at most so many others
SOLVED = 0.1  # of the inner threshold: how far the equations are solved
SEEN_REACH = 1.5  # spacings of the scan: a CAD point with no scan point so near is not seen
START_REACH = 3.0  # CAD spacings: before it moves, a CAD point with no scan point so near has none
SHARERS = 3  # CAD points that may share a scan point and still be seen by it
RIM_RINGS = 2  # of CAD points at the rim of what is seen take no part in the form
FORGET_MM = 3.0  # beyond what is seen, over which the form may change altogether
RMS_POINTS = 50_000  # of the scan, to compare with the twin
LEAST_EDGE_MM = 1.0  # the twin's mesh is halved no finer


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


def fit_twin_thesis(
    cloud: Cloud,
    mask: Bools,
    alignment: Alignment,
    nominal: Nominal,
    settings: ThesisTwinSettings = ThesisTwinSettings(),
) -> Twin:
    """The twin of a scan, in the nominal frame, by stiff non-rigid registration.

    Damage is what region growing finds and what `mask` (points,) holds already. Neither a threshold nor a
    weight tells whether a quadric still means something far from its own points, so beyond its neighbourhood
    there is no correspondence; the thesis leaves such pairs to their small weights.
    `sigma_mm` where points are seen: the scan's misfit to the twin without its noise, and the noise that one
    local quadric takes up (the ties average it further, which is not counted). For how it grows beyond, see
    `_doubt`.
    Raises `CannotFitTwin` when sound points hold too little of the airfoil. Source: thesis 5.4.
    """
    rng = np.random.default_rng(settings.seed)
    scan_mm = apply(alignment.T_nominal_scan, cloud.points_mm)
    sound = ~(mask | grow_damage(scan_mm, nominal, settings.regions))
    sound &= nominal.airfoil_face[nominal.closest(scan_mm).face]
    if sound.sum() < CANDIDATES:
        raise CannotFitTwin(f"{int(sound.sum())} sound points on the airfoil")
    ground, surface = _prepare(scan_mm[sound], nominal, settings, rng)
    apart_mm, _ = surface.tree.query(ground.nodes.points_mm)
    _check_held(np.asarray(apart_mm <= START_REACH * ground.pitch_mm), settings)
    matched = _relax(ground, surface, settings)
    seen = _seen(matched, surface)
    _check_held(seen, settings)
    refined, displacement_mm = _carry(ground, matched, nominal)
    mesh = Mesh(vertices_mm=refined.mesh.vertices_mm + displacement_mm, faces=refined.mesh.faces)
    noise_mm = _noise(surface)
    rms_mm = _rms(mesh, rng.permutation(scan_mm[sound])[:RMS_POINTS])
    seen_sigma_mm = float(np.sqrt(max(rms_mm**2 - noise_mm**2, 0.0) + FITTED * noise_mm**2))
    apart_mm, _ = cKDTree(ground.nodes.points_mm[seen]).query(refined.mesh.vertices_mm)
    return Twin(
        mesh=mesh,
        nominal_face=refined.parent,
        displacement_mm=displacement_mm,
        sigma_mm=np.hypot(seen_sigma_mm, _doubt(apart_mm - ground.pitch_mm, ground.nodes, matched, seen)),
        supported=apart_mm <= ground.pitch_mm,
        form_mm=_form(ground, matched, seen, seen_sigma_mm, alignment),
        sound=sound,
        noise_mm=noise_mm,
        sound_rms_mm=rms_mm,
        iterations=matched.steps,
        converged=matched.converged,
    )


def _check_held(held: Bools, settings: ThesisTwinSettings) -> None:
    if not held.mean() >= settings.min_supported:
        raise CannotFitTwin(f"sound points hold {held.mean():.0%} of the airfoil")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Ground:
    """The sampled nominal, its ties, and the sheet between its sides."""

    nodes: Nodes
    stiffness: Stiffness
    sheet: Floats  # (sections, columns, 3)
    pitch_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Surface:
    """The sound scan points with their local quadrics."""

    points_mm: Floats
    pitch_mm: float
    tree: cKDTree
    thin_tree: cKDTree  # of as many of the points as keep the spacing of the CAD points
    frames: Floats
    coefficients: Floats
    reach_mm: Floats


def _prepare(
    sound_mm: Floats, nominal: Nominal, settings: ThesisTwinSettings, rng: np.random.Generator
) -> tuple[_Ground, _Surface]:
    """CAD points and scan points at one spacing."""
    scan_pitch_mm = pitch_of(sound_mm)
    area_mm2 = float(nominal.samples.area_mm2.sum())
    pitch_mm = max(scan_pitch_mm, float(np.sqrt(area_mm2 / settings.nodes)))
    wanted = max(CANDIDATES, round(len(sound_mm) * (scan_pitch_mm / pitch_mm) ** 2))
    thin_tree = cKDTree(rng.permutation(sound_mm)[:wanted])
    nodes, patch = _nodes(nominal, pitch_mm, area_mm2, settings.patches)
    ties, _ = nodes.near(nodes.points_mm, nodes.normals, TIE_REACH, TIES + 1)
    ground = _Ground(
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


def _quadrics(points_mm: Floats, thin_tree: cKDTree, nominal: Nominal, pitch_mm: float) -> _Surface:
    """The balanced local quadric of each scan point; points round a thin edge take no part in it."""
    normals = nominal.closest(points_mm).normals
    cloud = Nodes(points_mm=points_mm, normals=normals, area_mm2=np.ones(len(normals)), spacing_mm=pitch_mm)
    candidates, _ = cloud.near(points_mm, normals, CANDIDATE_REACH, CANDIDATES)
    alike = np.einsum("nkj,nj->nk", normals[candidates], normals) >= ALIKE
    candidates = np.where(alike, candidates, -1)
    frames, coefficients, reach_mm = fit_quadrics(points_mm, normals, candidates, SECTORS, PER_SECTOR)
    return _Surface(
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


def _correspond(moved_mm: Floats, ground: _Ground, surface: _Surface) -> _Pairs:
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
class _Matched:
    motions: Floats  # (nodes, 4, 3) transposed transformations
    moved_mm: Floats  # (nodes, 3)
    pairs: _Pairs
    steps: int
    converged: bool


def _relax(ground: _Ground, surface: _Surface, settings: ThesisTwinSettings) -> _Matched:
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
    return _Matched(
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
    ground: _Ground,
    surface: _Surface,
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


def _seen(matched: _Matched, surface: _Surface) -> Bools:
    """CAD points (n,) that have a scan point of their own nearby."""
    pairs = matched.pairs
    near = pairs.distance_mm <= SEEN_REACH * surface.pitch_mm
    return np.asarray(near & (pairs.sharers <= SHARERS) & (pairs.weights > 0.0))


def _noise(surface: _Surface) -> float:
    """Scatter of the scan points about their quadrics, one standard deviation; these follow them in part."""
    fitted = surface.reach_mm > 0.0
    height_mm = surface.coefficients[fitted, 0] * surface.reach_mm[fitted]
    return robust_sigma(height_mm) / float(np.sqrt(1.0 - FITTED))


def _rms(mesh: Mesh, points_mm: Floats) -> float:
    return float(np.sqrt(np.mean(Skin(mesh).closest(np.ascontiguousarray(points_mm))[0] ** 2)))


def _doubt(beyond_mm: Floats, nodes: Nodes, matched: _Matched, seen: Bools) -> Floats:
    """Standard deviation (n,) of the twin this far beyond what is seen; 0 for what is not beyond.

    The twin goes on with the slope that its transformations have at the rim, where points are drawn to the
    scan without being seen; that slope is in doubt as a whole. And within `FORGET_MM` the form has become
    any other that it has elsewhere.
    """
    beyond_mm = np.maximum(beyond_mm, 0.0)
    rim = (matched.pairs.weights > 0.0) & ~seen
    chosen = rim if rim.any() else seen
    tilt = np.einsum("nad,nd->na", matched.motions[chosen, :3] - np.eye(3), nodes.normals[chosen])
    along = np.einsum("na,na->n", tilt, nodes.normals[chosen])
    slope = float(np.sqrt(np.mean(np.sum(tilt**2, axis=1) - along**2)))
    moved_mm = np.einsum("nj,nj->n", matched.moved_mm - nodes.points_mm, nodes.normals)[seen]
    form_mm = float(np.sqrt(np.mean(moved_mm**2)))
    return np.hypot(slope * beyond_mm, form_mm * np.minimum(beyond_mm / FORGET_MM, 1.0))


def _carry(ground: _Ground, matched: _Matched, nominal: Nominal) -> tuple[Refined, Floats]:
    """The nominal with long edges halved, and the displacement (vertices, 3) of the nodes on it."""
    longest_mm = max(2.0 * ground.pitch_mm, LEAST_EDGE_MM)
    refined = refine(nominal.mesh, solid_normals(nominal.mesh).corner, nominal.airfoil_face, longest_mm)
    moves_mm = matched.moved_mm - ground.nodes.points_mm
    return refined, _at_vertices(refined.mesh, ground.nodes, moves_mm)


def _at_vertices(mesh: Mesh, nodes: Nodes, moves_mm: Floats) -> Floats:
    """The nodes' moves (n, 3) at the vertices of a mesh, linear between; beyond all nodes the nearest's."""
    looks = solid_normals(mesh).vertex
    looks = np.ascontiguousarray(looks / np.linalg.norm(looks, axis=1, keepdims=True))
    near, rho = nodes.near(mesh.vertices_mm, looks, TIE_REACH, TIES)
    weights = linear_weights(mesh.vertices_mm, looks, nodes.points_mm, nodes.normals, near, rho, TIE_REACH)
    result = np.einsum("vk,vkd->vd", np.where(near >= 0, weights, 0.0), moves_mm[near])
    alone = np.flatnonzero(near[:, 0] < 0)
    result[alone] = moves_mm[cKDTree(nodes.points_mm).query(mesh.vertices_mm[alone])[1]]
    return np.asarray(result)


def _inner(seen: Bools, stiffness: Stiffness) -> Bools:
    """Seen points (n,) whose neighbours, and theirs, are seen: at a rim quadrics are one-sided and tilt."""
    inner = seen
    for _ in range(RIM_RINGS):
        inner = inner & np.minimum.reduceat(inner[stiffness.columns], stiffness.offsets[:-1])
    return inner


def _form(
    ground: _Ground, matched: _Matched, seen: Bools, seen_sigma_mm: float, alignment: Alignment
) -> Measured:
    """Largest |twin - nominal| along the normal where it is well seen; its sigma includes the pose's."""
    nodes, inner = ground.nodes, _inner(seen, ground.stiffness)
    if not inner.any():
        return NotMeasured(reason="no sound surface")
    along_mm = np.einsum("nj,nj->n", matched.moved_mm - nodes.points_mm, nodes.normals)
    worst = int(np.argmax(np.where(inner, np.abs(along_mm), -1.0)))
    pose_mm2 = variance_along(alignment, nodes.points_mm[worst], nodes.normals[worst])
    return Measurand(
        name="form_deviation",
        value=float(np.abs(along_mm[worst])),
        sigma=float(np.sqrt(seen_sigma_mm**2 + pose_mm2)),
        unit="mm",
    )
