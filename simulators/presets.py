"""The parts that the simulated cell offers: one for each verdict, each with its ground truth.

Every true value keeps clear of the limits of the recipe, so that a measurement with the stated
uncertainty must reach the verdict of the truth.
"""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from zlib import crc32

import numpy as np
from scipy.spatial.transform import Rotation

from simulators.beads import side_bead
from simulators.bends import Bend
from simulators.blade import BladeShape, Wear, blade_solid
from simulators.cutters import Cut, edge_nick, pit, tip_corner
from simulators.optics import BlindSpot, OpticsSettings
from simulators.parts import PEDESTAL_MM, SimPart, assemble, clamped
from simulators.preset_names import DEMO, preset_named
from simulators.recipe import write_plan
from simulators.rig import Rig, rig_around
from simulators.solids import Solid, read_solid
from simulators.wear import NominalBlade, WornBlade, mesh_nominal, thesis_nominal, worn_blade

__all__ = [
    "SimPart",
    "make_part",
    "nominal_blade",
    "part_for",
    "rig_for",
    "rig_of",
    "write_recipe",
]

CLEARANCE_MM = 3.0  # round the part, for its play in the fixture
PITCH_MM = 0.2  # of a pixel on the thesis' blade

CutList = list[Cut]
CutMaker = Callable[[NominalBlade, WornBlade, np.random.Generator], CutList]


@lru_cache(maxsize=4)
def nominal_blade(
    path: Path | None, z_min_mm: float | None = None, z_max_mm: float | None = None
) -> NominalBlade:
    """The part number that a cell simulates: the thesis' blade, or that of a mesh file.

    Raises `NotASolid` with one line for a file that is not a closed blade.
    """
    if path is None:
        return thesis_nominal(BladeShape(), z_min_mm, z_max_mm)
    return mesh_nominal(_part_number(path), read_solid(path), z_min_mm, z_max_mm)


def _part_number(path: Path) -> str:
    letters = "".join(c if c.isascii() and c.isalnum() else "-" for c in path.stem.upper())
    return f"SIM-{letters}"[:32]


def part_for(preset: str, seed: int, index: int, nominal: Path | None = None) -> SimPart:
    """Part number `index` of the endless sequence of a preset; equal arguments give equal parts."""
    return make_part(nominal_blade(nominal), preset, seed, index)


def make_part(blade: NominalBlade, preset: str, seed: int, index: int = 0) -> SimPart:
    """One part of a preset. Raises ValueError for an unknown one."""
    preset = preset_named(preset)
    if preset == "demo":
        preset = DEMO[index % len(DEMO)]
    rng = np.random.default_rng([seed, index, crc32(preset.encode())])
    serial = serial_of(seed, index)
    if preset == "HOLD-wrong-part":
        return _wrong_part(blade, serial, seed, rng)
    worn = worn_blade(blade, service_wear(blade, rng))
    optics = OpticsSettings(blind=(_dirt(blade, worn, rng),) if preset == "HOLD-hole" else ())
    bends = (bent_corner(blade, rng),) if preset == "REPAIR-bent" else ()
    cuts = CUTS[preset](blade, worn, rng) if preset in CUTS else []
    return assemble(blade, worn, cuts, bends, preset=preset, serial=serial, seed=seed, optics=optics, rng=rng)


def serial_of(seed: int, index: int) -> str:
    """The serial number of a part of a sequence: 1 to 32 characters of `[A-Z0-9-]`."""
    return f"SIM-{abs(seed) % 10**9:04d}-{index % 10**9:04d}"


def service_wear(blade: NominalBlade, rng: np.random.Generator) -> Wear:
    """Wear well inside the serviceable limits of form and sections, less on a smaller blade."""
    s = blade.scale
    return Wear(
        wave_mm=0.005,
        bump_mm=float(rng.uniform(0.04, 0.07)) * s,
        bend_mm=float(rng.uniform(-0.08, 0.08)) * s,
        untwist_deg=float(rng.uniform(-0.10, 0.10)),
        seed=int(rng.integers(2**31)),
    )


def shallow_nick(blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> CutList:
    """A nick of the leading edge that stays serviceable."""
    s = blade.scale
    return [edge_nick(worn.airfoil, "leading_edge", rng.uniform(0.3, 0.7), 0.25 * s, 3.0 * s, rng)]


def broken_corner(blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> CutList:
    """The corner of tip and trailing edge, repairable."""
    return [tip_corner(worn.airfoil, rng.uniform(6.0, 10.0) * blade.scale, rng.uniform(0.55, 0.72), rng)]


def repairable_nick(blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> CutList:
    """A nick of the leading edge, repairable."""
    s = blade.scale
    depth, width = rng.uniform(0.9, 1.3) * s, rng.uniform(5.0, 6.0) * s
    return [edge_nick(worn.airfoil, "leading_edge", rng.uniform(0.6, 0.7), depth, width, rng)]


def repairable_pit(blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> CutList:
    """A void on the pressure side, repairable."""
    s = blade.scale
    depth, radius = rng.uniform(0.7, 1.1) * s, rng.uniform(2.5, 3.5) * s
    return [pit(worn.airfoil, rng.uniform(0.25, 0.5), rng.uniform(0.4, 0.6), depth, radius, rng)]


def corner_and_pit(blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> CutList:
    """A broken corner, and every other time a pit too."""
    pits = repairable_pit(blade, worn, rng) if rng.random() < 0.5 else []
    return broken_corner(blade, worn, rng) + pits


def weld_bead(blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> CutList:
    """The bead of an old weld on the suction side, to be taken off."""
    s = blade.scale
    height, radius = rng.uniform(0.7, 1.1) * s, rng.uniform(2.5, 3.0) * s
    return [side_bead(worn.airfoil, rng.uniform(0.25, 0.5), rng.uniform(0.4, 0.6), height, radius)]


def bent_corner(blade: NominalBlade, rng: np.random.Generator) -> Bend:
    """The corner of tip and trailing edge, bent beyond the serviceable limit of form."""
    length_mm = rng.uniform(10.0, 14.0) * blade.scale
    return Bend(length_mm=length_mm, chord_fraction=rng.uniform(0.6, 0.7), depth_mm=rng.uniform(0.6, 0.7))


def beyond_repair(blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> CutList:
    """A nick or a corner that is deeper than anybody may repair."""
    s = blade.scale
    if rng.random() < 0.5:
        height, depth, width = rng.uniform(0.3, 0.7), rng.uniform(3.4, 4.0) * s, rng.uniform(12.0, 14.0) * s
        return [edge_nick(worn.airfoil, "leading_edge", height, depth, width, rng)]
    return [tip_corner(worn.airfoil, rng.uniform(20.0, 23.0) * s, rng.uniform(0.5, 0.6), rng)]


CUTS: dict[str, CutMaker] = {
    "PASS-nick": shallow_nick,
    "REPAIR": corner_and_pit,
    "REPAIR-weld": weld_bead,
    "SCRAP": beyond_repair,
}


def _dirt(blade: NominalBlade, worn: WornBlade, rng: np.random.Generator) -> BlindSpot:
    """A blind spot of the suction side, several times the gap that a plan allows."""
    frame = worn.airfoil.frame(worn.airfoil.height_mm(rng.uniform(0.35, 0.65)))
    x, y, z = frame.suction_point_mm(rng.uniform(0.4, 0.6))
    return BlindSpot(centre_mm=(float(x), float(y), float(z)), radius_mm=max(6.0 * blade.scale, 3.0))


def _wrong_part(blade: NominalBlade, serial: str, seed: int, rng: np.random.Generator) -> SimPart:
    """A sound blade of another part number."""
    return SimPart(
        serial=serial,
        preset="HOLD-wrong-part",
        part_number=blade.name,
        seed=seed,
        solid=_other_blade(blade),
        T_table_part=clamped(blade, rng),
        optics=OpticsSettings(),
    )


def _other_blade(blade: NominalBlade) -> Solid:
    """A blade of about the same size that no motion takes to this one: more camber, half the twist."""
    if blade.shape is not None:
        other = BladeShape(chord_mm=41.0, twist_deg=12.0, camber=0.38, thickness=(0.17, 0.20, 0.13))
        return blade_solid(other, other.surface)
    airfoil = blade.airfoil
    solid = airfoil.solid
    height = (solid.vertices_mm[:, 2] - airfoil.z_min_mm) / airfoil.span_mm
    turned = Rotation.from_rotvec(np.outer(np.radians(10.0) * height, [0.0, 0.0, 1.0]))
    return Solid(vertices_mm=turned.apply(solid.vertices_mm * [0.9, 1.2, 1.0]), faces=solid.faces)


def rig_for(seed: int, nominal: Path | None = None) -> Rig:
    """The rig of a cell that measures this part number, the same for all of its parts."""
    return rig_of(nominal_blade(nominal), seed)


def rig_of(blade: NominalBlade, seed: int, pitch_mm: float | None = None) -> Rig:
    """The rig for a nominal; pixels are a little larger in proportion on smaller blades."""
    airfoil = blade.airfoil
    points = airfoil.solid.vertices_mm[airfoil.solid.vertices_mm[:, 2] >= airfoil.seat_mm]
    middle = 0.5 * (airfoil.le_mm + airfoil.te_mm).mean(axis=0)
    radius = float(np.linalg.norm(points[:, :2] - middle[:2], axis=1).max())
    return rig_around(
        radius_mm=radius + CLEARANCE_MM,
        low_mm=PEDESTAL_MM,
        high_mm=PEDESTAL_MM + airfoil.z_max_mm - airfoil.seat_mm,
        pitch_mm=PITCH_MM * min(1.0, blade.scale + 0.05) if pitch_mm is None else pitch_mm,
        seat_mm=PEDESTAL_MM,
        seed=seed,
    )


def write_recipe(folder: Path, preset: str, seed: int, nominal: Path | None = None) -> Path:
    """Write plan.toml and nominal.stl of the simulated cell's part number; returns the plan's path.

    All parts of a cell, whatever preset and seed, are of one part number and share its plan.
    """
    return write_plan(folder, nominal_blade(nominal))
