"""Volume error of repair patches over kinds and sizes of damage, noise and seeds; and their time.

python -m benchmarks.repair [seeds]
"""

import sys
from collections.abc import Callable
from time import process_time
from typing import Any

import numpy as np

from geometry.repair.patches import RepairSettings, find_repairs
from geometry.types import Zone
from tests.geometry import repair_blades as blades

NOISES_MM = (0.0, 0.02)
CASES: dict[str, tuple[Zone, Callable[[], Any]]] = {
    "tip corner, 3 mm": (Zone.TIP, lambda: blades.tip_corner_cutter(3.0)),
    "tip corner, 5 mm": (Zone.TIP, lambda: blades.tip_corner_cutter(5.0)),
    "tip corner, 8 mm": (Zone.TIP, lambda: blades.tip_corner_cutter(8.0)),
    "tip corner, 12 mm": (Zone.TIP, lambda: blades.tip_corner_cutter(12.0)),
    "tip corner, 8 mm, rough": (Zone.TIP, lambda: blades.tip_corner_cutter(8.0, 0.9)),
    "whole tip, 3 mm": (Zone.TIP, lambda: blades.tip_cutter(3.0)),
    "pit, 0.6 mm": (Zone.SURFACE, lambda: blades.pit_cutter(0.6)),
    "pit, 1.2 mm": (Zone.SURFACE, lambda: blades.pit_cutter(1.2)),
    "pit, 1.8 mm": (Zone.SURFACE, lambda: blades.pit_cutter(1.8, 3.5)),
    "dent running out, 0.8 mm": (Zone.SURFACE, blades.dent_cutter),
    "edge nick, 1 mm": (Zone.LEADING_EDGE, lambda: blades.edge_nick_cutter(1.0)),
    "edge nick, 2 mm": (Zone.LEADING_EDGE, lambda: blades.edge_nick_cutter(2.0)),
    "edge nick, 3.5 mm": (Zone.LEADING_EDGE, lambda: blades.edge_nick_cutter(3.5, 2.5)),
    "eroded edge, 0.3 mm": (Zone.LEADING_EDGE, lambda: blades.eroded_edge_cutter(0.3)),
    "eroded edge, 0.8 mm": (Zone.LEADING_EDGE, lambda: blades.eroded_edge_cutter(0.8)),
}


def measure(case: str, noise_mm: float, seed: int) -> tuple[float, float, float, float, float, str]:
    """True volume (mm3), errors of both methods (%), error in sigmas, CPU time (s), and what failed."""
    zone, cutter = CASES[case]
    scan = blades.specimen({zone: cutter()}, noise_mm, np.random.default_rng(seed))
    start_s = process_time()
    found = find_repairs(scan.twin, scan.cloud, scan.alignment, scan.damages, RepairSettings())
    spent_s = process_time() - start_s
    truth = scan.removed_mm3[0]
    if not found.patches:
        return truth, np.nan, np.nan, np.nan, spent_s, found.failures[0]
    patch = found.patches[0]
    error = patch.volume_mm3.value - truth
    check = patch.volume_check_mm3 - truth
    return truth, 100 * error / truth, 100 * check / truth, error / patch.volume_mm3.sigma, spent_s, ""


def main(seeds: int) -> None:
    measure("pit, 0.6 mm", 0.0, 0)  # kernels compiled
    print(f"{'damage':26} {'noise':>6} {'mm3':>8} {'error % mean':>13} {'worst':>7} ", end="")
    print(f"{'2nd method':>10} {'in sigmas':>9} {'CPU s':>6}  failures")
    for case in CASES:
        for noise_mm in NOISES_MM:
            rows = [measure(case, noise_mm, seed) for seed in range(seeds)]
            truth, error, check, ratio, spent_s = np.array([row[:5] for row in rows]).T
            good = np.isfinite(error)
            worst = [np.abs(x[good]).max() if good.any() else np.nan for x in (error, check, ratio)]
            mean = error[good].mean() if good.any() else np.nan
            print(f"{case:26} {noise_mm:6.3f} {truth[0]:8.2f} {mean:13.2f} {worst[0]:7.2f} ", end="")
            print(
                f"{worst[1]:10.2f} {worst[2]:9.1f} {spent_s.mean():6.2f}  {(~good).sum() or ''}", flush=True
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
