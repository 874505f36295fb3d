"""Twin minus scan: watertight patches with volume, for the repair shop."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.solid import volume_mm3
from geometry.damage.broken import BrokenSurface, Scan, find_broken_surface
from geometry.damage.damages import IN_LAYERS, Damage, DamageKind
from geometry.damage.depth import BORDER
from geometry.damage.skin import Skin, skin_of
from geometry.deformation.twin import Twin
from geometry.errors import BadInput, CannotRepair
from geometry.registration.alignment import Alignment
from geometry.repair.border import border_of
from geometry.repair.columns import volume_by_columns
from geometry.repair.cut_body import Reach, cut_body
from geometry.repair.lost_piece import Piece, lost_piece, solid_of
from geometry.threads import one_blas_thread
from geometry.transforms import apply, check_rigid, inverse
from geometry.types import Bools, Cloud, Floats, Measurand, Measured, Mesh, NotMeasured, Zone

NEAR_MM = 2.0  # about a patch, where its vertices of the twin are sought
REACHES = ((0.25, 0.25), (0.5, 0.5), (0.5, 1.25))  # of the permitted gap: about scan points, about the break
SLACK = 0.25  # of the permitted gap: sound skin may be nearer than the break by so much
A_HANDFUL = 7.0  # points that would tell a volume to itself
NOT_MEASURED = NotMeasured(reason="was not measured")


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairSettings:
    """How patches are made."""

    max_gap_mm: float = 1.5  # a larger hole in the broken surface is not bridged
    film_sigmas: float = 3.0  # closer than this to the twin, in sigmas of a scan point, is sound skin
    min_points: int = 12  # on the broken surface: a scrap of a torn tip has no more
    resolution: float = 60.0  # grid cells across the square root of the broken area
    max_nodes: int = 12_000_000
    sliver_fraction: float = 0.01  # pieces smaller than this share of the largest are dropped
    agreement: float = 0.05  # largest difference of the two volumes, relative
    agreement_mm3: float = 0.05  # and added to that
    allowance_mm: float = 0.0  # for machining: the written patch stands out of the twin by so much
    max_twin_sigma_mm: float = (
        0.25  # of the twin over the lost skin; beyond, the form of the metal is a guess
    )

    def __post_init__(self) -> None:
        if not (self.max_gap_mm > 0.0 and self.film_sigmas > 0.0 and self.resolution >= 5.0):
            raise BadInput("repair settings: gap, film and resolution must be positive")
        if not (0.0 <= self.allowance_mm < np.inf and self.max_twin_sigma_mm > 0.0):
            raise BadInput("repair settings: an allowance below zero, or no uncertainty of the twin allowed")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """The metal to put back for one damage: a closed, oriented solid in the nominal frame.

    `mesh` is the metal that was lost; `written` is what the repair shop gets, with the machining allowance.
    """

    damage: int  # index into the damages it was made for
    zone: Zone
    mesh: Mesh
    outer: Bools  # (faces,) on the twin's skin; the others lie on the broken surface
    watertight: bool
    volume_mm3: Measurand
    volume_check_mm3: float  # by an independent second method
    broken_gap_mm: float  # diameter of the largest empty disc on the broken surface
    border_step_mm: Measured  # largest height of the sound skin off the patch's, along the border
    border_angle_deg: Measured  # and largest angle between them
    area_mm2: Measured = NOT_MEASURED  # of the lost skin
    allowance_mm: float = 0.0

    @property
    def written(self) -> Mesh:
        """The patch with its allowance beyond the twin's skin."""
        return with_allowance(self, self.allowance_mm) if self.allowance_mm else self.mesh

    @property
    def written_mm3(self) -> Measurand:
        """Volume of the patch as written; the allowance adds nothing to its uncertainty."""
        return replace(self.volume_mm3, name="written_mm3", value=volume_mm3(self.written))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RepairVolume:
    """All patches, their total, and why a damage has none: `failures` maps damage index to reason."""

    patches: tuple[Patch, ...]
    volume_mm3: Measurand
    failures: dict[int, str]


@one_blas_thread
def find_repairs(
    twin: Twin, cloud: Cloud, alignment: Alignment, damages: Sequence[Damage], settings: RepairSettings
) -> RepairVolume:
    """One patch, or the reason why there is none, for each damage with missing metal.

    Metal whose skin was scanned as well is not known to be missing: it gets none.
    """
    missing = [i for i, damage in enumerate(damages) if damage.kind is DamageKind.MISSING]
    patches: list[Patch] = []
    failures = {i: IN_LAYERS.reason for i in missing if damages[i].layered}
    missing = [i for i in missing if i not in failures]
    if missing:
        skin, solid = skin_of(twin.mesh), solid_of(twin.mesh).as_original()
        scan = _scan(twin, cloud, alignment, damages)
    for i in missing:
        try:
            patches.append(_patch(i, damages[i], twin, skin, solid, scan, settings))
        except CannotRepair as reason:
            failures[i] = str(reason)
    return RepairVolume(patches=tuple(patches), volume_mm3=_total(patches), failures=failures)


def in_frame(mesh: Mesh, T_to_nominal: Floats) -> Mesh:
    """The mesh of the nominal frame in another one, of a fixture or a machine: `T_to_nominal` (4, 4)."""
    check_rigid(T_to_nominal, "the pose of a patch")
    return Mesh(vertices_mm=apply(T_to_nominal, mesh.vertices_mm), faces=mesh.faces)


def to_scan_frame(mesh: Mesh, alignment: Alignment) -> Mesh:
    """The mesh as it lies on the scanned part: moved from the nominal frame back into the scan's."""
    return in_frame(mesh, inverse(alignment.T_nominal_scan))


def with_allowance(patch: Patch, allowance_mm: float) -> Mesh:
    """The patch grown outward by `allowance_mm` (>= 0) beyond the twin's skin, to be machined off.

    Each vertex of the outer skin moves along its mean normal, far enough to clear every face around it.
    """
    if not 0.0 <= allowance_mm < np.inf:
        raise BadInput(f"a machining allowance of {allowance_mm} mm")
    mesh, corners = patch.mesh, patch.mesh.faces[patch.outer].ravel()
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces[patch.outer]], 1, 0)
    cross = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    count = len(mesh.vertices_mm)
    normal = _unit(np.column_stack([np.bincount(corners, cross[:, i], count) for i in range(3)]))
    clear = np.ones(count)
    np.minimum.at(clear, corners, (_unit(cross) * normal[corners]).sum(axis=1))
    reach_mm = allowance_mm / np.maximum(clear, 0.5)
    return Mesh(vertices_mm=mesh.vertices_mm + reach_mm[:, None] * normal, faces=mesh.faces)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300))


def _scan(twin: Twin, cloud: Cloud, alignment: Alignment, damages: Sequence[Damage]) -> Scan:
    points_mm = apply(alignment.T_nominal_scan, cloud.points_mm)
    flagged = np.zeros(len(cloud), bool)
    for damage in damages:
        flagged[damage.points] = True
    seen = twin.sigma_mm[twin.supported]
    return Scan(
        points_mm=points_mm,
        sigma_mm=np.maximum(cloud.sigma_mm, twin.noise_mm),
        flagged=flagged,
        twin_sigma_mm=float(np.median(seen if len(seen) else twin.sigma_mm)),
    )


def _patch(
    index: int, damage: Damage, twin: Twin, skin: Skin, solid: Any, scan: Scan, settings: RepairSettings
) -> Patch:
    broken = find_broken_surface(
        skin, scan, damage.points, settings.film_sigmas, settings.max_gap_mm, settings.min_points
    )
    piece, gap_mm = _closed_off(broken, skin, solid, settings)
    volume, check = volume_mm3(piece.mesh), volume_by_columns(broken, skin)
    allowed = settings.agreement * volume + settings.agreement_mm3
    if not abs(volume - check) <= allowed:
        raise CannotRepair(f"two ways to its volume disagree: {volume:.3f} and {check:.3f} mm3")
    skin_sigma_mm, area_mm2 = _on_lost_skin(piece, twin)
    twin_sigma_mm = float(skin_sigma_mm @ area_mm2 / area_mm2.sum())
    if not twin_sigma_mm <= settings.max_twin_sigma_mm:
        raise CannotRepair(f"over the lost skin the twin is known to {twin_sigma_mm:.2f} mm only")
    sigma = _volume_sigma(piece, float(skin_sigma_mm @ area_mm2), broken, abs(volume - check))
    step, angle = border_of(piece, broken)
    return Patch(
        damage=index,
        zone=damage.zone,
        mesh=piece.mesh,
        outer=piece.outer,
        watertight=True,
        volume_mm3=Measurand(name="volume_mm3", value=volume, sigma=sigma, unit="mm3"),
        volume_check_mm3=check,
        broken_gap_mm=gap_mm,
        border_step_mm=step,
        border_angle_deg=angle,
        area_mm2=_lost_area(piece, area_mm2, broken),
        allowance_mm=settings.allowance_mm,
    )


def _closed_off(
    broken: BrokenSurface, skin: Skin, solid: Any, settings: RepairSettings
) -> tuple[Piece, float]:
    """The lost metal, and the diameter of the largest disc on its broken side that holds no scan point.

    By the narrowest continuation of the broken surface that closes the lost metal off and bridges no larger
    hole than is permitted.
    """
    why = CannotRepair("")
    for known, own in REACHES:
        reach = Reach(known_mm=known * settings.max_gap_mm, break_mm=own * settings.max_gap_mm)
        slack_mm = SLACK * settings.max_gap_mm
        try:
            body = cut_body(broken, skin, reach, slack_mm, settings.resolution, settings.max_nodes)
            piece = lost_piece(solid, body, settings.sliver_fraction)
        except CannotRepair as reason:
            why = reason
            continue
        gap_mm = _broken_gap(piece, broken)
        if gap_mm <= settings.max_gap_mm:
            return piece, gap_mm
        why = CannotRepair(f"a hole of {gap_mm:.2f} mm in the scan of the broken surface")
    raise why


def _broken_gap(piece: Piece, broken: BrokenSurface) -> float:
    known_mm = np.concatenate([broken.raw_mm, broken.rim.points_mm])
    return 2.0 * float(np.max(cKDTree(known_mm).query(piece.faces(~piece.outer)[0])[0]))


def _total(patches: Sequence[Patch]) -> Measurand:
    """The sum; the sigmas add, because the twin's error is common to all."""
    value = sum(patch.volume_mm3.value for patch in patches)
    sigma = sum(patch.volume_mm3.sigma for patch in patches)
    return Measurand(name="volume_mm3", value=value, sigma=sigma, unit="mm3")


def _on_lost_skin(piece: Piece, twin: Twin) -> tuple[Floats, Floats]:
    """Standard uncertainty of the twin (n,) at the outer faces, and the areas (n,) of these."""
    mesh, (middle_mm, area_mm2) = piece.mesh, piece.faces(piece.outer)
    low_mm, high_mm = mesh.vertices_mm.min(axis=0) - NEAR_MM, mesh.vertices_mm.max(axis=0) + NEAR_MM
    vertices_mm = twin.mesh.vertices_mm
    near = np.flatnonzero(((vertices_mm >= low_mm) & (vertices_mm <= high_mm)).all(axis=1))
    if not len(near):
        near = np.arange(len(vertices_mm))
    return twin.sigma_mm[near[cKDTree(vertices_mm[near]).query(middle_mm)[1]]], area_mm2


def _lost_area(piece: Piece, area_mm2: Floats, broken: BrokenSurface) -> Measurand:
    """Area of the outer skin; its border is known to a part of the spacing of the points."""
    mesh, outer = piece.mesh, piece.outer
    corner_mm, on_border = mesh.vertices_mm[mesh.faces[outer]], np.isin(mesh.faces[outer], mesh.faces[~outer])
    edge_mm = np.linalg.norm(np.roll(corner_mm, -1, axis=1) - corner_mm, axis=2)
    border_mm = float(edge_mm[on_border & np.roll(on_border, -1, axis=1)].sum())
    sigma = BORDER * float(np.median(broken.spacing_mm)) * border_mm
    return Measurand(name="area_mm2", value=float(area_mm2.sum()), sigma=sigma, unit="mm2")


def _volume_sigma(piece: Piece, from_twin_mm3: float, broken: BrokenSurface, difference_mm3: float) -> float:
    """Standard uncertainty of the volume, mm3.

    The twin's error is taken as the same all over the lost skin; the noise of the scan points averages
    out; where the patch is thinner than the film its edge is a matter of chance; what the two methods
    disagree by and what was dropped stand for the shape between the points, and a share of it all where
    only a handful tells that.
    """
    middle_mm, area_mm2 = piece.faces(piece.outer)
    from_noise = broken.sigma_mm * broken.area_mm2 / np.sqrt(len(broken.raw_mm))
    broken_mm = piece.faces(~piece.outer)[0]
    to_break_mm, _ = cKDTree(broken_mm).query(middle_mm, distance_upper_bound=broken.film_mm)
    from_film = broken.film_mm * float(area_mm2[to_break_mm < broken.film_mm].sum()) / np.sqrt(12.0)
    from_shape = np.hypot(difference_mm3 / np.sqrt(12.0), piece.dropped_mm3 / np.sqrt(3.0))
    from_few = (A_HANDFUL / len(broken.raw_mm)) ** 2 * volume_mm3(piece.mesh)
    return float(np.linalg.norm([from_twin_mm3, from_noise, from_film, from_shape, from_few]))
