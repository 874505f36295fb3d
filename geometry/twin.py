"""The damage-free twin: the nominal deformed non-rigidly onto the sound part of the scan."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from geometry.errors import CannotFitTwin
from geometry.freeform import COMPONENTS, Freeform, Lattice, fit_freeform, lattice_over, swell
from geometry.kernels.graph import dilate, grow
from geometry.nominal import Closest, Nominal
from geometry.offset import Nodes, Offset, fit_offset, scatter_nodes
from geometry.refine import Refined, refine
from geometry.register import Alignment, variance_along
from geometry.solid import face_areas_mm2, solid_normals
from geometry.surface import near_each_other
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Ints, Measurand, Measured, Mesh, NotMeasured

CREASE_COSINE = 0.94  # corner normals that differ more belong to different sides of an edge
COARSER = 2.0  # spacing of the nodes that the free form is fitted to, in those of the offset
PATCH_CELLS = 0.4  # what the lattice cannot follow is alike over this part of a cell
FIRST_STIFFNESS = 1e4  # of the free form, before the data set it
LOOSE_ROUNDS = 2  # at first more stands out than damage: form that the field has not taken up yet
NO_NOISE_MM = 1e-5  # least scatter believed


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinSettings:
    """How far form goes and where damage begins.

    Form is what a spline of about `cells` cubic cells over the airfoil follows, plus ripples shallower than
    `damage_mm`; what stands out of the smooth fit by more is damage, and does not shape the twin.
    """

    cells: int = 100  # of the free-form lattice over the airfoil's box
    rounds: int = 8  # of the free-form fit, at most
    points: int = 50_000  # subsample of the free-form fit
    slide_mm: float = 1.0  # the surface may well have moved this far along itself
    damage_mm: float = 0.03
    nodes: int = 9000  # of the offset field; its spacing follows from the airfoil's area
    draws: int = 64  # posterior draws behind the sigmas
    min_supported: float = 0.3  # of the airfoil's area; with less under sound points there is no twin
    seed: int = 0  # of the subsample and the draws


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twin:
    """The blade as it would be today had it not been damaged: the nominal mesh, long edges halved, deformed.

    `sigma_mm` (vertices,): standard uncertainty along the normal, growing into what was not seen.
    `supported` (vertices,): sound scan points vote there; elsewhere the twin is extrapolated.
    `form_mm`: largest |twin - nominal| over the sound required surface.
    """

    mesh: Mesh  # closed, nominal frame
    nominal_face: Ints  # (faces,) the nominal's face that each face lies on, ascending
    displacement_mm: Floats  # (vertices, 3)
    sigma_mm: Floats  # (vertices,)
    supported: Bools  # (vertices,)
    form_mm: Measured
    sound: Bools  # (scan points,) shaped the twin
    noise_mm: float  # scatter of the sound points about the surface, one standard deviation
    sound_rms_mm: float  # sound scan points against the twin
    iterations: int
    converged: bool


def fit_twin(
    cloud: Cloud, mask: Bools, alignment: Alignment, nominal: Nominal, settings: TwinSettings
) -> Twin:
    """The twin of a scan, in the nominal frame.

    `mask` (points,) is True where the registration saw damage; it starts the fit, which then judges
    what stands out. Two steps: a volumetric cubic B-spline moves and swells the airfoil as a whole and
    extrapolates over what is missing; an offset along the normal takes up the ripple where it is seen.
    Raises `CannotFitTwin` when sound points do not hold enough of the airfoil.
    """
    scan_mm = apply(alignment.T_nominal_scan, cloud.points_mm)
    order = near_each_other(scan_mm)  # what is asked together then lies in the cache
    scan_mm, mask, point_sigma_mm = scan_mm[order], mask[order], cloud.sigma_mm[order]
    rng = np.random.default_rng(settings.seed)
    ground = _prepare(nominal, min(settings.nodes, max(len(cloud) // 4, 100)), settings)
    field, rounds, converged = _fit_smooth(scan_mm, mask, ground, settings, rng)
    found = _compare(scan_mm, field, ground, nominal.closest(scan_mm))
    sound = _screen(found, found.usable, ground, settings.damage_mm, 1)
    offset, noise_mm = _fit_ripple(found, sound, point_sigma_mm, field, ground, settings, rng)
    surface = _surface(field, offset, settings, rng)
    displacement_mm, sigma_mm, supported = _vertices(ground.refined, field, offset, surface, rng)
    return Twin(
        mesh=Mesh(
            vertices_mm=ground.refined.mesh.vertices_mm + displacement_mm, faces=ground.refined.mesh.faces
        ),
        nominal_face=ground.refined.parent,
        displacement_mm=displacement_mm,
        sigma_mm=sigma_mm,
        supported=supported,
        form_mm=_form(surface, ground.nodes, alignment),
        sound=sound[np.argsort(order)],
        noise_mm=noise_mm,
        sound_rms_mm=offset.rms_mm,
        iterations=rounds,
        converged=converged,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Ground:
    """What the fit needs of the nominal."""

    nominal: Nominal
    lattice: Lattice
    refined: Refined
    nodes: Nodes
    graph: Ints  # (nodes, k) neighbours
    coarse: Nodes  # what the free form is fitted to
    patch_nodes: float  # coarse nodes over which the misfit of the free form is alike


@lru_cache(maxsize=2)
def _prepare(nominal: Nominal, wanted: int, settings: TwinSettings) -> _Ground:
    """The ground of a fit with about so many nodes, kept from one part to the next."""
    lattice = lattice_over(nominal.samples.points_mm, settings.cells)
    corners = solid_normals(nominal.mesh).corner
    refined = refine(nominal.mesh, corners, nominal.airfoil_face, lattice.cell_mm / 6.0)
    nodes = _scatter(nominal, refined, wanted)
    coarse = scatter_nodes(nodes.points_mm, nodes.normals, 1.0, COARSER * nodes.spacing_mm)
    return _Ground(
        nominal=nominal,
        lattice=lattice,
        refined=refined,
        nodes=nodes,
        graph=nodes.graph(),
        coarse=coarse,
        patch_nodes=max((PATCH_CELLS * lattice.cell_mm / coarse.spacing_mm) ** 2, 1.0),
    )


def _scatter(nominal: Nominal, refined: Refined, wanted: int) -> Nodes:
    """About `wanted` nodes over the airfoil, more where it turns."""
    mesh = refined.mesh
    area_mm2 = np.where(nominal.airfoil_face[refined.parent], face_areas_mm2(mesh), 0.0)
    spacing_mm = float(np.sqrt(area_mm2.sum() / wanted))
    count = int(12.0 * area_mm2.sum() / spacing_mm**2)
    each_mm2 = float(area_mm2.sum()) / count
    face = np.searchsorted(np.cumsum(area_mm2), (np.arange(count) + 0.5) * each_mm2)
    # The R2 sequence (Roberts, 2018) spreads the points in their faces without clumps.
    u, v = np.modf(np.arange(count)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]))[0].T
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    points_mm = np.einsum("nc,ncj->nj", weights, mesh.vertices_mm[mesh.faces[face]])
    normals = np.einsum("nc,ncj->nj", weights, refined.corner_normals[face])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    within = (points_mm[:, 2] >= nominal.z_min_mm) & (points_mm[:, 2] <= nominal.z_max_mm)
    return scatter_nodes(points_mm[within], normals[within], each_mm2, spacing_mm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """Scan points against the nominal moved by the free form."""

    near: Closest  # on the nominal
    along_mm: Floats  # (n,) signed, along the normal
    owner: Ints  # (n,) nearest node; -1 none
    usable: Bools  # (n,) straight above a foot on the airfoil


def _compare(points_mm: Floats, field: Freeform | None, ground: _Ground, foot: Closest) -> _Found:
    """Points pulled back by the free form, as it is at their `foot`, and compared with the nominal."""
    near, moved_mm = foot, np.zeros_like(points_mm)
    if field is not None:
        pulled_mm = points_mm - field.displacement(foot.points_mm, foot.normals)
        near = ground.nominal.closest_from(pulled_mm, foot.face)
        moved_mm = field.displacement(near.points_mm, near.normals)
    along_mm = np.einsum("nj,nj->n", points_mm - moved_mm - near.points_mm, near.normals)
    aside_mm = np.sqrt(np.maximum(near.distance_mm**2 - along_mm**2, 0.0))
    owner = ground.nodes.owner(near.points_mm, near.normals)
    return _Found(
        near=near,
        along_mm=along_mm,
        owner=owner,
        usable=(aside_mm <= 0.5 * np.abs(along_mm) + 0.02) & (owner >= 0),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Votes:
    """Chosen points gathered on their nodes; zeros where a node has none."""

    count: Floats  # (nodes,)
    centre_mm: Floats  # (nodes, 3) mean foot
    normals: Floats  # (nodes, 3) mean normal, shorter than 1 where the surface turns
    along_mm: Floats  # (nodes,) mean
    noise_mm: float  # scatter of the points about their node


def _gather(feet_mm: Floats, normals: Floats, along_mm: Floats, owner: Ints, nodes: Nodes) -> _Votes:
    """Points (n,) with an owner each, on their nodes."""
    size = len(nodes.points_mm)
    count = np.bincount(owner, minlength=size).astype(np.float64)
    values = (along_mm, *feet_mm.T, *normals.T)
    mean = [np.bincount(owner, v, minlength=size) / np.maximum(count, 1.0) for v in values]
    many = count[owner] >= 3.0
    if not many.any():
        raise CannotFitTwin("too few sound points on the airfoil")
    freedom = np.sqrt(count / np.maximum(count - 1.0, 1.0))
    spread_mm = (along_mm - mean[0][owner]) * freedom[owner]
    noise_mm = max(_spread(spread_mm[many]), NO_NOISE_MM)
    return _Votes(
        count=count,
        centre_mm=np.column_stack(mean[1:4]),
        normals=np.column_stack(mean[4:]),
        along_mm=mean[0],
        noise_mm=noise_mm,
    )


def _spread(values: Floats) -> float:
    """Standard deviation about zero, robust: from the median absolute value."""
    return 1.4826 * float(np.median(np.abs(values)))


def _medians(owner: Ints, values: Floats, size: int) -> tuple[Floats, Bools]:
    """Lower median (size,) of the values of each owner, and whether there are any."""
    order = np.lexsort((values, owner))
    count = np.bincount(owner, minlength=size)
    last = np.cumsum(count)
    some = count > 0
    medians = np.zeros(size)
    medians[some] = values[order[(last - count + (count - 1) // 2)[some]]]
    return medians, some


def _screen(found: _Found, chosen: Bools, ground: _Ground, damage_mm: float, rings: int) -> Bools:
    """Which of the chosen points (n,) lie on sound surface: their node does not stand out, nor they of it.

    A node stands out where its median is deeper than `damage_mm` and far from the common run of nodes, or
    joins one that does and is half as deep; so do `rings` of nodes around, for a hollow runs out flat.
    """
    median_mm, some = _medians(found.owner[chosen], found.along_mm[chosen], len(ground.nodes.points_mm))
    if not some.any():
        raise CannotFitTwin("no sound points on the airfoil")
    depth_mm = np.abs(median_mm)
    high_mm = max(damage_mm, 5.0 * _spread(median_mm[some]))
    out = grow(depth_mm > high_mm, depth_mm > 0.5 * high_mm, ground.graph)
    for _ in range(rings):
        out = dilate(out, ground.graph)
    apart_mm = np.abs(found.along_mm - median_mm[found.owner])
    single_mm = max(damage_mm, 5.0 * _spread(apart_mm[chosen]))
    return np.asarray(chosen & ~out[found.owner] & (apart_mm <= single_mm))


def _fit_smooth(
    scan_mm: Floats, mask: Bools, ground: _Ground, settings: TwinSettings, rng: np.random.Generator
) -> tuple[Freeform, int, bool]:
    """The free form that moves the nominal onto the sound points, the rounds it took, and whether it settled.

    Each round compares, screens and solves; the free form and what it leaves out settle together.
    """
    chosen = rng.permutation(len(scan_mm))[: settings.points]
    points_mm = scan_mm[chosen]
    found = _compare(points_mm, None, ground, ground.nominal.closest(points_mm))
    sound = found.usable & ~mask[chosen]
    stiffness = np.full(COMPONENTS, FIRST_STIFFNESS)
    before_mm = np.zeros(len(ground.nodes.points_mm))
    field: Freeform | None = None
    for rounds in range(1, settings.rounds + 1):
        loose_mm = settings.damage_mm * max(1, LOOSE_ROUNDS + 1 - rounds)
        field = _smooth_round(found, sound, field, stiffness, loose_mm, ground, settings)
        stiffness = field.stiffness
        after_mm = field.along(ground.nodes.points_mm, ground.nodes.normals)
        settled = bool(np.abs(after_mm - before_mm).max() <= 0.2 * settings.damage_mm)
        if settled and rounds > LOOSE_ROUNDS:
            return field, rounds, True
        before_mm = after_mm
        found = _compare(points_mm, field, ground, found.near)
        sound = _screen(found, found.usable, ground, loose_mm, 0)
    if field is None:
        raise CannotFitTwin("no round was allowed")
    return field, settings.rounds, False


def _smooth_round(
    found: _Found,
    sound: Bools,
    field: Freeform | None,
    stiffness: Floats,
    loose_mm: float,
    ground: _Ground,
    settings: TwinSettings,
) -> Freeform:
    """One weighted fit to the node means; nodes of one patch share their misfit, so they count as few."""
    feet_mm, normals, left_mm = (a[sound] for a in (found.near.points_mm, found.near.normals, found.along_mm))
    owner = ground.coarse.owner(feet_mm, normals)
    held = owner >= 0
    feet_mm, normals, left_mm, owner = feet_mm[held], normals[held], left_mm[held], owner[held]
    votes = _gather(feet_mm, normals, left_mm, owner, ground.coarse)
    residual, goal_mm = votes.along_mm, votes.along_mm
    if field is not None:
        goal_mm = residual + field.along(votes.centre_mm, votes.normals)
    held = votes.count > 0.0
    share_mm2 = votes.noise_mm**2 / np.maximum(votes.count, 1.0)
    misfit_mm2 = max(_spread(residual[held]) ** 2 - float(np.median(share_mm2[held])), NO_NOISE_MM**2)
    expected_mm = 0.1 * settings.damage_mm  # the nominal's facets and normals are no better
    if field is not None:
        expected_mm = max(expected_mm, float(np.sqrt(misfit_mm2)))
    weights = 1.0 / (share_mm2 + ground.patch_nodes * expected_mm**2)
    weights *= _tukey(residual, np.sqrt(misfit_mm2 + share_mm2 + (0.5 * loose_mm) ** 2)) * held
    return fit_freeform(
        ground.lattice,
        votes.centre_mm[held],
        votes.normals[held],
        goal_mm[held],
        weights[held],
        stiffness=stiffness,
        slide=1.0 / (ground.patch_nodes * settings.slide_mm**2),
        form_mm=settings.damage_mm,
    )


def _tukey(residuals: Floats, scale: Floats) -> Floats:
    """Tukey's biweight (n,): 1 at 0, 0 beyond 4.685 scales."""
    u = np.minimum(np.abs(residuals) / (4.685 * scale), 1.0)
    return np.asarray((1.0 - u * u) ** 2)


def _fit_ripple(
    found: _Found,
    sound: Bools,
    sigma_mm: Floats,
    field: Freeform,
    ground: _Ground,
    settings: TwinSettings,
    rng: np.random.Generator,
) -> tuple[Offset, float]:
    """The offset field that the sound points ask for, and their scatter; each counts by its own sigma."""
    feet_mm, normals, along_mm = (
        a[sound] for a in (found.near.points_mm, found.near.normals, found.along_mm)
    )
    votes = _gather(feet_mm, normals, along_mm, found.owner[sound], ground.nodes)
    held = votes.count >= 3.0
    ripple_mm2 = float(np.mean(votes.along_mm[held] ** 2 - votes.noise_mm**2 / votes.count[held]))
    relative = sigma_mm[sound] / float(np.median(sigma_mm[sound]))
    offset = fit_offset(
        ground.nodes,
        feet_mm,
        normals,
        along_mm,
        votes.noise_mm * relative,
        prior_sigma_mm=float(np.sqrt(max(ripple_mm2, NO_NOISE_MM**2))),
        length_mm=ground.lattice.cell_mm / np.pi,
        draws=settings.draws,
        rng=rng,
    )
    supported = float(offset.nodes.area_mm2[offset.held].sum() / offset.nodes.area_mm2.sum())
    if not supported >= settings.min_supported:
        raise CannotFitTwin(f"sound points hold {supported:.0%} of the airfoil")
    return offset, votes.noise_mm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Surface:
    """The twin at the nodes."""

    moved_mm: Floats  # (nodes,) along the normal, from the nominal
    sigma_mm: Floats  # (nodes,)
    held: Bools  # (nodes,)


def _surface(field: Freeform, offset: Offset, settings: TwinSettings, rng: np.random.Generator) -> _Surface:
    """Both fields together; where the offset is not held by data the free form's own uncertainty shows."""
    nodes = offset.nodes
    free = field.draws(rng, nodes.points_mm, nodes.normals, settings.draws)
    open_fraction = np.minimum((offset.sigma_mm / offset.prior_sigma_mm) ** 2, 1.0)
    return _Surface(
        moved_mm=field.along(nodes.points_mm, nodes.normals) + offset.value_mm,
        sigma_mm=np.sqrt(offset.sigma_mm**2 + open_fraction * np.mean(free**2, axis=1)),
        held=offset.held,
    )


def _form(surface: _Surface, nodes: Nodes, alignment: Alignment) -> Measured:
    """Largest |twin - nominal| along the normal where sound points hold it; its sigma includes the pose's."""
    if not surface.held.any():
        return NotMeasured(reason="no sound surface")
    worst = int(np.argmax(np.where(surface.held, np.abs(surface.moved_mm), -1.0)))
    pose_mm2 = variance_along(alignment, nodes.points_mm[worst], nodes.normals[worst])
    return Measurand(
        name="form_deviation",
        value=float(np.abs(surface.moved_mm[worst])),
        sigma=float(np.sqrt(surface.sigma_mm[worst] ** 2 + pose_mm2)),
        unit="mm",
    )


def _vertices(
    refined: Refined, field: Freeform, offset: Offset, surface: _Surface, rng: np.random.Generator
) -> tuple[Floats, Floats, Bools]:
    """Displacement (n, 3), sigma (n,) and support (n,) of the mesh vertices."""
    vertices, count = refined.mesh.vertices_mm, len(refined.mesh.vertices_mm)
    vertex, normals = _sides(refined)
    carry = offset.nodes.interpolation(vertices[vertex], normals)
    shift, swelling = field.shift(vertices)
    along_mm = swelling[vertex] * swell(normals) + carry @ offset.value_mm
    near = _largest(vertex, np.asarray(carry @ np.ones(carry.shape[1])), count) > 0.5
    variance = np.maximum(carry @ surface.sigma_mm**2, float(surface.sigma_mm.min()) ** 2)
    sigma_mm = np.sqrt(_largest(vertex, variance, count))
    held = -_largest(vertex, -(carry @ surface.held.astype(np.float64)), count) > 0.5
    far = np.flatnonzero(~near)
    spread = field.draws(rng, vertices[far], np.ascontiguousarray(normals[far]), 16)
    sigma_mm[far] = np.sqrt(np.mean(spread**2, axis=1) + offset.prior_sigma_mm**2)
    return shift + _least_move(vertex, normals, along_mm, count), sigma_mm, held & near


def _largest(vertex: Ints, values: Floats, count: int) -> Floats:
    """The largest of the values (k,) that fall on each vertex."""
    result = np.full(count, -np.inf)
    np.maximum.at(result, vertex, values)
    return result


def _sides(refined: Refined) -> tuple[Ints, Floats]:
    """Every vertex with its normal, in order; then once more for each other side of an edge through it."""
    corner_vertex = refined.mesh.faces.ravel()
    corner_normal = refined.corner_normals.reshape(-1, 3)
    _, first = np.unique(corner_vertex, return_index=True)
    main = corner_normal[first]
    other = np.flatnonzero(np.einsum("cj,cj->c", corner_normal, main[corner_vertex]) < CREASE_COSINE)
    keys = np.column_stack([corner_vertex[other], np.round(corner_normal[other] * 64.0).astype(np.int64)])
    _, extra = np.unique(keys, axis=0, return_index=True)
    extra = other[extra]
    return (
        np.concatenate([np.arange(len(first)), corner_vertex[extra]]),
        np.concatenate([main, corner_normal[extra]]),
    )


def _least_move(vertex: Ints, normals: Floats, along_mm: Floats, count: int) -> Floats:
    """The shortest move (count, 3) of each vertex that gives every side through it its offset along its
    normal."""
    damping = 1e-2  # of sides that nearly face each other, as at a sharp trailing edge
    moves = along_mm[:count, None] * normals[:count]
    creased, place = np.unique(vertex[count:], return_inverse=True)
    at = np.concatenate([np.arange(len(creased)), place])
    rows = np.concatenate([creased, np.arange(count, len(vertex))])
    system, right = np.zeros((len(creased), 3, 3)), np.zeros((len(creased), 3))
    np.add.at(system, at, normals[rows][:, :, None] * normals[rows][:, None, :])
    np.add.at(right, at, along_mm[rows][:, None] * normals[rows])
    moves[creased] = np.linalg.solve(system + damping * np.eye(3), right[:, :, None])[:, :, 0]
    return moves
