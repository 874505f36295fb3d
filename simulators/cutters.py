"""Cutters: what breaks a tip off, nicks or erodes an edge, or pits a side, as closed solids.

A cutter is a rough height field over a plane, or along an edge: the fracture surface below, everything
outward of it taken away. Works on any closed blade whose airfoil is known.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from simulators.airfoils import Airfoil, SectionFrame, airfoil_loop
from simulators.solids import Floats, Ints, Solid

ZoneName = Literal["tip", "leading_edge", "trailing_edge", "surface"]
EdgeName = Literal["leading_edge", "trailing_edge"]
SideName = Literal["suction", "pressure"]
Relief = Callable[[Floats, Floats], Floats]  # (u, v) -> how far inward the fracture lies
WAVES = 9  # of a rough surface
BLUNT = 0.045  # radius of an eroded edge, of the chord, at least
FLAT = 2.0  # the same, of one that is as good as flat
WIDE = 0.1  # how far an eroded edge may reach to either side, of the chord


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cut:
    """One cutter: a closed solid, and the zone in which its damage counts. `adds`: its metal is put on."""

    zone: ZoneName
    cutter: Solid
    adds: bool = False


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
    zone: EdgeName,
    span_fraction: float,
    depth_mm: float,
    width_mm: float,
    rng: np.random.Generator,
) -> Cut:
    """A notch through the edge, about `depth_mm` deep in the section and `width_mm` long on the edge.

    Its flank toward the tip is the gentle one, so that a scanner that looks down sees all of it.
    """
    edge, outward = edge_frame(airfoil, zone, airfoil.height_mm(span_fraction))
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


def eroded_edge(
    airfoil: Airfoil,
    zone: EdgeName,
    span_fractions: tuple[float, float],
    depth_mm: float,
    rng: np.random.Generator,
) -> Cut:
    """An edge worn back between two fractions of the span by about `depth_mm`, left blunt and rounded.

    It runs out at both ends, and on both sides into the skin: the blunter, the thicker the edge.
    """
    z_mm = np.linspace(airfoil.height_mm(span_fractions[0]), airfoil.height_mm(span_fractions[1]), 241)
    edge, outward = (
        np.array(rows) for rows in zip(*(edge_frame(airfoil, zone, z) for z in z_mm), strict=True)
    )
    across = np.column_stack([outward[:, 1], -outward[:, 0], np.zeros(len(z_mm))])
    v_mm = np.linspace(-1.0, 1.0, 121) * WIDE * airfoil.chord_mm
    radius_mm = _blunt_mm(airfoil, zone, float(z_mm[len(z_mm) // 2]), depth_mm)
    t, v = np.meshgrid(np.linspace(-1.0, 1.0, len(z_mm)), v_mm, indexing="ij")
    rough = _roughness(rng, 0.04 * depth_mm, 0.1 * airfoil.span_mm)
    worn = depth_mm * (1.0 - 1.2 * t**4) + v**2 / (2.0 * radius_mm) + rough(z_mm[:, None] + 0.0 * v, v)
    flat = edge[:, None] + v[..., None] * across[:, None]
    return Cut(
        zone=zone,
        cutter=_slab(
            flat - worn[..., None] * outward[:, None],
            flat + 0.1 * airfoil.chord_mm * outward[:, None],
        ),
    )


def _blunt_mm(airfoil: Airfoil, zone: EdgeName, z_mm: float, depth_mm: float) -> float:
    """The least radius of an edge worn back by `depth_mm` that leaves the skin on both sides: no undercut."""
    edge, outward = edge_frame(airfoil, zone, z_mm)
    off = airfoil_loop(airfoil.solid, z_mm) - edge[:2]
    off = np.roll(off, -int(np.argmin(np.linalg.norm(off, axis=1))), axis=0)
    radius_mm = BLUNT * airfoil.chord_mm
    for flank in (off, off[::-1]):
        behind, aside = -flank @ outward[:2], flank @ np.array([outward[1], -outward[0]])
        beside = np.cumsum(np.abs(aside) > 0.9 * WIDE * airfoil.chord_mm) == 0
        cut = beside & (behind > 1.1 * depth_mm)
        radii_mm = aside[cut] ** 2 / (2.0 * (behind[cut] - depth_mm))
        radius_mm = max(radius_mm, 1.2 * float(radii_mm.min(initial=FLAT * airfoil.chord_mm)))
    return radius_mm


def pit(
    airfoil: Airfoil,
    span_fraction: float,
    chord_fraction: float,
    depth_mm: float,
    radius_mm: float,
    rng: np.random.Generator,
) -> Cut:
    """A void on the pressure side: a rough spherical cap, about `depth_mm` deep along the normal."""
    centre, along, across, outward = side_frame(airfoil, "pressure", span_fraction, chord_fraction)
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


def side_frame(
    airfoil: Airfoil, side: SideName, span_fraction: float, chord_fraction: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """A point on a side, two tangents, the first along the chord, and the outward normal there."""

    def on(frame: SectionFrame, fraction: float) -> Floats:
        return frame.suction_point_mm(fraction) if side == "suction" else frame.pressure_point_mm(fraction)

    z_mm, step = airfoil.height_mm(span_fraction), 0.01 * airfoil.span_mm
    here, above, below = (airfoil.frame(z) for z in (z_mm, z_mm + step, z_mm - step))
    chordwise = on(here, chord_fraction + 0.02) - on(here, chord_fraction - 0.02)
    normal = _unit(np.cross(chordwise, on(above, chord_fraction) - on(below, chord_fraction)))
    along = _unit(chordwise)
    outward = np.append(here.toward_suction, 0.0) * (1.0 if side == "suction" else -1.0)
    return on(here, chord_fraction), along, np.cross(normal, along), normal * np.sign(normal @ outward)


def edge_frame(airfoil: Airfoil, zone: EdgeName, z_mm: float) -> tuple[Floats, Floats]:
    """The point (3,) of an edge at a height, and the unit vector (3,) along the chord out of it."""
    le, te = airfoil.edge_points_mm(z_mm)
    edge, far = (le, te) if zone == "leading_edge" else (te, le)
    return edge, _unit(edge - far)


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
    return _slab(broken, flat + out_mm * outward)


def _slab(under_mm: Floats, over_mm: Floats) -> Solid:
    """The closed solid between two grids of points (rows, columns, 3), one above the other."""
    vertices = np.concatenate([under_mm.reshape(-1, 3), over_mm.reshape(-1, 3)])
    return Solid(vertices_mm=vertices, faces=_slab_faces(*under_mm.shape[:2]))


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
