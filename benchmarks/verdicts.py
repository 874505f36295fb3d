"""Verdicts of the whole product against the truth: random parts, scanned, inspected from their files.

    python -m benchmarks.verdicts [parts] [first seed] [--real] [--rework]

Each part is a blade worn at random, from half to three times what the presets allow, with up to three
damages whose sizes are drawn on a logarithmic scale across both limits of their zone, so that many true
values lie near a limit. Twelve views with a calibrated axis are merged, written, and inspected by
`station.inspect` as a file from anywhere would be. The truth is what a perfect measurement would decide;
where the scan has a larger gap than the plan allows, it is SCRAP or HOLD.

With `--real` the nominals are a turbine blade and two compressor rows in turn, where their geometry is
here; sizes go with the chord.

With `--rework` parts have metal put on and bent as well: beads on a side and on the leading edge, a bent
corner of the tip.

HOLD is always allowed: near a limit it is the only honest word. Its reasons are listed, with how far the
truth lies from the limit that it is nearest to, in shares of that limit. Any other word that is not the
truth is wrong, and there must be none.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simulators.beads import edge_bead, side_bead
from simulators.bends import Bend
from simulators.blade import Wear
from simulators.cutters import Cut, edge_nick, eroded_edge, pit, tip_corner
from simulators.optics import OpticsSettings
from simulators.parts import SimPart, assemble
from simulators.presets import nominal_blade, serial_of
from simulators.recipe import recipe_of
from simulators.solids import NotASolid
from simulators.synth import write_scanned
from simulators.wear import NominalBlade, WornBlade, worn_blade
from station.inspect import inspect_scan
from tests.geometry import real_parts as real

VIEWS = 12
WORDS = ("PASS", "REPAIR", "SCRAP", "HOLD")


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """One part: what it is, what it was called and why."""

    seed: int
    truth: str
    word: str
    reasons: tuple[str, ...]
    clear: float  # of the nearest limit, as a share of it
    removed_mm3: float
    seconds: float

    @property
    def wrong(self) -> bool:
        return self.word not in (self.truth, "HOLD")


def random_part(blade: NominalBlade, seed: int, rework: bool = False) -> SimPart:
    """A part with wear and damages of any size that a plan is about."""
    rng, more = np.random.default_rng([seed, 11]), np.random.default_rng([seed, 13])
    size = recipe_of(blade).scale
    worn = worn_blade(blade, random_wear(rng, size))
    while True:
        cuts = random_cuts(worn, rng, size)
        beads = random_beads(worn, more, size) if rework else []
        bends = random_bends(more, size) if rework and all(cut.zone != "tip" for cut in cuts) else []
        try:
            return assemble(
                blade,
                worn,
                cuts + beads,
                bends,
                preset="random",
                serial=serial_of(seed, 0),
                seed=seed,
                optics=OpticsSettings(noise_normal_mm=rng.uniform(0.005, 0.015)),
                rng=rng,
            )
        except NotASolid:  # a cut that misses the blade: draw again
            continue


def random_wear(rng: np.random.Generator, size: float) -> Wear:
    much = np.exp(rng.uniform(np.log(0.5), np.log(3.0)))
    return Wear(
        wave_mm=0.005,
        bump_mm=float(0.06 * much * size),
        bend_mm=float(rng.uniform(-0.08, 0.08) * much * size),
        untwist_deg=float(rng.uniform(-0.15, 0.15) * much),
        seed=int(rng.integers(2**31)),
    )


def random_cuts(worn: WornBlade, rng: np.random.Generator, size: float) -> list[Cut]:
    """Each of four kinds of damage with a chance of two in five, in places that do not overlap."""
    depth = {"tip": (0.6, 18.0), "leading": (0.2, 3.0), "trailing": (0.2, 3.0), "pit": (0.15, 2.5)}
    chosen = {kind: size * logarithmic(rng, *range_) for kind, range_ in depth.items() if rng.random() < 0.4}
    eroded = rng.random() < 0.3
    makers = {
        "tip": lambda d: tip_corner(worn.airfoil, d, rng.uniform(0.4, 0.8), rng),
        "leading": lambda d: (
            eroded_edge(worn.airfoil, "leading_edge", (rng.uniform(0.1, 0.3), rng.uniform(0.5, 0.8)), d, rng)
            if eroded
            else edge_nick(worn.airfoil, "leading_edge", rng.uniform(0.25, 0.7), d, 3.0 * size + 3.0 * d, rng)
        ),
        "trailing": lambda d: edge_nick(
            worn.airfoil, "trailing_edge", rng.uniform(0.25, 0.6), d, 3.0 * size + 3.0 * d, rng
        ),
        "pit": lambda d: pit(
            worn.airfoil, rng.uniform(0.25, 0.7), rng.uniform(0.4, 0.6), d, 1.5 * size + 2.0 * d, rng
        ),
    }
    return [makers[kind](depth_mm) for kind, depth_mm in chosen.items()]


def random_beads(worn: WornBlade, rng: np.random.Generator, size: float) -> list[Cut]:
    """Either kind with a chance of two in five, off the other damages."""
    heights = [size * logarithmic(rng, 0.1, 3.0) if rng.random() < 0.4 else 0.0 for _ in range(2)]
    radii = [size + height for height in heights]
    beads = []
    if heights[0]:
        at = rng.uniform(0.25, 0.7), rng.uniform(0.3, 0.7)
        beads.append(side_bead(worn.airfoil, *at, heights[0], radii[0]))
    if heights[1]:
        beads.append(edge_bead(worn.airfoil, "leading_edge", rng.uniform(0.8, 0.88), heights[1], radii[1]))
    return beads


def random_bends(rng: np.random.Generator, size: float) -> list[Bend]:
    """A bent corner every other time."""
    if rng.random() < 0.5:
        return []
    length_mm, depth_mm = size * rng.uniform(5.0, 15.0), logarithmic(rng, 0.1, 3.0)
    return [Bend(length_mm=length_mm, chord_fraction=rng.uniform(0.5, 0.8), depth_mm=depth_mm)]


def logarithmic(rng: np.random.Generator, least: float, most: float) -> float:
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def judged(blade: NominalBlade, seed: int, folder: Path, rework: bool) -> Judged:
    """The part of a seed, inspected from its files in `folder`."""
    part = random_part(blade, seed, rework)
    truth = write_scanned(folder, blade, part, VIEWS, seed)
    started_s = time.process_time()
    inspection = inspect_scan(
        folder / "plan.toml",
        folder / "scan.ply",
        folder / "out",
        serial=part.serial,
        clock=time.monotonic,
        progress=lambda step: None,
    )
    return Judged(
        seed=seed,
        truth=truth["verdict"],
        word=str(inspection.verdict.verdict),
        reasons=inspection.verdict.reasons,
        clear=clearance(part),
        removed_mm3=truth["removed_mm3"],
        seconds=time.process_time() - started_s,
    )


def clearance(part: SimPart) -> float:
    """How near the nearest true value lies to one of its limits, as a share of that limit."""
    return min(abs(f.value / limit - 1.0) for f in part.judged for limit in (f.serviceable, f.repairable))


def show(parts: list[Judged]) -> None:
    """The table of truths and words, every HOLD's first reason, every wrong word."""
    counts = Counter((part.truth, part.word) for part in parts)
    print(f"\n{'truth':8}" + "".join(f"{word:>8}" for word in WORDS))
    for truth in WORDS:
        print(f"{truth:8}" + "".join(f"{counts[truth, word]:8d}" for word in WORDS))
    wrong = [part for part in parts if part.wrong]
    print(f"{len(wrong)} wrong of {len(parts)}; {np.mean([part.seconds for part in parts]):.1f} CPU s a part")


def nominals(real_parts: bool) -> list[NominalBlade]:
    """The part numbers whose parts take turns."""
    if not real_parts:
        return [nominal_blade(None)]
    return list(real.part_numbers().values()) if real.present() else []


def main() -> int:
    """How many verdicts were wrong."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    arguments.add_argument("parts", type=int, nargs="?", default=6)
    arguments.add_argument("first", type=int, nargs="?", default=0)
    arguments.add_argument("--real", action="store_true")
    arguments.add_argument("--rework", action="store_true")
    asked = arguments.parse_args()
    blades = nominals(asked.real)
    if not blades:
        print("skipped: the real parts are not beside the project")
        return 0
    done = []
    print(f"{'seed':>5} {'truth':7}{'word':7} {'clear %':>7} {'mm3':>8}  why, where it is not the truth")
    for seed in range(asked.first, asked.first + asked.parts):
        with tempfile.TemporaryDirectory() as folder:
            done.append(judged(blades[seed % len(blades)], seed, Path(folder), asked.rework))
        part = done[-1]
        why = "" if part.word == part.truth else "; ".join(part.reasons[:2])
        print(
            f"{seed:5d} {part.truth:7}{part.word:7} {100.0 * part.clear:7.1f} {part.removed_mm3:8.2f}  {why}",
            flush=True,
        )
    show(done)
    return sum(part.wrong for part in done)


if __name__ == "__main__":
    sys.exit(main())
