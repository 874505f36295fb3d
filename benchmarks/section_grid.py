"""Section profiles over the thesis' grid of noise and point spacing, by its own method and by the product's.

    python -m benchmarks.section_grid [--draws 10] [--noise 0.015] [--spacing 0.1]

The blade is re-made from the thesis' words (4.4.1): 45 x 105 mm, 25 deg of twist, a sinusoid of random
amplitude up to 0.005 mm around every section, and 0.09 mm on both sides near the tip; sections at 7, 52.5
and 98 mm. Noise is N(0, sigma) along a random direction, so sigma / sqrt(3) along the normal, as in the
thesis. Both methods get the same points, of which the thesis' takes a slab next to the section and the
product's a band of neighbouring heights. Figures are the largest of all draws and sections.

The last tables set them against what noise allows, the bound of Cramer and Rao: for the product that of its
band, for the thesis' that of the slab. No method that sees one slab only can be better: where the thesis' own
figure is, its points were other than its words say. Points fall at random here, so that edges are left bare
for a millimetre, where an even sampling leaves none. The thesis used 36.35 s a section (table 4.2).
"""

import argparse
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from benchmarks.sections import true_nodes
from geometry.errors import CannotMeasure
from geometry.sections.band import band_of
from geometry.sections.chart import Chart, SectionSettings, unroll
from geometry.sections.curve import centroid, centroid_gradient, node_shares, orientation
from geometry.sections.profile import reconstruct
from geometry.thesis.rwlls_profile import reconstruct_thesis
from geometry.thesis.rwlls_sections import trace
from geometry.types import Floats
from tests.geometry.airfoils import AnalyticNominal, Blade, Part, scan_in_place

NOISES_MM = (0.010, 0.015, 0.020, 0.025, 0.030)
SPACINGS_MM = (0.100, 0.125, 0.150, 0.175, 0.200)
HEIGHTS_MM = (7.0, 52.5, 98.0)
NEAR_MM = 1.0  # of the section: the points that the thesis' method is given
SETTINGS = SectionSettings()

THESIS = {  # rows by spacing, columns by noise
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


@dataclass(frozen=True, kw_only=True)
class Found:
    """One section by one method, errors in mm and deg."""

    profile_mm: float  # the largest
    centroid_mm: float
    orientation_deg: float
    least: tuple[float, float]  # standard deviation of centroid and orientation that noise leaves
    cpu_s: float

    @property
    def errors(self) -> tuple[float, float, float]:
        return self.profile_mm, self.centroid_mm, self.orientation_deg


Cells = dict[tuple[float, float], list[Found]]


def product(part: Part, chart: Chart, points_mm: Floats, noise_mm: float, spacing_mm: float) -> Found:
    """The product's section, from the band of heights that it takes."""
    scan = scan_in_place(points_mm, noise_mm)
    start_s = time.process_time()
    curve_mm = reconstruct(scan, chart, SETTINGS).curve_mm
    cpu_s = time.process_time() - start_s
    low_mm, high_mm = band_of(chart, points_mm[:, 2], SETTINGS)
    per_mm = (high_mm - low_mm) / spacing_mm**2
    least = least_sigmas(chart.curve_mm, chart.curve_mm, noise_mm / np.sqrt(3.0), per_mm)
    return judged(part, chart, curve_mm, curve_mm, least, cpu_s)


def faithful(part: Part, chart: Chart, points_mm: Floats, noise_mm: float) -> Found:
    """The thesis' section, from those of the points that lie next to it."""
    near_mm = points_mm[np.abs(points_mm[:, 2] - chart.section_z_mm) <= NEAR_MM]
    sigma_mm = noise_mm / np.sqrt(3.0)
    start_s = time.process_time()
    profile = reconstruct_thesis(near_mm, chart.section_z_mm, sigma_mm)
    curve_mm = profile.curve_mm(np.arange(4096) / 4096)
    cpu_s = time.process_time() - start_s
    nodes_mm = trace(profile, near_mm, chart).curve_mm
    per_mm = len(profile.thinned.points_mm) / node_shares(nodes_mm).sum()
    least = least_sigmas(nodes_mm, chart.curve_mm, sigma_mm, per_mm)
    return judged(part, chart, curve_mm, nodes_mm, least, cpu_s)


def judged(
    part: Part, chart: Chart, curve_mm: Floats, nodes_mm: Floats, least: tuple[float, float], cpu_s: float
) -> Found:
    """A curve, and the same on the nodes of the nominal section, against the true one."""
    true_mm = part.section(chart.section_z_mm)
    true_turn = orientation(true_nodes(part, chart.section_z_mm), chart.curve_mm).value
    turn = orientation(nodes_mm, chart.curve_mm).value
    return Found(
        profile_mm=float(distance_to(true_mm, curve_mm).max()),
        centroid_mm=float(np.linalg.norm(centroid(curve_mm) - centroid(true_mm))),
        orientation_deg=float(np.rad2deg(abs(turn - true_turn))),
        least=least,
        cpu_s=cpu_s,
    )


def grid(
    part: Part, nominal: AnalyticNominal, draws: int, noises: Sequence[float], spacings: Sequence[float]
) -> tuple[Cells, Cells]:
    """Every section of every draw by the thesis' method and by the product, on the same points."""
    charts = [unroll(nominal, z_mm, SETTINGS.widest_band_mm, SETTINGS) for z_mm in HEIGHTS_MM]
    both(part, charts[1], 0.01, 0.3, np.random.default_rng(0))  # compiles the kernels
    theirs: Cells = {}
    ours: Cells = {}
    for cell in itertools.product(noises, spacings):
        found = [
            both(part, chart, *cell, np.random.default_rng(draw)) for chart in charts for draw in range(draws)
        ]
        theirs[cell] = [its for its, _ in found if its is not None]
        ours[cell] = [here for _, here in found]
    return theirs, ours


def both(
    part: Part, chart: Chart, noise_mm: float, spacing_mm: float, rng: np.random.Generator
) -> tuple[Found | None, Found]:
    points_mm = part.scan(rng, float(chart.z_mm[0]), float(chart.z_mm[-1]), spacing_mm, noise_mm)
    here = product(part, chart, points_mm, noise_mm, spacing_mm)
    try:
        return faithful(part, chart, points_mm, noise_mm), here
    except CannotMeasure:
        return None, here


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


def least_sigmas(curve: Floats, nominal: Floats, sigma: float, per_mm: float) -> tuple[float, float]:
    """The least standard deviations of centroid (mm, both axes) and orientation (deg) that noise `sigma`
    along the normal allows, with `per_mm` points on each mm of arc.

    The Cramer-Rao bound of a section whose form is the same at all heights that the points come from. One
    that moves along a line has it too.
    """
    growths = np.vstack([centroid_gradient(curve), np.rad2deg(orientation(curve, nominal).gradient)])
    x, y, turn = sigma**2 / per_mm * (growths**2 / node_shares(curve)).sum(axis=1)
    return float(np.sqrt(x + y)), float(np.sqrt(turn))


def table(kind: int, title: str, thesis: tuple[tuple[float, ...], ...], theirs: Cells, ours: Cells) -> None:
    """The thesis' figures, then the largest error of either method."""
    print(f"\n{title}: thesis / its method here / product")
    for i, spacing in enumerate(SPACINGS_MM):
        for j, noise in enumerate(NOISES_MM):
            cell = noise, spacing
            if cell in ours:
                its, here = (worst(cells[cell], kind) for cells in (theirs, ours))
                stated = thesis[i][j]
                share = f"{here / stated:.2f} of the table"
                print(
                    f"  spacing {spacing:.3f} noise {noise:.3f}  {stated:.6f} {its:.6f} {here:.6f}  {share}"
                )


def worst(rows: list[Found], kind: int) -> float:
    return max((found.errors[kind] for found in rows), default=np.nan)


def against_noise(kind: int, title: str, theirs: Cells, ours: Cells, draws: int) -> None:
    """Standard deviations that noise leaves, and the largest errors in these."""
    print(f"\n{title}: least standard deviation and largest error over it, of the thesis' method / product")
    for (noise, spacing), rows in ours.items():
        pairs = []
        for found in (theirs[noise, spacing], rows):
            least = max((one.least[kind - 1] for one in found), default=np.nan)
            pairs.append(f"{least:.6f} x {worst(found, kind) / least:.1f}")
        print(f"  spacing {spacing:.3f} noise {noise:.3f}  {' / '.join(pairs)}")
    print(f"  Of {draws} draws at the bound the largest would be {largest_of(draws):.1f} times it.")


def largest_of(count: int) -> float:
    """The mean of the largest of so many sizes of standard normal draws."""
    return float(np.abs(np.random.default_rng(0).normal(size=(4000, count))).max(axis=1).mean())


def main() -> None:
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--draws", type=int, default=10)
    arguments.add_argument("--noise", type=float, nargs="*", default=NOISES_MM)
    arguments.add_argument("--spacing", type=float, nargs="*", default=SPACINGS_MM)
    asked = arguments.parse_args()
    part = in_service_blade(np.random.default_rng(0))
    nominal = AnalyticNominal(part.blade)
    theirs, ours = grid(part, nominal, asked.draws, asked.noise, asked.spacing)
    for kind, (title, thesis) in enumerate(THESIS.items()):
        table(kind, title, thesis, theirs, ours)
    for kind, title in enumerate(("centroid, mm", "orientation, deg"), 1):
        against_noise(kind, title, theirs, ours, len(HEIGHTS_MM) * asked.draws)
    seconds = [np.median([one.cpu_s for rows in cells.values() for one in rows]) for cells in (theirs, ours)]
    refused = sum(len(rows) - len(theirs[cell]) for cell, rows in ours.items())
    print(f"\nCPU seconds a section, median: {seconds[0]:.3f} / {seconds[1]:.3f}; thesis 36.35", end="")
    print(f"; sections that the thesis' method refused: {refused}")


if __name__ == "__main__":
    main()
