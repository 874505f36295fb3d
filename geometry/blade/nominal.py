"""The nominal blade, prepared once per part number: closest point, sections, edge lines, zones."""

import ctypes
import sys
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from geometry.blade import outline as outlines
from geometry.blade.outline import End, Outline
from geometry.blade.scatter import even_points
from geometry.blade.solid import (
    Normals,
    check_solid,
    faces_around,
    facet_bulge_mm,
    slice_loops,
    solid_normals,
)
from geometry.blade.span import airfoil_start_mm, edge_lines, on_line_mm
from geometry.errors import BadInput
from geometry.kernels.neighbours import near_each_other
from geometry.kernels.parts import over_parts, threads_for
from geometry.kernels.triangle import describe_feet, refine_closest
from geometry.types import Bools, Floats, Ints, Mesh, Zone

ZONE_ORDER: tuple[Zone, ...] = tuple(Zone)
CURVE_STEP_MM = 0.05  # a section curve is at least this dense
CURVE_POINTS = 2000  # and has at least so many points
SPAN_SLACK = (
    1e-3  # of the height: a plan's span may pass the mesh by this much, for files round their numbers
)
UP = 0.7  # the z of a unit normal that looks up rather than sideways


def of_end_faces(normals: Floats) -> Bools:
    """Which unit normals (n, 3) look up or down rather than sideways, as those of end faces do."""
    return np.asarray(np.abs(normals[:, 2]) > UP)


@dataclass(frozen=True, slots=True, kw_only=True)
class NominalSettings:
    """What the plan says of the nominal. None: from just above the root end face to the tip."""

    z_min_mm: float | None = None
    z_max_mm: float | None = None
    tip_mm: float = 5.0  # zone "tip": this far along the span from the tip
    edge_mm: float = 3.0  # zones of the edges: this far from the edge lines, in the section plane
    sample_mm: float = 0.5  # pitch of the uniform samples of the required surface


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Closest:
    """Closest points on the exact mesh. Signed distance is positive outside."""

    points_mm: Floats  # (n, 3)
    normals: Floats  # (n, 3) unit outward normal of the surface there, smooth across flat edges
    distance_mm: Floats  # (n,) signed
    face: Ints  # (n,)

    def of(self, chosen: Bools) -> "Closest":
        """Those of the chosen points (n,)."""
        return Closest(
            points_mm=self.points_mm[chosen],
            normals=self.normals[chosen],
            distance_mm=self.distance_mm[chosen],
            face=self.face[chosen],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NominalSection:
    """One planar section of the nominal airfoil as a dense closed polyline.

    Counter-clockwise seen from +Z, the first point not repeated; starts at the trailing edge.
    `side` (m,): 0 leading edge, 1 suction, 2 trailing edge, 3 pressure (edge = within `edge_mm`).
    """

    z_mm: float
    curve_mm: Floats  # (m, 2)
    normals: Floats  # (m, 2) outward
    arc_mm: Floats  # (m,) arc length from the first point
    perimeter_mm: float
    le_index: int
    te_index: int
    side: Ints  # (m,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceSamples:
    """Uniform samples of the required surface: airfoil between z_min and z_max with its tip face."""

    points_mm: Floats  # (n, 3)
    normals: Floats  # (n, 3)
    area_mm2: Floats  # (n,)
    zone: Ints  # (n,) index into ZONE_ORDER
    tip_face: Bools  # (n,)


class Nominal:
    """A closed nominal mesh with what every later step asks of it; made by `prepare_nominal`."""

    mesh: Mesh
    settings: NominalSettings
    z_min_mm: float
    z_max_mm: float
    tip_z_mm: float  # the top of the mesh; z_max_mm is below it where the plan ends the span early
    le_line_mm: Floats  # (k, 3) leading-edge line, z ascending
    te_line_mm: Floats  # (k, 3)
    samples: SurfaceSamples
    airfoil_face: Bools  # (faces,) belongs to the required surface (airfoil or tip face)
    tip_face: Bools  # (faces,) looks up at the end of the airfoil, and is required
    end_face: Bools  # (faces,) looks down at the bottom of the mesh: no scan sees it
    shell_mm: Floats  # (s, 3) about one point a square millimetre of all that a scan may see
    shell_normals: Floats  # (s, 3)
    pivot_mm: Floats  # (3,) middle of the required surface
    gyration_mm: float  # its root mean square distance from there
    mesh_normals: Normals  # of faces, corners and vertices

    def __init__(self, mesh: Mesh, settings: NominalSettings) -> None:
        self.mesh, self.settings = mesh, settings
        self.mesh_normals = solid_normals(mesh)
        self._ring = faces_around(mesh)
        self._centre_mm = mesh.vertices_mm.mean(axis=0)
        self._scene = _ray_scene(mesh.vertices_mm - self._centre_mm, mesh.faces)
        self._bottom_mm, self.tip_z_mm = (float(f(mesh.vertices_mm[:, 2])) for f in (np.min, np.max))
        self.z_min_mm, self.z_max_mm = self._span()
        lines = edge_lines(self.outline, self.z_min_mm, self.z_max_mm)
        self.le_line_mm, self.te_line_mm = lines.le_line_mm, lines.te_line_mm
        self._suction_first = lines.suction_first
        self.tip_face = self._tip_faces()
        self.airfoil_face = self._airfoil_faces()
        self.end_face = self._end_faces()
        self.samples = _sample(self)
        self.shell_mm, self.shell_normals = _shell(self)
        self.pivot_mm = self.samples.points_mm.mean(axis=0)
        self.gyration_mm = float(
            np.sqrt(np.sum((self.samples.points_mm - self.pivot_mm) ** 2, axis=1).mean())
        )

    @cached_property
    def bulge_mm(self) -> Floats:
        """How far (faces,) a smooth surface stands over each facet, on the mean."""
        return facet_bulge_mm(self.mesh, self.mesh_normals.corner)

    def closest(self, points_mm: Floats) -> Closest:
        """The nearest point of the mesh to each point (n, 3).

        Open3D finds the triangle in float32; the point on it and on the triangles around is then
        computed in float64. Normals are interpolated between the corners of the triangle.
        """
        return self.closest_from(points_mm, self._nearest_faces(points_mm))

    def closest_from(self, points_mm: Floats, near_face: Ints) -> Closest:
        """The same where a face (n,) near the nearest is known: the downhill walk from it, no search.

        For points that moved little since that face was nearest, as between the steps of a fit; a rival
        beyond the neighbouring faces may be missed by a tenth of a micrometre.
        """
        parts = over_parts(lambda a, b: self._feet(points_mm[a:b], near_face[a:b]), len(points_mm))
        feet_mm, smooth, distance_mm, face = (
            np.concatenate(of_parts) for of_parts in zip(*parts, strict=True)
        )
        return Closest(points_mm=feet_mm, normals=smooth, distance_mm=distance_mm, face=face)

    def _feet(self, points_mm: Floats, near_face: Ints) -> tuple[Floats, Floats, Floats, Ints]:
        """Feet, normals, signed distances and faces of the nearest points, from a face near each."""
        mesh, normals = self.mesh, self.mesh_normals
        shape = (points_mm, mesh.vertices_mm, mesh.faces)
        face, weights = refine_closest(*shape, near_face, *self._ring)
        feet_mm, smooth, distance_mm = describe_feet(
            *shape, face, weights, normals.corner, normals.face, normals.edge, normals.vertex
        )
        return feet_mm, smooth, distance_mm, face

    def section(self, z_mm: float) -> NominalSection:
        """The airfoil's section at height `z_mm`.

        Raises `BadInput` where the plane misses the mesh, `BadMesh` where it cuts no airfoil.
        """
        outline = self.outline(z_mm)
        le, te = self._ends_at(z_mm, outline)
        count = len(outline.points_mm)
        outline, le_index = outlines.start_at(outline, te.index), (le.index - te.index) % count
        arc_mm, perimeter_mm = outlines.arc_length(outline.points_mm)
        return NominalSection(
            z_mm=z_mm,
            curve_mm=outline.points_mm,
            normals=outline.normals,
            arc_mm=arc_mm,
            perimeter_mm=perimeter_mm,
            le_index=le_index,
            te_index=0,
            side=self._sides(outline.points_mm, le_index),
        )

    def outline(self, z_mm: float) -> Outline:
        """The outer loop of the section at `z_mm`, before its ends are known; a tip face is cut just below.

        Raises `BadInput` where the plane misses the mesh.
        """
        loops = slice_loops(self.mesh, self.mesh_normals.corner, self._below_tip(z_mm))
        if not loops:
            raise BadInput(f"section at z = {z_mm:g} mm: outside the nominal")
        loop = max(loops, key=lambda one: outlines.area(one.points_mm))
        _, perimeter_mm = outlines.arc_length(loop.points_mm)
        step_mm = min(CURVE_STEP_MM, perimeter_mm / CURVE_POINTS)
        return outlines.refine(loop.points_mm, loop.start_normals, loop.end_normals, step_mm)

    def zone_of(self, points_mm: Floats) -> Ints:
        """The zone (n,) of each point (n, 3), as index into `ZONE_ORDER`.

        Tip before leading edge before trailing edge. OUTSIDE where the nearest face is off the
        airfoil, or the point is below the span, or above a span that ends short of the tip.
        """
        return self.zones_on(points_mm, self.closest(points_mm).face)

    def zones_on(self, points_mm: Floats, face: Ints) -> Ints:
        """The same as `zone_of` for points (n, 3) whose nearest face (n,) is known already."""
        z_mm = points_mm[:, 2]
        top_mm = self.z_max_mm if self.z_max_mm < self.tip_z_mm else np.inf
        off = ~self.airfoil_face[face] | (z_mm < self.z_min_mm) | (z_mm > top_mm)
        le_mm, te_mm = self.from_edges_mm(points_mm)
        in_tip = z_mm >= self.tip_z_mm - self.settings.tip_mm
        in_le = (le_mm <= self.settings.edge_mm) & (le_mm <= te_mm)
        in_te = te_mm <= self.settings.edge_mm
        zones = [Zone.OUTSIDE, Zone.TIP, Zone.LEADING_EDGE, Zone.TRAILING_EDGE]
        return np.select(
            [off, in_tip, in_le, in_te], [ZONE_ORDER.index(z) for z in zones], ZONE_ORDER.index(Zone.SURFACE)
        )

    def from_edges_mm(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """How far (n,) points (n, 3) lie from leading and trailing edge line, in the section plane."""
        le_mm, te_mm = (
            np.linalg.norm(points_mm[:, :2] - on_line_mm(line, points_mm[:, 2]), axis=1)
            for line in (self.le_line_mm, self.te_line_mm)
        )
        return le_mm, te_mm

    def _nearest_faces(self, points_mm: Floats) -> Ints:
        """The nearest face (n,) to float32, computed about the centre of the mesh to lose least."""
        query = np.ascontiguousarray(points_mm - self._centre_mm, dtype=np.float32)
        order = near_each_other(points_mm)
        found = self._scene.compute_closest_points(query[order], nthreads=threads_for(len(query)))
        face = np.empty(len(query), np.int64)
        face[order] = found["primitive_ids"].numpy()
        return face

    def _below_tip(self, z_mm: float) -> float:
        """The height itself, except that a plane in the tip face cuts just below it."""
        slack_mm = SPAN_SLACK * (self.tip_z_mm - self._bottom_mm)
        in_tip_face = self.tip_z_mm - 1e-6 * slack_mm < z_mm <= self.tip_z_mm + slack_mm
        return self.tip_z_mm - 1e-6 * slack_mm if in_tip_face else z_mm

    def _span(self) -> tuple[float, float]:
        """The airfoil's z range: as the plan says, else from the root end face or platform to the tip."""
        bottom_mm, top_mm = self._bottom_mm, self.tip_z_mm
        slack_mm = SPAN_SLACK * (top_mm - bottom_mm)
        asked_low, asked_high = self.settings.z_min_mm, self.settings.z_max_mm
        low_mm = airfoil_start_mm(self.outline, bottom_mm, top_mm) if asked_low is None else asked_low
        high_mm = top_mm if asked_high is None or abs(asked_high - top_mm) <= slack_mm else asked_high
        if not bottom_mm - slack_mm <= low_mm < high_mm <= top_mm:
            raise BadInput(
                f"airfoil from z {low_mm:g} to {high_mm:g} mm: the nominal has {bottom_mm:g} to {top_mm:g} mm"
            )
        return max(low_mm, bottom_mm), high_mm

    def _tip_faces(self) -> Bools:
        if self.z_max_mm < self.tip_z_mm:
            return np.zeros(len(self.mesh.faces), np.bool_)
        lowest_mm = self.mesh.vertices_mm[self.mesh.faces, 2].min(axis=1)
        return np.asarray(
            (self.mesh_normals.face[:, 2] > UP) & (lowest_mm >= self.tip_z_mm - self.settings.tip_mm)
        )

    def _end_faces(self) -> Bools:
        highest_mm = self.mesh.vertices_mm[self.mesh.faces, 2].max(axis=1)
        slack_mm = SPAN_SLACK * (self.tip_z_mm - self._bottom_mm)
        return np.asarray((self.mesh_normals.face[:, 2] < -UP) & (highest_mm <= self._bottom_mm + slack_mm))

    def _airfoil_faces(self) -> Bools:
        """Faces that reach into the span, without end faces: those at z_min and at a z_max below the tip."""
        z_mm = self.mesh.vertices_mm[self.mesh.faces, 2]
        reaches = (z_mm.max(axis=1) > self.z_min_mm) & (z_mm.min(axis=1) < self.z_max_mm)
        return np.asarray(reaches | self.tip_face)

    def _ends_at(self, z_mm: float, outline: Outline) -> tuple[End, End]:
        """Leading and trailing end of an outline, told apart by the edge lines."""
        a, b = outlines.find_ends(outline)
        le_mm, te_mm = (on_line_mm(line, np.array([z_mm]))[0] for line in (self.le_line_mm, self.te_line_mm))
        forward = np.subtract(b.point_mm, a.point_mm) @ (te_mm - le_mm) > 0.0
        return (a, b) if forward else (b, a)

    def _sides(self, points_mm: Floats, le_index: int) -> Ints:
        """0 leading edge, 1 suction, 2 trailing edge, 3 pressure, for a curve that starts at its TE."""
        first, second = (1, 3) if self._suction_first else (3, 1)
        side = np.where(np.arange(len(points_mm)) <= le_index, first, second)
        le_mm = np.linalg.norm(points_mm - points_mm[le_index], axis=1)
        te_mm = np.linalg.norm(points_mm - points_mm[0], axis=1)
        side[(te_mm <= self.settings.edge_mm) & (te_mm < le_mm)] = 2
        side[(le_mm <= self.settings.edge_mm) & (le_mm <= te_mm)] = 0
        return side


def prepare_nominal(mesh: Mesh, settings: NominalSettings) -> Nominal:
    """The nominal ready for measuring: a few seconds, once per part number.

    Raises `BadMesh` if the mesh is not a solid or has no airfoil, `BadInput` if the span is not in it.
    """
    check_solid(mesh)
    return Nominal(mesh, settings)


def _ray_scene(vertices_mm: Floats, faces: Ints) -> Any:
    """Open3D's ray casting scene of the mesh, for its closest-point query."""
    if sys.platform == "linux":
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    tensor = open3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(vertices_mm.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene


def _sample(nominal: Nominal) -> SurfaceSamples:
    """One point a cell of the pitch: the drawn point nearest to the middle of those drawn in the cell.

    Nine times as many points as needed are drawn evenly over the faces; a cell takes points that look
    the same way only, so that the two sides of a thin edge stay apart.
    """
    pitch_mm = nominal.settings.sample_mm
    drawn_mm, face, each_mm2 = even_points(nominal.mesh, nominal.airfoil_face, 9.0 / pitch_mm**2)
    inside = (drawn_mm[:, 2] >= nominal.z_min_mm) & (drawn_mm[:, 2] <= nominal.z_max_mm)
    drawn_mm, face = drawn_mm[inside], face[inside]
    look = nominal.closest(drawn_mm).normals
    axis = np.abs(look).argmax(axis=1)
    facing = 2 * axis + (look[np.arange(len(look)), axis] > 0.0)
    place = np.floor((drawn_mm - drawn_mm.min(axis=0)) / pitch_mm).astype(np.int64)
    counts = place.max(axis=0) + 1
    key = ((place[:, 0] * counts[1] + place[:, 1]) * counts[2] + place[:, 2]) * 6 + facing
    _, cell, drawn = np.unique(key, return_inverse=True, return_counts=True)
    middle_mm = np.column_stack([np.bincount(cell, drawn_mm[:, i]) / drawn for i in range(3)])
    order = np.lexsort([np.linalg.norm(drawn_mm - middle_mm[cell], axis=1), cell])
    kept = order[np.concatenate([[0], np.cumsum(drawn)[:-1]])]
    return SurfaceSamples(
        points_mm=drawn_mm[kept],
        normals=look[kept],
        area_mm2=np.asarray(drawn * each_mm2, dtype=np.float64),
        zone=nominal.zones_on(drawn_mm[kept], face[kept]),
        tip_face=nominal.tip_face[face[kept]],
    )


def _shell(nominal: Nominal) -> tuple[Floats, Floats]:
    points_mm, _, _ = even_points(nominal.mesh, ~nominal.end_face, 1.0)
    return points_mm, nominal.closest(points_mm).normals
