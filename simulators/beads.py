"""Metal too much: the bead of an old weld, on a side or on an edge, as a closed solid to be added."""

from dataclasses import replace

import manifold3d
import numpy as np

from simulators.airfoils import Airfoil
from simulators.cutters import Cut, EdgeName, edge_frame, side_frame
from simulators.solids import Floats, Solid, from_manifold

SEGMENTS = 96  # round a bead
UNDER = 0.3  # of the metal's thickness: so deep a bead reaches into it, at most


def side_bead(
    airfoil: Airfoil, span_fraction: float, chord_fraction: float, height_mm: float, radius_mm: float
) -> Cut:
    """A bead on the suction side: half an ellipsoid of this height and radius."""
    top, along, across, outward = side_frame(airfoil, "suction", span_fraction, chord_fraction)
    foot = airfoil.frame(airfoil.height_mm(span_fraction)).pressure_point_mm(chord_fraction)
    under_mm = min(height_mm, UNDER * float(np.linalg.norm(top - foot)))
    axes_mm = np.array([radius_mm * along, radius_mm * across, height_mm * outward])
    return Cut(zone="surface", cutter=_bead(top, axes_mm, under_mm / height_mm), adds=True)


def edge_bead(
    airfoil: Airfoil, zone: EdgeName, span_fraction: float, height_mm: float, radius_mm: float
) -> Cut:
    """A bead round an edge, `height_mm` out of it along the chord and `radius_mm` long to either side."""
    edge, outward = edge_frame(airfoil, zone, airfoil.height_mm(span_fraction))
    up = np.array([0.0, 0.0, 1.0])
    axes_mm = np.array([height_mm * np.cross(up, outward), radius_mm * up, height_mm * outward])
    return Cut(zone=zone, cutter=_bead(edge, axes_mm, 2.0), adds=True)


def _bead(centre_mm: Floats, axes_mm: Floats, under: float) -> Solid:
    """Two halves of ellipsoids about a point: `axes_mm` (3, 3) are their half axes as rows, the third out of
    the metal; into the metal it is `under` times as long."""
    ball = from_manifold(manifold3d.Manifold.sphere(1.0, SEGMENTS))
    out = ball.vertices_mm[:, 2:]
    stretched = np.hstack([ball.vertices_mm[:, :2], np.where(out > 0.0, out, under * out)])
    if np.linalg.det(axes_mm) < 0.0:
        axes_mm = axes_mm * [[-1.0], [1.0], [1.0]]
    return replace(ball, vertices_mm=centre_mm + stretched @ axes_mm)
