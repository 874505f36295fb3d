"""Twin minus scan: watertight patches with volume, for the repair shop."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import manifold3d
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geometry.blade.solid import check_solid, volume_mm3
from geometry.damage.broken import BrokenSurface, Scan, Skin, find_broken_surface, frames_along, skin_of
from geometry.damage.damages import Damage, DamageKind
from geometry.damage.depth import BORDER
from geometry.deformation.twin import Twin
from geometry.errors import BadInput, CannotRepair
from geometry.registration.register import Alignment
from geometry.repair.columns import volume_by_columns
from geometry.repair.cut_body import cut_body
from geometry.transforms import apply, check_rigid, inverse
from geometry.types import Bools, Cloud, Floats, Ints, Measurand, Measured, Mesh, NotMeasured, Zone

BORDER_POINTS = 24  # sound points that tell how the skin meets the patch
SAME_FACE = 0.9  # least cosine between places on one face of the part
NEAR_MM = 2.0  # about a patch, where its vertices of the twin are sought
NOT_MEASURED = NotMeasured(reason="was not measured")


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairSettings:
    """How patches are made."""

    max_gap_mm: float = 1.5  # a larger hole in the broken surface is not bridged
    film_sigmas: float = 3.0  # closer than this to the twin, in sigmas of a scan point, is sound skin
    min_points: int = 30  # on the broken surface
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


def find_repairs(
    twin: Twin, cloud: Cloud, alignment: Alignment, damages: Sequence[Damage], settings: RepairSettings
) -> RepairVolume:
    """One patch, or the reason why there is none, for each damage with missing metal."""
    missing = [i for i, damage in enumerate(damages) if damage.kind is DamageKind.MISSING]
    patches: list[Patch] = []
    failures: dict[int, str] = {}
    if missing:
        skin, solid = skin_of(twin.mesh), _solid(twin.mesh).as_original()
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
    body = cut_body(broken, skin, settings.max_gap_mm, settings.resolution, settings.max_nodes)
    mesh, outer, dropped_mm3 = _lost_piece(solid, body, settings.sliver_fraction)
    gap_mm = _broken_gap(mesh, outer, broken)
    if not gap_mm <= settings.max_gap_mm:
        raise CannotRepair(f"a hole of {gap_mm:.2f} mm in the scan of the broken surface")
    volume = volume_mm3(mesh)
    check = volume_by_columns(broken, skin)
    allowed = settings.agreement * volume + settings.agreement_mm3
    if not abs(volume - check) <= allowed:
        raise CannotRepair(f"two ways to its volume disagree: {volume:.3f} and {check:.3f} mm3")
    skin_sigma_mm, area_mm2 = _on_lost_skin(mesh, outer, twin)
    twin_sigma_mm = float(skin_sigma_mm @ area_mm2 / area_mm2.sum())
    if not twin_sigma_mm <= settings.max_twin_sigma_mm:
        raise CannotRepair(f"over the lost skin the twin is known to {twin_sigma_mm:.2f} mm only")
    from_twin_mm3 = float(skin_sigma_mm @ area_mm2)
    sigma = _volume_sigma(mesh, outer, from_twin_mm3, broken, abs(volume - check), dropped_mm3)
    step, angle = _border(mesh, outer, broken)
    return Patch(
        damage=index,
        zone=damage.zone,
        mesh=mesh,
        outer=outer,
        watertight=True,
        volume_mm3=Measurand(name="volume_mm3", value=volume, sigma=sigma, unit="mm3"),
        volume_check_mm3=check,
        broken_gap_mm=gap_mm,
        border_step_mm=step,
        border_angle_deg=angle,
        area_mm2=_lost_area(mesh, outer, area_mm2, broken),
        allowance_mm=settings.allowance_mm,
    )


def _total(patches: Sequence[Patch]) -> Measurand:
    """The sum; the sigmas add, because the twin's error is common to all."""
    value = sum(patch.volume_mm3.value for patch in patches)
    sigma = sum(patch.volume_mm3.sigma for patch in patches)
    return Measurand(name="volume_mm3", value=value, sigma=sigma, unit="mm3")


def _solid(mesh: Mesh) -> Any:
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.array(mesh.vertices_mm), np.array(mesh.faces, dtype=np.uint64))
    )
    if solid.status() != manifold3d.Error.NoError:
        raise CannotRepair(f"a body is not a solid: {solid.status()}")
    return solid


def _lost_piece(solid: Any, body: Mesh, sliver_fraction: float) -> tuple[Mesh, Bools, float]:
    """The twin within the cut body without slivers, which of its faces are the twin's, and what was dropped.

    Components by graph search on the faces: manifold3d's own decomposition does not come back from
    thousands of pieces.
    """
    if volume_mm3(body) < 0.0:
        body = Mesh(vertices_mm=body.vertices_mm, faces=body.faces[:, ::-1])
    raw = (solid ^ _solid(body)).to_mesh64()
    vertices = np.asarray(raw.vert_properties)[:, :3]
    faces = np.asarray(raw.tri_verts).astype(np.int64)
    if not len(faces):
        raise CannotRepair("no metal is missing under the broken surface")
    component = _components(faces, len(vertices))
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    volumes = np.bincount(component, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)
    kept = volumes >= sliver_fraction * volumes.max()
    own = kept[component]
    used, compact = np.unique(faces[own], return_inverse=True)
    mesh = Mesh(vertices_mm=vertices[used], faces=compact.reshape(-1, 3))
    check_solid(mesh)
    return mesh, _from_original(raw, solid.original_id())[own], float(np.abs(volumes[~kept]).sum())


def _components(faces: Ints, count: int) -> Ints:
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1][faces[:, 0]])


def _from_original(raw: Any, origin: int) -> Bools:
    runs = np.asarray(raw.run_index, dtype=np.int64) // 3
    mask = np.zeros(len(raw.tri_verts), bool)
    for own, first, last in zip(raw.run_original_id, runs[:-1], runs[1:], strict=True):
        mask[first:last] = own == origin
    return mask


def _faces(mesh: Mesh, chosen: Bools) -> tuple[Floats, Floats]:
    """Middles (n, 3) and areas (n,) of the chosen faces."""
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces[chosen]], 1, 0)
    return (a + b + c) / 3.0, 0.5 * np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))


def _broken_gap(mesh: Mesh, outer: Bools, broken: BrokenSurface) -> float:
    """Diameter of the largest disc on the patch's broken side that holds no scan point."""
    if outer.all():
        raise CannotRepair("the patch has no broken side")
    known_mm = np.concatenate([broken.raw_mm, broken.rim.points_mm])
    return 2.0 * float(np.max(cKDTree(known_mm).query(_faces(mesh, ~outer)[0])[0]))


def _border(mesh: Mesh, outer: Bools, broken: BrokenSurface) -> tuple[Measured, Measured]:
    """Largest step (mm) and angle (deg) between the patch's outer skin and the sound skin that it meets.

    At each place of the border a plane through the heights of the nearest `BORDER_POINTS` points that are
    clear of the break and on the same face of the part; the step is its height in their middle.
    """
    feet_mm, normals, height_mm = broken.rim.clear_of(broken.points_mm, 2.0 * float(broken.spacing_mm.max()))
    if len(feet_mm) < BORDER_POINTS:
        unseen = NotMeasured(reason=f"{len(feet_mm)} scan points on the sound skin round the patch")
        return unseen, unseen
    at_mm = mesh.vertices_mm[np.intersect1d(mesh.faces[outer], mesh.faces[~outer])]
    _, index = cKDTree(feet_mm).query(at_mm, np.arange(1, BORDER_POINTS + 1))
    same = np.einsum("ni,nki->nk", normals[index[:, 0]], normals[index]) > SAME_FACE
    off_mm = feet_mm[index] - (np.einsum("nk,nki->ni", same, feet_mm[index]) / same.sum(1)[:, None])[:, None]
    across = np.einsum("nij,nkj->nki", frames_along(normals[index[:, 0]])[:, :2], off_mm)
    inverse = np.linalg.pinv(same[..., None] * np.concatenate([np.ones((*index.shape, 1)), across], axis=2))
    plane = np.einsum("nik,nk->ni", inverse, height_mm[index])
    sigma = broken.sigma_mm * np.linalg.norm(inverse, axis=2)
    slope, slope_sigma = np.linalg.norm(plane[:, 1:], axis=1), np.linalg.norm(sigma[:, 1:], axis=1)
    i, j = int(np.abs(plane[:, 0]).argmax()), int((slope - slope_sigma).argmax())
    return (
        Measurand(name="border_step_mm", value=abs(float(plane[i, 0])), sigma=float(sigma[i, 0]), unit="mm"),
        Measurand(
            name="border_angle_deg",
            value=float(np.rad2deg(np.arctan(slope[j]))),
            sigma=float(np.rad2deg(slope_sigma[j])),
            unit="deg",
        ),
    )


def _on_lost_skin(mesh: Mesh, outer: Bools, twin: Twin) -> tuple[Floats, Floats]:
    """Standard uncertainty of the twin (n,) at the outer faces, and the areas (n,) of these."""
    middle_mm, area_mm2 = _faces(mesh, outer)
    low_mm, high_mm = mesh.vertices_mm.min(axis=0) - NEAR_MM, mesh.vertices_mm.max(axis=0) + NEAR_MM
    vertices_mm = twin.mesh.vertices_mm
    near = np.flatnonzero(((vertices_mm >= low_mm) & (vertices_mm <= high_mm)).all(axis=1))
    if not len(near):
        near = np.arange(len(vertices_mm))
    return twin.sigma_mm[near[cKDTree(vertices_mm[near]).query(middle_mm)[1]]], area_mm2


def _lost_area(mesh: Mesh, outer: Bools, area_mm2: Floats, broken: BrokenSurface) -> Measurand:
    """Area of the outer skin; its border is known to a part of the spacing of the points."""
    corner_mm, on_border = mesh.vertices_mm[mesh.faces[outer]], np.isin(mesh.faces[outer], mesh.faces[~outer])
    edge_mm = np.linalg.norm(np.roll(corner_mm, -1, axis=1) - corner_mm, axis=2)
    border_mm = float(edge_mm[on_border & np.roll(on_border, -1, axis=1)].sum())
    sigma = BORDER * float(np.median(broken.spacing_mm)) * border_mm
    return Measurand(name="area_mm2", value=float(area_mm2.sum()), sigma=sigma, unit="mm2")


def _volume_sigma(
    mesh: Mesh,
    outer: Bools,
    from_twin_mm3: float,
    broken: BrokenSurface,
    difference_mm3: float,
    dropped_mm3: float,
) -> float:
    """Standard uncertainty of the volume, mm3.

    The twin's error is taken as the same all over the lost skin; the noise of the scan points averages
    out; where the patch is thinner than the film its edge is a matter of chance; what the two methods
    disagree by and what was dropped stand for the shape between the points.
    """
    middle_mm, area_mm2 = _faces(mesh, outer)
    from_noise = broken.sigma_mm * broken.area_mm2 / np.sqrt(len(broken.raw_mm))
    broken_mm = _faces(mesh, ~outer)[0]
    to_break_mm, _ = cKDTree(broken_mm).query(middle_mm, distance_upper_bound=broken.film_mm)
    from_film = broken.film_mm * float(area_mm2[to_break_mm < broken.film_mm].sum()) / np.sqrt(12.0)
    from_shape = np.hypot(difference_mm3 / np.sqrt(12.0), dropped_mm3 / np.sqrt(3.0))
    return float(np.linalg.norm([from_twin_mm3, from_noise, from_film, from_shape]))
