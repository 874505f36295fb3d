"""A small analytic blade: sections, edges and damage known from its own formulas, never from geometry."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from geometry.types import Floats, Mesh


@dataclass(frozen=True, slots=True, kw_only=True)
class Blade:
    """Sections x = (1 - cos t) / 2, y = camber 4 x (1 - x) +- sin(t) / 2 S(x), chord times as large.

    t = 0 is the leading and t = pi the trailing edge; S is quadratic with the edge radii at its ends. The
    section turns about z with `twist_deg` over the height and shrinks by `taper`.
    """

    chord_mm: float = 45.0
    height_mm: float = 105.0
    thickness_mm: float = 5.0
    le_radius_mm: float = 0.8
    te_radius_mm: float = 0.45
    camber: float = 0.06
    twist_deg: float = 25.0
    taper: float = 0.12
    thickness_taper: float = 0.25

    def point(self, t: Floats, z_mm: Floats) -> Floats:
        """Surface points (n, 3)."""
        x = 0.5 * (1.0 - np.cos(t))
        up = z_mm / self.height_mm
        ends = np.sqrt(2.0 * np.array([self.le_radius_mm, self.te_radius_mm]) / self.chord_mm)
        middle = 2.0 * self.thickness_mm / self.chord_mm - 0.5 * ends.sum()
        shape = ends[0] * (1 - x) ** 2 + 2.0 * middle * x * (1 - x) + ends[1] * x**2
        half = 0.5 * np.sin(t) * shape * (1.0 - self.thickness_taper * up)
        scale = self.chord_mm * (1.0 - self.taper * up)
        flat = np.column_stack([(x - 0.45) * scale, (self.camber * 4.0 * x * (1 - x) + half) * scale])
        turn = np.deg2rad(self.twist_deg) * up
        c, s = np.cos(turn), np.sin(turn)
        return np.column_stack([c * flat[:, 0] - s * flat[:, 1], s * flat[:, 0] + c * flat[:, 1], z_mm])

    def normal(self, t: Floats, z_mm: Floats) -> tuple[Floats, Floats]:
        """Unit outward normals (n, 3) and area per dt dz (n,), by central differences."""
        h = 1e-5
        along = (self.point(t + h, z_mm) - self.point(t - h, z_mm)) / (2 * h)
        up = (self.point(t, z_mm + h) - self.point(t, z_mm - h)) / (2 * h)
        outward = np.cross(up, along)
        area = np.linalg.norm(outward, axis=1)
        return outward / area[:, None], area


def mesh(blade: Blade, around: int = 400, up: int = 106, z0_mm: float = 0.0) -> Mesh:
    """The blade as a closed solid: `around` (even) points a section, `up` sections, flat end faces."""
    t = 2.0 * np.pi * np.arange(around) / around
    heights = np.linspace(0.0, blade.height_mm, up)
    rings = [blade.point(t, np.full(around, z)) for z in heights]
    vertices = np.concatenate(rings) + np.array([0.0, 0.0, z0_mm])
    i, j = np.meshgrid(np.arange(around), np.arange(up - 1), indexing="xy")
    a, b = (j * around + i).ravel(), (j * around + (i + 1) % around).ravel()
    c, d = a + around, b + around
    walls = np.concatenate([np.column_stack([a, c, b]), np.column_stack([b, c, d])])
    top = (up - 1) * around
    bottom_cap = _cap(around)
    return Mesh(vertices_mm=vertices, faces=np.concatenate([walls, bottom_cap, bottom_cap[:, ::-1] + top]))


def _cap(around: int) -> np.ndarray:
    """Strips between t and -t, seen from below."""
    half = around // 2
    faces = [(0, 1, around - 1)]
    for k in range(1, half - 1):
        upper, lower = k, around - k
        faces += [(upper, upper + 1, lower), (upper + 1, lower - 1, lower)]
    faces.append((half - 1, half, half + 1))
    return np.array(faces)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Points of a blade, blade frame: `depth_mm` is how far damage moved each inward, infinity on a cut."""

    points_mm: Floats
    normals: Floats
    depth_mm: Floats


def scan(blade: Blade, per_mm2: float, rng: np.random.Generator, *, tip_face: bool = True) -> Scan:
    """Points even over the exact surface, by default with its tip face."""
    densest = 1.3 * blade.normal(np.full(2, np.pi / 2), np.zeros(2))[1][0]  # mm2 for each unit of t and z
    drawn = int(per_mm2 * densest * 2 * np.pi * blade.height_mm)
    t, z = rng.uniform(0, 2 * np.pi, drawn), rng.uniform(0, blade.height_mm, drawn)
    normals, density = blade.normal(t, z)
    kept = rng.uniform(0, densest, drawn) < density
    points, normals = blade.point(t[kept], z[kept]), normals[kept]
    if tip_face:
        lid = _lid(blade, per_mm2, rng, lambda points: np.full(len(points), blade.height_mm))
        points, normals = np.concatenate([points, lid]), np.concatenate([normals, _up(len(lid))])
    return Scan(points_mm=points, normals=normals, depth_mm=np.zeros(len(points)))


def _up(count: int) -> Floats:
    return np.tile([0.0, 0.0, 1.0], (count, 1))


def _lid(blade: Blade, per_mm2: float, rng: np.random.Generator, height) -> Floats:
    """Points even over the surface z = height(points) inside the blade."""
    t, mix = np.arccos(rng.uniform(-1, 1, 100_000)), rng.uniform(0, 1, (100_000, 1))
    z = np.full(len(t), blade.height_mm)
    for _ in range(8):
        upper, lower = blade.point(t, z), blade.point(-t, z)
        z = np.minimum(height(mix * upper + (1 - mix) * lower), blade.height_mm)
    width = np.linalg.norm(blade.point(t, z) - blade.point(-t, z), axis=1)
    wanted = int(per_mm2 * width.mean() * blade.chord_mm * (1 - blade.taper))
    chosen = rng.choice(len(t), min(wanted, len(t)), replace=False, p=width / width.sum())
    points = mix[chosen] * upper[chosen] + (1 - mix[chosen]) * lower[chosen]
    return np.column_stack([points[:, :2], z[chosen]])


def with_form_error(scan: Scan, size_mm: float) -> Scan:
    """The points moved along their normals by a smooth wave of amplitude `size_mm`."""
    x, _, z = scan.points_mm.T
    wave = size_mm * np.sin(0.45 * x + 0.07 * z) * np.cos(0.05 * z + 0.3)
    return replace(scan, points_mm=scan.points_mm + wave[:, None] * scan.normals)


def with_noise(scan: Scan, sigma_mm: float, rng: np.random.Generator) -> Scan:
    """The points moved along their normals by normal noise."""
    noise = (
        rng.normal(scale=sigma_mm, size=len(scan.points_mm)) if sigma_mm else np.zeros(len(scan.points_mm))
    )
    return replace(scan, points_mm=scan.points_mm + noise[:, None] * scan.normals)


def with_dent(scan: Scan, centre_mm: Floats, radius_mm: float, depth_mm: float) -> Scan:
    """A smooth dent: depth times (1 - (r / radius)^2)^2, along the normal, round a point of the surface."""
    near = np.sum((scan.points_mm - centre_mm) ** 2, axis=1) / radius_mm**2
    inward = np.where(near < 1.0, depth_mm * (1.0 - np.minimum(near, 1.0)) ** 2, 0.0)
    points_mm = scan.points_mm - inward[:, None] * scan.normals
    return replace(scan, points_mm=points_mm, depth_mm=scan.depth_mm + inward)


def with_tip_cut(
    scan: Scan, blade: Blade, depth_mm: float, rng: np.random.Generator, slope: float = 0.5
) -> Scan:
    """The trailing corner of the tip gone above a plane `depth_mm` below it there, rising with `slope`."""
    te = blade.point(np.array([np.pi]), np.array([blade.height_mm]))[0]
    chordwise = blade.point(np.array([0.0]), np.array([blade.height_mm]))[0] - te
    chordwise /= np.linalg.norm(chordwise)

    def plane(points: Floats) -> Floats:
        return te[2] - depth_mm + slope * ((points - te) @ chordwise)

    below = scan.points_mm[:, 2] <= plane(scan.points_mm)
    per_mm2 = 1.0 / np.median(_spacing_mm(scan.points_mm)) ** 2 / 4.0
    cut = _lid(blade, per_mm2, rng, plane)
    cut = cut[cut[:, 2] < blade.height_mm - 1e-6]
    return Scan(
        points_mm=np.concatenate([scan.points_mm[below], cut]),
        normals=np.concatenate([scan.normals[below], _up(len(cut))]),
        depth_mm=np.concatenate([scan.depth_mm[below], np.full(len(cut), np.inf)]),
    )


def _spacing_mm(points: Floats) -> Floats:
    return cKDTree(points).query(points[:2000], k=2)[0][:, 1]
