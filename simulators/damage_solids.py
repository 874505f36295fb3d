"""Broken tips, nicks and pits as exact solid subtraction, with the volume and depth of each.

A cutter is a rough height field over a plane: the fracture surface below, everything outward of it
taken away. What it removes is the intersection with the blade, so volume and depth belong to the very
mesh that is scanned. Works on any closed blade whose airfoil is known.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Literal

import manifold3d
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from simulators.airfoils import Airfoil, airfoil_loop
from simulators.solids import Floats, Ints, NotASolid, Solid, from_manifold, to_manifold

ZoneName = Literal["tip", "leading_edge", "trailing_edge", "surface"]
Relief = Callable[[Floats, Floats], Floats]  # (u, v) -> how far inward the fracture lies
WAVES = 9  # of a rough surface
EDGE_SLICES = 41
DEEPEST = 40  # fracture points whose depth is computed exactly


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cut:
    """One cutter: a closed solid, and the zone in which its damage counts."""

    zone: ZoneName
    cutter: Solid


@dataclass(frozen=True, slots=True, kw_only=True)
class DamageTruth:
    """One damage as it was made, nominal frame."""

    zone: ZoneName
    volume_mm3: float
    depth_mm: float
    area_mm2: float  # of the lost skin
    centroid_mm: tuple[float, float, float]
    z_low_mm: float
    z_high_mm: float

    def __post_init__(self) -> None:
        if not (isfinite(self.depth_mm) and self.depth_mm > 0.0 and self.volume_mm3 > 0.0):
            raise NotASolid(f"{self.zone}: a cutter that removes nothing")


def break_off(airfoil: Airfoil, cuts: Sequence[Cut]) -> tuple[Solid, tuple[DamageTruth, ...]]:
    """The airfoil's solid after all cuts, and the truth of each. Cuts must not overlap.

    Raises `NotASolid` when a cut misses the blade or severs it in two.
    """
    blade = to_manifold(airfoil.solid)
    chips = []
    for cut in cuts:
        blade = blade.as_original()
        cutter = to_manifold(cut.cutter)
        rest = blade - cutter
        chips.append((cut.zone, blade ^ cutter, rest, blade.original_id()))
        blade = rest
    if len(blade.decompose()) != 1:
        raise NotASolid("a damage severs the blade")
    truths = tuple(_truth(airfoil, *chip) for chip in chips)
    return from_manifold(blade) if cuts else airfoil.solid, truths


def _truth(
    airfoil: Airfoil, zone: ZoneName, removed: manifold3d.Manifold, rest: manifold3d.Manifold, blade_id: int
) -> DamageTruth:
    if removed.is_empty():
        raise NotASolid(f"{zone}: the cutter misses the blade")
    chip = from_manifold(removed)
    skin = _faces_from(removed, blade_id)
    fracture = chip.vertices_mm[np.unique(np.delete(chip.faces, skin, axis=0))]
    heights = chip.vertices_mm[:, 2]
    return DamageTruth(
        zone=zone,
        volume_mm3=float(removed.volume()),
        depth_mm=_depth_mm(airfoil, zone, rest, chip.vertices_mm[chip.faces[skin]], fracture),
        area_mm2=_area_mm2(chip.vertices_mm[chip.faces[skin]]),
        centroid_mm=_centroid_mm(chip),
        z_low_mm=float(heights.min()),
        z_high_mm=float(heights.max()),
    )


def _depth_mm(
    airfoil: Airfoil, zone: ZoneName, rest: manifold3d.Manifold, skin_mm: Floats, fracture_mm: Floats
) -> float:
    if zone == "tip":
        return float(airfoil.solid.vertices_mm[:, 2].max() - fracture_mm[:, 2].min())
    if zone == "surface":
        return _normal_depth_mm(skin_mm, fracture_mm)
    after = from_manifold(rest)
    levels = np.linspace(fracture_mm[:, 2].min(), fracture_mm[:, 2].max(), EDGE_SLICES + 2)[1:-1]
    return max(_edge_loss_mm(airfoil, zone, after, float(z)) for z in levels)


def _faces_from(removed: manifold3d.Manifold, blade_id: int) -> Ints:
    mesh = removed.to_mesh64()
    starts = np.array(mesh.run_index, dtype=np.int64) // 3
    runs = [
        np.arange(a, b)
        for a, b, source in zip(starts[:-1], starts[1:], mesh.run_original_id, strict=True)
        if source == blade_id
    ]
    return np.concatenate(runs) if runs else np.zeros(0, dtype=np.int64)


def _edge_loss_mm(airfoil: Airfoil, zone: ZoneName, after: Solid, z_mm: float) -> float:
    """How far along the chord the edge of one section lies behind where it was."""
    le, te = airfoil.edge_points_mm(z_mm)
    inward = (te - le)[:2] if zone == "leading_edge" else (le - te)[:2]
    edge = le if zone == "leading_edge" else te
    rest = airfoil_loop(after, z_mm) - edge[:2]
    return float((rest @ inward).min() / np.linalg.norm(inward))


def _normal_depth_mm(skin_mm: Floats, fracture_mm: Floats) -> float:
    """From the lost skin (m, 3, 3), the distance of the fracture point that is farthest from it."""
    rough = cKDTree(skin_mm.mean(axis=1)).query(fracture_mm)[0]
    deepest = fracture_mm[np.argsort(-rough)[:DEEPEST]]
    pairs = np.repeat(skin_mm[None], len(deepest), axis=0).reshape(-1, 3, 3)
    points = np.repeat(deepest, len(skin_mm), axis=0)
    gaps = np.linalg.norm(trimesh.triangles.closest_point(pairs, points) - points, axis=1)
    return float(gaps.reshape(len(deepest), -1).min(axis=1).max())


def _area_mm2(triangles_mm: Floats) -> float:
    a, b, c = np.moveaxis(triangles_mm, 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _centroid_mm(chip: Solid) -> tuple[float, float, float]:
    origin = chip.vertices_mm.mean(axis=0)
    a, b, c = (chip.vertices_mm - origin)[chip.faces.T]
    six_volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    x, y, z = origin + ((a + b + c) * six_volumes[:, None]).sum(axis=0) / (4.0 * six_volumes.sum())
    return float(x), float(y), float(z)


def tip_corner(airfoil: Airfoil, depth_mm: float, chord_fraction: float, rng: np.random.Generator) -> Cut:
    """The corner of tip and trailing edge broken off: from `chord_fraction` of the chord at the tip down
    to about `depth_mm` below it at the trailing edge."""
    le, te = airfoil.edge_points_mm(airfoil.z_max_mm)
    start = le + chord_fraction * (te - le)
    end = airfoil.edge_points_mm(airfoil.z_max_mm - depth_mm)[1]
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    flat = te - le
    across = _unit(np.array([-flat[1], flat[0], 0.0]))
    size = airfoil.chord_mm
    return Cut(
        zone="tip",
        cutter=_height_field(
            start,
            along,
            across,
            u_mm=(-0.4 * length - 0.1 * size, 1.4 * length + 0.1 * size),
            v_mm=(-0.4 * size, 0.4 * size),
            relief=_roughness(rng, 0.008 * size, 0.2 * size),
            out_mm=1.2 * (size + depth_mm),
            pitch_mm=size / 250.0,
            toward=te - start,
        ),
    )


def tip_loss(airfoil: Airfoil, depth_mm: float, rng: np.random.Generator) -> Cut:
    """The whole tip gone, to about `depth_mm`."""
    le, te = airfoil.edge_points_mm(airfoil.z_max_mm - depth_mm)
    size = airfoil.chord_mm
    along = _unit(te - le + np.array([0.0, 0.0, rng.uniform(-0.05, 0.05) * size]))
    across = _unit(np.array([-along[1], along[0], 0.0]))
    return Cut(
        zone="tip",
        cutter=_height_field(
            0.5 * (le + te),
            along,
            across,
            u_mm=(-0.75 * size, 0.75 * size),
            v_mm=(-0.5 * size, 0.5 * size),
            relief=_roughness(rng, 0.008 * size, 0.2 * size),
            out_mm=size + depth_mm,
            pitch_mm=size / 250.0,
            toward=np.array([0.0, 0.0, 1.0]),
        ),
    )


def edge_nick(
    airfoil: Airfoil,
    zone: Literal["leading_edge", "trailing_edge"],
    span_fraction: float,
    depth_mm: float,
    width_mm: float,
    rng: np.random.Generator,
) -> Cut:
    """A notch through the edge, about `depth_mm` deep in the section and `width_mm` long on the edge.

    Its flank toward the tip is the gentle one, so that a scanner that looks down sees all of it.
    """
    z_mm = airfoil.height_mm(span_fraction)
    le, te = airfoil.edge_points_mm(z_mm)
    edge, far = (le, te) if zone == "leading_edge" else (te, le)
    outward = _unit(edge - far)
    across = np.array([-outward[1], outward[0], 0.0])
    rough = _roughness(rng, 0.04 * depth_mm, width_mm)
    below, above = 0.3 * width_mm, 0.7 * width_mm

    def relief(u: Floats, v: Floats) -> Floats:
        return depth_mm * (1.0 - (u / np.where(u < 0.0, below, above)) ** 2) + rough(u, v)

    return Cut(
        zone=zone,
        cutter=_height_field(
            edge,
            np.array([0.0, 0.0, 1.0]),
            across,
            u_mm=(-1.1 * below, 1.1 * above),
            v_mm=(-0.2 * airfoil.chord_mm, 0.2 * airfoil.chord_mm),
            relief=relief,
            out_mm=0.2 * airfoil.chord_mm,
            pitch_mm=width_mm / 50.0,
            toward=outward,
        ),
    )


def pit(
    airfoil: Airfoil,
    span_fraction: float,
    chord_fraction: float,
    depth_mm: float,
    radius_mm: float,
    rng: np.random.Generator,
) -> Cut:
    """A void on the pressure side: a rough spherical cap, about `depth_mm` deep along the normal."""
    centre, along, across, outward = _pressure_frame(airfoil, span_fraction, chord_fraction)
    sphere_mm = (radius_mm**2 + depth_mm**2) / (2.0 * depth_mm)
    rough = _roughness(rng, 0.05 * depth_mm, radius_mm)

    def relief(u: Floats, v: Floats) -> Floats:
        sagitta = sphere_mm - np.sqrt(np.maximum(sphere_mm**2 - u**2 - v**2, 0.0))
        return np.maximum(depth_mm - sagitta + rough(u, v), -0.4 * depth_mm)

    reach = 1.1 * radius_mm
    return Cut(
        zone="surface",
        cutter=_height_field(
            centre,
            along,
            across,
            u_mm=(-reach, reach),
            v_mm=(-reach, reach),
            relief=relief,
            out_mm=2.0 * radius_mm,
            pitch_mm=radius_mm / 25.0,
            toward=outward,
        ),
    )


def _pressure_frame(
    airfoil: Airfoil, span_fraction: float, chord_fraction: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """A point on the pressure side, two tangents and the outward normal there."""
    z_mm, step = airfoil.height_mm(span_fraction), 0.01 * airfoil.span_mm
    frame = airfoil.frame(z_mm)
    centre = frame.pressure_point_mm(chord_fraction)
    chordwise = frame.pressure_point_mm(chord_fraction + 0.02) - frame.pressure_point_mm(
        chord_fraction - 0.02
    )
    spanwise = airfoil.frame(z_mm + step).pressure_point_mm(chord_fraction) - airfoil.frame(
        z_mm - step
    ).pressure_point_mm(chord_fraction)
    normal = _unit(np.cross(chordwise, spanwise))
    inward = np.append(frame.toward_suction, 0.0)
    along = _unit(chordwise)
    return centre, along, np.cross(normal, along), -normal * np.sign(normal @ inward)


def _unit(vector: Floats) -> Floats:
    unit: Floats = vector / np.linalg.norm(vector)
    return unit


def _roughness(rng: np.random.Generator, amplitude_mm: float, longest_mm: float) -> Relief:
    """A wavy relief of about `amplitude_mm`: plane waves, shorter ones lower, in random directions."""
    lengths = longest_mm * np.geomspace(1.0, 0.12, WAVES)
    heading, phase = rng.uniform(0.0, 2.0 * np.pi, (2, WAVES))
    heights = amplitude_mm * rng.uniform(0.5, 1.0, WAVES) * (lengths / longest_mm) ** 1.2

    def relief(u: Floats, v: Floats) -> Floats:
        total = np.zeros_like(u)
        for length, angle, shift, height in zip(lengths, heading, phase, heights, strict=True):
            run = u * np.cos(angle) + v * np.sin(angle)
            total += height * np.sin(2.0 * np.pi * run / length + shift)
        return total

    return relief


def _height_field(
    origin: Floats,
    along: Floats,
    across: Floats,
    *,
    u_mm: tuple[float, float],
    v_mm: tuple[float, float],
    relief: Relief,
    out_mm: float,
    pitch_mm: float,
    toward: Floats,
) -> Solid:
    """The closed solid between the relief and a plane `out_mm` outside; outside is on the side `toward`.

    `along` and `across` (3,) span the plane through `origin`; the relief counts inward.
    """
    outward = np.cross(along, across)
    if outward @ toward < 0.0:
        across, outward = -across, -outward
    axes = [np.linspace(a, b, max(8, int(np.ceil((b - a) / pitch_mm)))) for a, b in (u_mm, v_mm)]
    u, v = np.meshgrid(*axes, indexing="ij")
    flat = origin + u[..., None] * along + v[..., None] * across
    broken = flat - relief(u, v)[..., None] * outward
    vertices = np.concatenate([broken.reshape(-1, 3), (flat + out_mm * outward).reshape(-1, 3)])
    return Solid(vertices_mm=vertices, faces=_slab_faces(*u.shape))


def _slab_faces(rows: int, columns: int) -> Ints:
    """Faces of two grids (rows, columns) one above the other, closed round the border."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    sheet = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    border = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    following = np.roll(border, -1)
    top = rows * columns
    wall = np.concatenate(
        [
            np.column_stack([border, following, following + top]),
            np.column_stack([border, following + top, border + top]),
        ]
    )
    return np.concatenate([sheet[:, ::-1], sheet + top, wall])
