"""The sheet midway between the two sides of the nominal airfoil."""

import numpy as np

from geometry.blade.nominal import Nominal, NominalSection
from geometry.kernels.airfoil import inscribed_circles
from geometry.types import Floats

CIRCLES = 200  # inscribed circles of a section
INSET = 1e-3  # of the span: end sections are taken this far inside


def medial_sheet(nominal: Nominal, sections: int = 40, columns: int = 60) -> Floats:
    """The medial axes of the nominal's sections (sections, columns, 3), z ascending, trailing edge first.

    Source: thesis 5.4.3.1, the mesh of the sectional medial axes.
    """
    inset_mm = INSET * (nominal.z_max_mm - nominal.z_min_mm)
    heights_mm = np.linspace(nominal.z_min_mm + inset_mm, nominal.z_max_mm - inset_mm, sections)
    return np.stack([_medial_axis(nominal.section(float(z)), columns) for z in heights_mm])


def _medial_axis(section: NominalSection, columns: int) -> Floats:
    """Centres (columns, 3), evenly along the axis, of the largest circles that touch both sides."""
    count, le = len(section.curve_mm), section.le_index
    at = np.unique(np.linspace(1, le - 1, CIRCLES).astype(np.int64))
    radius_mm, _ = inscribed_circles(section.curve_mm, section.normals, at, np.arange(le + 1, count))
    bounded = np.isfinite(radius_mm)
    at, radius_mm = at[bounded], radius_mm[bounded]
    centres_mm = section.curve_mm[at] - radius_mm[:, None] * section.normals[at]
    steps_mm = np.linalg.norm(np.diff(centres_mm, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps_mm)])
    even = np.linspace(0.0, along[-1], columns)
    x, y = (np.interp(even, along, centre) for centre in centres_mm.T)
    return np.column_stack([x, y, np.full(columns, section.z_mm)])
