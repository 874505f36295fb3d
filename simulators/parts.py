"""One simulated part: its true shape, how it sits on the table, and its ground truth as a document."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from simulators.bends import Bend, bent
from simulators.cutters import Cut
from simulators.damage_solids import DamageTruth, break_off
from simulators.optics import OpticsSettings, StructuredLight
from simulators.recipe import Finding, decide, findings, recipe_of
from simulators.rig import Rig, inverse
from simulators.sections import SectionTruth
from simulators.solids import Floats, Ints, Solid
from simulators.wear import NominalBlade, WornBlade, section_truths

PEDESTAL_MM = 20.0  # of the fixture's upper face above the table


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimPart:
    """One part on the turntable: true shape and pose, what of it can be seen, and its truth.

    `judged` is every true value that the plan limits; it is empty for another part number's blade.
    """

    serial: str
    preset: str
    part_number: str
    seed: int
    solid: Solid
    T_table_part: Floats
    optics: OpticsSettings
    damages: tuple[DamageTruth, ...] = ()
    sections: tuple[SectionTruth, ...] = ()
    judged: tuple[Finding, ...] = ()

    @property
    def vertices_mm(self) -> Floats:
        """The vertices (n, 3) in the part frame, which is the nominal's."""
        return self.solid.vertices_mm

    @property
    def faces(self) -> Ints:
        """The faces (m, 3)."""
        return self.solid.faces

    @property
    def truth(self) -> dict[str, Any]:
        """The ground truth as a document, for a scan that misses nothing but the blind spots."""
        return self.truth_when(hidden=bool(self.optics.blind))

    def truth_when(self, *, hidden: bool) -> dict[str, Any]:
        """The ground truth; `hidden`: the scan cannot see all that it must. Scan frame: table at 0 deg."""
        return {
            "verdict": decide(self.judged, stranger=not self.judged, hidden=hidden),
            "T_nominal_scan": inverse(self.T_table_part).tolist(),
            "removed_mm3": sum(damage.volume_mm3 for damage in self.damages if damage.kind == "missing"),
            "damages": [asdict(damage) for damage in self.damages],
            "sections": [_section_row(section) for section in self.sections],
            "noise_normal_mm": self.optics.noise_normal_mm,
            "seed": self.seed,
            "serial": self.serial,
            "preset": self.preset,
            "part_number": self.part_number,
            "findings": [asdict(finding) for finding in self.judged],
        }

    def before(self, rig: Rig) -> StructuredLight:
        """The scanner in front of this part."""
        return StructuredLight(self.vertices_mm, self.faces, self.T_table_part, rig, self.optics)


def _section_row(section: SectionTruth) -> dict[str, float]:
    return {
        "z_mm": section.z_mm,
        "position_x_mm": section.position_x_mm,
        "position_y_mm": section.position_y_mm,
        "orientation_deg": section.orientation_deg,
        "chord_mm": section.actual.chord_mm,
        "max_thickness_mm": section.actual.max_thickness_mm,
        "profile_max_mm": section.profile_max_mm,
        "profile_min_mm": section.profile_min_mm,
    }


def assemble(
    blade: NominalBlade,
    worn: WornBlade,
    cuts: Sequence[Cut],
    bends: Sequence[Bend] = (),
    *,
    preset: str,
    serial: str,
    seed: int,
    optics: OpticsSettings,
    rng: np.random.Generator,
) -> SimPart:
    """The part of a worn blade bent and with the cuts made, clamped with a play drawn from `rng`."""
    folds: list[DamageTruth] = []
    for bend in bends:
        worn, fold = bent(blade, worn, bend)
        folds.append(fold)
    solid, changes = break_off(worn.airfoil, cuts)
    damages = (*changes, *folds)
    recipe = recipe_of(blade)
    sections = section_truths(blade, worn, recipe.section_z_mm)
    return SimPart(
        serial=serial,
        preset=preset,
        part_number=blade.name,
        seed=seed,
        solid=solid,
        T_table_part=clamped(blade, rng),
        optics=optics,
        damages=damages,
        sections=sections,
        judged=tuple(findings(recipe, sections, damages, worn.form_mm)),
    )


def clamped(blade: NominalBlade, rng: np.random.Generator) -> Floats:
    """A pose `T_table_part` in the fixture: any heading, half a millimetre and a third of a degree of play.

    The part is held below its airfoil, whose middle stands near the axis of the table.
    """
    airfoil = blade.airfoil
    middle = 0.5 * (airfoil.le_mm + airfoil.te_mm).mean(axis=0)
    lean = rng.normal(0.0, np.radians(0.3), 2)
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * Rotation.from_rotvec([*lean, 0.0])
    T = np.eye(4)
    T[:3, :3] = turn.as_matrix()
    T[:3, 3] = -T[:3, :3] @ np.array([middle[0], middle[1], airfoil.seat_mm])
    T[:3, 3] += np.array([*rng.normal(0.0, 0.5, 2), PEDESTAL_MM])
    return T
