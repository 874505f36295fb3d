"""Registration of damaged blades: product, the fit that knows the damage, and two peers on the same clouds.

    python -m benchmarks.registration [--seed 1] [--without-peers]

Blades as in thesis chapter 3: a form error of 0.010 to 0.035 mm with six waves round the section, a cut tip
and a dent; 2 and 12 % of the points are damaged. Blade 3 lost its whole tip face, and with it what holds it
along its own screw. Noise is N(0, sigma) along a random direction, so
sigma / sqrt(3) along the normal, as in the thesis. Columns, mm:

- section: largest change of a sectional RMSE to the nominal (20 sections) against the true pose, the thesis'
  measure (its fine-tuned method: 0.002 and 0.015; its ICP: 0.022 and 0.164);
- true: largest displacement of the surface against the true pose, which the form error bounds from below;
- known: the same against the least-squares pose of the points known to be sound;
- found, false: share of the damaged points deeper than 3 sigma that are masked, and of the sound ones.

Peers start from the product's coarse pose, on 60,000 points sampled from the nominal with its normals. Times
are CPU seconds of one thread.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from geometry.coarse import CoarseSettings, find_pose
from geometry.fit import Fit, fit_kept
from geometry.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.register import mask_damage, register
from geometry.transforms import apply, inverse, rigid
from geometry.types import Cloud, Floats
from tests.geometry import blades

BLADE = blades.Blade()
NOISES_MM = (0.0, 0.01, 0.03, 0.05)
PER_MM2 = 6.5  # 61,000 points
FORM_WAVES = 6
DAMAGE = {  # depth of the tip cut and its slope; radius and depth of the dent, mm
    "blade 1": (10.0, 0.5, 5.0, 1.0),
    "blade 2": (28.0, 1.1, 13.0, 1.6),
    "blade 3": (32.0, 0.5, 12.0, 1.6),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A scan with its truth: `T_true` carries it onto the nominal."""

    name: str
    noise_mm: float
    scan: blades.Scan
    cloud: Cloud
    T_true: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What one method made of one case."""

    section_mm: float
    true_mm: float
    known_mm: float
    cpu_s: float


def with_waves(scan: blades.Scan, rng: np.random.Generator) -> blades.Scan:
    """The thesis' form error: A(z) sin(2 pi k s + phase) along the normal, A random at 22 heights."""
    heights_mm = np.linspace(0.0, BLADE.height_mm, 22)
    amplitude, phase = (
        CubicSpline(heights_mm, rng.uniform(low, high, 22)) for low, high in ((0.010, 0.035), (0.0, 1.0))
    )
    x, _, z = scan.points_mm.T
    around = x / BLADE.chord_mm * np.sign(scan.normals[:, 1] + 1e-12)
    wave = amplitude(z) * np.sin(2.0 * np.pi * FORM_WAVES * around + phase(z))
    return replace(scan, points_mm=scan.points_mm + wave[:, None] * scan.normals)


def case_of(name: str, noise_mm: float, form: bool, seed: int) -> Case:
    """Blade 1 has a small cut and dent, blade 2 large ones, blade 3 has nothing left of its tip face."""
    rng = np.random.default_rng(seed)
    scan = blades.scan(BLADE, PER_MM2, rng)
    if form:
        scan = with_waves(scan, rng)
    cut_mm, slope, dent_mm, depth_mm = DAMAGE[name]
    centre_mm = BLADE.point(np.array([4.5]), np.array([50.0]))[0]
    dented = blades.with_dent(scan, centre_mm, dent_mm, depth_mm)
    scan = blades.with_tip_cut(dented, BLADE, cut_mm, rng, slope)
    noise = rng.normal(scale=max(noise_mm, 1e-12) / np.sqrt(3.0), size=scan.points_mm.shape)
    T_true = rigid(_random_rotation(rng), rng.uniform(-100.0, 100.0, 3))
    points_mm = apply(inverse(T_true), scan.points_mm + noise)
    count = len(points_mm)
    sigma_mm = np.full(count, max(noise_mm / np.sqrt(3.0), 0.001))
    cloud = Cloud(points_mm=points_mm, sigma_mm=sigma_mm, view=np.zeros(count, np.int64))
    return Case(name=name, noise_mm=noise_mm, scan=scan, cloud=cloud, T_true=T_true)


def _random_rotation(rng: np.random.Generator) -> Floats:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def known_pose(case: Case, nominal: Nominal) -> Floats:
    """Least squares over the points that damage did not touch, from the true pose."""
    found = nominal.closest(apply(case.T_true, case.cloud.points_mm))
    start = Fit(T_nominal_scan=case.T_true, found=found, weak=(), iterations=0, converged=False)
    fit = fit_kept(case.cloud.points_mm, start, case.scan.depth_mm == 0.0, nominal, steps=20, close_mm=1e-7)
    return fit.T_nominal_scan


def sectional_rmse(case: Case, T: Floats, nominal: Nominal) -> Floats:
    """RMSE (20,) to the nominal of the points of 20 sections, each the same points whatever the pose."""
    distance_mm = nominal.closest(apply(T, case.cloud.points_mm)).distance_mm
    z_mm = case.scan.points_mm[:, 2]
    slabs = [np.abs(z_mm - z) < 0.3 for z in np.linspace(5.0, 70.0, 20)]
    return np.array([np.sqrt(np.mean(distance_mm[slab] ** 2)) for slab in slabs])


def displacement_mm(T: Floats, T_other: Floats, nominal: Nominal) -> float:
    """Largest displacement of the nominal's surface between two poses of a scan."""
    moved = apply(T @ inverse(T_other), nominal.samples.points_mm) - nominal.samples.points_mm
    return float(np.linalg.norm(moved, axis=1).max())


def judge(case: Case, method: Callable[[], Floats], nominal: Nominal, T_known: Floats) -> Row:
    start_s = time.process_time()
    T = method()
    cpu_s = time.process_time() - start_s
    change_mm = sectional_rmse(case, T, nominal) - sectional_rmse(case, case.T_true, nominal)
    return Row(
        section_mm=float(np.abs(change_mm).max()),
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


def shares(case: Case, nominal: Nominal) -> tuple[float, float]:
    """Damaged points found, and sound points masked."""
    alignment = register(case.cloud, nominal)
    flags = mask_damage(case.cloud, alignment, nominal)
    deep = case.scan.depth_mm > max(3.0 * case.noise_mm / np.sqrt(3.0), 0.03)
    return float(flags[deep].mean()), float(flags[case.scan.depth_mm == 0.0].mean())


def show(label: str, row: Row, product_s: float, tail: str = "") -> None:
    print(
        f"    {label:22s} {row.section_mm:9.4f} {row.true_mm:9.4f} {row.known_mm:9.4f}"
        f" {row.cpu_s:7.2f} {row.cpu_s / product_s:6.1f}x {tail}",
        flush=True,
    )


def compare(case: Case, nominal: Nominal, peers: bool) -> None:
    """Print one block: product and peers on one case."""
    T_known = known_pose(case, nominal)
    product = judge(case, lambda: register(case.cloud, nominal).T_nominal_scan, nominal, T_known)
    found, false = shares(case, nominal)
    damaged = np.mean(case.scan.depth_mm > 0.0)
    print(f"  {case.name}, noise {case.noise_mm:g}: {len(case.cloud)} points, {damaged:.1%} damaged")
    show("product", product, product.cpu_s, f"found {found:.3f} false {false:.3f}")
    show("known damage", judge(case, lambda: T_known, nominal, T_known), product.cpu_s)
    if peers:
        T_start = find_pose(case.cloud.points_mm, nominal, CoarseSettings()).T_nominal_scan
        pick = np.random.default_rng(0).choice(len(nominal.samples.points_mm), 60_000, replace=True)
        targets_mm = nominal.samples.points_mm[np.unique(pick)]
        normals = nominal.samples.normals[np.unique(pick)]
        tukey = judge(case, lambda: open3d_tukey(case, T_start, targets_mm, normals), nominal, T_known)
        show("Open3D Tukey", tukey, product.cpu_s)
        plane = judge(case, lambda: small_gicp_plane(case, T_start, targets_mm), nominal, T_known)
        show("small_gicp plane", plane, product.cpu_s)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--without-peers", action="store_true")
    asked = arguments.parse_args()
    settings = NominalSettings(z_min_mm=0.0, z_max_mm=BLADE.height_mm, sample_mm=0.35)
    nominal = prepare_nominal(blades.mesh(BLADE, around=600, up=160), settings)
    register(case_of("blade 1", 0.0, True, 0).cloud, nominal)  # compiles the kernels
    print(f"registration, seed {asked.seed}; mm; CPU s and ratio to the product")
    print(f"    {'':22s} {'section':>9s} {'true':>9s} {'known':>9s} {'s':>7s}")
    for form in (True, False):
        print(f"form error {'0.010 to 0.035 mm' if form else 'off'}")
        for name in DAMAGE:
            for noise_mm in NOISES_MM if form and name != "blade 3" else (0.05,):
                peers = not asked.without_peers and noise_mm in {0.0, 0.05} and form
                compare(case_of(name, noise_mm, form, asked.seed), nominal, peers)


if __name__ == "__main__":
    main()
