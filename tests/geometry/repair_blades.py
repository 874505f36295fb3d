"""A blade with exact damage for the tests of repair and coverage: solids of manifold3d, volumes known.

The section is a shape-function airfoil over a parabolic camber line, twisted and tapered along z.
Nothing here uses the product but its plain data types.
"""

from dataclasses import dataclass, replace
from math import comb, pi, radians

import manifold3d
import mapbox_earcut
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geometry.damage.damages import Damage, DamageKind
from geometry.deformation.twin import Twin
from geometry.registration.alignment import Alignment
from geometry.types import Cloud, Measurand, Mesh, NotMeasured, Zone
from tests.geometry.poses import in_place

Array = NDArray[np.float64]

CHORD_MM, SPAN_MM, TWIST_RAD, TAPER, CAMBER = 32.0, 40.0, radians(14.0), 0.1, 0.24
LE_RADIUS_MM, TE_RADIUS_MM = 0.45, 0.3
_SHAPE = np.array(
    [np.sqrt(2.0 * LE_RADIUS_MM / CHORD_MM), 0.12, 0.14, 0.09, np.sqrt(2.0 * TE_RADIUS_MM / CHORD_MM)]
)


def section(theta: Array) -> Array:
    """Untwisted section (n, 2), counter-clockwise from the leading edge over the pressure side."""
    x = 0.5 * (1.0 - np.cos(theta))
    n = len(_SHAPE) - 1
    shape = sum(_SHAPE[k] * comb(n, k) * x**k * (1.0 - x) ** (n - k) for k in range(n + 1))
    half = -0.5 * np.sin(theta) * shape
    slope = CAMBER * (1.0 - 2.0 * x)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    return CHORD_MM * np.column_stack(
        [x - 0.45 - half * slope * cosine, CAMBER * x * (1.0 - x) + half * cosine - 0.04]
    )


def blade_mesh(pitch_mm: float = 0.35) -> Mesh:
    """The closed blade, its end faces flat at z = 0 and z = SPAN_MM."""
    dense = np.linspace(0.0, 2.0 * pi, 20001)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(section(dense), axis=0), axis=1))])
    around = int(arc[-1] / pitch_mm)
    flat = section(np.interp(np.arange(around) * arc[-1] / around, arc, dense))
    z = np.linspace(0.0, SPAN_MM, int(SPAN_MM / pitch_mm) + 1)
    rings = []
    for height in z:
        angle, scale = TWIST_RAD * (height / SPAN_MM - 0.5), 1.0 - TAPER * height / SPAN_MM
        c, s = np.cos(angle), np.sin(angle)
        rings.append(np.column_stack([scale * flat @ np.array([[c, s], [-s, c]]), np.full(around, height)]))
    i, j = np.meshgrid(np.arange(len(z) - 1), np.arange(around), indexing="ij")
    a, b = (i * around + j).ravel(), (i * around + (j + 1) % around).ravel()
    side = np.concatenate([np.column_stack([a, b, b + around]), np.column_stack([a, b + around, a + around])])
    cap = (
        mapbox_earcut.triangulate_float64(flat, np.array([around], np.uint32)).reshape(-1, 3).astype(np.int64)
    )
    (ax, ay), (bx, by) = (np.moveaxis(flat[cap][:, i] - flat[cap][:, 0], 1, 0) for i in (1, 2))
    clockwise = ax * by - ay * bx < 0.0
    cap[clockwise] = cap[clockwise][:, ::-1]
    faces = np.concatenate([side, cap[:, ::-1], cap + (len(z) - 1) * around])
    return Mesh(vertices_mm=np.concatenate(rings), faces=faces)


def solid_of(mesh: Mesh) -> manifold3d.Manifold:
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.array(mesh.vertices_mm), np.array(mesh.faces, np.uint64))
    )
    assert solid.status() == manifold3d.Error.NoError, solid.status()
    return solid


def mesh_of(solid: manifold3d.Manifold) -> Mesh:
    raw = solid.to_mesh64()
    return Mesh(
        vertices_mm=np.asarray(raw.vert_properties)[:, :3], faces=np.asarray(raw.tri_verts).astype(np.int64)
    )


def frame_with_z(direction: Array) -> Array:
    """A rotation whose third column is `direction`."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, [0.31, 0.82, 0.48])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def wavy_cutter(
    at_mm: Array, outward: Array, wave_mm: float = 0.35, length_mm: float = 4.0, half_mm: float = 27.0
) -> manifold3d.Manifold:
    """All that lies beyond a wavy surface through `at_mm` that faces `outward`."""
    n = int(2.0 * half_mm / 0.3)
    u = np.linspace(-half_mm, half_mm, n + 1)
    grid = np.stack(np.meshgrid(u, u, indexing="ij"), -1).reshape(-1, 2)
    height = (
        wave_mm
        * np.sin(2 * pi * grid[:, 0] / length_mm)
        * np.cos(2 * pi * grid[:, 1] / (1.3 * length_mm) + 0.4)
    )
    return _column_solid(grid, height, half_mm, n, frame_with_z(outward), at_mm)


def _column_solid(
    grid: Array, height: Array, top_mm: float, n: int, R: Array, at_mm: Array
) -> manifold3d.Manifold:
    """Everything between a height field over a square grid of n cells a side and the flat `top_mm`."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a = (i * (n + 1) + j).ravel()
    b, c, d = a + n + 1, a + n + 2, a + 1
    bottom = np.concatenate([np.column_stack([a, c, b]), np.column_stack([a, d, c])])
    count = (n + 1) ** 2
    rim = np.concatenate(
        [
            np.arange(n) * (n + 1),
            n * (n + 1) + np.arange(n),
            (n - np.arange(n)) * (n + 1) + n,
            n - np.arange(n),
        ]
    )
    after = np.roll(rim, -1)
    walls = np.concatenate(
        [np.column_stack([rim, after, after + count]), np.column_stack([rim, after + count, rim + count])]
    )
    top = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]) + count
    vertices = np.concatenate(
        [np.column_stack([grid, height]), np.column_stack([grid, np.full(count, top_mm)])]
    )
    faces = np.concatenate([bottom, walls, top])
    return solid_of(Mesh(vertices_mm=vertices @ R.T + at_mm, faces=faces))


def tip_corner_cutter(depth_mm: float = 8.0, wave_mm: float = 0.35) -> manifold3d.Manifold:
    """Cuts the trailing-edge corner of the tip: about `depth_mm` along the span at the edge."""
    edge = trailing_edge_at(SPAN_MM - depth_mm)
    return wavy_cutter(edge, np.array([0.62, 0.1, 0.77]), wave_mm)


def tip_cutter(depth_mm: float = 3.0, wave_mm: float = 0.35) -> manifold3d.Manifold:
    """Cuts the whole tip off."""
    return wavy_cutter(np.array([0.0, 0.0, SPAN_MM - depth_mm]), np.array([0.12, 0.05, 1.0]), wave_mm)


def _placed(x: float, y: float, z_mm: float) -> Array:
    angle, scale = TWIST_RAD * (z_mm / SPAN_MM - 0.5), 1.0 - TAPER * z_mm / SPAN_MM
    c, s = np.cos(angle), np.sin(angle)
    return np.array([scale * (c * x - s * y), scale * (s * x + c * y), z_mm])


def trailing_edge_at(z_mm: float) -> Array:
    x, y = section(np.array([pi]))[0]
    return _placed(x, y, z_mm)


def leading_edge_at(z_mm: float) -> Array:
    x, y = section(np.array([0.0]))[0]
    return _placed(x, y, z_mm)


def pressure_side_at(share: float, z_mm: float) -> tuple[Array, Array]:
    """A point of the pressure side (0 leading edge, 1 trailing edge) and the outward normal there."""
    return _side_at(pi * share, z_mm)


def suction_side_at(share: float, z_mm: float) -> tuple[Array, Array]:
    return _side_at(2.0 * pi - pi * share, z_mm)


def _side_at(theta: float, z_mm: float) -> tuple[Array, Array]:
    t = np.array([theta - 1e-5, theta, theta + 1e-5])
    p = np.array([_placed(x, y, z_mm) for x, y in section(t)])
    above = np.array([_placed(x, y, z_mm + 1e-3) for x, y in section(t[1:2])])[0]
    normal = np.cross(p[2] - p[0], above - p[1])
    return p[1], normal / np.linalg.norm(normal)


def pit_cutter(depth_mm: float = 1.2, radius_mm: float = 3.0, share: float = 0.45) -> manifold3d.Manifold:
    """A ball that dips `depth_mm` into the pressure side."""
    at, normal = pressure_side_at(share, 0.55 * SPAN_MM)
    ball = manifold3d.Manifold.sphere(radius_mm, 160)
    return ball.translate(tuple(at + (radius_mm - depth_mm) * normal))


def hole_cutter(radius_mm: float = 1.5, share: float = 0.45) -> manifold3d.Manifold:
    """A drill through the blade from the pressure side."""
    at, normal = pressure_side_at(share, 0.55 * SPAN_MM)
    drill = manifold3d.Manifold.cylinder(24.0, radius_mm, radius_mm, 160, True)
    return drill.transform(np.column_stack([frame_with_z(normal), at]))


def dent_cutter(depth_mm: float = 0.8, width_mm: float = 1.6, share: float = 0.4) -> manifold3d.Manifold:
    """A smooth hollow whose rim runs out tangentially into the suction side."""
    at, normal = suction_side_at(share, 0.5 * SPAN_MM)
    n, half = 160, 6.0
    u = np.linspace(-half, half, n + 1)
    grid = np.stack(np.meshgrid(u, u, indexing="ij"), -1).reshape(-1, 2)
    lift = 0.04 * (grid**2).sum(1)  # off the curved skin at the rim
    height = lift - depth_mm * np.exp(-(grid**2).sum(1) / width_mm**2)
    return _column_solid(grid, height, half, n, frame_with_z(normal), at)


def edge_nick_cutter(
    depth_mm: float = 2.0, radius_mm: float = 2.0, z_mm: float = 20.0
) -> manifold3d.Manifold:
    """A round file across the leading edge."""
    edge = leading_edge_at(z_mm)
    inward = np.array([1.0, 0.0, 0.0])
    round_file = manifold3d.Manifold.cylinder(12.0, radius_mm, radius_mm, 200, True).rotate((75.0, 0.0, 0.0))
    return round_file.translate(tuple(edge + (depth_mm - radius_mm) * inward))


def eroded_edge_cutter(
    depth_mm: float = 0.4, radius_mm: float = 1.5, half_mm: float = 13.0
) -> manifold3d.Manifold:
    """Wears the leading edge back over 24 mm of the span, evenly, to a blunter round."""
    z_mm, n = 0.5 * SPAN_MM, 240
    low, high = leading_edge_at(z_mm - 5.0), leading_edge_at(z_mm + 5.0)
    along = (high - low) / np.linalg.norm(high - low)
    across = np.cross(leading_edge_at(z_mm) - trailing_edge_at(z_mm), along)
    across /= np.linalg.norm(across)
    R = np.column_stack([along, across, np.cross(along, across)])
    u = np.linspace(-half_mm, half_mm, n + 1)
    grid = np.stack(np.meshgrid(u, u, indexing="ij"), -1).reshape(-1, 2)
    height = -depth_mm * (1.0 - 1.2 * (grid[:, 0] / half_mm) ** 4) - grid[:, 1] ** 2 / (2.0 * radius_mm)
    return _column_solid(grid, np.maximum(height, -CHORD_MM / 4), half_mm, n, R, leading_edge_at(z_mm))


CUTTERS = {
    "tip corner": (Zone.TIP, tip_corner_cutter),
    "small tip corner": (Zone.TIP, lambda: tip_corner_cutter(4.0)),
    "rough tip corner": (Zone.TIP, lambda: tip_corner_cutter(8.0, 0.8)),
    "whole tip": (Zone.TIP, tip_cutter),
    "pit": (Zone.SURFACE, pit_cutter),
    "shallow dent": (Zone.SURFACE, dent_cutter),
    "edge nick": (Zone.LEADING_EDGE, edge_nick_cutter),
    "eroded edge": (Zone.LEADING_EDGE, eroded_edge_cutter),
}


@dataclass(frozen=True)
class Specimen:
    """A damaged blade, its truth, and its scan in the nominal frame."""

    twin: Twin
    cloud: Cloud
    alignment: Alignment
    damages: tuple[Damage, ...]
    removed_mm3: tuple[float, ...]  # or put on
    damaged: Mesh
    on_break: NDArray[np.int64]  # (points,) number of the damage that the point lies on, -1 none


def twin_of(mesh: Mesh, sound: NDArray[np.bool_], noise_mm: float, sigma_mm: float = 0.002) -> Twin:
    count = len(mesh.vertices_mm)
    return Twin(
        mesh=mesh,
        nominal_face=np.arange(len(mesh.faces)),
        displacement_mm=np.zeros((count, 3)),
        sigma_mm=np.full(count, sigma_mm),
        supported=np.ones(count, bool),
        form_mm=Measurand(name="form", value=0.0, sigma=0.001, unit="mm"),
        sound=sound,
        noise_mm=noise_mm,
        sound_rms_mm=noise_mm,
        iterations=3,
        converged=True,
    )


def specimen(
    cutters: dict[Zone, manifold3d.Manifold],
    noise_mm: float,
    rng: np.random.Generator,
    per_mm2: float = 25.0,
    pitch_mm: float = 0.35,
    z_from_mm: float = 0.0,
    adds: bool = False,
) -> Specimen:
    """A blade cut by `cutters`, or with these put on, scanned at random with noise along the normal."""
    mesh = blade_mesh(pitch_mm)
    whole = solid_of(mesh).as_original()
    rest, removed = whole, []
    marks = {whole.original_id(): -1}
    for number, tool in enumerate(cutters.values()):
        cutter = tool.as_original()
        marks[cutter.original_id()] = number
        removed.append(float((cutter - rest if adds else rest ^ cutter).volume()))
        rest = rest + cutter if adds else rest - cutter
    damaged = mesh_of(rest)
    points, normals, face = _sampled(damaged, per_mm2, rng)
    on_break = _marks(rest, marks)[face]
    keep = (points[:, 2] > z_from_mm) & ~((normals[:, 2] < -0.9) & (points[:, 2] < 1e-6))
    points, normals, on_break = points[keep], normals[keep], on_break[keep]
    scan = points + noise_mm * rng.standard_normal(len(points))[:, None] * normals
    cloud = Cloud(
        points_mm=scan,
        sigma_mm=np.full(len(scan), max(noise_mm, 0.002)),
        view=np.zeros(len(scan), np.int64),
    )
    damages = tuple(damage_at(zone, scan, on_break == number) for number, zone in enumerate(cutters))
    return Specimen(
        twin=twin_of(mesh, on_break < 0, noise_mm),
        cloud=cloud,
        alignment=in_place(),
        damages=damages,
        removed_mm3=tuple(removed),
        damaged=damaged,
        on_break=on_break,
    )


def _marks(solid: manifold3d.Manifold, marks: dict[int, int]) -> NDArray[np.int64]:
    """The number of the damage that made each face, -1 where it is the blade's own skin."""
    raw = solid.to_mesh64()
    runs = np.asarray(raw.run_index) // 3
    mark = np.full(len(raw.tri_verts), -1)
    for origin, start, stop in zip(raw.run_original_id, runs[:-1], runs[1:], strict=True):
        mark[int(start) : int(stop)] = marks[int(origin)]
    return mark


def _sampled(mesh: Mesh, per_mm2: float, rng: np.random.Generator) -> tuple[Array, Array, NDArray[np.int64]]:
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces], 1, 0)
    cross = np.cross(b - a, c - a)
    twice = np.linalg.norm(cross, axis=1)
    count = int(rng.poisson(0.5 * twice.sum() * per_mm2))
    face = rng.choice(len(twice), count, p=twice / twice.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    points = a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]
    return points, cross[face] / twice[face][:, None], face


def without(scanned: Specimen, gone: NDArray[np.bool_]) -> Specimen:
    """The same specimen, but the scan lacks some points."""
    kept, number = ~gone, np.cumsum(~gone) - 1
    cloud, damages = scanned.cloud, scanned.damages
    return replace(
        scanned,
        cloud=cloud.of(kept),
        damages=tuple(replace(d, points=number[d.points[kept[d.points]]]) for d in damages),
        on_break=scanned.on_break[kept],
    )


def damage_at(
    zone: Zone,
    points: Array,
    broken: NDArray[np.bool_],
    ring_mm: float = 0.3,
    kind: DamageKind = DamageKind.MISSING,
) -> Damage:
    """The damage as a mask finds it: the broken points and a ring of sound ones round them."""
    distance, _ = cKDTree(points[broken]).query(points, distance_upper_bound=ring_mm)
    nothing = NotMeasured(reason="not asked")
    return Damage(
        zone=zone,
        kind=kind,
        depth_mm=nothing,
        area_mm2=nothing,
        volume_mm3=nothing,
        length_mm=float(np.ptp(points[broken], axis=0).max()),
        span_mm=(float(points[broken, 2].min()), float(points[broken, 2].max())),
        centroid_mm=points[broken].mean(axis=0),
        points=np.flatnonzero(np.isfinite(distance)),
    )
