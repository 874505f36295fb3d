"""Depth of damages from dense scans to thin ones, and which hollows are found.

    python -m benchmarks.damage [seeds]

First table: blades cut exactly, 0.012 mm noise; 60 points a square millimetre are a whole scan, 12 and 3
every 5th and every 20th of its points. U = 2 sigma. Second: hollows with smooth rims beside a broken corner;
`width` in point spacings. Found is the share of the hollows with a damage of their own; recall the share of
the points that truly lie deeper than 3 sigmas of noise and 0.03 mm, false that of the sound points told to
lie on damage. Third: losses of tip and edges as deep as their detection limits, or a part of them; strange is
what else is told.
"""

import sys

import numpy as np

from geometry.damage.damages import find_damages
from geometry.damage.detection import HOLLOW_SPACINGS, detection_limit
from geometry.deformation.twin import TwinSettings, fit_twin
from geometry.types import Measurand, Zone
from tests.geometry import twin_blades as blades
from tests.geometry.airfoils import cloud_of
from tests.geometry.poses import in_place
from tests.geometry.test_damage_depth import CUTTERS, DENSITIES, NOISE_MM, number, one, truth
from tests.geometry.test_damage_detection import centres_of
from tests.geometry.test_damage_limits import found_at
from tests.geometry.test_twin import nominal

HOLLOWS = (  # depth in detection limits, width in spacings, pitch, noise
    (1.0, HOLLOW_SPACINGS, 0.4, 0.01),
    (1.0, HOLLOW_SPACINGS, 0.25, 0.012),
    (1.3, HOLLOW_SPACINGS, 0.4, 0.03),
    (1.3, 8.0, 0.4, 0.01),
)


def depths(seeds: int) -> None:
    print(f"{'damage':12} {'per mm2':>8} {'true':>7} {'mean error':>11} {'worst':>7} {'U':>6} {'worst/U':>8}")
    for name in CUTTERS:
        for per_mm2 in DENSITIES:
            found = [number(one(name, per_mm2, seed).depth_mm) for seed in range(seeds)]
            off_mm = np.array([depth.value - truth(name) for depth in found])
            U_mm = np.array([2.0 * depth.sigma for depth in found])
            worst_mm, ratio = np.abs(off_mm).max(), np.abs(off_mm / U_mm).max()
            print(f"{name:12} {per_mm2:8.0f} {truth(name):7.3f} {off_mm.mean():+11.3f} ", end="")
            print(f"{worst_mm:7.3f} {U_mm.mean():6.3f} {ratio:8.2f}", flush=True)


def hollows(limits: float, spacings: float, pitch_mm: float, noise_mm: float, seeds: int) -> None:
    """One line: hollows of so many detection limits, whose depth a first scan without any gives."""
    whole = blades.SHAPES["service"]
    truth_of = blades.Truth(whole)
    cuts, width_mm = (blades.tip_corner(),), spacings * pitch_mm
    depth_mm, found, recall, false = 0.0, [], [], []
    for seed in range(seeds + 1):
        centres = centres_of(whole, np.random.default_rng(seed))
        shape = blades.hollowed(whole, centres, depth_mm, width_mm)
        scan = blades.scan(truth_of, cuts, pitch_mm=pitch_mm, noise_mm=noise_mm, scanned=shape, seed=seed)
        cloud = cloud_of(scan.points, noise_mm)
        twin = fit_twin(cloud, scan.label > 0, in_place(), nominal(), TwinSettings())
        if not seed:
            limit = detection_limit(cloud, in_place(), nominal(), twin).depth_mm[Zone.SURFACE]
            assert isinstance(limit, Measurand)
            depth_mm = limits * limit.value
            continue
        damages = find_damages(cloud, scan.label > 0, in_place(), nominal(), twin)
        told = np.isin(np.arange(len(cloud)), np.concatenate([damage.points for damage in damages]))
        deep_mm = blades.hollow_depth(scan.points, centres, depth_mm, width_mm)
        broken_mm = scan.points[scan.label > 0]
        deep_mm[scan.label > 0] = np.minimum(-truth_of.distance(broken_mm), blades.SPAN_MM - broken_mm[:, 2])
        middles = np.array([damage.centroid_mm for damage in damages])
        apart_mm = np.linalg.norm(centres[:, None] - middles, axis=2).min(axis=1)
        found.append((apart_mm < 0.5 * width_mm).mean())
        recall.append(told[deep_mm > max(3.0 * noise_mm, 0.03)].mean())
        false.append(told[deep_mm < 1e-6].mean())
    shares = " ".join(f"{100 * np.mean(share):8.2f}" for share in (found, recall, false))
    print(
        f"{depth_mm:7.3f} {limits:7.1f} {spacings:7.0f} {pitch_mm:7.2f} {noise_mm:7.3f} {shares}", flush=True
    )


def limits(shares: float, per_mm2: float, noise_mm: float, seeds: int) -> None:
    """One line: losses of tip and edges as deep as so many of their limits, and the share that is found."""
    rows = [found_at(shares, per_mm2, noise_mm, seed) for seed in range(seeds)]
    for zone in (Zone.TIP, Zone.LEADING_EDGE, Zone.TRAILING_EDGE):
        hits = np.concatenate([found[zone] for _, found, _ in rows])
        print(f"{zone:14} {shares:5.1f} {per_mm2:8.0f} {noise_mm:7.3f} {rows[0][0][zone]:7.3f} ", end="")
        print(
            f"{100 * hits.mean():8.1f} of {len(hits):3d} {sum(strange for _, _, strange in rows):8d}",
            flush=True,
        )


def main(seeds: int) -> None:
    print(f"noise {NOISE_MM} mm")
    depths(seeds)
    print("\n  depth  limits   width   pitch   noise  found % recall %  false %")
    for row in HOLLOWS:
        hollows(*row, seeds)
    print(f"\n{'loss':14} {'of':>5} {'per mm2':>8} {'noise':>7} {'depth':>7} {'found %':>8} {'strange':>15}")
    for per_mm2, noise_mm in ((60.0, 0.01), (25.0, 0.01), (25.0, 0.05), (8.0, 0.02)):
        for shares in (1.0, 0.6):
            limits(shares, per_mm2, noise_mm, seeds)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
