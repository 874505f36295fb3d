"""A damaged blade with its ground truth: plan.toml, nominal.stl, scan.ply and truth.json in one folder.

    python -m simulators.synth --out DIR [--preset NAME] [--nominal FILE] [--seed S] ...

The scan is what the simulated cell would merge: the views of the rig, turned back into the table frame
with the calibrated axis (not the true one), in random order.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from simulators.blade import Wear
from simulators.calibration_file import calibrated_axis
from simulators.optics import OpticsSettings
from simulators.parts import SimPart, assemble
from simulators.preset_names import PRESETS, preset_named
from simulators.presets import (
    broken_corner,
    make_part,
    nominal_blade,
    repairable_nick,
    repairable_pit,
    rig_of,
    serial_of,
    service_wear,
)
from simulators.recipe import SIGMA_MM, write_plan
from simulators.rig import Rig, about_z, apply, inverse
from simulators.solids import Floats, NotASolid, Solid, face_normals, write_point_ply
from simulators.wear import NominalBlade, worn_blade

DAMAGES = {"tip": broken_corner, "edge": repairable_nick, "pit": repairable_pit}
MAX_GAP_MM = 1.5
SAMPLE_MM = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What is to be made."""

    preset: str
    seed: int
    noise_mm: float
    views: int
    damages: tuple[str, ...] | None
    form_error: bool


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status: 0, or 2 after one line on stderr."""
    options = _parser().parse_args(arguments)
    try:
        order = _order(options)
        nominal = None if options.nominal is None else Path(options.nominal)
        blade = nominal_blade(nominal, options.z_min_mm, options.z_max_mm)
        synthesise(Path(options.out), blade, order)
    except (NotASolid, ValueError, OSError) as fault:
        sys.stderr.write(f"synth: {fault}\n")
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="synth", description=__doc__.partition("\n")[0])
    parser.add_argument("--out", required=True, metavar="DIR")
    parser.add_argument("--preset", default="REPAIR", metavar="NAME", help=", ".join(PRESETS))
    parser.add_argument("--nominal", metavar="FILE", help="any closed blade mesh, span along +Z, in mm")
    parser.add_argument("--seed", type=int, default=0, metavar="S")
    parser.add_argument("--noise-mm", type=float, default=0.012, metavar="X", help="along the normal")
    parser.add_argument("--views", type=int, default=12, metavar="N")
    parser.add_argument("--z-min-mm", type=float, metavar="A", help="where the airfoil begins")
    parser.add_argument("--z-max-mm", type=float, metavar="B", help="where it ends")
    parser.add_argument("--damage", metavar="LIST", help=f"of {','.join(DAMAGES)}, or none")
    parser.add_argument("--no-form-error", action="store_true", help="undamaged form as drawn")
    return parser


def _order(options: argparse.Namespace) -> Order:
    kinds = None
    if options.damage is not None:
        kinds = tuple(kind for kind in options.damage.split(",") if kind not in ("", "none"))
        strange = [kind for kind in kinds if kind not in DAMAGES]
        if strange:
            raise ValueError(f"--damage {strange[0]!r} is none of {', '.join(DAMAGES)}")
    if options.views < 1 or options.seed < 0:
        raise ValueError("--views is at least 1 and --seed at least 0")
    if not (isfinite(options.noise_mm) and options.noise_mm >= 0.0):
        raise ValueError("--noise-mm is zero or more")
    return Order(
        preset=preset_named(options.preset),
        seed=options.seed,
        noise_mm=options.noise_mm,
        views=options.views,
        damages=kinds,
        form_error=not options.no_form_error,
    )


def synthesise(folder: Path, blade: NominalBlade, order: Order) -> dict[str, Any]:
    """Make the part, scan it, write the four files into `folder`; returns the truth."""
    return write_scanned(folder, blade, ordered_part(blade, order), order.views, order.seed)


def write_scanned(folder: Path, blade: NominalBlade, part: SimPart, views: int, seed: int) -> dict[str, Any]:
    """Scan the part and write the four files into `folder`; returns the truth."""
    scan = merged_scan(part, rig_of(blade, seed), views, seed)
    gap_mm = largest_gap_mm(part.solid, blade, scan, part.T_table_part)
    truth = part.truth_when(hidden=gap_mm > MAX_GAP_MM)
    truth |= {"largest_gap_mm": gap_mm, "views": views, "points": len(scan)}
    write_plan(folder, blade, sigma_mm=max(SIGMA_MM, part.optics.noise_normal_mm))
    write_point_ply(folder / "scan.ply", scan)
    text = json.dumps(truth, indent=1, allow_nan=False)
    (folder / "truth.json").write_text(text + "\n", encoding="utf-8")
    return truth


def ordered_part(blade: NominalBlade, order: Order) -> SimPart:
    """The part of a preset, or one with the damages and the form that were asked for by name."""
    optics = OpticsSettings(noise_normal_mm=order.noise_mm)
    if order.damages is None and order.form_error:
        part = make_part(blade, order.preset, order.seed)
        return replace(part, optics=replace(part.optics, noise_normal_mm=order.noise_mm))
    rng = np.random.default_rng([order.seed, 2])
    worn = worn_blade(blade, service_wear(blade, rng) if order.form_error else Wear(wave_mm=0.0, bump_mm=0.0))
    kinds = ("tip", "pit") if order.damages is None else order.damages
    cuts = [cut for kind in kinds for cut in DAMAGES[kind](blade, worn, rng)]
    return assemble(
        blade,
        worn,
        cuts,
        preset="custom",
        serial=serial_of(order.seed, 0),
        seed=order.seed,
        optics=optics,
        rng=rng,
    )


def merged_scan(part: SimPart, rig: Rig, views: int, seed: int) -> Floats:
    """The points (n, 3) of evenly turned views in the calibrated table frame at angle 0, shuffled."""
    rng = np.random.default_rng([seed, 3])
    scanner = part.before(rig)
    axis = calibrated_axis(rig, seed)
    clouds = []
    for angle_deg in np.arange(views) * 360.0 / views:
        image = scanner.capture(float(angle_deg), rng).reshape(-1, 3)
        seen = image[np.isfinite(image[:, 0])]
        clouds.append(apply(inverse(axis @ about_z(float(angle_deg))), seen))
    return rng.permutation(np.concatenate(clouds))


def largest_gap_mm(part: Solid, blade: NominalBlade, scan_mm: Floats, T_table_part: Floats) -> float:
    """The diameter of the largest ball about a point of the true required surface without a scan point.

    The required surface is what is left of the airfoil, its tip face and the broken surfaces.
    """
    samples = _samples(part, np.random.default_rng(5))
    height = samples[:, 2]
    required = samples[(height > blade.airfoil.z_min_mm) & (height < blade.airfoil.z_max_mm + SAMPLE_MM)]
    distances, _ = cKDTree(apply(inverse(T_table_part), scan_mm)).query(required)
    return 2.0 * float(np.max(distances))


def _samples(solid: Solid, rng: np.random.Generator) -> Floats:
    """Points spread over the surface at random, about one per square of `SAMPLE_MM`."""
    areas = face_normals(solid)[1]
    count = int(areas.sum() / SAMPLE_MM**2)
    a, b, c = solid.vertices_mm[solid.faces[rng.choice(len(areas), count, p=areas / areas.sum())].T]
    root, share = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    points: Floats = a * (1.0 - root) + root * ((1.0 - share) * b + share * c)
    return points


if __name__ == "__main__":
    sys.exit(main())
