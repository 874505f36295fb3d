"""The thesis' own section reconstruction over its grid of noise and spacing, beside its tables 4.3 to 4.5.

    python -m benchmarks.thesis_sections [--draws 10] [--noise 0.015] [--spacing 0.1]

Blade, heights, noise and figures are those of `benchmarks.sections`. The last tables hold what noise alone
does to centroid and orientation on this blade: their standard deviation when every point of the slab
takes part in a profile whose form is known, and what the largest of as many draws then is. No method that
sees one slab only can be better: where the thesis' own figure is less than that, its points were other
than its words say. Points fall at random here, so that edges are left bare for a millimetre, where an even
sampling leaves none. The thesis used 36.35 s for 1,685 points (table 4.2).
"""

import argparse
import time

import numpy as np

from benchmarks.sections import (
    HEIGHTS_MM,
    NOISES_MM,
    SPACINGS_MM,
    THESIS,
    Cells,
    distance_to,
    in_service_blade,
    largest_of,
    table,
)
from geometry.errors import CannotMeasure
from geometry.sections.chart import SectionSettings, unroll
from geometry.sections.curve import centroid, centroid_gradient, node_shares, orientation
from geometry.thesis.rwlls_profile import reconstruct_thesis
from geometry.thesis.rwlls_sections import trace
from geometry.types import Floats
from tests.geometry.airfoils import AnalyticNominal, Part

NEAR_MM = 1.0


def one(
    part: Part, nominal: AnalyticNominal, z: float, noise: float, spacing: float, rng: np.random.Generator
) -> tuple[float, ...]:
    """Largest profile, centroid and orientation (deg) error, what noise alone does to these two, seconds."""
    points = part.scan(rng, max(0.0, z - NEAR_MM), min(105.0, z + NEAR_MM), spacing, noise)
    start = time.process_time()
    profile = reconstruct_thesis(points, z, noise / np.sqrt(3.0))
    curve = profile.curve_mm(np.arange(4096) / 4096)
    seconds = time.process_time() - start
    true, chart = part.section(z), unroll(nominal, z, NEAR_MM, SectionSettings())
    traced = trace(profile, points, chart).curve_mm
    turn = orientation(traced, chart.curve_mm).value - orientation(true, nominal.section(z).curve_mm).value
    alone = noise_alone(traced, chart.curve_mm, noise / np.sqrt(3.0), len(profile.thinned.points_mm))
    return (
        float(distance_to(true, curve).max()),
        float(np.linalg.norm(centroid(curve) - centroid(true))),
        float(np.rad2deg(abs(turn))),
        *alone,
        seconds,
    )


def noise_alone(curve: Floats, nominal: Floats, sigma: float, points: int) -> tuple[float, float]:
    """Standard deviation of centroid (mm, both axes) and orientation (deg) from `points` on a known form."""
    share = node_shares(curve)
    each = share.sum() / points
    x, y = centroid_gradient(curve)
    turn = orientation(curve, nominal).gradient
    variances = [float((g**2 / share).sum()) * each * sigma**2 for g in (x, y, turn)]
    return float(np.sqrt(variances[0] + variances[1])), float(np.rad2deg(np.sqrt(variances[2])))


def against_noise(
    title: str, thesis: tuple[tuple[float, ...], ...], found: Cells, alone: Cells, draws: int
) -> None:
    """Prints what noise alone does beside what the thesis states and what was found here."""
    most = largest_of(draws)
    print(f"\n{title}: one standard deviation of what noise alone does, the largest of {draws} such draws")
    print("  spacing  noise  alone     largest   thesis    here      here / largest")
    for (noise, spacing), sigma in sorted(alone.items(), key=lambda item: item[0][::-1]):
        stated = thesis[SPACINGS_MM.index(spacing)][NOISES_MM.index(noise)]
        here, bound = found[noise, spacing], most * sigma
        figures = f"{sigma:.6f}  {bound:.6f}  {stated:.6f}  {here:.6f}  {here / bound:.2f}"
        print(f"  {spacing:.3f}    {noise:.3f}  {figures}")


def main() -> None:
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--draws", type=int, default=10)
    arguments.add_argument("--noise", type=float, nargs="*", default=NOISES_MM)
    arguments.add_argument("--spacing", type=float, nargs="*", default=SPACINGS_MM)
    asked = arguments.parse_args()
    part = in_service_blade(np.random.default_rng(0))
    nominal = AnalyticNominal(part.blade)
    one(part, nominal, 52.5, 0.01, 0.2, np.random.default_rng(0))
    found: list[dict[tuple[float, float], float]] = [{} for _ in range(5)]
    seconds, refused = [], 0
    for noise in asked.noise:
        for spacing in asked.spacing:
            rows = []
            for z in HEIGHTS_MM:
                for draw in range(asked.draws):
                    try:
                        rows.append(one(part, nominal, z, noise, spacing, np.random.default_rng(draw)))
                    except CannotMeasure:
                        refused += 1
            seconds += [row[5] for row in rows]
            for cell, values in zip(found, np.array(rows).T[:5], strict=True):
                cell[noise, spacing] = float(values.max())
    for (title, thesis), cell in zip(THESIS.items(), found[:3], strict=True):
        table(title, thesis, cell)
    figures = list(THESIS.values())[1:]
    for title, thesis, cell, alone in zip(
        ("centroid, mm", "orientation, deg"), figures, found[1:3], found[3:], strict=True
    ):
        against_noise(title, thesis, cell, alone, len(HEIGHTS_MM) * asked.draws)
    print(f"\nrefused {refused}; CPU seconds a section: median {np.median(seconds):.3f}, thesis 36.35")


if __name__ == "__main__":
    main()
