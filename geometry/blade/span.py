"""Along the span of a blade: where its airfoil begins, and the lines of its two edges."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geometry.blade import outline as outlines
from geometry.blade.outline import End, Outline
from geometry.errors import BadMesh
from geometry.types import Floats

OutlineAt = Callable[[float], Outline]

END_FACE = 0.005  # "just above" an end face, as a fraction of the height of the mesh
PLATFORM_GROWTH = 1.5  # log area gained per caliper length of height: an airfoil stays below 0.5
STEPS = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeLines:
    """The edge lines of an airfoil, z ascending, and which side of it is convex."""

    le_line_mm: Floats  # (k, 3)
    te_line_mm: Floats  # (k, 3)
    suction_first: bool  # the suction side is the one from trailing to leading edge, counter-clockwise


def airfoil_start_mm(outline_at: OutlineAt, bottom_mm: float, top_mm: float) -> float:
    """The lowest z of the airfoil: just above the root end face, or where a platform's fillet ends.

    Walks down from the tip until the section's area grows faster than an airfoil's does.
    """
    step_mm = (top_mm - bottom_mm) / STEPS
    heights_mm = np.arange(top_mm - 0.02 * (top_mm - bottom_mm), bottom_mm + 0.5 * step_mm, -step_mm)
    above_mm2, above_z_mm = outlines.area(outline_at(float(heights_mm[0])).points_mm), float(heights_mm[0])
    for z_mm in heights_mm[1:]:
        points_mm = outline_at(float(z_mm)).points_mm
        area_mm2 = outlines.area(points_mm)
        growth = np.log(area_mm2 / above_mm2) * outlines.caliper_mm(points_mm) / step_mm
        if growth > PLATFORM_GROWTH:
            return above_z_mm
        above_mm2, above_z_mm = area_mm2, float(z_mm)
    return bottom_mm + END_FACE * (top_mm - bottom_mm)


def edge_lines(outline_at: OutlineAt, z_min_mm: float, z_max_mm: float) -> EdgeLines:
    """The edge lines between two heights, from sections about 1 mm apart, extended straight to both.

    The leading edge is the end that is wider on the mean of all sections; the suction side is the convex
    one. Raises `BadMesh` where too few sections have two ends.
    """
    margin_mm = 0.01 * (z_max_mm - z_min_mm)
    count = int(np.clip(np.ceil(z_max_mm - z_min_mm), 24, 128))
    pairs: list[tuple[End, End]] = []
    outlined: list[Outline] = []
    heights_mm: list[float] = []
    for z_mm in np.linspace(z_min_mm + margin_mm, z_max_mm - margin_mm, count):
        outline = outline_at(float(z_mm))
        try:
            ends = outlines.find_ends(outline)
        except BadMesh:
            continue
        pairs.append(_in_order(ends, pairs[-1]) if pairs else ends)
        outlined.append(outline)
        heights_mm.append(float(z_mm))
    if len(pairs) < 0.75 * count:
        raise BadMesh(f"no airfoil: {count - len(pairs)} of {count} sections have no two ends")
    if sum(a.width_mm - b.width_mm for a, b in pairs) < 0.0:
        pairs = [(b, a) for a, b in pairs]
    bow_mm2 = sum(_bow_mm2(outline, *pair) for outline, pair in zip(outlined, pairs, strict=True))
    lines = [_line([pair[i] for pair in pairs], heights_mm, z_min_mm, z_max_mm) for i in range(2)]
    return EdgeLines(le_line_mm=lines[0], te_line_mm=lines[1], suction_first=bow_mm2 > 0.0)


def on_line_mm(line_mm: Floats, z_mm: Floats) -> Floats:
    """The points (n, 2) of an edge line at heights (n,); its ends outside its reach."""
    return np.column_stack([np.interp(z_mm, line_mm[:, 2], line_mm[:, i]) for i in range(2)])


def _in_order(ends: tuple[End, End], previous: tuple[End, End]) -> tuple[End, End]:
    """The ends in the order of the section before: chords of neighbouring sections point the same way."""
    chord, before = (np.subtract(b.point_mm, a.point_mm) for a, b in (ends, previous))
    return ends if float(chord @ before) > 0.0 else (ends[1], ends[0])


def _bow_mm2(outline: Outline, le: End, te: End) -> float:
    """Area between camber line and chord, positive where it bows to the side that runs from TE to LE."""
    points_mm = outlines.start_at(outline, te.index).points_mm
    split = (le.index - te.index) % len(points_mm)
    there, back = points_mm[: split + 1], np.concatenate([points_mm[split:], points_mm[:1]])
    return abs(outlines.area(there)) - abs(outlines.area(back))


def _line(ends: list[End], heights_mm: list[float], z_min_mm: float, z_max_mm: float) -> Floats:
    line = np.column_stack([[end.point_mm for end in ends], heights_mm])
    ends_mm = [_extended(line[:2], z_min_mm), line, _extended(line[-2:], z_max_mm)]
    return np.concatenate(ends_mm)


def _extended(pair_mm: Floats, z_mm: float) -> Floats:
    """The point (1, 3) at height z on the straight line through two points."""
    (a, b) = pair_mm
    return np.asarray(a + (z_mm - a[2]) / (b[2] - a[2]) * (b - a))[None]
