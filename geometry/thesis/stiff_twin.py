"""The damage-free twin after thesis chapter 5: what the stiff fit found, read off as a surface with doubt."""

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.blade.solid import solid_normals
from geometry.damage.skin import Skin
from geometry.deformation.offset import Nodes
from geometry.deformation.refine import Refined, refine
from geometry.deformation.twin import Twin
from geometry.errors import CannotFitTwin
from geometry.kernels.stiff_quadric import TERMS
from geometry.kernels.thinplate import linear_weights
from geometry.registration.alignment import Alignment, variance_along
from geometry.robust import robust_sigma
from geometry.thesis.region_growing import grow_damage
from geometry.thesis.stiff_fit import (
    CANDIDATES,
    PER_SECTOR,
    SECTORS,
    START_REACH,
    TIE_REACH,
    TIES,
    Ground,
    Matched,
    Surface,
    ThesisTwinSettings,
    check_held,
    prepare,
    relax,
    seen_by,
)
from geometry.thesis.stiffness import Stiffness
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Measurand, Measured, Mesh, NotMeasured

__all__ = ["ThesisTwinSettings", "fit_twin_thesis"]

FITTED = TERMS / (1 + SECTORS * PER_SECTOR)  # share of the noise that a quadric takes up
RIM_RINGS = 2  # of CAD points at the rim of what is seen take no part in the form
FORGET_MM = 3.0  # beyond what is seen, over which the form may change altogether
RMS_POINTS = 50_000  # of the scan, to compare with the twin
LEAST_EDGE_MM = 1.0  # the twin's mesh is halved no finer


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
    there is no correspondence; the thesis leaves such pairs to their small weights. Form beyond the threshold
    of region growing, as a large bend that no alignment took up, is damage to it; what is left then holds too
    little, and the fit does not settle (`converged`).
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
    ground, surface = prepare(scan_mm[sound], nominal, settings, rng)
    apart_mm, _ = surface.tree.query(ground.nodes.points_mm)
    check_held(np.asarray(apart_mm <= START_REACH * ground.pitch_mm), settings)
    matched = relax(ground, surface, settings)
    seen = seen_by(matched, surface)
    check_held(seen, settings)
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


def _noise(surface: Surface) -> float:
    """Scatter of the scan points about their quadrics, one standard deviation; these follow them in part."""
    fitted = surface.reach_mm > 0.0
    height_mm = surface.coefficients[fitted, 0] * surface.reach_mm[fitted]
    return robust_sigma(height_mm) / float(np.sqrt(1.0 - FITTED))


def _rms(mesh: Mesh, points_mm: Floats) -> float:
    return float(np.sqrt(np.mean(Skin(mesh).closest(np.ascontiguousarray(points_mm))[0] ** 2)))


def _doubt(beyond_mm: Floats, nodes: Nodes, matched: Matched, seen: Bools) -> Floats:
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


def _carry(ground: Ground, matched: Matched, nominal: Nominal) -> tuple[Refined, Floats]:
    """The nominal with long edges halved, and the displacement (vertices, 3) of the nodes on it."""
    longest_mm = max(2.0 * ground.pitch_mm, LEAST_EDGE_MM)
    refined = refine(nominal.mesh, nominal.mesh_normals.corner, nominal.airfoil_face, longest_mm)
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
    ground: Ground, matched: Matched, seen: Bools, seen_sigma_mm: float, alignment: Alignment
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
