"""Section profiles over the thesis' grid of noise and point spacing, beside its tables 4.3, 4.4 and 4.5.

    python -m benchmarks.sections [--part grid ratios speed airfoils engeom] [--noise 0.015] [--spacing 0.1]

The blade is re-made from the thesis' words (4.4.1): 45 x 105 mm, 25 deg of twist, a sinusoid of random
amplitude up to 0.005 mm around every section, and 0.09 mm on both sides near the tip; sections at 7, 52.5
and 98 mm. Noise is N(0, sigma) along a random direction, so sigma / sqrt(3) along the normal, as in the
thesis. Figures of the grid are the largest of all draws and sections. The thesis used 36.35 s a
section (table 4.2).
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from geometry.blade.nominal import NominalSection
from geometry.errors import GeometryError
from geometry.sections.airfoil import measure_sections
from geometry.sections.band import band_of
from geometry.sections.chart import SectionSettings, unroll
from geometry.sections.curve import (
    camber_line,
    centroid,
    centroid_gradient,
    edge,
    edge_radius,
    node_shares,
    orientation,
    thick_part,
    thickness,
)
from geometry.sections.measurands import define, form, place, shape
from geometry.sections.profile import reconstruct
from geometry.types import Floats, Measurand
from tests.geometry.airfoils import (
    AnalyticNominal,
    Blade,
    DiscAirfoil,
    Part,
    alignment,
    cloud_of,
    random_airfoil,
    scan_in_place,
    section_of,
)

PERFECT = alignment()
NOISES_MM = (0.010, 0.015, 0.020, 0.025, 0.030)
SPACINGS_MM = (0.100, 0.125, 0.150, 0.175, 0.200)
HEIGHTS_MM = (7.0, 52.5, 98.0)

THESIS = {
    "profile, mm (table 4.3)": (
        (0.016976, 0.019402, 0.041759, 0.064732, 0.073552),
        (0.019125, 0.023564, 0.046539, 0.071692, 0.080025),
        (0.022031, 0.029395, 0.051464, 0.077300, 0.087039),
        (0.025457, 0.034121, 0.058532, 0.081763, 0.096462),
        (0.030882, 0.043750, 0.075263, 0.094395, 0.110774),
    ),
    "centroid, mm (table 4.4)": (
        (0.000428, 0.000753, 0.001088, 0.001594, 0.001721),
        (0.000485, 0.000810, 0.001210, 0.001685, 0.001867),
        (0.000546, 0.000951, 0.001574, 0.001992, 0.002213),
        (0.000625, 0.001127, 0.001606, 0.002285, 0.002664),
        (0.000703, 0.001356, 0.001747, 0.002518, 0.003207),
    ),
    "orientation, deg (table 4.5)": (
        (0.001192, 0.002037, 0.003592, 0.004732, 0.007528),
        (0.001245, 0.002713, 0.004127, 0.005602, 0.008364),
        (0.001536, 0.003615, 0.004635, 0.005718, 0.008771),
        (0.001791, 0.004244, 0.006621, 0.007310, 0.011120),
        (0.002133, 0.005614, 0.007105, 0.009162, 0.014698),
    ),
}


@dataclass(frozen=True, kw_only=True)
class InService:
    """The deviation of the thesis' simulated in-service blade."""

    amplitude: CubicSpline

    def __call__(self, s: Floats, z: Floats) -> Floats:
        form = self.amplitude(z) * np.sin(2.0 * np.pi * 6.0 * s + 0.7)
        near_tip = 1.0 / (1.0 + np.exp(-(z - 84.0) / 2.0))
        for centre, half in ((0.27, 0.10), (0.74, 0.10)):
            x = np.clip((s - centre) / half, -1.0, 1.0)
            form = form + near_tip * 0.09 * np.cos(np.pi * x / 2.0) ** 2 * np.sin(np.pi * (x + 1.0))
        return np.asarray(form)


def in_service_blade(rng: np.random.Generator) -> Part:
    heights = np.linspace(0.0, 105.0, 22)
    deviation = InService(amplitude=CubicSpline(heights, rng.uniform(0.0, 0.005, 22)))
    return Part(blade=Blade(twist_deg=25.0), deviation=deviation)


def distance_to(curve: Floats, points: Floats) -> Floats:
    """Distance of points to a dense closed polyline."""
    near = cKDTree(curve).query(points)[1]
    best = np.full(len(points), np.inf)
    for side in (-1, 0):
        a, b = curve[(near + side) % len(curve)], curve[(near + side + 1) % len(curve)]
        e = b - a
        f = np.clip(((points - a) * e).sum(axis=1) / (e * e).sum(axis=1), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - a - f[:, None] * e, axis=1))
    return best


@dataclass(frozen=True, kw_only=True)
class Found:
    """One section of one draw: largest errors of profile and centroid, mm, and orientation, deg."""

    profile_mm: float
    centroid_mm: float
    orientation_deg: float
    cpu_s: float
    bounds: tuple[float, float]  # least standard deviation of centroid, mm, and orientation, deg

    def errors(self) -> tuple[float, float, float]:
        return self.profile_mm, self.centroid_mm, self.orientation_deg


def one(
    part: Part, nominal: AnalyticNominal, z: float, noise: float, spacing: float, rng: np.random.Generator
) -> Found:
    """One section of one draw."""
    settings = SectionSettings()
    chart = unroll(nominal, z, settings.widest_band_mm, settings)
    points = part.scan(rng, float(chart.z_mm[0]), float(chart.z_mm[-1]), spacing, noise)
    scan = scan_in_place(points, noise)
    start = time.process_time()
    profile = reconstruct(scan, chart, settings)
    seconds = time.process_time() - start
    true = part.section(z)
    turns = [orientation(curve, chart.curve_mm).value for curve in (profile.curve_mm, true_nodes(part, z))]
    low, high = band_of(chart, points[:, 2], settings)
    return Found(
        profile_mm=float(distance_to(true, profile.curve_mm).max()),
        centroid_mm=float(np.linalg.norm(centroid(profile.curve_mm) - centroid(true))),
        orientation_deg=float(np.rad2deg(abs(turns[0] - turns[1]))),
        cpu_s=seconds,
        bounds=bounds(chart.curve_mm, noise / np.sqrt(3.0), (high - low) / spacing**2),
    )


@cache
def true_nodes(part: Part, z: float) -> Floats:
    """The true section on the nodes of the nominal one."""
    return unroll(TrueNominal(part), z, 0.5, SectionSettings()).curve_mm


def bounds(curve: Floats, noise: float, per_mm: float) -> tuple[float, float]:
    """The least standard deviations of centroid (mm) and orientation (deg) that noise `noise` along the
    normal allows.

    `per_mm` points on each mm of arc, all heights of the band together: the Cramer-Rao bound of a section
    whose form is unknown and the same all over the band. One that moves along a line has it too.
    """
    growths = np.vstack([centroid_gradient(curve), np.rad2deg(orientation(curve, curve).gradient)])
    x, y, turn = noise**2 / per_mm * (growths**2 / node_shares(curve)).sum(axis=1)
    return float(np.sqrt(x + y)), float(np.sqrt(turn))


Cells = dict[tuple[float, float], float]


def table(title: str, thesis: tuple[tuple[float, ...], ...], found: Cells) -> None:
    print(f"\n{title}: thesis / here\n  spacing  " + "".join(f"noise {n:.3f}         " for n in NOISES_MM))
    for i, spacing in enumerate(SPACINGS_MM):
        cells = [
            f"{thesis[i][j]:.6f}/{found[noise, spacing]:.6f}" if (noise, spacing) in found else " " * 17
            for j, noise in enumerate(NOISES_MM)
        ]
        print(f"  {spacing:.3f}    " + "   ".join(cells))


def grid(draws: int, noises: Sequence[float], spacings: Sequence[float]) -> None:
    """The thesis' grid: the largest errors of all draws and sections, and the centroid's bound."""
    part = in_service_blade(np.random.default_rng(0))
    nominal = AnalyticNominal(part.blade)
    one(part, nominal, 52.5, 0.01, 0.3, np.random.default_rng(0))
    worst: tuple[Cells, Cells, Cells] = ({}, {}, {})
    least: tuple[Cells, Cells] = ({}, {})
    seconds = []
    for noise in noises:
        for spacing in spacings:
            rows = [
                one(part, nominal, z, noise, spacing, np.random.default_rng(draw))
                for z in HEIGHTS_MM
                for draw in range(draws)
            ]
            seconds += [row.cpu_s for row in rows]
            for bound, value in zip(least, np.max([row.bounds for row in rows], axis=0), strict=True):
                bound[noise, spacing] = float(value)
            for found, value in zip(worst, np.max([row.errors() for row in rows], axis=0), strict=True):
                found[noise, spacing] = float(value)
    for (title, thesis), found in zip(THESIS.items(), worst, strict=True):
        table(title, thesis, found)
    for name, found, bound in zip(("centroid, mm", "orientation, deg"), worst[1:], least, strict=True):
        print(f"\n{name}: least standard deviation that noise and area allow; largest error over it")
        for spacing in spacings:
            cells = [f"{bound[n, spacing]:.6f} x {found[n, spacing] / bound[n, spacing]:.1f}" for n in noises]
            print(f"  {spacing:.3f}    " + "   ".join(cells))
    print(f"  Of {3 * draws} draws at the bound the largest would be {largest_of(3 * draws):.1f} times it.")
    print(f"\nCPU seconds a section: median {np.median(seconds):.3f}, thesis 36.35")


def largest_of(count: int) -> float:
    """The mean of the largest of so many sizes of standard normal draws."""
    return float(np.abs(np.random.default_rng(0).normal(size=(4000, count))).max(axis=1).mean())


def ratios(draws: int) -> None:
    """Spread of error over sigma of the measurands, over random form, motion, noise and sampling."""
    settings, nominal = SectionSettings(), AnalyticNominal(Blade())
    rows: dict[str, list[float]] = {}
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        part = random_part(rng)
        points = part.scan(rng, 40.5, 64.5, 0.3, 0.02)
        (section,) = measure_sections(
            cloud_of(points, 0.01), np.zeros(len(points), bool), PERFECT, nominal, [52.5], settings
        )
        for name, true in truth_of(part, nominal, settings).items():
            found = section.measurands[name]
            assert isinstance(found, Measurand), name
            rows.setdefault(name, []).append((found.value - true) / max(found.sigma, 1e-9))
    print(f"\nerror over sigma, {draws} draws: standard deviation (1 = honest), mean")
    for name, values in rows.items():
        print(f"  {name:30s} {np.std(values):5.2f} {np.mean(values):+6.2f}")


def random_part(rng: np.random.Generator) -> Part:
    amplitude, phase = rng.uniform(0.0, 0.01), rng.uniform(0.0, 6.28)
    return Part(
        deviation=lambda s, z: amplitude * np.sin(2 * np.pi * 6 * s + phase + 0.02 * z),
        shift_mm=(rng.normal(0.0, 0.05), rng.normal(0.0, 0.05)),
        turn_deg=rng.normal(0.0, 0.2),
    )


class TrueNominal(AnalyticNominal):
    """A part unrolled on the nodes of its nominal."""

    def __init__(self, part: Part) -> None:
        super().__init__(part.blade)
        self.part = part

    def section(self, z_mm: float) -> NominalSection:
        return section_of(self.part.section(z_mm), self.blade.section(z_mm)[1], z_mm)


def truth_of(part: Part, nominal: AnalyticNominal, settings: SectionSettings) -> dict[str, float]:
    """True values by the definitions, from the part's own curve."""
    chart = unroll(nominal, 52.5, 6.0, settings)
    definition = define(chart.curve_mm, chart.side, settings)
    true = true_nodes(part, 52.5)
    off = chart.project(np.column_stack([true, np.full(len(true), 52.5)]))[:, 1]
    found = {
        **place(true, chart.curve_mm),
        **shape(true, definition),
        **form(true, off, np.ones(len(true), bool), definition),
    }
    return {name: estimate.value for name, estimate in found.items()}


def speed(points: int = 950_000, sections: int = 20) -> None:
    """CPU and wall time of many sections of one large scan, and of a single one, kernels and nominal warm."""
    settings, nominal = SectionSettings(), AnalyticNominal(Blade())
    curve = nominal.section(52.5).curve_mm
    spacing = float(np.sqrt(105.0 * node_shares(curve).sum() / points))
    scan = np.vstack(
        [Part().scan(np.random.default_rng(i), i * 21.0, i * 21.0 + 21.0, spacing, 0.015) for i in range(5)]
    )
    cloud, mask = cloud_of(scan, 0.01), np.zeros(len(scan), bool)
    heights = np.linspace(5.0, 100.0, sections).tolist()
    for asked in (heights, heights, heights[:1]):
        cpu, wall = time.process_time(), time.perf_counter()
        measure_sections(cloud, mask, PERFECT, nominal, asked, settings)
        used = time.process_time() - cpu, time.perf_counter() - wall
        if len(asked) > 1:
            print(f"{len(asked)} sections of {len(scan)} points: CPU {used[0]:.2f} s, wall {used[1]:.2f} s")
    slab = np.count_nonzero(np.abs(scan[:, 2] - heights[0]) <= 0.09)
    print(f"\none section, {slab} points within 0.09 mm of its plane: CPU {used[0]:.3f} s")


def campaign(count: int, seed: int) -> None:
    """Generated airfoils, every measurand of each: failures, edges swapped, errors against the discs."""
    rng, settings = np.random.default_rng(seed), SectionSettings(edge_mm=1.0)
    failed = swapped = done = 0
    worst = {"chord": 0.0, "thickness": 0.0, "le radius": 0.0, "te radius": 0.0}
    while done < count:
        airfoil = random_airfoil(rng)
        if airfoil is None:
            continue
        done += 1
        turn = rng.uniform(-180.0, 180.0)
        blade = Blade(airfoil=airfoil, twist_deg=turn, height_mm=1.0, taper=0.0)
        try:
            chart = unroll(AnalyticNominal(blade), 1.0, 0.1, settings)
            found = shape(chart.curve_mm, define(chart.curve_mm, chart.side, settings))
        except (GeometryError, ArithmeticError, ValueError, IndexError) as why:
            failed += 1
            print(f"  failed: {airfoil}: {why}")
            continue
        off = (found["stagger_deg"].value - turn + 180.0) % 360.0 - 180.0
        swapped += not abs(off) < 30.0
        true = {
            "chord": (found["chord_mm"], farthest(airfoil)),
            "thickness": (found["max_thickness_mm"], 2.0 * float(airfoil.discs(FINE)[1].max())),
            "le radius": (found["le_radius_mm"], airfoil.le_mm),
            "te radius": (found["te_radius_mm"], airfoil.te_mm),
        }
        for name, (estimate, value) in true.items():
            worst[name] = max(worst[name], abs(estimate.value - value) / value)
    print(f"\n{count} airfoils: {failed} failed, {swapped} swapped; largest relative errors")
    print("  " + ", ".join(f"{name} {value:.1e}" for name, value in worst.items()))


FINE = np.linspace(0.0, 1.0, 2001)


def farthest(airfoil: DiscAirfoil) -> float:
    """The largest distance between points of a curve of discs."""
    centre, radius, _ = airfoil.discs(FINE)
    front, back = slice(None, None, 8), slice(None, None, 8)
    away = np.linalg.norm(centre[front][:, None] - centre[back], axis=2)
    return float((away + radius[front][:, None] + radius[back]).max())


def peer() -> None:
    """The same curves measured by engeom: values, what differs and why, times."""
    try:
        from engeom import airfoil2, geom2
    except ImportError:
        print("\nengeom is not installed: no comparison")
        return
    print("\nhere / engeom, mm       max thickness        le radius          te radius        ms")
    warm, nose = PEERS[0].curve(per_side=1200)
    thickness(warm, thick_part(camber_line(warm, nose)))
    for airfoil in PEERS:
        curve, le = airfoil.curve(per_side=1200)
        start = time.process_time()
        camber = camber_line(curve, le)
        ours = [thickness(curve, thick_part(camber)).value]
        ours += [edge_radius(curve, edge(curve, tip).arc).value for tip in (le, 0)]
        middle = time.process_time()
        section = geom2.Curve2(curve, force_closed=True)
        circles = airfoil2.extract_inscribed_circles(section, 1e-4)
        centres = np.array([[c.center.x, c.center.y] for c in circles])
        ahead = bool(np.linalg.norm(centres[0] - curve[le]) < np.linalg.norm(centres[0] - curve[0]))
        ends = [airfoil2.fit_full_round_edge(section, 1e-4, circles, front) for front in (ahead, not ahead)]
        stop = time.process_time()
        theirs = [2.0 * max(c.radius for c in circles), *(end.edge.geometry.radius for end in ends)]
        pairs = "  ".join(f"{a:.5f}/{b:.5f}" for a, b in zip(ours, theirs, strict=True))
        mine, his = 1e3 * (middle - start), 1e3 * (stop - middle)
        print(f"  span {airfoil.span_mm:5.1f} mm        {pairs}  {mine:.1f}/{his:.1f} = {mine / his:.2f}")
    print("  Both stop at tolerances: engeom's circles at 1e-4 mm, here the nodes of the curve.")


PEERS = (
    DiscAirfoil(),
    DiscAirfoil(camber_mm=0.0),
    DiscAirfoil(span_mm=30.0, camber_mm=5.0, le_mm=1.0, te_mm=0.3, largest_mm=2.0),
    DiscAirfoil(span_mm=60.0, camber_mm=2.0, le_mm=0.5, te_mm=0.5, largest_mm=3.5),
)


def main() -> None:
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--part", choices=("grid", "ratios", "speed", "airfoils", "engeom"), nargs="*")
    arguments.add_argument("--draws", type=int, default=10)
    arguments.add_argument("--noise", type=float, nargs="*", default=NOISES_MM)
    arguments.add_argument("--spacing", type=float, nargs="*", default=SPACINGS_MM)
    arguments.add_argument("--ratios", type=int, default=200, help="draws of error over sigma")
    arguments.add_argument("--airfoils", type=int, default=2000)
    arguments.add_argument("--seed", type=int, default=0, help="of the airfoils")
    asked = arguments.parse_args()
    parts = {
        "grid": lambda: grid(asked.draws, asked.noise, asked.spacing),
        "ratios": lambda: ratios(asked.ratios),
        "speed": speed,
        "airfoils": lambda: campaign(asked.airfoils, asked.seed),
        "engeom": peer,
    }
    for name in asked.part or parts:
        parts[name]()


if __name__ == "__main__":
    main()
