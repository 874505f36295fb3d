"""The same curves measured by engeom, an independent library of airfoil metrology."""

import numpy as np
import pytest

from geometry.sections.curve import camber_line, edge, edge_radius, thick_part, thickness
from tests.geometry.airfoils import DiscAirfoil

engeom_airfoil = pytest.importorskip("engeom.airfoil2", reason="engeom is a benchmark extra")
engeom_geometry = pytest.importorskip("engeom.geom2", reason="engeom is a benchmark extra")

AIRFOILS = [
    DiscAirfoil(),
    DiscAirfoil(camber_mm=0.0),
    DiscAirfoil(span_mm=30.0, camber_mm=5.0, le_mm=1.0, te_mm=0.3, largest_mm=2.0),
    DiscAirfoil(span_mm=60.0, camber_mm=2.0, le_mm=0.5, te_mm=0.5, largest_mm=3.5),
]


@pytest.fixture(params=AIRFOILS)
def both(request):
    """A curve with its leading-edge index, and engeom's inscribed circles of it."""
    curve, le = request.param.curve(per_side=1200)
    section = engeom_geometry.Curve2(curve, force_closed=True)
    return curve, le, section, engeom_airfoil.extract_inscribed_circles(section, 1e-4)


def test_maximum_thickness_agrees(both):
    curve, le, _, circles = both
    largest = max(circle.radius for circle in circles)
    assert thickness(curve, thick_part(camber_line(curve, le))).value == pytest.approx(
        2.0 * largest, abs=2e-4
    )


def test_camber_lines_agree(both):
    curve, le, _, circles = both
    line = camber_line(curve, le)
    theirs = np.array([[c.center.x, c.center.y, c.radius] for c in circles])
    theirs = theirs[np.argsort(theirs[:, 0])]
    x = line.centre_mm[:, 0]
    inside = (x > theirs[0, 0]) & (x < theirs[-1, 0])
    assert np.count_nonzero(inside) > 100
    for mine, column in ((line.centre_mm[:, 1], 1), (line.radius_mm, 2)):
        assert np.abs(mine - np.interp(x, theirs[:, 0], theirs[:, column]))[inside].max() < 2e-3


def test_edge_radii_agree(both):
    curve, le, section, circles = both
    centres = np.array([[c.center.x, c.center.y] for c in circles])
    leading_first = np.linalg.norm(centres[0] - curve[le]) < np.linalg.norm(centres[0] - curve[0])
    for tip, at_front in ((le, leading_first), (0, not leading_first)):
        theirs = engeom_airfoil.fit_full_round_edge(section, 1e-4, circles, bool(at_front))
        radius = theirs.edge.geometry.radius
        assert edge_radius(curve, edge(curve, tip).arc).value == pytest.approx(radius, rel=0.05)
