"""The nominal with its edges where the part's are: an edge may lose more than its rounding is wide.

Of such an edge no point has its foot on the end of the nominal's, and no displacement along normals leads
from the one to the other; of one that lies as far forward, a displacement along normals is a needle. So the
nominal's edges are pushed along the chord first, as far as the points say; what is then left is small.
"""

import numpy as np

from geometry.sections.chart import NODES, Chart, with_nodes
from geometry.sections.motion import Motion
from geometry.types import Floats

EDGES = (0, NODES // 2)  # nodes: trailing, leading
REACH_MM = 3.0  # from an edge, over which its push fades
NEAR_MM = 1.5  # from an edge: points that tell of it, ...
POINTS = 300  # ... below the section and above it no more than so many ...
LEAST = 20  # ... nor fewer
HERE_MM = 1.5  # above the section and below: where its own edge is
TRIED_MM = np.linspace(-0.5, 1.0, 61)  # pushes; forward ones are negative
LEAST_MM = 0.2  # either way, of the larger push: less is as well told along normals
WORN_MM = 0.02  # off the nominal, near an edge (rms): where it is less nothing is pushed, ...
BETTER = 0.7  # ... nor unless no more than this share of it is left
FAR_MM = 0.3  # farther off counts as so far: single points decide nothing


def with_worn_edges(chart: Chart, motion: Motion, points_mm: Floats) -> Chart:
    """The chart, each edge pushed to where the points (n, 3) of a part have it.

    The push may differ below the section and above it, and is linear in height between and beyond.
    """
    place_mm = motion.undo(points_mm)
    moved_mm = np.sum([_moved_mm(chart, edge, place_mm) for edge in EDGES], axis=0)
    return with_nodes(chart, chart.nodes_mm + moved_mm) if moved_mm.any() else chart


def _moved_mm(chart: Chart, edge: int, place_mm: Floats) -> Floats:
    """How far an edge takes each node with it, (2 k + 1, NODES, 2).

    Damage may have taken the edge above the section, or below: what is pushed must do good at its own height.
    """
    near_mm = place_mm[_behind_mm(chart, edge, place_mm) < NEAR_MM]
    height_mm = near_mm[:, 2] - chart.section_z_mm
    halves = [half for half in (near_mm[height_mm < 0.0], near_mm[height_mm >= 0.0]) if len(half) >= LEAST]
    pushes_mm = [_push_mm(chart, edge, half) for half in halves]
    if max(map(abs, pushes_mm), default=0.0) < LEAST_MM:
        return np.zeros_like(chart.nodes_mm)
    push_mm = np.interp(chart.z_mm, [float(half[:, 2].mean()) for half in halves], pushes_mm)
    here_mm = near_mm[np.abs(height_mm) <= HERE_MM]
    if not _better(chart, edge, here_mm, float(push_mm[chart.here])):
        return np.zeros_like(chart.nodes_mm)
    stands_mm = (chart.nodes_mm - chart.nodes_mm[:, edge][:, None]) @ _inward(chart, edge)
    shares = np.clip(1.0 - stands_mm / REACH_MM, 0.0, 1.0) ** 2
    return np.asarray((push_mm[:, None] * shares)[:, :, None] * _inward(chart, edge))


def _push_mm(chart: Chart, edge: int, near_mm: Floats) -> float:
    """The push after which points (n, 3) near an edge lie on the nominal best."""
    few_mm = near_mm[:: max(1, len(near_mm) // POINTS)]
    if _off_mm(chart, edge, few_mm, 0.0) <= WORN_MM:
        return 0.0
    best = int(np.argmin([_off_mm(chart, edge, few_mm, push_mm) for push_mm in TRIED_MM.tolist()]))
    return float(TRIED_MM[best]) if _better(chart, edge, few_mm, float(TRIED_MM[best])) else 0.0


def _better(chart: Chart, edge: int, points_mm: Floats, push_mm: float) -> bool:
    """Whether points (n, 3) are off the nominal, and much less so after a push."""
    off_mm = _off_mm(chart, edge, points_mm, 0.0) if len(points_mm) >= LEAST else 0.0
    return off_mm > WORN_MM and _off_mm(chart, edge, points_mm, push_mm) < BETTER * off_mm


def _off_mm(chart: Chart, edge: int, points_mm: Floats, push_mm: float) -> float:
    """How far points (n, 3) are off a nominal whose edge is pushed back (rms), but for what all of them
    share: bent metal lies aside of the chord, and metal that wore evenly within both sides."""
    inward = _inward(chart, edge)
    back_mm = _before_mm(_behind_mm(chart, edge, points_mm), push_mm)
    foot = chart.project(points_mm + np.pad(back_mm[:, None] * inward, ((0, 0), (0, 1))))
    off_mm = np.clip(foot[:, 1], -FAR_MM, FAR_MM)
    shared = np.column_stack([np.ones(len(foot)), foot[:, 2:] @ np.array([-inward[1], inward[0]])])
    off_mm = off_mm - shared @ np.linalg.lstsq(shared, off_mm, rcond=None)[0]
    return float(np.sqrt(np.mean(off_mm**2)))


def _before_mm(behind_mm: Floats, push_mm: float) -> Floats:
    """How far a push carried what now lies so far behind the edge, taken back: the root of
    now = share + push (1 - share)^2, in shares of the reach."""
    now, push = behind_mm / REACH_MM, push_mm / REACH_MM
    slope = 1.0 - 2.0 * push
    share = 2.0 * (now - push) / (slope + np.sqrt(np.maximum(slope**2 + 4.0 * push * (now - push), 0.0)))
    return np.asarray(np.where(now < 1.0, share - now, 0.0) * REACH_MM)


def _behind_mm(chart: Chart, edge: int, points_mm: Floats) -> Floats:
    """How far points (n, 3) lie inward of the nominal's edge, along the chord."""
    path = [np.interp(points_mm[:, 2], chart.z_mm, chart.nodes_mm[:, edge, axis]) for axis in (0, 1)]
    return np.asarray((points_mm[:, :2] - np.column_stack(path)) @ _inward(chart, edge))


def _inward(chart: Chart, edge: int) -> Floats:
    """The direction (2,) along the chord from an edge to the other one."""
    chord = chart.curve_mm[(edge + NODES // 2) % NODES] - chart.curve_mm[edge]
    return np.asarray(chord / np.linalg.norm(chord))
