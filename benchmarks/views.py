"""Volumes of repair patches from simulated captures: occlusion, flying points, a calibrated axis and wear.

    python -m benchmarks.views [seeds]

The simulated cell takes twelve views of a worn blade from which an exact solid was subtracted; the chain of
the product runs over them from fusing to repair. Noise is the standard deviation along the normal; an axis
as a calibration gives it is 0.003 mm and 0.002 deg off. Asked: 1 % of the volume, 2 % below 5 mm3.

Columns: true volume with the first seed; error of the volume in percent, mean and worst over the seeds; worst
of the second method; worst error in stated sigmas; patches that a solid modeller takes as closed and
oriented; why there is none. Last: damages told beyond those made, and seconds of one thread from views to
patches.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import manifold3d
import numpy as np

from geometry.damage.damages import DamageKind
from geometry.errors import CannotMeasure
from geometry.types import Mesh
from simulators.cutters import edge_nick, pit, tip_corner, tip_loss
from simulators.damage_solids import DamageTruth
from simulators.presets import nominal_blade
from tests.geometry.captures import Cutter, Inspected, capture, inspect, nominal_of

NOISES_MM = (0.0, 0.02)
DAMAGES: dict[str, Cutter] = {
    "tip corner, 3 mm": lambda worn, rng: tip_corner(worn.airfoil, 3.0, 0.8, rng),
    "tip corner, 6 mm": lambda worn, rng: tip_corner(worn.airfoil, 6.0, 0.65, rng),
    "tip corner, 12 mm": lambda worn, rng: tip_corner(worn.airfoil, 12.0, 0.5, rng),
    "tip corner, 16 mm": lambda worn, rng: tip_corner(worn.airfoil, 16.0, 0.4, rng),
    "whole tip, 3 mm": lambda worn, rng: tip_loss(worn.airfoil, 3.0, rng),
    "leading edge, 1 mm": lambda worn, rng: edge_nick(worn.airfoil, "leading_edge", 0.6, 1.0, 5.0, rng),
    "leading edge, 2 mm": lambda worn, rng: edge_nick(worn.airfoil, "leading_edge", 0.5, 2.0, 8.0, rng),
    "trailing edge, 2 mm": lambda worn, rng: edge_nick(worn.airfoil, "trailing_edge", 0.5, 2.0, 8.0, rng),
    "trailing edge, 4 mm": lambda worn, rng: edge_nick(worn.airfoil, "trailing_edge", 0.4, 4.0, 14.0, rng),
    "pit, 0.5 mm": lambda worn, rng: pit(worn.airfoil, 0.4, 0.5, 0.5, 2.0, rng),
    "pit, 0.9 mm": lambda worn, rng: pit(worn.airfoil, 0.4, 0.5, 0.9, 3.0, rng),
    "pit, 1.5 mm": lambda worn, rng: pit(worn.airfoil, 0.35, 0.45, 1.5, 4.5, rng),
}
PARTS = (  # damages that one blade bears
    ("tip corner, 3 mm", "leading edge, 1 mm", "trailing edge, 2 mm", "pit, 0.5 mm"),
    ("tip corner, 6 mm", "leading edge, 2 mm", "trailing edge, 4 mm", "pit, 0.9 mm"),
    ("tip corner, 12 mm", "pit, 1.5 mm"),
    ("tip corner, 16 mm",),
    ("whole tip, 3 mm",),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One damage as it was made, and its patch; what there is not is NaN."""

    name: str
    truth_mm3: float
    volume_mm3: float = np.nan
    check_mm3: float = np.nan
    sigma_mm3: float = np.nan
    closed: bool = False
    failure: str = ""

    @property
    def percent(self) -> float:
        return 100.0 * (self.volume_mm3 / self.truth_mm3 - 1.0)


def row_of(name: str, truth: DamageTruth, found: Inspected) -> Row:
    """The patch whose damage lies nearest to a damage as it was made."""
    missing = [i for i, damage in enumerate(found.damages) if damage.kind is DamageKind.MISSING]
    row = Row(name=name, truth_mm3=truth.volume_mm3)
    if not missing:
        return replace(row, failure="not found")
    off_mm = [np.linalg.norm(found.damages[i].centroid_mm - truth.centroid_mm) for i in missing]
    nearest = missing[int(np.argmin(off_mm))]
    patches = [patch for patch in found.repairs.patches if patch.damage == nearest]
    if not patches:
        return replace(row, failure=found.repairs.failures[nearest])
    patch = patches[0]
    return replace(
        row,
        volume_mm3=patch.volume_mm3.value,
        check_mm3=patch.volume_check_mm3,
        sigma_mm3=patch.volume_mm3.sigma,
        closed=is_closed(patch.mesh),
    )


def is_closed(mesh: Mesh) -> bool:
    """Whether manifold3d takes the mesh as an oriented manifold that encloses a volume."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.array(mesh.vertices_mm), np.array(mesh.faces, dtype=np.uint64))
    )
    return bool(solid.status() == manifold3d.Error.NoError and solid.volume() > 0.0)


def repaired(names: Sequence[str], noise_mm: float, seed: int) -> tuple[list[Row], int, float]:
    """The damages of one part, how many more were told than made, and its CPU seconds."""
    blade = nominal_blade(None)
    taken = capture(blade, [DAMAGES[name] for name in names], noise_mm, seed)
    truths = list(zip(names, taken.part.damages, strict=True))
    try:
        found = inspect(taken, nominal_of(blade), noise_mm)
    except CannotMeasure as why:
        return [Row(name=name, truth_mm3=t.volume_mm3, failure=str(why)) for name, t in truths], 0, np.nan
    told = sum(damage.kind is not DamageKind.DEFORMATION for damage in found.damages)
    return [row_of(name, truth, found) for name, truth in truths], told - len(truths), found.cpu_s


def show(noise_mm: float, rows: Sequence[Row]) -> None:
    """One line: the same damage over the seeds."""
    percent = np.array([row.percent for row in rows])
    check = np.array([100.0 * (row.check_mm3 / row.truth_mm3 - 1.0) for row in rows])
    sigmas = np.array([(row.volume_mm3 - row.truth_mm3) / row.sigma_mm3 for row in rows])
    made = np.isfinite(percent)
    mean = percent[made].mean() if made.any() else np.nan
    worst = [np.abs(x[made]).max(initial=0.0) for x in (percent, check, sigmas)]
    closed = sum(row.closed for row in rows)
    failures = "; ".join(sorted({row.failure for row in rows} - {""}))
    print(
        f"{rows[0].name:20} {noise_mm:6.3f} {rows[0].truth_mm3:8.2f} {mean:8.2f} {worst[0]:7.2f}"
        f" {worst[1]:10.2f} {worst[2]:9.1f} {closed:4d} of {len(rows)}  {failures}",
        flush=True,
    )


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    print(f"{'damage':20} {'noise':>6} {'mm3':>8} {'mean %':>8} {'worst %':>7} {'2nd method':>10} ", end="")
    print(f"{'in sigmas':>9} {'closed':>9}  failures")
    strange, spent_s = 0, []
    for noise_mm in NOISES_MM:
        for names in PARTS:
            parts = [repaired(names, noise_mm, seed) for seed in range(seeds)]
            for same in zip(*(rows for rows, _, _ in parts), strict=True):
                show(noise_mm, same)
            strange += sum(more for _, more, _ in parts)
            spent_s += [cpu_s for _, _, cpu_s in parts]
    print(f"{strange} damages told beyond those made; {np.nanmean(spent_s):.1f} CPU s a part")


if __name__ == "__main__":
    main()
