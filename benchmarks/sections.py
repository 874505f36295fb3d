"""Section profiles over the thesis' grid of noise and point spacing, beside its tables 4.3, 4.4 and 4.5.

    python -m benchmarks.sections [--draws 10] [--noise 0.015] [--spacing 0.1]

The blade is re-made from the thesis' words (4.4.1): 45 x 105 mm, 25 deg of twist, a sinusoid of random
amplitude up to 0.005 mm around every section, and 0.09 mm on both sides near the tip; sections at 7, 52.5
and 98 mm. Noise is N(0, sigma) along a random direction, so sigma / sqrt(3) along the normal, as in the
thesis. Figures are the largest of all draws and sections. The thesis used 36.35 s a section (table 4.2).
"""

import argparse
import time
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from geometry.chart import SectionSettings, unroll
from geometry.curve import centroid, orientation
from geometry.profile import Scan, reconstruct
from geometry.types import Floats
from tests.geometry.airfoils import AnalyticNominal, Blade, Part

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


def one(
    part: Part, nominal: AnalyticNominal, z: float, noise: float, spacing: float, rng: np.random.Generator
) -> tuple[float, float, float, float]:
    """Largest profile error, centroid error, orientation error (deg) and seconds of one section."""
    settings = SectionSettings()
    low, high = max(0.0, z - settings.band_mm), min(105.0, z + settings.band_mm)
    points = part.scan(rng, low, high, spacing, noise)
    count = len(points)
    scan = Scan(points_mm=points, sigma_mm=np.full(count, noise), mask=np.zeros(count, bool))
    start = time.perf_counter()
    chart = unroll(nominal, z, settings.band_mm, settings)
    profile = reconstruct(scan, chart, settings)
    seconds = time.perf_counter() - start
    true = part.section(z)
    turns = [orientation(curve, chart.curve_mm).value for curve in (profile.curve_mm, true)]
    return (
        float(distance_to(true, profile.curve_mm).max()),
        float(np.linalg.norm(centroid(profile.curve_mm) - centroid(true))),
        float(np.rad2deg(abs(turns[0] - turns[1]))),
        seconds,
    )


def table(title: str, thesis: tuple[tuple[float, ...], ...], found: dict[tuple[float, float], float]) -> None:
    print(f"\n{title}: thesis / here\n  spacing  " + "".join(f"noise {n:.3f}         " for n in NOISES_MM))
    for i, spacing in enumerate(SPACINGS_MM):
        cells = [
            f"{thesis[i][j]:.6f}/{found[noise, spacing]:.6f}" if (noise, spacing) in found else " " * 17
            for j, noise in enumerate(NOISES_MM)
        ]
        print(f"  {spacing:.3f}    " + "   ".join(cells))


def main() -> None:
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--draws", type=int, default=10)
    arguments.add_argument("--noise", type=float, nargs="*", default=NOISES_MM)
    arguments.add_argument("--spacing", type=float, nargs="*", default=SPACINGS_MM)
    asked = arguments.parse_args()
    part = in_service_blade(np.random.default_rng(0))
    nominal = AnalyticNominal(part.blade)
    one(part, nominal, 52.5, 0.01, 0.3, np.random.default_rng(0))
    worst: list[dict[tuple[float, float], float]] = [{}, {}, {}]
    seconds = []
    for noise in asked.noise:
        for spacing in asked.spacing:
            rows = [
                one(part, nominal, z, noise, spacing, np.random.default_rng(draw))
                for z in HEIGHTS_MM
                for draw in range(asked.draws)
            ]
            seconds += [row[3] for row in rows]
            for found, value in zip(worst, np.max(rows, axis=0), strict=False):
                found[noise, spacing] = float(value)
    for (title, thesis), found in zip(THESIS.items(), worst, strict=True):
        table(title, thesis, found)
    print(f"\nseconds a section: median {np.median(seconds):.3f}, thesis 36.35")


if __name__ == "__main__":
    main()
