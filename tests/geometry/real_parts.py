"""Real blades as part numbers to simulate: a turbine blade with root, and lofted rows of a compressor."""

from functools import cache
from pathlib import Path

import mapbox_earcut
import numpy as np
from scipy.interpolate import CubicSpline

from geometry.types import Floats, Ints
from simulators.solids import Solid, read_solid
from simulators.wear import NominalBlade, mesh_nominal

DATA = Path(__file__).parents[3] / "shared/data"
TURBINE = DATA / "turbineblade/turbineblade.ply"
ROWS = {
    "rotor 2": DATA / "hannover_tfd4ac/3_Rotor2_Blade.crv",
    "stator 1": DATA / "hannover_tfd4ac/2_Stator1_Vane.crv",
}
FINER = 4  # points between two of a profile
ROWS_ALONG = 161  # heights of the lofted mesh
DENSE = 801  # heights between the first profile and the last at which the loft is tabled


def present() -> bool:
    """Whether the real geometry is here."""
    return all(path.is_file() for path in (TURBINE, *ROWS.values()))


def part_numbers() -> dict[str, NominalBlade]:
    """Each real part as a nominal, in mm, span along +Z."""
    return {"turbine": turbine()} | {name: row(name) for name in ROWS}


@cache
def turbine() -> NominalBlade:
    return mesh_nominal("TURBINE", read_solid(TURBINE), None, None)


@cache
def row(name: str) -> NominalBlade:
    """The airfoil of one compressor row."""
    return mesh_nominal(name.upper().replace(" ", "-"), loft(read_profiles(ROWS[name])), None, None)


def read_profiles(path: Path) -> Floats:
    """The profiles (k, n, 3) of a .crv file in mm, hub first, span along +Z, each closed by its first point.

    The file's machine axis is z and its profiles lie on stream surfaces about it; its y is radial here.
    """
    profiles: list[list[list[float]]] = []
    for line in path.read_text(encoding="ascii").splitlines():
        if line.startswith("#"):
            profiles.append([])
        elif line.strip():
            profiles[-1].append([float(word) for word in line.split()])
    return np.array(profiles)[:, :, [2, 0, 1]]


def loft(profiles_mm: Floats) -> Solid:
    """The closed solid through profiles (k, n, 3), cut plane where the first and the last are whole."""
    curves = np.stack([_finer(profile) for profile in profiles_mm])
    along = curves[:, :, 2].mean(axis=1)
    surface = CubicSpline(along, curves, axis=0)(np.linspace(along[0], along[-1], DENSE))
    heights_mm = np.linspace(surface[0, :, 2].max(), surface[-1, :, 2].min(), ROWS_ALONG)
    rows = np.stack([_at_heights(surface[:, i], heights_mm) for i in range(surface.shape[1])], axis=1)
    return _closed(rows - origin_mm(profiles_mm))


def origin_mm(profiles_mm: Floats) -> Floats:
    """The point (3,) among profiles that the lofted solid has as its origin: amid them, at its lower end."""
    middle = profiles_mm[:, :-1].mean(axis=(0, 1))
    return np.array([middle[0], middle[1], profiles_mm[0, :, 2].max()])


def _finer(profile_mm: Floats) -> Floats:
    """A periodic spline through a profile, counter-clockwise seen from the tip, without its closing point."""
    flat = profile_mm[:-1, :2] - profile_mm[:-1, :2].mean(axis=0)
    twice_area = np.sum(flat[:, 0] * np.roll(flat[:, 1], -1) - np.roll(flat[:, 0], -1) * flat[:, 1])
    ordered = profile_mm if twice_area > 0.0 else profile_mm[::-1]
    ordered = np.vstack([ordered[:-1], ordered[:1]])
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(ordered, axis=0), axis=1)))
    between = np.arange((len(arc) - 1) * FINER) / FINER
    return np.asarray(
        CubicSpline(arc, ordered, bc_type="periodic")(np.interp(between, np.arange(len(arc)), arc))
    )


def _at_heights(line_mm: Floats, heights_mm: Floats) -> Floats:
    """The points (h, 3) of a line along the span, z ascending, at these heights."""
    x, y, z = line_mm.T
    return np.column_stack([CubicSpline(z, x)(heights_mm), CubicSpline(z, y)(heights_mm), heights_mm])


def _closed(rows_mm: Floats) -> Solid:
    """The wall through rings (h, n, 3) and a flat cap at either end."""
    rings, around = rows_mm.shape[:2]
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    here, beside = (i * around + j).ravel(), (i * around + (j + 1) % around).ravel()
    above, across = here + around, beside + around
    wall = np.concatenate([np.column_stack([here, beside, across]), np.column_stack([here, across, above])])
    low, high = _cap(rows_mm[0])[:, ::-1], _cap(rows_mm[-1]) + (rings - 1) * around
    return Solid(vertices_mm=rows_mm.reshape(-1, 3), faces=np.concatenate([wall, low, high]))


def _cap(ring_mm: Floats) -> Ints:
    """Faces of a plane ring, looking up."""
    flat = np.ascontiguousarray(ring_mm[:, :2])
    faces = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32))
    faces = faces.reshape(-1, 3).astype(np.int64)
    a, b, c = flat[faces[0]]
    up = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0.0
    return np.asarray(faces if up else faces[:, ::-1])
