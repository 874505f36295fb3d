"""Section plots and limit bars as inline SVG: numbers in, path strings out."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.types import Floats, Ints
from station.plans import Limit

PLOT_PX = 720.0
ZOOM_PX = 230.0
ZOOM_MM = 1.6  # half width of the edge pictures
MAGNIFIED = 0.06  # of the chord: how long the largest deviation is drawn
MAX_POINTS = 700


@dataclass(frozen=True, slots=True, kw_only=True)
class Whisker:
    """A drawn deviation: a path, and the class that colours it."""

    path: str
    grade: str  # "inside", "serviceable" (beyond it), "repairable" (beyond it), "free" (no limit)


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionPlot:
    """Paths of one section in a box of `width` by `height`, deviations drawn `scale` times as long."""

    width: float
    height: float
    nominal: str
    band: tuple[str, ...]
    whiskers: tuple[Whisker, ...]
    scale: int
    edges: tuple["EdgePlot", ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgePlot:
    """Paths round one edge at true proportions in a square of `ZOOM_PX`."""

    title: str
    nominal: str
    band: tuple[str, ...]
    profile: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """From mm to the picture, y downwards."""

    left_mm: float
    top_mm: float
    px_per_mm: float

    def path(self, points_mm: Floats, *, closed: bool = False) -> str:
        """An SVG path through points (n, 2)."""
        x = (points_mm[:, 0] - self.left_mm) * self.px_per_mm
        y = (self.top_mm - points_mm[:, 1]) * self.px_per_mm
        return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)) + ("Z" if closed else "")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """A measured profile on its nominal: unbroken stretches apart."""

    curve_mm: Floats  # (m, 2) nominal, closed, counter-clockwise
    profile_mm: Floats  # (n, 2)
    deviation_mm: Floats  # (n,)
    run: Ints  # (n,)


def plot_section(curve: Curve, ends_mm: dict[str, Floats], limit: Limit | None) -> SectionPlot:
    """The plot of one section, laid level along its chord, with a picture of each end in `ends_mm`."""
    turn = level(curve.curve_mm)
    nominal_mm, profile_mm = curve.curve_mm @ turn.T, curve.profile_mm @ turn.T
    outward = normals(nominal_mm)
    extent_mm = float(np.ptp(nominal_mm[:, 0]))
    largest_mm = max(float(np.abs(curve.deviation_mm).max(initial=0.0)), limit.serviceable if limit else 0.0)
    scale = magnification(MAGNIFIED * extent_mm, largest_mm)
    margin_mm = 1.6 * MAGNIFIED * extent_mm
    frame = Frame(
        left_mm=float(nominal_mm[:, 0].min()) - margin_mm,
        top_mm=float(nominal_mm[:, 1].max()) + margin_mm,
        px_per_mm=PLOT_PX / (extent_mm + 2.0 * margin_mm),
    )
    height_mm = float(np.ptp(nominal_mm[:, 1])) + 2.0 * margin_mm
    foot = nearest(nominal_mm, profile_mm)
    return SectionPlot(
        width=PLOT_PX,
        height=height_mm * frame.px_per_mm,
        nominal=frame.path(thinned(nominal_mm), closed=True),
        band=offsets(frame, nominal_mm, outward, limit, scale),
        whiskers=whiskers(
            frame, nominal_mm[foot], outward[foot], curve.deviation_mm, curve.run, limit, scale
        ),
        scale=scale,
        edges=tuple(
            edge_plot(title, turn @ end_mm, nominal_mm, outward, profile_mm, curve.run, limit)
            for title, end_mm in ends_mm.items()
        ),
    )


def level(curve_mm: Floats) -> Floats:
    """The turn (2, 2) that lays the longest direction of a curve along x, without mirroring it."""
    _, vectors = np.linalg.eigh(np.cov((curve_mm - curve_mm.mean(axis=0)).T))
    along = vectors[:, 1] * np.sign(vectors[0, 1] or 1.0)
    return np.array([along, [-along[1], along[0]]])


def normals(curve_mm: Floats) -> Floats:
    """Outward unit normals (m, 2) of a closed counter-clockwise curve."""
    tangent = np.roll(curve_mm, -1, axis=0) - np.roll(curve_mm, 1, axis=0)
    outward = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    return np.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True))


def nearest(curve_mm: Floats, points_mm: Floats) -> Ints:
    """The index of the nearest point of the curve to each point (n, 2)."""
    return np.asarray(cKDTree(curve_mm).query(points_mm)[1], np.int64)


def magnification(drawn_mm: float, largest_mm: float) -> int:
    """A round factor that draws the largest deviation about `drawn_mm` long."""
    wanted = drawn_mm / max(largest_mm, 1e-3)
    steps = [s * 10**power for power in range(4) for s in (1, 2, 5)]
    return max([step for step in steps if step <= wanted], default=1)


def thinned(points: Floats) -> Floats:
    """Every so many points, so that at most `MAX_POINTS` are drawn."""
    return points[thin_indices(len(points))]


def thin_indices(count: int) -> Ints:
    return np.arange(0, count, -(-count // MAX_POINTS) or 1, dtype=np.int64)


def offsets(
    frame: Frame, curve_mm: Floats, outward: Floats, limit: Limit | None, scale: float
) -> tuple[str, ...]:
    """The curve moved out and in by the serviceable limit."""
    if limit is None:
        return ()
    moved = (curve_mm + sign * scale * limit.serviceable * outward for sign in (1.0, -1.0))
    return tuple(frame.path(thinned(each), closed=True) for each in moved)


def whiskers(
    frame: Frame,
    foot_mm: Floats,
    outward: Floats,
    deviation_mm: Floats,
    run: Ints,
    limit: Limit | None,
    scale: float,
) -> tuple[Whisker, ...]:
    """A line from the nominal to each measured point, drawn `scale` times as long, sorted by grade."""
    keep = thin_indices(len(foot_mm))
    tip_mm = foot_mm + scale * deviation_mm[:, None] * outward
    grade = np.array([grade_of(deviation, limit) for deviation in deviation_mm[keep]])
    lines = []
    for name in ("inside", "free", "serviceable", "repairable"):
        pairs = [frame.path(np.stack([foot_mm[i], tip_mm[i]])) for i in keep[grade == name]]
        if pairs:
            lines.append(Whisker(path="".join(pairs), grade=name))
    tips = [frame.path(tip_mm[keep][run[keep] == number]) for number in np.unique(run)]
    return (*lines, *(Whisker(path=path, grade="profile") for path in tips if "L" in path))


def grade_of(deviation_mm: float, limit: Limit | None) -> str:
    """How far a deviation reaches, without its uncertainty."""
    if limit is None:
        return "free"
    if abs(deviation_mm) <= limit.serviceable:
        return "inside"
    return "serviceable" if abs(deviation_mm) <= limit.repairable else "repairable"


def edge_plot(
    title: str,
    end_mm: Floats,
    curve_mm: Floats,
    outward: Floats,
    profile_mm: Floats,
    run: Ints,
    limit: Limit | None,
) -> EdgePlot:
    """The picture of one end of a section."""
    frame = Frame(
        left_mm=end_mm[0] - ZOOM_MM, top_mm=end_mm[1] + ZOOM_MM, px_per_mm=ZOOM_PX / (2.0 * ZOOM_MM)
    )
    near = np.abs(profile_mm - end_mm).max(axis=1) < 2.0 * ZOOM_MM
    stretches = [profile_mm[near & (run == number)] for number in np.unique(run)]
    around = ordered_near(curve_mm, end_mm)
    moved = () if limit is None else (limit.serviceable, -limit.serviceable)
    return EdgePlot(
        title=title,
        nominal=frame.path(curve_mm[around]),
        band=tuple(frame.path((curve_mm + shift * outward)[around]) for shift in moved),
        profile=tuple(frame.path(stretch) for stretch in stretches if len(stretch) > 1),
    )


def ordered_near(curve_mm: Floats, end_mm: Floats) -> Ints:
    """Indices of the curve's stretch round an end, in order, across the start of the curve if need be."""
    count, middle = len(curve_mm), int(nearest(curve_mm, end_mm[None])[0])
    step_mm = float(np.median(np.linalg.norm(np.diff(curve_mm, axis=0), axis=1)))
    reach = min(int(5.0 * ZOOM_MM / max(step_mm, 1e-6)), count // 2 - 1)
    around: Ints = np.arange(middle - reach, middle + reach + 1) % count
    return around[thin_indices(len(around))]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """Where a value lies to its limits, in percent of a bar that ends beyond the repairable limit."""

    serviceable: float
    repairable: float
    low: float
    high: float
    value: float


def limit_bar(judged: float, U: float, limit: Limit) -> Bar:
    """The bar of a finding. The serviceable limit stands at 40 %, the repairable one at 80 %."""

    def place(value: float) -> float:
        if value <= limit.serviceable:
            return 40.0 * max(value, 0.0) / limit.serviceable if limit.serviceable > 0.0 else 40.0
        span = limit.repairable - limit.serviceable
        if value <= limit.repairable:
            return 40.0 + 40.0 * (value - limit.serviceable) / span
        return min(80.0 + 20.0 * (value - limit.repairable) / (limit.repairable or 1.0), 100.0)

    return Bar(
        serviceable=40.0, repairable=80.0, low=place(judged - U), high=place(judged + U), value=place(judged)
    )
