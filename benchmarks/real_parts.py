"""Real parts through the whole chain: a turbine blade with its root, a rotor and a stator of a compressor.

    python -m benchmarks.real_parts [seeds]

Each is the nominal; the simulated cell scans it worn in service, with a broken tip corner, a nick and a pit
subtracted exactly, in twelve views with occlusion and 0.01 mm of noise along the normal. Sizes go with the
chord. Needs the geometry beside the project; says so where it is not.

Columns: points; largest displacement (mm) of the surface against the fit that knows the damage (asked 0.001),
against the true pose, and the root mean square of that error over its stated sigma, motion by motion; damaged
points deeper than 0.05 mm that the mask found (0.97), sound ones that it took (0.016), percent; twin's mean
error (mm) over sound metal (0.001), over lost metal, and over the nominal's own; largest error of a section's
position, profile (mm) and orientation (deg), each with its ratio to two sigmas; error of each repair volume,
percent (1); CPU seconds of one thread.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.views import row_of
from geometry.blade.nominal import Nominal
from geometry.damage.skin import Skin
from geometry.errors import CannotMeasure
from geometry.registration.alignment import Alignment
from geometry.registration.uncertainty import certainty
from geometry.sections.airfoil import SectionSettings, measure_sections
from geometry.transforms import apply, inverse, log
from geometry.types import Floats, Measurand
from simulators.cutters import Cut
from simulators.presets import CutMaker, broken_corner, repairable_nick, repairable_pit
from simulators.sections import SectionTruth
from simulators.wear import NominalBlade, WornBlade
from tests.geometry import real_parts as real
from tests.geometry.captures import (
    Axis,
    Capture,
    Cutter,
    Inspected,
    Known,
    believed_axis,
    capture,
    displacement_mm,
    exact_axis,
    inspect,
    known_of,
    known_pose,
    mesh_of,
    nominal_of,
)

NOISE_MM = 0.01
DEEP_MM = 0.05
DAMAGES: dict[str, CutMaker] = {"tip": broken_corner, "nick": repairable_nick, "pit": repairable_pit}


def in_sigmas(alignment: Alignment, T_true: Floats, nominal: Nominal) -> float:
    """Root mean square over the six motions of the pose's error in its stated sigmas."""
    stated = certainty(nominal, alignment.information, alignment.form_covariance)
    off = log(alignment.T_nominal_scan @ inverse(T_true), nominal.pivot_mm)
    return float(np.sqrt(np.mean((np.linalg.solve(stated.twists, off) / stated.sigma_mm) ** 2)))


def shares(found: Inspected, known: Known) -> tuple[float, float]:
    """Damaged points that the mask found and sound ones that it took, percent, on the airfoil."""
    deep, sound = known.off_mm < -DEEP_MM, known.sound
    return 100.0 * float(found.mask[deep].mean()), 100.0 * float(found.mask[sound].mean())


def twin_errors(found: Inspected, known: Known, taken: Capture, nominal: Nominal) -> tuple[float, ...]:
    """Mean error (mm) of the twin's vertices over sound metal and over lost metal, and the nominal's own.

    The twin is taken back by the error of the pose, which is told apart.
    """
    back = known.T_true @ inverse(found.alignment.T_nominal_scan)
    vertices_mm = apply(back, found.twin.mesh.vertices_mm)
    before_mm = found.twin.mesh.vertices_mm - found.twin.displacement_mm
    side = (before_mm[:, 2] > nominal.z_min_mm) & (before_mm[:, 2] < nominal.z_max_mm - 1e-3)
    error_mm, feet_mm, _ = known.worn.closest(np.ascontiguousarray(vertices_mm[side]))
    lost = Skin(mesh_of(taken.part.solid)).closest(feet_mm)[0] > 1e-4
    own_mm = known.worn.closest(np.ascontiguousarray(before_mm[side]))[0]
    return tuple(float(np.abs(e).mean()) for e in (error_mm[~lost], error_mm[lost], own_mm))


def section_errors(
    found: Inspected, known: Known, truths: Sequence[SectionTruth], nominal: Nominal
) -> dict[str, tuple[float, float]]:
    """Largest error of each measurand over the sections that no damage touches, and in two sigmas.

    At the true pose: a section's sigma holds noise only, and the error of the pose is told apart.
    """
    sections = measure_sections(
        found.cloud,
        found.mask & ~found.twin.sound,
        replace(found.alignment, T_nominal_scan=known.T_true),
        nominal,
        [truth.z_mm for truth in truths],
        SectionSettings(),
    )
    worst: dict[str, tuple[float, float]] = {}
    for section, truth in zip(sections, truths, strict=True):
        for name in ("position_x_mm", "position_y_mm", "orientation_deg", "profile_max_mm", "profile_min_mm"):
            told = section.measurands[name]
            if not isinstance(told, Measurand):
                continue
            error = abs(told.value - getattr(truth, name))
            kind, before = name.split("_")[0], worst.get(name.split("_")[0], (0.0, 0.0))
            worst[kind] = (max(before[0], error), max(before[1], error / (2.0 * told.sigma)))
    return worst


def cutters_of(blade: NominalBlade) -> list[Cutter]:
    """Damages that a shop may repair, in proportion to the part."""
    return [partial(_one, make, blade) for make in DAMAGES.values()]


def _one(make: CutMaker, blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> Cut:
    return make(blade, worn, rng)[0]


def show(name: str, blade: NominalBlade, axis_of: Axis, seed: int) -> None:
    """One line: one part with three damages."""
    nominal = nominal_of(blade)
    taken = capture(blade, cutters_of(blade), NOISE_MM, seed, axis_of)
    try:
        found = inspect(taken, nominal, NOISE_MM)
    except CannotMeasure as why:
        print(f"{name:9} {seed:4d}  {why}", flush=True)
        return
    known = known_of(taken, found.cloud)
    T = found.alignment.T_nominal_scan
    pose = [displacement_mm(T, known_pose(found.cloud, known, nominal), nominal)]
    pose += [displacement_mm(T, known.T_true, nominal), in_sigmas(found.alignment, known.T_true, nominal)]
    recall, false = shares(found, known)
    twin = twin_errors(found, known, taken, nominal)
    sections = section_errors(found, known, taken.part.sections, nominal)
    rows = [row_of(kind, t, found) for kind, t in zip(DAMAGES, taken.part.damages, strict=True)]
    volumes = ", ".join(
        f"{row.name} {row.truth_mm3:.1f}: " + (row.failure or f"{row.percent:+.2f} %") for row in rows
    )
    print(f"{name:9} {seed:4d} {len(found.cloud):7d} {pose[0]:7.4f} {pose[1]:7.4f} {pose[2]:6.2f}", end="")
    print(f" {recall:6.2f} {false:5.2f} {twin[0]:8.5f} {twin[1]:8.5f} {twin[2]:8.4f}", end="")
    for kind in ("position", "profile", "orientation"):
        error, ratio = sections.get(kind, (np.nan, np.nan))
        print(f" {error:7.4f} {ratio:4.2f}", end="")
    print(f" {found.cpu_s:6.1f}  {volumes}; {len(found.damages)} told", flush=True)


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    if not real.present():
        print("skipped: the real parts are not beside the project")
        return
    print(f"{'':9} {'seed':>4} {'points':>7} {'known':>7} {'true':>7} {'sigmas':>6}", end="")
    print(f" {'found':>6} {'false':>5} {'sound':>8} {'lost':>8} {'nominal':>8}", end="")
    print(f" {'place':>7} {'/2s':>4} {'profile':>7} {'/2s':>4} {'turn':>7} {'/2s':>4} {'CPU s':>6}  volumes")
    for label, axis_of in (("exact axis", exact_axis), ("calibrated axis", believed_axis)):
        print(label)
        for name, blade in real.part_numbers().items():
            for seed in range(seeds):
                show(name, blade, axis_of, seed)


if __name__ == "__main__":
    main()
