"""How deep a damage of tip or edge is: along the span at the tip, along the chord at an edge."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.blade.solid import slice_loops
from geometry.blade.span import on_line_mm
from geometry.damage.regions import Field, Region
from geometry.deformation.twin import Twin
from geometry.types import Floats, Measurand, Measured, Mesh, NotMeasured, Zone

PLANE_POINTS = 12  # of the break, whose plane ends it
PLANE_REACH = 3.0  # spacings that such a plane may be continued beyond them
BORDER = 0.5  # standard uncertainty of where a break ends, in spacings of its points, at least
FRONT_POINTS = 30  # of the break about a height, whose quadric is the metal left there
LEAST_FRONT = 10
FRONT = 0.1  # standard uncertainty of that quadric between the points, in their spacings, at least
HEIGHTS = 40  # over an edge damage, at most
RIM_STEP_MM = 0.02  # between points of the twin's section at an edge
ON_EDGE = 1.5  # spacings of the points from the line of an edge that count as on it
NEAR_EDGE_MM = 6.0  # of the edge line, where the edge of the twin is sought


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeLoss:
    """What an edge damage took of a section, along the chord, where it took most."""

    depth_mm: Measured
    remaining_chord_mm: Measured


def span_depth(tip_mm: float, lowest: Measured) -> Measured:
    """The loss along the span: from the twin's tip down to the lowest point of the break."""
    if isinstance(lowest, NotMeasured):
        return lowest
    return Measurand(
        name="depth", value=max(tip_mm - lowest.value, 0.0), sigma=lowest.sigma, unit=lowest.unit
    )


def lowest_mm(region: Region, found: Field, twin: Twin) -> Measured:
    """Height of the lowest point of a damage: where the plane of the lowest of its break leaves the twin.

    The lowest of the scan points alone would lie too high, by about their spacing; those that merely stand
    off the twin next to it too low. A break that is lowest inside the blade ends at its lowest point. A
    tail too thin to be seen counts for nothing: metal lost by less than the detection limit.
    """
    break_mm = _break(region, found)
    if len(break_mm) < PLANE_POINTS:
        return NotMeasured(reason=f"{len(break_mm)} points lie on the damage for certain")
    tree = cKDTree(break_mm)
    start = break_mm[int(np.argmin(break_mm[:, 2]))]
    reach_mm = PLANE_REACH * found.spacing_mm
    end_mm, scatter_mm = _end(tree, start, PLANE_POINTS, twin, reach_mm)
    wider_mm, _ = _end(tree, start, 2 * PLANE_POINTS, twin, reach_mm)  # a bent break ends elsewhere
    bare_mm = _bare_mm(end_mm, found, 4.0 * reach_mm)
    border_mm = max(BORDER * found.spacing_mm, 0.5 * float(start[2] - end_mm[2]), 0.5 * bare_mm)
    bent_mm = float(wider_mm[2] - end_mm[2])
    sigma_mm = float(np.linalg.norm([border_mm, scatter_mm, bent_mm, region_sigma_mm(region, found)]))
    return Measurand(name="lowest", value=float(end_mm[2]) - 0.5 * bare_mm, sigma=sigma_mm, unit="mm")


def _end(tree: cKDTree, start_mm: Floats, count: int, twin: Twin, reach_mm: float) -> tuple[Floats, float]:
    """Where the plane through the `count` points of a break next to `start_mm` leaves the twin lowest, and
    the scatter of these points about it.

    It is continued no farther than `reach_mm` beyond the points of the break.
    """
    apart_mm, near = tree.query(start_mm, min(count, tree.n))
    near_mm, weight = tree.data[near], (1.0 - (apart_mm / (1.1 * apart_mm[-1])) ** 2) ** 2
    middle_mm = np.average(near_mm, axis=0, weights=weight)
    normal = np.linalg.eigh(np.cov(near_mm.T, aweights=weight))[1][:, 0]
    rim_mm = _plane_section(twin, middle_mm, normal, start_mm, 2.0 * reach_mm)
    rim_mm = np.concatenate([start_mm[None], rim_mm[tree.query(rim_mm)[0] <= reach_mm]])
    scatter_mm = float(np.sqrt(np.average(((near_mm - middle_mm) @ normal) ** 2, weights=weight)))
    return rim_mm[int(np.argmin(rim_mm[:, 2]))], scatter_mm


def _bare_mm(end_mm: Floats, found: Field, reach_mm: float) -> float:
    """How much farther than their spacing the end of a break lies from the points of the sound skin.

    The break ends somewhere in such a gap.
    """
    near = (np.abs(found.scan_mm - end_mm).max(axis=1) <= reach_mm) & ~found.off_skin
    apart_mm = np.linalg.norm(found.scan_mm[near] - end_mm, axis=1)
    return float(np.clip(apart_mm.min(initial=reach_mm) - found.spacing_mm, 0.0, None))


def _break(region: Region, found: Field) -> Floats:
    """The points (m, 3) of a region that lie off the twin each by itself and not alone."""
    points_mm = found.scan_mm[region.points[found.off_skin[region.points]]]
    if len(points_mm) < PLANE_POINTS:
        return points_mm
    apart_mm = cKDTree(points_mm).query(points_mm, 3)[0][:, 2]
    return np.asarray(points_mm[apart_mm <= 3.0 * found.spacing_mm])


def region_sigma_mm(region: Region, found: Field) -> float:
    """Standard uncertainty of a mean distance in the region, as a rule."""
    return float(np.median(found.sigma_mm[region.points]))


def _plane_section(twin: Twin, at_mm: Floats, normal: Floats, about_mm: Floats, reach_mm: float) -> Floats:
    """Points (m, 3) where edges of the twin near a place cross a plane through `at_mm`."""
    vertices, faces = twin.mesh.vertices_mm, twin.mesh.faces
    near = np.abs(vertices - about_mm).max(axis=1) <= reach_mm
    faces = faces[near[faces].any(axis=1)]
    a, b = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
    above_a, above_b = (vertices[a] - at_mm) @ normal, (vertices[b] - at_mm) @ normal
    cut = above_a * above_b < 0.0
    share = above_a[cut] / (above_a[cut] - above_b[cut])
    return np.asarray(vertices[a[cut]] + share[:, None] * (vertices[b[cut]] - vertices[a[cut]]))


def reaches_edge(region: Region, found: Field, nominal: Nominal, zone: Zone) -> bool:
    """Whether skin on the line of an edge was lost: beside it a break tells nothing of the edge."""
    skin_mm = nominal.samples.points_mm[region.lost] if len(region.lost) else found.scan_mm[region.points]
    le_mm, te_mm = nominal.from_edges_mm(skin_mm)
    apart_mm = le_mm if zone is Zone.LEADING_EDGE else te_mm
    return bool(apart_mm.min() <= max(ON_EDGE * found.spacing_mm, nominal.settings.sample_mm))


def edge_loss(region: Region, found: Field, nominal: Nominal, twin: Twin, zone: Zone) -> EdgeLoss:
    """The largest loss in a section plane, along the chord: from the twin's edge to the metal left.

    At each height the break is a quadric through its points round about; what is left of the section begins
    at its foremost point, where the break leaves the skin or between.
    """
    break_mm = _break(region, found)
    if len(break_mm) < LEAST_FRONT:
        few = NotMeasured(reason=f"{len(break_mm)} points lie on the damage for certain")
        return EdgeLoss(depth_mm=few, remaining_chord_mm=few)
    low_mm, high_mm = break_mm[:, 2].min(), break_mm[:, 2].max()
    count = int(np.clip((high_mm - low_mm) / found.spacing_mm, 3, HEIGHTS))
    mesh = between(twin.mesh, low_mm, high_mm)
    heights_mm = np.linspace(low_mm, high_mm, count + 2)[1:-1]
    rows = [
        _section_loss(float(z_mm), break_mm, nominal, mesh, zone, found.spacing_mm) for z_mm in heights_mm
    ]
    loss_mm, scatter_mm, chord_mm = np.array(rows).T
    worst, shortest = int(np.argmax(loss_mm)), int(np.argmin(chord_mm - loss_mm))
    common_mm = np.hypot(region_sigma_mm(region, found), FRONT * found.spacing_mm)
    sigma_mm = [np.hypot(common_mm, scatter_mm[i]) for i in (worst, shortest)]
    return EdgeLoss(
        depth_mm=Measurand(name="depth", value=float(loss_mm[worst]), sigma=float(sigma_mm[0]), unit="mm"),
        remaining_chord_mm=Measurand(
            name="remaining_chord",
            value=float(chord_mm[shortest] - loss_mm[shortest]),
            sigma=float(sigma_mm[1]),
            unit="mm",
        ),
    )


def _section_loss(
    z_mm: float, break_mm: Floats, nominal: Nominal, mesh: Mesh, zone: Zone, spacing_mm: float
) -> tuple[float, float, float]:
    """Loss at a height, its standard uncertainty there, and the chord of the twin.

    Where a break grazes the skin it lies on neither for certain. What is left may begin where the quadric
    meets the skin, or where the last point of the break lies: halfway.
    """
    outward, edge_mm = _outward(nominal, zone, z_mm)
    across = np.array([-outward[1], outward[0]])
    loop_mm = outline_mm(mesh, z_mm)
    chord_mm = float(np.ptp(loop_mm @ outward))
    rim_mm = dense(loop_mm)
    rim_mm = rim_mm[np.linalg.norm(rim_mm - edge_mm, axis=1) < NEAR_EDGE_MM]
    foremost_mm = float((rim_mm @ outward).max())
    near_mm = break_mm[np.argsort(np.abs(break_mm[:, 2] - z_mm))[:FRONT_POINTS]]
    seen_mm = (near_mm[:, :2] - edge_mm) @ across
    coefficients, scatter_mm = _quadric(seen_mm, near_mm[:, 2] - z_mm, foremost_mm - near_mm[:, :2] @ outward)
    skin_mm, side_mm = foremost_mm - rim_mm @ outward, (rim_mm - edge_mm) @ across
    cut_mm = coefficients[0] + coefficients[1] * side_mm + coefficients[2] * side_mm**2
    if (skin_mm >= cut_mm).all():
        return 0.0, scatter_mm, chord_mm
    front_mm = np.maximum(skin_mm, cut_mm)  # of the metal left
    told = (side_mm >= seen_mm.min() - spacing_mm) & (side_mm <= seen_mm.max() + spacing_mm)
    least_mm, most_mm = float(front_mm.min()), float(front_mm[told].min(initial=np.inf))
    unsure_mm = 0.5 * (most_mm - least_mm) if np.isfinite(most_mm) else 0.0
    return least_mm + unsure_mm, float(np.hypot(scatter_mm, unsure_mm)), chord_mm


def between(mesh: Mesh, low_mm: float, high_mm: float) -> Mesh:
    """The faces that a plane at a height between those two may cut."""
    heights_mm = mesh.vertices_mm[mesh.faces, 2]
    own = (heights_mm.max(axis=1) >= low_mm) & (heights_mm.min(axis=1) <= high_mm)
    return Mesh(vertices_mm=mesh.vertices_mm, faces=mesh.faces[own])


def outline_mm(mesh: Mesh, z_mm: float) -> Floats:
    """The section's largest loop (m, 2) at a height."""
    loops = slice_loops(mesh, np.zeros((len(mesh.faces), 3, 3)), z_mm)
    return max((loop.points_mm for loop in loops), key=len)


def _quadric(across_mm: Floats, up_mm: Floats, depth_mm: Floats) -> tuple[Floats, float]:
    """Coefficients of 1, across, across^2 in the full quadric of the depth, and the scatter about it."""
    terms = np.stack(
        [np.ones_like(up_mm), across_mm, across_mm**2, across_mm * up_mm, up_mm, up_mm**2], axis=1
    )
    coefficients = np.asarray(np.linalg.lstsq(terms, depth_mm, rcond=1e-6)[0])
    return coefficients, float(np.std(depth_mm - terms @ coefficients))


def dense(loop_mm: Floats) -> Floats:
    """The closed polyline (m, 2) with points `RIM_STEP_MM` apart."""
    closed_mm = np.concatenate([loop_mm, loop_mm[:1]])
    arc_mm = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed_mm, axis=0), axis=1))])
    at_mm = np.arange(0.0, arc_mm[-1], RIM_STEP_MM)
    return np.column_stack([np.interp(at_mm, arc_mm, closed_mm[:, i]) for i in range(2)])


def _outward(nominal: Nominal, zone: Zone, z_mm: float) -> tuple[Floats, Floats]:
    """The direction (2,) along the chord out of an edge at a height, and the edge (2,) there."""
    le_mm, te_mm = (
        on_line_mm(line, np.array([z_mm]))[0] for line in (nominal.le_line_mm, nominal.te_line_mm)
    )
    chord_mm = le_mm - te_mm if zone is Zone.LEADING_EDGE else te_mm - le_mm
    return chord_mm / np.linalg.norm(chord_mm), le_mm if zone is Zone.LEADING_EDGE else te_mm
