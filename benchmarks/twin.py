"""The damage-free twin against blades in closed form: thesis section 5.5 re-made, and six kinds of wear.

    python -m benchmarks.twin [--full]

Errors are distances (mm) of the twin's vertices, on the side of the airfoil, to the true undamaged surface;
the fit is not told which points are damage but by a mask that it corrects. Noise is the standard deviation
along the normal. Thesis 5.5, 258,520 points: the nominal is 0.0223 off on the mean and 0.0618 at Z = 90; its
twin 0.0021 and 0.0041, with noise 0.0080 and 0.0060; 44 minutes and 54 seconds of segmentation.

- sound, lost: over metal that is there, and over metal that broke away (tip corner, pit);
- ends: over sound metal within 3 mm of the ends of the airfoil;
- ratio: root mean square of error over stated sigma where metal is lost, of all seeds and of the worst; 1 is
  honest, and where one piece is lost its errors go together, so that single seeds differ much;
- sigma: of the lost part of the section at Z = 90, root mean square, as the twin states it.

The table of wears is of about 60,000 points a scan.

Times are CPU seconds of one thread.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.blade.solid import slice_loops
from geometry.damage.damages import find_damages
from geometry.deformation.twin import Twin, TwinSettings, fit_twin
from geometry.registration.alignment import Alignment
from geometry.repair.patches import RepairSettings, find_repairs
from geometry.types import Bools, Cloud, Floats, Mesh
from tests.geometry import twin_blades as blades
from tests.geometry.poses import in_place

POINTS = 258_520
PITCH_MM = 0.1865  # gives slightly more
NOISES_MM = (0.0, 0.01, 0.03)
END_MM = 3.0
TIP_Z_MM = 90.0


def hump(z_mm: Floats, centre_mm: float, half_mm: float) -> Floats:
    inside = np.abs(z_mm - centre_mm) < half_mm
    return np.where(inside, np.cos(0.5 * np.pi * (z_mm - centre_mm) / half_mm) ** 2, 0.0)


def side(theta: Floats) -> Floats:
    """1 on the suction side, -1 on the pressure side, 0 at the edges."""
    return np.tanh(3.0 * np.sin(theta))


def bumps(theta: Floats, z_mm: Floats, a: Floats) -> Floats:
    belly = np.sin(theta) ** 2
    return belly * (0.08 * a[0] * hump(z_mm, 90.0, 40.0) * side(theta) - 0.04 * a[1] * hump(z_mm, 35.0, 25.0))


def thicker(theta: Floats, z_mm: Floats, a: Floats) -> Floats:
    return 0.06 * a[0] * np.sin(0.5 * theta) ** 2 * (0.4 + 0.6 * hump(z_mm, 80.0 + 10.0 * a[1], 60.0))


def thinner(theta: Floats, z_mm: Floats, a: Floats) -> Floats:
    return -0.05 * a[0] * hump(z_mm, 50.0 + 20.0 * a[1], 75.0) * np.sin(theta) ** 2


def edge_wear(theta: Floats, z_mm: Floats, a: Floats) -> Floats:
    at_edge = np.exp(-((np.sin(0.5 * theta) / 0.25) ** 2))
    return -0.07 * a[0] * at_edge * (0.3 + 0.7 * (z_mm / blades.SPAN_MM) ** 2)


def nothing(theta: Floats, z_mm: Floats, a: Floats) -> Floats:
    return 0.0 * (theta + z_mm)


def mixture(theta: Floats, z_mm: Floats, a: Floats) -> Floats:
    return bumps(theta, z_mm, 0.6 * a) + thinner(theta, z_mm, 0.5 * a[::-1]) + edge_wear(theta, z_mm, 0.6 * a)


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One kind of wear: an offset along the section's normal, and the bend of the whole blade."""

    offset: Callable[[Floats, Floats, Floats], Floats]
    bend_mm: float = 0.0
    untwist_deg: float = 0.0


FIELDS = {
    "bumps": Field(offset=bumps),
    "thickening": Field(offset=thicker),
    "thinning": Field(offset=thinner),
    "bend and untwist": Field(offset=nothing, bend_mm=0.3, untwist_deg=0.3),
    "edge wear": Field(offset=edge_wear),
    "mixture": Field(offset=mixture, bend_mm=0.15, untwist_deg=0.15),
}


def worn(field: Field, seed: int) -> blades.Shape:
    """A blade with form error and this wear, its sizes drawn from 0.7 to 1.3 of the nominal ones."""
    a = np.random.default_rng(seed).uniform(0.7, 1.3, 4)

    def offset(theta: Floats, z_mm: Floats) -> Floats:
        return np.asarray(blades.ripple(theta, z_mm) + field.offset(theta, z_mm, a[:2]))

    def warp(points_mm: Floats) -> Floats:
        s = points_mm[..., 2] / blades.SPAN_MM
        turn = np.deg2rad(field.untwist_deg) * a[2] * s
        x, y = points_mm[..., 0], points_mm[..., 1]
        c, si = np.cos(turn), np.sin(turn)
        return np.stack([c * x - si * y, si * x + c * y + field.bend_mm * a[3] * s**2, points_mm[..., 2]], -1)

    return blades.Shape(offset, warp)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """A scan of a damaged blade and its truth."""

    truth: blades.Truth
    cuts: tuple[blades.Cut, ...]
    cloud: Cloud
    broken: Bools


def case(shape: blades.Shape, pitch_mm: float, noise_mm: float, seed: int, most: int | None = None) -> Case:
    truth = blades.Truth(shape)
    cuts = (blades.tip_corner(), blades.pit(truth, 1.5 * np.pi, 48.0, 1.5, 3.2))
    scan = blades.scan(truth, cuts, pitch_mm=pitch_mm, noise_mm=noise_mm, seed=seed)
    points_mm, broken = scan.points[:most], scan.label[:most] > 0
    sigma_mm = np.full(len(points_mm), max(noise_mm, 0.001))
    view = np.zeros(len(points_mm), np.int64)
    cloud = Cloud(points_mm=points_mm, sigma_mm=sigma_mm, view=view)
    return Case(truth=truth, cuts=cuts, cloud=cloud, broken=broken)


def nominal_of(pitch_mm: float, turn: float) -> Nominal:
    vertices, faces = blades.solid(pitch_mm, turn=turn)
    return prepare_nominal(Mesh(vertices_mm=vertices, faces=faces), NominalSettings(z_min_mm=2.0))


def gone(known: Case, points_mm: Floats) -> Bools:
    return np.logical_or.reduce([cut.gone(points_mm) for cut in known.cuts])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Errors:
    """Errors of a fitted mesh at its vertices on the side of the airfoil."""

    off_mm: Floats  # (n,) signed
    nominal_mm: Floats  # (n,) of the nominal
    sigma_mm: Floats  # (n,)
    lost: Bools
    at_end: Bools


def errors(known: Case, twin: Twin, most: int = 8000) -> Errors:
    before_mm = twin.mesh.vertices_mm - twin.displacement_mm
    on_side = np.flatnonzero((before_mm[:, 2] > 2.0) & (before_mm[:, 2] < blades.SPAN_MM - 1e-3))
    on_side = on_side[:: max(1, len(on_side) // most)]
    z_mm = before_mm[on_side, 2]
    return Errors(
        off_mm=known.truth.distance(twin.mesh.vertices_mm[on_side]),
        nominal_mm=known.truth.distance(before_mm[on_side]),
        sigma_mm=twin.sigma_mm[on_side],
        lost=gone(known, before_mm[on_side]),
        at_end=(z_mm < 2.0 + END_MM) | (z_mm > blades.SPAN_MM - END_MM),
    )


def profile_rms(known: Case, mesh: Mesh) -> tuple[float, float]:
    """Root mean square distance (mm) of the section at `TIP_Z_MM` to the truth: all of it, and where lost."""
    loops = slice_loops(mesh, np.zeros((len(mesh.faces), 3, 3)), TIP_Z_MM)
    flat_mm = max((loop.points_mm for loop in loops), key=len)
    points_mm = np.column_stack([flat_mm, np.full(len(flat_mm), TIP_Z_MM)])
    off_mm, lost = known.truth.distance(points_mm), gone(known, points_mm)
    return float(np.sqrt(np.mean(off_mm**2))), float(np.sqrt(np.mean(off_mm[lost] ** 2)))


def stated_mm(known: Case, twin: Twin) -> float:
    """Root mean square of the twin's sigma about the lost part of the section at `TIP_Z_MM`."""
    before_mm = twin.mesh.vertices_mm - twin.displacement_mm
    near = np.flatnonzero(np.abs(before_mm[:, 2] - TIP_Z_MM) < 1.0)
    return float(np.sqrt(np.mean(twin.sigma_mm[near[gone(known, before_mm[near])]] ** 2)))


def thesis_blade(nominal: Nominal, noise_mm: float, seed: int) -> None:
    """One line: section 5.5 at its number of points."""
    known = case(blades.SHAPES["service"], PITCH_MM, noise_mm, seed, POINTS)
    start_s = time.process_time()
    twin = fit_twin(known.cloud, known.broken, in_place(), nominal, TwinSettings())
    fitted_s = time.process_time()
    damages = find_damages(known.cloud, known.broken, in_place(), nominal, twin)
    found_s = time.process_time()
    find_repairs(twin, known.cloud, in_place(), damages, RepairSettings())
    patched_s = time.process_time()
    error = errors(known, twin)
    whole, lost = profile_rms(known, twin.mesh)
    as_drawn, as_drawn_lost = profile_rms(known, nominal.mesh)
    print(
        f"{noise_mm:6.3f} {seed:4d} {len(known.cloud):8d} {np.abs(error.nominal_mm).mean():8.4f} "
        f"{np.abs(error.off_mm).mean():8.5f} {as_drawn:8.4f} {whole:8.5f} {as_drawn_lost:8.4f} {lost:8.5f} "
        f"{stated_mm(known, twin):8.5f} "
        f"{fitted_s - start_s:6.1f} {found_s - fitted_s:7.1f} {patched_s - found_s:7.1f}",
        flush=True,
    )


def wear(nominal: Nominal, name: str, noise_mm: float, seeds: int) -> None:
    """One line: the worst and the mean over seeds of one kind of wear."""
    rows = []
    for seed in range(seeds):
        known = case(worn(FIELDS[name], seed), 0.4, noise_mm, seed)
        twin = fit_twin(known.cloud, known.broken, in_place(), nominal, TwinSettings())
        error = errors(known, twin)
        off_mm = np.abs(error.off_mm)
        sound, lost = off_mm[~error.lost], off_mm[error.lost]
        ratio = np.sqrt(np.mean((lost / error.sigma_mm[error.lost]) ** 2))
        ends = off_mm[~error.lost & error.at_end].mean()
        drawn = np.abs(error.nominal_mm).mean()
        rows.append(
            [drawn, sound.mean(), np.quantile(sound, 0.99), sound.max(), lost.mean(), lost.max(), ends]
        )
        rows[-1].append(ratio)
    mean, worst = np.mean(rows, axis=0), np.max(rows, axis=0)
    ratio = np.sqrt(np.mean(np.square(rows)[:, 7]))
    shown = [mean[0], mean[1], worst[2], worst[3], mean[4], worst[5], mean[6]]
    numbers = " ".join(f"{value:8.4f}" for value in shown)
    print(f"{name:17} {noise_mm:6.3f} {numbers} {ratio:6.2f} {worst[7]:6.2f}", flush=True)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--full", action="store_true", help="five seeds")
    chosen = options.parse_args()
    coarse = nominal_of(0.7, 0.12)
    fit_twin(*_warm(), coarse, TwinSettings())  # kernels compiled
    fine = nominal_of(0.3, 0.06)
    pair = f" {'nominal':>8} {'twin':>8}"
    fit_twin(*_warm(), fine, TwinSettings())  # what the nominal alone tells is kept
    print(f"{'':20} {'mean error':>17} {'RMS at Z = 90':>17} {'where lost':>17} {'':>8}  CPU s")
    print(f"{'noise':>6} {'seed':>4} {'points':>8}{3 * pair} {'sigma':>8}   twin  damage  repair")
    for noise_mm in (0.0, 0.01):
        for seed in (1, 2, 3, 4, 5) if chosen.full else (1,):
            thesis_blade(fine, noise_mm, seed)
    print(f"\n{'wear':17} {'noise':>6} {'nominal':>8} {'sound':>8} {'p99':>8} {'max':>8} ", end="")
    print(f"{'lost':>8} {'max':>8} {'ends':>8} {'ratio':>6} {'worst':>6}")
    for name in FIELDS:
        for noise_mm in NOISES_MM:
            wear(coarse, name, noise_mm, 5 if chosen.full else 1)


def _warm() -> tuple[Cloud, Bools, Alignment]:
    known = case(blades.SHAPES["service"], 0.45, 0.01, 0)  # enough points for as many nodes
    return known.cloud, known.broken, in_place()


if __name__ == "__main__":
    main()
