"""The least loss of an edge and of the tip that a scan shows."""

import numpy as np

from geometry.damage.depth import dense, outline_mm
from geometry.deformation.twin import Twin
from geometry.types import Floats

SPAN = (0.1, 0.3, 0.5, 0.7, 0.9)  # shares of the span that is seen, at which the edges are asked
TIP = 0.98  # and the tip
SHOWN = 0.8  # of the mean depth of a strip: few points fall on it, and by chance (simulated, for 95 %)


def edge_limit_mm(twin: Twin, hollow_mm: float, across_mm: float) -> float:
    """Loss of an edge, along the chord, that shows as well as a smooth hollow of `hollow_mm` in a face.

    A file leaves a strip across the edge, as wide as the section is thick there. Its depth normal to the twin
    is two thirds of the loss on the mean, or where its own sides are nearer, their distance; and where it is
    narrower than a neighbourhood, `across_mm`, the sound skin beside it takes part. Of both edges the one
    that shows least; infinite where none could.
    """
    return max(
        _first(loss_mm, np.minimum(2.0 / 3.0 * loss_mm, 0.25 * wide_mm) * shares, hollow_mm)
        for share in SPAN
        for loss_mm, wide_mm, shares in _ends(twin, share, across_mm)
    )


def tip_limit_mm(twin: Twin, hollow_mm: float, across_mm: float, length_mm: float) -> float:
    """Loss of the tip, along the span, over `length_mm` that shows as well at its thin ends."""
    return max(
        hollow_mm / float(np.interp(0.5 * length_mm, from_end_mm, shares))
        for from_end_mm, _, shares in _ends(twin, TIP, across_mm)
    )


def _ends(twin: Twin, share: float, across_mm: float) -> list[tuple[Floats, Floats, Floats]]:
    """For both ends of a section: ways from the end along its longest axis, how thick the section is there at
    most, and the share of a neighbourhood that so wide a strip fills, as far as it shows."""
    seen_mm = twin.mesh.vertices_mm[twin.supported, 2]
    outline = dense(outline_mm(twin.mesh, float(seen_mm.min() + share * np.ptp(seen_mm))))
    centred_mm = outline - outline.mean(axis=0)
    side, along = np.linalg.eigh(centred_mm.T @ centred_mm)[1].T
    found = []
    for sign in (1.0, -1.0):
        order = np.argsort(-sign * centred_mm @ along)
        from_end_mm = -sign * (centred_mm[order] @ along)
        aside_mm = centred_mm[order] @ side
        wide_mm = np.maximum.accumulate(aside_mm) - np.minimum.accumulate(aside_mm)
        found.append((from_end_mm - from_end_mm[0], wide_mm, SHOWN * np.minimum(wide_mm / across_mm, 1.0)))
    return found


def _first(loss_mm: Floats, shown_mm: Floats, hollow_mm: float) -> float:
    enough = np.flatnonzero(shown_mm >= hollow_mm)
    return float(loss_mm[enough[0]]) if len(enough) else np.inf
