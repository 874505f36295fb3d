"""Registration of damaged blades: product, the fit that knows the damage, and two peers on the same clouds.

    python -m benchmarks.registration [--seed 1] [--without-peers] [--full]

Blades as in thesis section 3.4: a form error of 0.010 to 0.035 mm with 3, 6 or 12 waves round the section, a
cut tip and a dent. Sections taper or stay constant, the tip face is seen (capped) or not (open). Noise is
N(0, sigma) along a random direction, so sigma / sqrt(3) along the normal, as in the thesis. By default one
draw of a few rows, with `--full` ten of all. Columns, mm:

- section: largest change of a sectional RMSE to the nominal (20 sections) against the true pose, the thesis'
  measure (its fine-tuned method: 0.002 and 0.015; its ICP: 0.022 and 0.164); mean: the average of figure 3.9;
- global: change of the RMSE of all points, in percent of it (table 3.1: 0.06 and 0.83);
- true: largest displacement of the surface against the true pose, which the form error bounds from below;
- known: the same against the least-squares pose of the points known to be sound;
- found, false: share of the damaged points deeper than 0.05 mm (3 sigma where that is more) that are masked,
  and of the sound ones; weak: motions that the alignment itself calls open, which no gate lets pass.

Then: what noise alone leaves beside the bound of Cramer and Rao, the scatter of poses in stated sigmas, the
cost per point (to 2 million with `--full`), the thesis' own method on one cloud, and the peers on 250,000
points (950,000 with `--full`). Peers start from the product's coarse pose, on 60,000 points sampled from the
nominal with its normals. Times are CPU seconds of one thread.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.blade.read import read_nominal
from geometry.registration.alignment import Alignment
from geometry.registration.coarse import CoarseSettings, find_pose
from geometry.registration.ends import without_strays
from geometry.registration.fit import Fit, fit_kept, motions
from geometry.registration.register import RegisterSettings, mask_damage, neighbours_of, register
from geometry.registration.settled import held_by_ends
from geometry.registration.uncertainty import certainty
from geometry.scan.clean import clean
from geometry.scan.neighbourhood import surface_shares
from geometry.thesis.fine_tuned import register_thesis
from geometry.transforms import apply, inverse, log, rigid
from geometry.types import Cloud, Floats
from tests.geometry import blades

BLADES = {"tapered": blades.Blade(), "constant": blades.Blade(taper=0.0, thickness_taper=0.0)}
NOISES_MM = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05)
PER_MM2 = 6.5  # 61,000 points
DAMAGE = {  # depth of the tip cut and its slope; radius and depth of the dent, mm
    "blade 1": (10.0, 0.5, 5.0, 1.0),
    "blade 2": (28.0, 1.1, 13.0, 1.6),
}
SLICE = (  # section, damage, noise, waves, capped
    ("tapered", "blade 1", 0.0, 6, True),
    ("tapered", "blade 1", 0.05, 6, True),
    ("tapered", "blade 2", 0.0, 12, True),
    ("tapered", "blade 2", 0.05, 6, True),
    ("tapered", "blade 2", 0.03, 3, False),
    ("constant", "blade 1", 0.02, 6, True),
    ("constant", "blade 2", 0.05, 6, True),
    ("constant", "blade 1", 0.05, 6, False),
)
COSTS = (6.5, 26.5)  # points a square millimetre: 60k, 250k
MORE_COSTS = (100.0, 213.0)  # 950k, 2M
TURBINE = Path(__file__).parents[2] / "shared/data/turbineblade/turbineblade.ply"
DRAWS = 200  # of noise, for the scatter of poses


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A scan with its truth: `T_true` carries it onto the nominal."""

    name: str
    blade: blades.Blade
    noise_mm: float
    scan: blades.Scan
    cloud: Cloud
    T_true: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What one method made of one case."""

    section_mm: float
    mean_mm: float
    of_all_percent: float
    true_mm: float
    known_mm: float
    cpu_s: float


@cache
def nominal_of(blade: blades.Blade) -> Nominal:
    settings = NominalSettings(z_min_mm=0.0, z_max_mm=blade.height_mm, sample_mm=0.35)
    return prepare_nominal(blades.mesh(blade, around=600, up=160), settings)


def with_waves(scan: blades.Scan, rng: np.random.Generator, waves: int, blade: blades.Blade) -> blades.Scan:
    """The thesis' form error: A(z) sin(2 pi k s + phase) along the normal, A random at 22 heights."""
    heights_mm = np.linspace(0.0, blade.height_mm, 22)
    amplitude, phase = (
        CubicSpline(heights_mm, rng.uniform(low, high, 22)) for low, high in ((0.010, 0.035), (0.0, 1.0))
    )
    x, _, z = scan.points_mm.T
    around = x / blade.chord_mm * np.sign(scan.normals[:, 1] + 1e-12)
    wave = amplitude(z) * np.sin(2.0 * np.pi * waves * around + phase(z))
    return replace(scan, points_mm=scan.points_mm + wave[:, None] * scan.normals)


def case_of(
    section: str, damage: str, noise_mm: float, waves: int, capped: bool, seed: int, per_mm2: float = PER_MM2
) -> Case:
    """A cut and a dent, small on blade 1 and large on blade 2; no form error without waves."""
    rng, blade = np.random.default_rng(seed), BLADES[section]
    scan = blades.scan(blade, per_mm2, rng, tip_face=capped)
    if waves:
        scan = with_waves(scan, rng, waves, blade)
    cut_mm, slope, dent_mm, depth_mm = DAMAGE[damage]
    centre_mm = blade.point(np.array([4.5]), np.array([50.0]))[0]
    dented = blades.with_dent(scan, centre_mm, dent_mm, depth_mm)
    scan = blades.with_tip_cut(dented, blade, cut_mm, rng, slope)
    noise = rng.normal(scale=max(noise_mm, 1e-12) / np.sqrt(3.0), size=scan.points_mm.shape)
    T_true = rigid(_random_rotation(rng), rng.uniform(-100.0, 100.0, 3))
    name = f"{section}, {damage}, {'capped' if capped else 'open'}, {waves} waves, noise {noise_mm:g}"
    cloud = cloud_of(apply(inverse(T_true), scan.points_mm + noise), max(noise_mm / np.sqrt(3.0), 0.001))
    return Case(name=name, blade=blade, noise_mm=noise_mm, scan=scan, cloud=cloud, T_true=T_true)


def cloud_of(points_mm: Floats, sigma_mm: float) -> Cloud:
    count = len(points_mm)
    return Cloud(points_mm=points_mm, sigma_mm=np.full(count, sigma_mm), view=np.zeros(count, np.int64))


def _random_rotation(rng: np.random.Generator) -> Floats:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def known_pose(case: Case, nominal: Nominal) -> Floats:
    """Least squares over the points that damage did not touch, from the true pose; ends as in the product."""
    found = nominal.closest(apply(case.T_true, case.cloud.points_mm))
    start = Fit(T_nominal_scan=case.T_true, found=found, weak=(), iterations=0, converged=False)
    sound = case.scan.depth_mm == 0.0
    shares = surface_shares(case.cloud.points_mm, neighbours_of(case.cloud, RegisterSettings()))
    fit = fit_kept(case.cloud.points_mm, start, sound * shares, nominal, steps=20, close_mm=1e-7)
    resting = without_strays(sound, sound, fit.found, nominal)
    return held_by_ends(case.cloud, fit, sound, resting * shares, nominal).fit.T_nominal_scan


def sectional_rmse(case: Case, T: Floats, nominal: Nominal) -> Floats:
    """RMSE (21,) to the nominal of 20 sections' points, the same points whatever the pose, and of all."""
    distance_mm = nominal.closest(apply(T, case.cloud.points_mm)).distance_mm
    z_mm = case.scan.points_mm[:, 2]
    slabs = [np.abs(z_mm - z) < 0.1 for z in np.linspace(5.0, 100.0, 20)]
    slabs = [slab if slab.any() else np.ones(len(z_mm), bool) for slab in slabs]
    return np.array([np.sqrt(np.mean(distance_mm[slab] ** 2)) for slab in (*slabs, slice(None))])


def displacement_mm(T: Floats, T_other: Floats, nominal: Nominal) -> float:
    """Largest displacement of the nominal's surface between two poses of a scan."""
    moved = apply(T @ inverse(T_other), nominal.samples.points_mm) - nominal.samples.points_mm
    return float(np.linalg.norm(moved, axis=1).max())


def judge(case: Case, method: Callable[[], Floats], nominal: Nominal, T_known: Floats) -> Row:
    start_s = time.process_time()
    T = method()
    cpu_s = time.process_time() - start_s
    actual_mm = sectional_rmse(case, case.T_true, nominal)
    change_mm = np.abs(sectional_rmse(case, T, nominal) - actual_mm)
    return Row(
        section_mm=float(change_mm[:-1].max()),
        mean_mm=float(change_mm[:-1].mean()),
        of_all_percent=float(100.0 * change_mm[-1] / actual_mm[-1]),
        true_mm=displacement_mm(T, case.T_true, nominal),
        known_mm=displacement_mm(T, T_known, nominal),
        cpu_s=cpu_s,
    )


def open3d_tukey(case: Case, T_start: Floats, targets_mm: Floats, normals: Floats) -> Floats:
    """Open3D's point-to-plane ICP with Tukey's loss, k = 0.2."""
    import open3d

    clouds = [open3d.geometry.PointCloud() for _ in range(2)]
    for cloud, points_mm in zip(clouds, (case.cloud.points_mm, targets_mm), strict=True):
        cloud.points = open3d.utility.Vector3dVector(points_mm.copy())
    clouds[1].normals = open3d.utility.Vector3dVector(normals)
    registration = open3d.pipelines.registration
    estimate = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=0.2))
    criteria = registration.ICPConvergenceCriteria(1e-9, 1e-9, 100)
    found = registration.registration_icp(clouds[0], clouds[1], 3.0, T_start, estimate, criteria)
    return np.asarray(found.transformation)


def small_gicp_plane(case: Case, T_start: Floats, targets_mm: Floats) -> Floats:
    """small_gicp's point-to-plane ICP at its own defaults but 0.1 mm voxels and 3 mm correspondences."""
    import small_gicp

    found = small_gicp.align(
        targets_mm,
        case.cloud.points_mm,
        init_T_target_source=T_start,
        registration_type="PLANE_ICP",
        downsampling_resolution=0.1,
        max_correspondence_distance=3.0,
        num_threads=1,
    )
    return np.asarray(found.T_target_source)


def shares(case: Case, alignment: Alignment, nominal: Nominal) -> tuple[float, float]:
    """Damaged points found, and sound points masked."""
    flags = mask_damage(case.cloud, alignment, nominal)
    deep = case.scan.depth_mm > max(3.0 * case.noise_mm / np.sqrt(3.0), 0.05)
    return float(flags[deep].mean()), float(flags[case.scan.depth_mm == 0.0].mean())


def show(label: str, row: Row, product_s: float, tail: str = "") -> None:
    print(
        f"    {label:20s} {row.section_mm:8.4f} {row.mean_mm:8.5f} {row.of_all_percent:7.2f}"
        f" {row.true_mm:8.4f} {row.known_mm:8.4f} {row.cpu_s:7.2f} {row.cpu_s / product_s:6.1f}x {tail}",
        flush=True,
    )


def compare(case: Case, peers: bool) -> None:
    """Print one block: product and peers on one case."""
    nominal = nominal_of(case.blade)
    T_known = known_pose(case, nominal)
    alignment = register(case.cloud, nominal)
    ours = judge(case, lambda: register(case.cloud, nominal).T_nominal_scan, nominal, T_known)
    found, false = shares(case, alignment, nominal)
    damaged = np.mean(case.scan.depth_mm > 0.0)
    print(f"  {case.name}: {len(case.cloud)} points, {damaged:.1%} damaged")
    weak = len(alignment.weak_directions)
    show("product", ours, ours.cpu_s, f"found {found:.3f} false {false:.3f} weak {weak}")
    show("known damage", judge(case, lambda: T_known, nominal, T_known), ours.cpu_s)
    if peers:
        T_start = find_pose(case.cloud.points_mm, nominal, CoarseSettings()).T_nominal_scan
        pick = np.unique(np.random.default_rng(0).choice(len(nominal.samples.points_mm), 60_000))
        targets_mm, normals = nominal.samples.points_mm[pick], nominal.samples.normals[pick]
        tukey = judge(case, lambda: open3d_tukey(case, T_start, targets_mm, normals), nominal, T_known)
        show("Open3D Tukey", tukey, ours.cpu_s)
        plane = judge(case, lambda: small_gicp_plane(case, T_start, targets_mm), nominal, T_known)
        show("small_gicp plane", plane, ours.cpu_s)


def rows(full: bool) -> list[tuple[str, str, float, int, bool]]:
    """The whole campaign, or the slice of it."""
    if not full:
        return list(SLICE)
    return list(product(BLADES, DAMAGE, NOISES_MM, (3, 6, 12), (True, False)))


def noise_alone(seed: int) -> None:
    """Form error off, noise 0.05: displacement along the normal beside twice what Cramer and Rao allow."""
    for damage in DAMAGE:
        case = case_of("tapered", damage, 0.05, 0, True, seed)
        nominal = nominal_of(case.blade)
        alignment = register(case.cloud, nominal)
        off = log(alignment.T_nominal_scan @ inverse(case.T_true), nominal.pivot_mm)
        design = motions(nominal.samples.points_mm, nominal.samples.normals, nominal.pivot_mm)
        bound = np.einsum("ni,ij,nj->n", design, np.linalg.inv(alignment.information), design)
        print(
            f"  {damage}: {np.abs(design @ off).max():.4f} mm along the normal, rms"
            f" {np.sqrt(np.mean((design @ off) ** 2)):.5f}; bound {np.sqrt(bound.mean()):.5f} rms"
        )


def scatter(seed: int) -> None:
    """Spread of pose errors in stated sigmas, motion by motion: 1 is honest; form error off, damage in."""
    nominal, errors = nominal_of(BLADES["tapered"]), []
    for draw in range(DRAWS):
        case = case_of("tapered", "blade 1", 0.03, 0, True, 1000 * seed + draw, 0.6)
        alignment = register(case.cloud, nominal)
        stated = certainty(nominal, alignment.information, alignment.form_covariance)
        off = log(alignment.T_nominal_scan @ inverse(case.T_true), nominal.pivot_mm)
        errors.append(np.linalg.solve(stated.twists, off) / stated.sigma_mm)
    print("  " + " ".join(f"{x:.2f}" for x in np.sqrt(np.mean(np.square(errors), axis=0))))


def dense(seed: int, full: bool) -> None:
    """The product beside its peers on 250,000 points, and on 950,000."""
    for per_mm2 in (COSTS[-1], *(MORE_COSTS[:1] if full else ())):
        compare(case_of("tapered", "blade 1", 0.03, 6, True, seed, per_mm2), peers=True)


def against_thesis(seed: int) -> None:
    """The thesis' own method beside the product on one cloud."""
    case = case_of("tapered", "blade 2", 0.0, 6, True, seed)
    nominal = nominal_of(case.blade)
    T_known = known_pose(case, nominal)
    ours = judge(case, lambda: register(case.cloud, nominal).T_nominal_scan, nominal, T_known)
    thesis = judge(case, lambda: register_thesis(case.cloud, nominal).T_nominal_scan, nominal, T_known)
    show("product", ours, ours.cpu_s)
    show("thesis, faithful", thesis, ours.cpu_s)


def cost(seed: int, full: bool) -> None:
    """CPU seconds of clean, register and mask, by points."""
    for per_mm2 in COSTS + (MORE_COSTS if full else ()):
        case = case_of("tapered", "blade 1", 0.03, 6, True, seed, per_mm2)
        nominal, times_s = nominal_of(case.blade), [time.process_time()]
        tidy = clean(case.cloud)
        times_s.append(time.process_time())
        alignment = register(tidy, nominal)
        times_s.append(time.process_time())
        mask_damage(tidy, alignment, nominal)
        times_s.append(time.process_time())
        spent = "  ".join(f"{s:6.2f}" for s in np.diff(times_s))
        each_us = 1e6 * (times_s[-1] - times_s[0]) / len(tidy)
        print(f"  {len(case.cloud):8d} points: {spent} s, {each_us:.1f} us each", flush=True)


def real_part(seed: int) -> None:
    """A turbine blade with platform and root as nominal, 8,000 points of it from eight poses."""
    if not TURBINE.is_file():
        print(f"  skipped, {TURBINE.name} is not here")
        return
    nominal, rng = (
        prepare_nominal(read_nominal(TURBINE, "mm"), NominalSettings()),
        np.random.default_rng(seed),
    )
    chosen = rng.choice(len(nominal.shell_mm), 8000)
    tangents = rng.normal(scale=0.5, size=(8000, 3))
    surface_mm = nominal.closest(nominal.shell_mm[chosen] + tangents).points_mm
    for draw in range(8):
        cut_mm = nominal.z_max_mm - draw % 2 * rng.uniform(1.0, 4.0)
        seen_mm = surface_mm[surface_mm[:, 2] <= cut_mm]
        noisy_mm = seen_mm + rng.normal(scale=0.012, size=seen_mm.shape)
        T_true = rigid(_random_rotation(rng), rng.uniform(-200.0, 200.0, 3))
        alignment = register(cloud_of(apply(inverse(T_true), noisy_mm), 0.012), nominal)
        off_mm = displacement_mm(alignment.T_nominal_scan, T_true, nominal)
        print(
            f"  tip {'cut' if draw % 2 else 'whole'}: {off_mm:.4f} mm off, next pose"
            f" {alignment.runner_up_ratio:.1f} times worse, {len(alignment.weak_directions)} motions open"
        )


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--without-peers", action="store_true")
    arguments.add_argument("--full", action="store_true")
    asked = arguments.parse_args()
    first = case_of("tapered", "blade 1", 0.0, 6, True, 0)
    mask_damage(first.cloud, register(clean(first.cloud), nominal_of(first.blade)), nominal_of(first.blade))
    print(f"registration, seed {asked.seed}; mm; CPU s and ratio to the product")
    print(f"    {'':20s} {'section':>8s} {'mean':>8s} {'global%':>7s} {'true':>8s} {'known':>8s} {'s':>7s}")
    for row in rows(asked.full):
        for draw in range(10 if asked.full else 1):
            peers = not asked.without_peers and row[2] in {0.0, 0.05} and row[4] and draw == 0
            compare(case_of(*row, asked.seed + draw), peers)
    print("noise 0.05 alone")
    noise_alone(asked.seed)
    print(f"spread of {DRAWS} poses in stated sigmas, the surest motion first")
    scatter(asked.seed)
    print("clean, register, mask")
    cost(asked.seed, asked.full)
    print("the thesis' method")
    against_thesis(asked.seed)
    if not asked.without_peers:
        print("denser clouds")
        dense(asked.seed, asked.full)
    print("a real part")
    real_part(asked.seed)


if __name__ == "__main__":
    main()
