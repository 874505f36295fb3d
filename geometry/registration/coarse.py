"""From no idea of the pose to within a millimetre: principal axes, then many starts where in doubt."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geometry.blade.nominal import Nominal
from geometry.errors import BadInput, CannotRegister
from geometry.registration.fit import every, fit_robust, unit_motions
from geometry.transforms import apply, inverse, rigid
from geometry.types import Floats

DESCENT_STEPS = 15
FALLBACK_POINTS = 200
SHELL_REACH_MM = 2.0  # a point further off its nearest shell point is off the surface


@dataclass(frozen=True, slots=True, kw_only=True)
class CoarseSettings:
    points: int = 1500
    cap_mm: float = 0.5  # a point further off counts as this far
    clear_ratio: float = 3.0  # runner-up over best below which more starts are tried
    clear_score_mm: float = 0.15  # a best score above which more starts are tried
    different_mm: float = 2.0  # rms displacement of the surface that makes two poses different

    def __post_init__(self) -> None:
        positive = (self.cap_mm, self.clear_ratio, self.clear_score_mm, self.different_mm)
        if not (self.points >= 50 and all(x > 0.0 for x in positive)):
            raise BadInput(f"coarse: {self} contradicts itself")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Coarse:
    """The best pose, its score, and that of the best pose that is another one, over it."""

    T_nominal_scan: Floats
    score_mm: float
    runner_up_ratio: float


def find_pose(points_mm: Floats, nominal: Nominal, settings: CoarseSettings) -> Coarse:
    """The pose of the scan to about a millimetre.

    Principal axes give four proper sign combinations; each descends a few damped steps, and the mean
    truncated distance to the nominal ranks them. If that leaves doubt, starts over rolls and shifts along the
    span join. Raises `CannotRegister` for points that lie on a line or less.
    """
    few_mm = points_mm[every(len(points_mm), settings.points)]
    shell = cKDTree(nominal.shell_mm)
    starts = _descend(few_mm, _axis_starts(points_mm, nominal), nominal, shell)
    ranked = _rank(starts, few_mm, nominal, shell, settings)
    if not _clear(ranked, settings):
        sparse_mm = few_mm[every(len(few_mm), FALLBACK_POINTS)]
        more = _many_starts(points_mm, nominal)
        for most in (64, 16):
            more = _promising(_descend(sparse_mm, more, nominal, shell, steps=6), sparse_mm, shell, most)
        more = _descend(few_mm, more, nominal, shell)
        poses = np.concatenate([[pose.T_nominal_scan for pose in ranked], more])
        ranked = _rank(poses, few_mm, nominal, shell, settings)
    best, *others = ranked
    ratio = others[0].score_mm / best.score_mm if others else np.inf
    return Coarse(T_nominal_scan=best.T_nominal_scan, score_mm=best.score_mm, runner_up_ratio=float(ratio))


def _clear(ranked: list["_Pose"], settings: CoarseSettings) -> bool:
    ratio = ranked[1].score_mm / ranked[0].score_mm if len(ranked) > 1 else np.inf
    return bool(ratio >= settings.clear_ratio and ranked[0].score_mm <= settings.clear_score_mm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pose:
    T_nominal_scan: Floats
    score_mm: float


def principal_frame(points_mm: Floats) -> Floats:
    """The 4x4 that carries principal coordinates (longest first) to where the points are."""
    mean_mm = points_mm.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov((points_mm - mean_mm).T))
    if not spread[1] > 1e-6 * spread[2]:
        raise CannotRegister(f"{len(points_mm)} points lie on a line")
    axes = axes[:, ::-1]
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return rigid(axes, mean_mm)


def _axis_starts(points_mm: Floats, nominal: Nominal) -> Floats:
    """Poses (s, 4, 4) that lay principal axes on principal axes: of the airfoil, and of the whole nominal."""
    T_principal_scan = inverse(principal_frame(points_mm))
    flips = [np.diag([a, b, a * b, 1.0]) for a, b in product((1.0, -1.0), repeat=2)]
    frames = [principal_frame(nominal.samples.points_mm), principal_frame(nominal.shell_mm)]
    return np.stack([frame @ flip @ T_principal_scan for frame in frames for flip in flips])


def _many_starts(points_mm: Floats, nominal: Nominal) -> Floats:
    """Poses (s, 4, 4): each principal axis of the scan up or down the span, rolled, and shifted along it."""
    centred = inverse(principal_frame(points_mm))
    axes = [p for p in permutations(range(3)) if p in {(0, 1, 2), (1, 2, 0), (2, 0, 1)}]
    height_mm = nominal.z_max_mm - nominal.z_min_mm
    starts = []
    for axis, down, roll_deg, shift in product(axes, (0.0, 180.0), range(0, 360, 30), (-0.25, 0.0, 0.25)):
        turn = Rotation.from_euler("xz", [down, roll_deg], degrees=True).as_matrix()
        upright = np.eye(3)[:, [axis[1], axis[2], axis[0]]].T
        place_mm = nominal.pivot_mm + np.array([0.0, 0.0, shift * height_mm])
        starts.append(rigid(turn @ upright, place_mm) @ centred)
    return np.stack(starts)


def _descend(
    points_mm: Floats, starts: Floats, nominal: Nominal, shell: cKDTree, steps: int = DESCENT_STEPS
) -> Floats:
    """The poses (s, 4, 4) after a few damped, robust point-to-plane steps on the shell, all at once."""
    poses = starts.copy()
    scale = unit_motions(nominal)
    for _ in range(steps):
        moved_mm = np.einsum("sij,nj->sni", poses[:, :3, :3], points_mm) + poses[:, None, :3, 3]
        distance_mm, nearest = shell.query(moved_mm)
        normals = nominal.shell_normals[nearest]
        height_mm = np.einsum("sni,sni->sn", moved_mm - nominal.shell_mm[nearest], normals)
        width_mm = np.maximum(np.median(distance_mm, axis=1, keepdims=True), 0.3)
        weights = width_mm**2 / (width_mm**2 + distance_mm**2)
        design = np.concatenate([np.cross(moved_mm - nominal.pivot_mm, normals), normals], axis=2) * scale
        weighted = design * weights[:, :, None]
        normal_matrix = np.einsum("sni,snj->sij", weighted, design) + 1e-3 * len(points_mm) * np.eye(6)
        right = np.einsum("sni,sn->si", weighted, height_mm)
        twists = -np.linalg.solve(normal_matrix, right[:, :, None])[:, :, 0] * scale
        poses = _turned(poses, twists, nominal.pivot_mm)
    return poses


def _turned(poses: Floats, twists: Floats, pivot_mm: Floats) -> Floats:
    """The poses (s, 4, 4), each followed by the motion of its twist (s, 6) about the pivot."""
    turns = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    moved = poses.copy()
    moved[:, :3, :3] = turns @ poses[:, :3, :3]
    moved[:, :3, 3] = np.einsum("sij,sj->si", turns, poses[:, :3, 3] - pivot_mm) + pivot_mm + twists[:, 3:]
    return moved


def _promising(poses: Floats, points_mm: Floats, shell: cKDTree, most: int) -> Floats:
    """The poses with the least mean truncated distance to the shell."""
    moved_mm = np.einsum("sij,nj->sni", poses[:, :3, :3], points_mm) + poses[:, None, :3, 3]
    distance_mm, _ = shell.query(moved_mm, distance_upper_bound=2.0)
    return np.asarray(poses[np.argsort(np.minimum(distance_mm, 2.0).mean(axis=1), kind="stable")[:most]])


def _rank(
    poses: Floats, points_mm: Floats, nominal: Nominal, shell: cKDTree, settings: CoarseSettings
) -> list[_Pose]:
    """The poses that differ, best first; the best three settled by the robust fit on the exact nominal."""
    scored = [_roughly_scored(T, points_mm, nominal, shell, settings) for T in poses]
    different = _different(sorted(scored, key=lambda pose: pose.score_mm), nominal, settings)
    settled = [fit_robust(points_mm, pose.T_nominal_scan, nominal, steps=12) for pose in different[:3]]
    again = [_scored(fit.T_nominal_scan, fit.found.distance_mm, settings) for fit in settled]
    best = [min(a, b, key=lambda pose: pose.score_mm) for a, b in zip(again, different[:3], strict=True)]
    ordered = sorted(best + different[3:], key=lambda pose: pose.score_mm)
    return _different(ordered, nominal, settings)


def _roughly_scored(
    T_nominal_scan: Floats, points_mm: Floats, nominal: Nominal, shell: cKDTree, settings: CoarseSettings
) -> _Pose:
    """The pose scored against the tangent planes of the shell, which hold as far as its points are apart."""
    moved_mm = apply(T_nominal_scan, points_mm)
    apart_mm, nearest = shell.query(moved_mm, distance_upper_bound=SHELL_REACH_MM)
    near = np.isfinite(apart_mm)
    offset_mm = moved_mm[near] - nominal.shell_mm[nearest[near]]
    distance_mm = np.full(len(points_mm), settings.cap_mm)
    distance_mm[near] = np.einsum("nj,nj->n", offset_mm, nominal.shell_normals[nearest[near]])
    return _scored(T_nominal_scan, distance_mm, settings)


def _scored(T_nominal_scan: Floats, distance_mm: Floats, settings: CoarseSettings) -> _Pose:
    score_mm = float(np.minimum(np.abs(distance_mm), settings.cap_mm).mean())
    return _Pose(T_nominal_scan=T_nominal_scan, score_mm=max(score_mm, 1e-9))


def _different(ordered: list[_Pose], nominal: Nominal, settings: CoarseSettings) -> list[_Pose]:
    """Of poses that agree, the first only."""
    kept: list[_Pose] = []
    for pose in ordered:
        if all(_apart_mm(pose, other, nominal) > settings.different_mm for other in kept):
            kept.append(pose)
    return kept


def _apart_mm(a: _Pose, b: _Pose, nominal: Nominal) -> float:
    """Root mean square displacement of the nominal's surface between two poses."""
    moved_mm = apply(a.T_nominal_scan @ inverse(b.T_nominal_scan), nominal.shell_mm)
    return float(np.sqrt(np.mean(np.sum((moved_mm - nominal.shell_mm) ** 2, axis=1))))
