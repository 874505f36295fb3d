"""Random poses and what may be wrong with a scan: right, refused, or confidently wrong.

    python -m benchmarks.poses [count per scenario, default 10] [seed, default 1]

Every scan is turned at random over all rotations and shifted by up to 200 mm; 3,000 to 8,000 points, with
noise and the form that service leaves. A pose is right if the surface lies within 0.05 mm of where the fit
to the points known to be sound puts it, or within four of the standard uncertainties that the alignment
states; it is accepted by the station's own gates. Accepted and not right is a failure, and the only one:
the exit status is their number. The blades: one with taper, and one that is nearly a screw.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.errors import CannotRegister
from geometry.registration.alignment import Alignment
from geometry.registration.register import register
from geometry.registration.uncertainty import certainty
from geometry.transforms import apply, inverse, log, rigid
from geometry.types import Cloud, Floats
from station.gates import ACCEPTANCE, pose_doubts
from tests.geometry import blades

TAPERED = blades.Blade()
SCREW = blades.Blade(taper=0.02, thickness_taper=0.05)
NOISE_MM = 0.012
PER_MM2 = 0.6
FORM_MM = 0.03
RIGHT_MM = 0.05
SIGMAS = 4.0

Maker = Callable[[blades.Scan, blades.Blade, np.random.Generator], blades.Scan]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One pose: accepted or not, right or not, and what it took."""

    seed: int
    doubts: tuple[str, ...]
    error_mm: float
    sigmas: float
    cpu_s: float

    @property
    def right(self) -> bool:
        return self.error_mm <= RIGHT_MM or self.sigmas <= SIGMAS

    @property
    def failed(self) -> bool:
        return not self.doubts and not self.right


@cache
def nominal_of(blade: blades.Blade) -> Nominal:
    settings = NominalSettings(z_min_mm=6.0, z_max_mm=blade.height_mm)
    return prepare_nominal(blades.mesh(blade), settings)


def whole(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    return scan


def damaged(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    """A dent, and part of the tip broken off."""
    centre_mm = blade.point(np.array([4.5]), np.array([rng.uniform(30.0, 70.0)]))[0]
    dented = blades.with_dent(scan, centre_mm, rng.uniform(2.0, 6.0), rng.uniform(0.5, 1.2))
    return blades.with_tip_cut(dented, blade, rng.uniform(4.0, 25.0), rng, rng.uniform(0.4, 1.2))


def without_quarter(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    return _below(scan, 0.75 * blade.height_mm, rng)


def without_half(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    return _below(scan, 0.5 * blade.height_mm, rng)


def _below(scan: blades.Scan, z_mm: float, rng: np.random.Generator) -> blades.Scan:
    """What is left under a ragged edge."""
    ragged_mm = z_mm + 2.0 * np.sin(0.7 * scan.points_mm[:, 0] + rng.uniform(0.0, 6.0))
    return _chosen(scan, scan.points_mm[:, 2] < ragged_mm)


def one_sided(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    """What a scanner sees that looks across the chord, within 75 degrees of square."""
    turn = rng.choice([-1.0, 1.0]) * np.pi / 2 + rng.uniform(-0.3, 0.3)
    look = np.array([np.cos(turn), np.sin(turn), 0.3])
    return _chosen(scan, scan.normals @ look > np.cos(np.radians(75.0)) * np.linalg.norm(look))


def cluttered(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    """A clamp round the root: half as many points as the blade has."""
    count = len(scan.points_mm) // 2
    block_mm = rng.uniform([-30.0, -20.0, -25.0], [30.0, 20.0, 0.0], (count, 3))
    axis = rng.integers(0, 3, count)
    sign = np.where(axis == 2, 0.0, rng.choice([-1.0, 1.0], count) * np.array([30.0, 20.0, 0.0])[axis])
    block_mm[np.arange(count), axis] = sign
    return _with(scan, block_mm)


def with_outliers(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    """One point in twenty anywhere around."""
    count = len(scan.points_mm) // 20
    return _with(scan, rng.uniform([-40.0, -30.0, -10.0], [40.0, 30.0, 120.0], (count, 3)))


def several(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    """One of each: what is missing of the blade, what of it is seen, what else is in the scan."""
    for makers in (
        (whole, damaged, without_quarter),
        (whole, one_sided, with_hole),
        (whole, gripped, with_outliers),
    ):
        scan = makers[rng.integers(len(makers))](scan, blade, rng)
    return scan


def with_hole(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    """A patch of 3 to 15 mm radius that no view saw."""
    centre_mm = blade.point(rng.uniform(0.0, 2.0 * np.pi, 1), rng.uniform(20.0, 90.0, 1))[0]
    apart_mm = np.linalg.norm(scan.points_mm - centre_mm, axis=1)
    return _chosen(scan, apart_mm > rng.uniform(3.0, 15.0))


def gripped(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    """The same clamp, its top up to 3 mm below or above the end of the blade."""
    count = len(scan.points_mm)
    clamp_mm = cluttered(scan, blade, rng).points_mm[count:]
    return _with(scan, clamp_mm + np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]))


def _chosen(scan: blades.Scan, kept: np.ndarray) -> blades.Scan:
    return blades.Scan(
        points_mm=scan.points_mm[kept], normals=scan.normals[kept], depth_mm=scan.depth_mm[kept]
    )


def _with(scan: blades.Scan, points_mm: Floats) -> blades.Scan:
    """The scan and points that are none of the blade's."""
    return blades.Scan(
        points_mm=np.concatenate([scan.points_mm, points_mm]),
        normals=np.concatenate([scan.normals, np.zeros_like(points_mm)]),
        depth_mm=np.concatenate([scan.depth_mm, np.full(len(points_mm), np.inf)]),
    )


SCENARIOS: dict[str, Maker] = {
    "whole": whole,
    "damaged": damaged,
    "top quarter missing": without_quarter,
    "top half missing": without_half,
    "one side seen": one_sided,
    "clamp in the scan": cluttered,
    "5 % outliers": with_outliers,
    "several at once": several,
}


def worn(scan: blades.Scan, blade: blades.Blade, rng: np.random.Generator) -> blades.Scan:
    """The form of service on sides: long waves, apart on the two sides, and the same on both."""
    x, _, z = scan.points_mm.T
    phase, size = rng.uniform(0.0, 2.0 * np.pi, 4), rng.uniform(0.3, 1.0, 2) * FORM_MM
    side = np.sign(scan.normals[:, 1] + 1e-12)
    apart = size[0] * np.sin(0.25 * x + 0.1 * z + phase[0])
    together = size[1] * side * np.cos(0.12 * z + phase[1]) * np.sin(0.2 * x + phase[2])
    wave_mm = np.where(scan.normals[:, 2] > 0.9, 0.0, apart + together)
    return replace(scan, points_mm=scan.points_mm + wave_mm[:, None] * scan.normals)


def outcome(make: Maker, blade: blades.Blade, seed: int) -> Outcome:
    """One random pose of one scan, registered and judged."""
    rng = np.random.default_rng(seed)
    scan = make(blades.scan(blade, PER_MM2, rng), blade, rng)
    scan = blades.with_noise(worn(scan, blade, rng), NOISE_MM, rng)
    T_true = rigid(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-200.0, 200.0, 3))
    points_mm = rng.permutation(apply(inverse(T_true), scan.points_mm))
    count = len(points_mm)
    cloud = Cloud(points_mm=points_mm, sigma_mm=np.full(count, NOISE_MM), view=np.zeros(count, np.int64))
    begun_s = time.process_time()
    try:
        alignment = register(cloud, nominal_of(blade))
    except CannotRegister as why:
        return Outcome(
            seed=seed, doubts=(str(why),), error_mm=np.inf, sigmas=np.inf, cpu_s=time.process_time() - begun_s
        )
    cpu_s = time.process_time() - begun_s
    error_mm, sigmas = distance(alignment, T_true, nominal_of(blade))
    doubts = tuple(pose_doubts(alignment, ACCEPTANCE))
    return Outcome(seed=seed, doubts=doubts, error_mm=error_mm, sigmas=sigmas, cpu_s=cpu_s)


def distance(alignment: Alignment, T_true: Floats, nominal: Nominal) -> tuple[float, float]:
    """Largest displacement of the surface from the truth, and the largest error in sigmas of its motion."""
    off = alignment.T_nominal_scan @ inverse(T_true)
    moved_mm = apply(off, nominal.samples.points_mm) - nominal.samples.points_mm
    known = certainty(nominal, alignment.information, alignment.form_covariance)
    along_mm = np.linalg.solve(known.twists, log(off, nominal.pivot_mm))
    return float(np.linalg.norm(moved_mm, axis=1).max()), float(np.abs(along_mm / known.sigma_mm).max())


def main() -> int:
    """The number of poses that were accepted and wrong."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    arguments.add_argument("count", type=int, nargs="?", default=10)
    arguments.add_argument("seed", type=int, nargs="?", default=1)
    asked = arguments.parse_args()
    outcome(whole, TAPERED, 0)  # compiles the kernels
    failures = 0
    print(f"{asked.count} random poses a row, seed {asked.seed}")
    print(
        f"  {'blade, scenario':32s} {'right':>6s} {'HOLD':>6s} {'wrong':>6s} {'error mm, median':>17s}"
        f" {'largest':>8s} {'CPU s':>6s}"
    )
    for label, blade in (("tapered", TAPERED), ("near screw", SCREW)):
        for name, make in SCENARIOS.items():
            found = [outcome(make, blade, 100_000 * asked.seed + i) for i in range(asked.count)]
            failures += show(f"{label}, {name}", found)
    print(f"{failures} accepted and wrong")
    return failures


def show(label: str, found: list[Outcome]) -> int:
    """Print one row; the number of failures in it."""
    accepted = [one for one in found if not one.doubts]
    failed = [one for one in found if one.failed]
    errors_mm = [one.error_mm for one in accepted] or [np.nan]
    print(
        f"  {label:32s} {len(accepted) - len(failed):6d} {len(found) - len(accepted):6d} {len(failed):6d}"
        f" {np.median(errors_mm):17.4f} {max(errors_mm):8.4f} {np.mean([one.cpu_s for one in found]):6.2f}",
        flush=True,
    )
    for one in failed:
        print(f"    seed {one.seed}: {one.error_mm:.3f} mm off, {one.sigmas:.1f} sigmas", flush=True)
    return len(failed)


if __name__ == "__main__":
    sys.exit(min(main(), 99))
