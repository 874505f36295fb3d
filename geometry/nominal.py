"""The nominal blade, prepared once per part number: closest point, sections, edge lines, zones."""

from dataclasses import dataclass

from geometry.types import Bools, Floats, Ints, Mesh


@dataclass(frozen=True, slots=True, kw_only=True)
class NominalSettings:
    """What the plan says of the nominal. None: from just above the root end face to the tip."""

    z_min_mm: float | None = None
    z_max_mm: float | None = None
    tip_mm: float = 5.0  # zone "tip": this far along the span from the tip
    edge_mm: float = 3.0  # zones of the edges: this far from the edge lines
    sample_mm: float = 0.5  # pitch of the uniform samples of the required surface


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Closest:
    """Closest points on the exact mesh. Signed distance is positive outside."""

    points_mm: Floats  # (n, 3)
    normals: Floats  # (n, 3) unit outward normal of the surface there, smooth across flat edges
    distance_mm: Floats  # (n,) signed
    face: Ints  # (n,)


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
    """A closed nominal mesh with what every later step asks of it."""

    mesh: Mesh
    settings: NominalSettings
    z_min_mm: float
    z_max_mm: float
    le_line_mm: Floats  # (k, 3) leading-edge line, z ascending
    te_line_mm: Floats  # (k, 3)
    samples: SurfaceSamples
    airfoil_face: Bools  # (faces,) belongs to the required surface (airfoil or tip face)

    def closest(self, points_mm: Floats) -> Closest:
        raise NotImplementedError

    def section(self, z_mm: float) -> NominalSection:
        raise NotImplementedError

    def zone_of(self, points_mm: Floats) -> Ints:
        raise NotImplementedError
