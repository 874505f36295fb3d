"""What a section's measurands are worth: sigmas, time, generated airfoils, engeom on the same curves.

    python -m benchmarks.sections [--part ratios speed airfoils engeom] [--ratios 200] [--airfoils 2000]

- ratios: spread of error over stated sigma of every measurand, over random form, motion and sampling;
- speed: 20 sections of 950,000 points, and one alone;
- airfoils: discs along a camber line, every measurand of each: failures, edges swapped, errors;
- engeom: an open implementation that takes ordered curves.
"""

import argparse
import time
from functools import cache

import numpy as np

from geometry.blade.nominal import NominalSection
from geometry.errors import GeometryError
from geometry.sections.airfoil import measure_sections
from geometry.sections.chart import SectionSettings, unroll
from geometry.sections.curve import (
    camber_line,
    edge,
    edge_radius,
    node_shares,
    thick_part,
    thickness,
)
from geometry.sections.measurands import define, form, place, shape
from geometry.types import Floats, Measurand
from tests.geometry.airfoils import (
    AnalyticNominal,
    Blade,
    DiscAirfoil,
    Part,
    alignment,
    cloud_of,
    random_airfoil,
    section_of,
)

PERFECT = alignment()


@cache
def true_nodes(part: Part, z: float) -> Floats:
    """The true section on the nodes of the nominal one."""
    return unroll(TrueNominal(part), z, 0.5, SectionSettings()).curve_mm


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
    arguments.add_argument("--part", choices=("ratios", "speed", "airfoils", "engeom"), nargs="*")
    arguments.add_argument("--ratios", type=int, default=200, help="draws of error over sigma")
    arguments.add_argument("--airfoils", type=int, default=2000)
    arguments.add_argument("--seed", type=int, default=0, help="of the airfoils")
    asked = arguments.parse_args()
    parts = {
        "ratios": lambda: ratios(asked.ratios),
        "speed": speed,
        "airfoils": lambda: campaign(asked.airfoils, asked.seed),
        "engeom": peer,
    }
    for name in asked.part or parts:
        parts[name]()


if __name__ == "__main__":
    main()
