"""Measurements and plans put together by hand, for tests of what the station makes of them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from geometry.coverage import CoverageStatus, ZoneCoverage
from geometry.damage.damages import Damage, DamageKind
from geometry.registration.alignment import Alignment
from geometry.repair.patches import Patch, RepairVolume
from geometry.sections.airfoil import Section, SectionStatus
from geometry.types import Measurand, Measured, Mesh, NotMeasured, Zone
from station.gates import Gate, Gates
from station.measurement import Measurement, Outline
from station.plans import BladePlan

ZONES = (Zone.TIP, Zone.LEADING_EDGE, Zone.TRAILING_EDGE, Zone.SURFACE)
UNITS = {"mm": "mm", "deg": "deg", "mm2": "mm2", "mm3": "mm3"}
CLOSED = Gate(holds=True)
GATES = Gates(calibration=CLOSED, daily_check=CLOSED, continuity=CLOSED, mode=CLOSED)

NOMINALS = {
    "position_x_mm": 0.0,
    "position_y_mm": 0.0,
    "position_mm": 0.0,
    "orientation_deg": 0.0,
    "profile_max_mm": 0.0,
    "profile_min_mm": 0.0,
    "chord_mm": 45.0,
    "max_thickness_mm": 4.0,
    "le_radius_mm": 0.7,
    "te_radius_mm": 0.4,
    "stagger_deg": 30.0,
}
LIMITS: Mapping[str, Any] = {
    "section": {"chord_mm": {"serviceable": 0.25, "repairable": 1.0}},
    "form": {"deviation_mm": {"serviceable": 0.15, "repairable": 0.5}},
    "damage": {
        "tip": {
            "depth_mm": {"serviceable": 0.5, "repairable": 15.0},
            "volume_mm3": {"serviceable": 5.0, "repairable": 400.0},
            "count": {"serviceable": 1, "repairable": 2},
        },
        **{
            zone: {"depth_mm": {"serviceable": 0.5, "repairable": 3.0}}
            for zone in ("leading_edge", "trailing_edge", "surface")
        },
    },
}


def plan(limits: Mapping[str, Any] = LIMITS, z_mm: tuple[float, ...] = (7.0,), **tables: Any) -> BladePlan:
    """A plan with these limits."""
    return BladePlan.model_validate(
        {
            "schema": "bladecell.plan/1",
            "part_number": "HPC-R3",
            "revision": "B",
            "nominal": "nominal.stl",
            "measurement": {"sigma_mm": 0.015, "coverage_factor": 2.0},
            "sections": {"z_mm": list(z_mm)},
            "limits": dict(limits),
            **tables,
        },
        context={"path": Path("plan.toml")},
    )


def number(name: str, value: float, sigma: float = 0.01) -> Measurand:
    """A measurand whose unit its name ends with."""
    return Measurand(name=name, value=value, sigma=sigma, unit=UNITS.get(name.rpartition("_")[2], "1"))  # type: ignore[arg-type]


def alignment(**changed: Any) -> Alignment:
    """A good alignment, but for what is changed."""
    fields: dict[str, Any] = {
        "method": "airfoil",
        "T_nominal_scan": np.eye(4),
        "pivot_mm": np.zeros(3),
        "information": np.eye(6),
        "weak_directions": (),
        "rms_mm": 0.012,
        "noise_mm": 0.012,
        "inlier_fraction": 0.97,
        "explained_fraction": 0.99,
        "runner_up_ratio": 8.0,
        "iterations": 12,
        "converged": True,
    }
    return Alignment(**{**fields, **changed})


def section(z_mm: float = 7.0, **measured: Measured | float) -> Section:
    """A section on nominal, but for the measurands given, as a number or as what was measured."""
    values: dict[str, Measured] = {name: number(name, value) for name, value in NOMINALS.items()}
    for name, given in measured.items():
        values[name] = number(name, given) if isinstance(given, float | int) else given
    turn = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    return Section(
        z_mm=z_mm,
        status=SectionStatus.MEASURED,
        reason=None,
        covered_fraction=0.99,
        measurands=values,
        nominals=NOMINALS,
        profile_mm=np.column_stack([22.5 * np.cos(turn), 2.0 * np.sin(turn)]),
        deviation_mm=0.02 * np.sin(3.0 * turn),
        run=np.zeros(200, np.int64),
    )


def damage(
    zone: Zone = Zone.TIP,
    kind: DamageKind = DamageKind.MISSING,
    depth: Measured | float = 8.0,
    volume: Measured | float = 60.0,
    off_nominal: Measured = NotMeasured(reason="not bent"),
) -> Damage:
    """One damage with these sizes."""
    return Damage(
        zone=zone,
        kind=kind,
        depth_mm=number("depth_mm", depth) if isinstance(depth, float | int) else depth,
        area_mm2=number("area_mm2", 12.0),
        volume_mm3=number("volume_mm3", volume) if isinstance(volume, float | int) else volume,
        length_mm=9.0,
        span_mm=(95.0, 105.0),
        centroid_mm=np.array([1.0, 2.0, 100.0]),
        points=np.arange(3),
        off_nominal_mm=off_nominal,
    )


def tetrahedron() -> Mesh:
    """The smallest closed mesh."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return Mesh(vertices_mm=corners, faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


def patch(index: int = 0, *, watertight: bool = True, volume_mm3: float = 60.0) -> Patch:
    """A patch for the damage with this index."""
    return Patch(
        damage=index,
        zone=Zone.TIP,
        mesh=tetrahedron(),
        outer=np.array([True, False, False, False]),
        watertight=watertight,
        volume_mm3=number("volume_mm3", volume_mm3, 0.2),
        volume_check_mm3=volume_mm3,
        broken_gap_mm=0.3,
        border_step_mm=number("border_step_mm", 0.02),
        border_angle_deg=NotMeasured(reason="the border is too short"),
    )


def repairs(*patches: Patch, failures: dict[int, str] | None = None) -> RepairVolume:
    """A repair volume of these patches."""
    total = sum(each.volume_mm3.value for each in patches)
    return RepairVolume(patches=patches, volume_mm3=number("volume_mm3", total), failures=failures or {})


def coverage(zone: Zone, fraction: float = 0.99, gap_mm: float = 0.4) -> ZoneCoverage:
    """A zone that was seen if these numbers say so."""
    seen = fraction >= 0.95 and gap_mm <= 1.5
    return ZoneCoverage(
        zone=zone,
        covered_fraction=fraction,
        absent_fraction=0.0,
        largest_gap_mm=gap_mm,
        status=CoverageStatus.SEEN if seen else CoverageStatus.UNSEEN,
    )


def measurement(**changed: Any) -> Measurement:
    """A sound blade, wholly seen, but for what is changed."""
    turn = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    curve_mm = np.column_stack([22.5 * np.cos(turn), 2.0 * np.sin(turn)])
    points = np.column_stack([curve_mm, np.linspace(5.0, 100.0, 200)])
    fields: dict[str, Any] = {
        "points": 200,
        "alignment": alignment(),
        "aligned_mm": points,
        "deviation_mm": 0.02 * np.sin(3.0 * turn),
        "sections": (section(),),
        "outlines": (Outline(z_mm=7.0, curve_mm=curve_mm, le_mm=curve_mm[100], te_mm=curve_mm[0]),),
        "twin_mesh": tetrahedron(),
        "form_mm": number("form_mm", 0.05),
        "residual_mm": 0.012,
        "damages": (),
        "detection_mm": {zone: number("depth_mm", 0.06, 0.01) for zone in ZONES},
        "detection_mm2": number("area_mm2", 3.0, 0.0),
        "repairs": repairs(),
        "zones": tuple(coverage(zone) for zone in ZONES),
        "timing_s": {"clean": 0.5, "register": 1.0},
    }
    return Measurement(**{**fields, **changed})


def lost(reason: str = "a gap of 2.0 mm", *, in_damage: bool = False) -> NotMeasured:
    return NotMeasured(reason=reason, in_damage=in_damage)
