"""Was every required part of the surface seen? By zone, by area and by largest gap."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import ZONE_ORDER, Nominal
from geometry.damage.damages import Damage, DamageKind
from geometry.damage.local_shape import frames_along
from geometry.damage.skin import Skin
from geometry.deformation.twin import Twin
from geometry.errors import BadInput
from geometry.kernels.facing_marks import FacingMarks
from geometry.registration.alignment import Alignment
from geometry.repair.patches import RepairVolume
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Ints, Mesh, Zone

SAME_SIDE = 0.3  # least cosine between the skin at a place and where a scan point lies, to show that place
ON_PATCH_MM = 0.02  # the outer skin of a patch is the twin's; rounding and the nominal's own facets
LEVELS = 3  # of division round a sample, in search of the largest empty disc


ToMark = Callable[[Floats, Floats], Floats]  # places (n, 3) and their normals to distances (n,), mm


class CoverageStatus(StrEnum):
    SEEN = "seen"  # sound, or absent inside a damage whose broken surface was seen
    UNSEEN = "unseen"


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageSettings:
    min_fraction: float = 0.95
    max_gap_mm: float = 1.5
    normal_mm: float = 0.5  # a scan point farther than this from the skin does not show it

    def __post_init__(self) -> None:
        if not (0.0 < self.min_fraction <= 1.0 and self.max_gap_mm > 0.0 and self.normal_mm > 0.0):
            raise BadInput("coverage settings: a fraction in (0, 1], gaps and distances above zero")


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneCoverage:
    """One zone of the required surface. `covered_fraction` counts area seen or absent; the gap is
    the diameter of the largest empty disc on what is neither, one within the permitted to the pitch of the
    samples only."""

    zone: Zone
    covered_fraction: float
    absent_fraction: float
    largest_gap_mm: float
    status: CoverageStatus


def measure_coverage(
    cloud: Cloud,
    alignment: Alignment,
    nominal: Nominal,
    twin: Twin | None,
    repairs: RepairVolume | None,
    settings: CoverageSettings,
    damages: Sequence[Damage] = (),
) -> tuple[ZoneCoverage, ...]:
    """Coverage of every zone that has required surface, in the order of `ZONE_ORDER`.

    Measured on uniform samples of the nominal, each of which stands for its area: a sample is seen if a
    scan point lies on the same side of the part, within `normal_mm` of the skin (the twin's, or the
    nominal's without one) and within half the permitted gap along it; absent if it belongs to the
    outer skin of a patch. Points on metal in excess or bent show the skin that it took, however far off they
    are. Repeated points add nothing, and fewer points never see more.
    """
    samples = nominal.samples
    raised = _raised(len(cloud), damages)
    seen_mm, seen_normals = _seen_skin(cloud, alignment, nominal, twin, settings.normal_mm, raised)
    absent = _absent(samples.points_mm, twin, repairs, settings.max_gap_mm)
    marks_mm = np.concatenate([seen_mm, samples.points_mm[absent]])
    marks_normals = np.concatenate([seen_normals, samples.normals[absent]])
    to_mark_mm = _to_mark(marks_mm, marks_normals, nominal.settings.sample_mm)
    empty_mm = to_mark_mm(samples.points_mm, samples.normals)
    rows = []
    for index, zone in enumerate(ZONE_ORDER):
        own = samples.zone == index
        if zone is not Zone.OUTSIDE and own.any():
            required = np.flatnonzero(own & ~absent)
            worst_mm = _largest_empty(nominal, required, empty_mm, to_mark_mm, 0.5 * settings.max_gap_mm)
            rows.append(_row(zone, samples.area_mm2[own], empty_mm[own], absent[own], worst_mm, settings))
    return tuple(rows)


def _to_mark(marks_mm: Floats, normals: Floats, cell_mm: float) -> ToMark:
    """The distance from places on the skin to the nearest mark on the same side of the part.

    At a thin edge the marks of the other side do not count.
    """
    if not len(marks_mm):
        return lambda places_mm, facing: np.full(len(places_mm), np.inf)
    marks = FacingMarks(marks_mm, normals, cell_mm)
    return lambda places_mm, facing: marks.distance_mm(places_mm, facing, SAME_SIDE)


def _row(
    zone: Zone, area_mm2: Floats, empty_mm: Floats, absent: Bools, worst_mm: float, settings: CoverageSettings
) -> ZoneCoverage:
    covered = empty_mm <= 0.5 * settings.max_gap_mm
    fraction = float(area_mm2[covered].sum() / area_mm2.sum())
    ok = fraction >= settings.min_fraction and 2.0 * worst_mm <= settings.max_gap_mm
    return ZoneCoverage(
        zone=zone,
        covered_fraction=fraction,
        absent_fraction=float(area_mm2[absent].sum() / area_mm2.sum()),
        largest_gap_mm=2.0 * worst_mm,
        status=CoverageStatus.SEEN if ok else CoverageStatus.UNSEEN,
    )


def _largest_empty(
    nominal: Nominal, own: Ints, empty_mm: Floats, to_mark_mm: ToMark, permitted_mm: float
) -> float:
    """Radius of the largest empty disc about the samples `own` and, where it may pass `permitted_mm`, the
    skin between them.

    The radius changes by no more than the way from one centre to the next, so only squares round a sample
    that may hold a larger one than any found and than is permitted are divided, `LEVELS` times into nine.
    """
    if not len(own):
        return 0.0
    centres_mm, normals = nominal.samples.points_mm[own], nominal.samples.normals[own]
    radius_mm, half_mm = empty_mm[own], 0.75 * nominal.settings.sample_mm
    largest_mm = float(radius_mm.max())
    if not np.isfinite(largest_mm):
        return 0.5 * float(np.linalg.norm(np.ptp(nominal.samples.points_mm, axis=0)))  # nothing of a side
    for _ in range(LEVELS):
        open_ = radius_mm + np.sqrt(2.0) * half_mm > max(largest_mm, permitted_mm)
        half_mm /= 3.0
        finer = nominal.closest(_nine(centres_mm[open_], normals[open_], 2.0 * half_mm))
        required = nominal.airfoil_face[finer.face] & (finer.points_mm[:, 2] >= nominal.z_min_mm)
        required &= finer.points_mm[:, 2] <= nominal.z_max_mm
        centres_mm, normals = finer.points_mm[required], np.repeat(normals[open_], 9, axis=0)[required]
        radius_mm = to_mark_mm(centres_mm, normals)
        largest_mm = max(largest_mm, float(radius_mm.max(initial=0.0)))
    return largest_mm


def _nine(centres_mm: Floats, normals: Floats, step_mm: float) -> Floats:
    """Each centre and eight places round it in its tangent plane, centre after centre: (9 n, 3)."""
    first, second = np.moveaxis(frames_along(normals)[:, :2], 1, 0)
    u, v = (part.reshape(1, 9, 1) for part in np.meshgrid(*2 * ([-step_mm, 0.0, step_mm],)))
    return np.asarray((centres_mm[:, None] + u * first[:, None] + v * second[:, None]).reshape(-1, 3))


def _seen_skin(
    cloud: Cloud, alignment: Alignment, nominal: Nominal, twin: Twin | None, normal_mm: float, raised: Bools
) -> tuple[Floats, Floats]:
    """Where on the nominal (n, 3) the scan shows skin or what took its place, and the nominal's normals.

    Each point goes back by what the twin has moved there: beside a sharp edge that wore away no point would
    have its foot on the edge's end.
    """
    points_mm = apply(alignment.T_nominal_scan, cloud.points_mm)
    if twin is not None:
        points_mm = points_mm - twin.displacement_mm[cKDTree(twin.mesh.vertices_mm).query(points_mm)[1]]
    foot = nominal.closest(points_mm)
    shown = (np.abs(foot.distance_mm) <= normal_mm) | raised
    return foot.points_mm[shown], foot.normals[shown]


def _raised(count: int, damages: Sequence[Damage]) -> Bools:
    """Which of so many scan points lie on metal in excess or bent."""
    raised = np.zeros(count, bool)
    for damage in damages:
        raised[damage.points] |= damage.kind is not DamageKind.MISSING
    return raised


def _on_twin(twin: Twin, points_mm: Floats) -> Floats:
    """Where the twin has carried points (n, 3) of the nominal's surface."""
    rest = Mesh(vertices_mm=twin.mesh.vertices_mm - twin.displacement_mm, faces=twin.mesh.faces)
    corner = rest.faces[Skin(rest).closest(points_mm)[2]]
    a, b, c = np.moveaxis(rest.vertices_mm[corner], 1, 0)
    ab, ac, ap = b - a, c - a, points_mm - a
    bb, bc, cc = ((x * y).sum(axis=1) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    pb, pc = (ap * ab).sum(axis=1), (ap * ac).sum(axis=1)
    whole = np.maximum(bb * cc - bc * bc, 1e-300)
    v, w = (cc * pb - bc * pc) / whole, (bb * pc - bc * pb) / whole
    weights = np.stack([1.0 - v - w, v, w], axis=1)
    return np.asarray(np.einsum("nc,nci->ni", weights, twin.mesh.vertices_mm[corner]))


def _absent(points_mm: Floats, twin: Twin | None, repairs: RepairVolume | None, max_gap_mm: float) -> Bools:
    """Which samples lie on the outer skin of a patch whose broken surface was seen without a larger gap."""
    absent = np.zeros(len(points_mm), bool)
    if twin is None or repairs is None:
        return absent
    on_twin_mm = _on_twin(twin, points_mm)
    for patch in repairs.patches:
        if patch.broken_gap_mm <= max_gap_mm:
            low, high = patch.mesh.vertices_mm.min(axis=0), patch.mesh.vertices_mm.max(axis=0)
            boxed = ((on_twin_mm >= low - ON_PATCH_MM) & (on_twin_mm <= high + ON_PATCH_MM)).all(axis=1)
            distance_mm, _, face = Skin(patch.mesh).closest(on_twin_mm[boxed])
            absent[boxed] |= (np.abs(distance_mm) <= ON_PATCH_MM) & patch.outer[face]
    return absent
