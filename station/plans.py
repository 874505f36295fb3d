"""plan.toml, one part number: what is required of a blade and where its limits lie."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    ValidationInfo,
    field_validator,
    model_validator,
)

from geometry.errors import BadInput
from geometry.transforms import check_rigid
from geometry.types import Zone
from station.tomlfile import BadFile, NonNegative, Number, Positive, Row, Settings, Text, read_settings

SPAN_TOLERANCE_MM = 0.01  # a nominal in float32 does not end exactly where the plan says

SECTION_KEYS = frozenset(
    {
        "position_mm",
        "position_x_mm",
        "position_y_mm",
        "centroid_x_mm",
        "centroid_y_mm",
        "orientation_deg",
        "profile_mm",
        "profile_form_mm",
        *(f"{side}_profile_mm" for side in ("le", "ss", "te", "ps")),
        "chord_mm",
        "chord_nose_tail_mm",
        "chord_tangent_mm",
        "stagger_deg",
        "max_thickness_mm",
        "max_thickness_position_mm",
        "max_camber_mm",
        *(
            f"{end}_{name}_mm"
            for end in ("le", "te")
            for name in ("radius", "min_radius", "flat", "thickness")
        ),
        "waviness_rms_mm",
        "waviness_height_mm",
        "out_of_tolerance_fraction",
        "fit_x_mm",
        "fit_y_mm",
        "fit_rotation_deg",
    }
)
THICKNESS_AT = re.compile(r"(le|te)_thickness_at_([0-9.]+)_mm")


def section_key(name: str) -> str:
    """`name`, if a section has such a characteristic."""
    if name not in SECTION_KEYS and not THICKNESS_AT.fullmatch(name):
        raise ValueError("unknown key")
    return name


DamageZone = Literal["tip", "leading_edge", "trailing_edge", "surface"]


class BadPlan(BadFile):
    """A plan that contradicts itself, its nominal, or cannot be read."""


class Limit(Settings):
    """Up to `serviceable` the part flies as it is, up to `repairable` it can be repaired."""

    serviceable: Number
    repairable: Number

    @model_validator(mode="after")
    def ordered(self) -> Self:
        if not 0.0 <= self.serviceable <= self.repairable:
            raise ValueError("limits must be 0 <= serviceable <= repairable")
        return self


class CountLimit(Limit):
    """How many damages, proven deeper than `min_depth_mm` (default: the detection limit)."""

    min_depth_mm: Positive | None = None


class Measurement(Settings):
    sigma_mm: Positive
    coverage_factor: Positive = 2.0
    merge_mm: NonNegative = 0.0  # of a scan merged elsewhere; of its own merging the station tells it itself


class Airfoil(Settings):
    z_min_mm: Number | None = None
    z_max_mm: Number | None = None

    @model_validator(mode="after")
    def ordered(self) -> Self:
        if self.z_min_mm is not None and self.z_max_mm is not None and self.z_max_mm <= self.z_min_mm:
            raise ValueError("z_max_mm must lie above z_min_mm")
        return self


class Coverage(Settings):
    min_fraction: Annotated[Number, Field(gt=0.0, le=1.0)] = 0.95
    max_gap_mm: Positive = 1.5


class Zones(Settings):
    tip_mm: Positive = 5.0
    edge_mm: Positive = 3.0


Point = tuple[Number, Number, Number]


class AlignmentChoice(Settings):
    """What the scan is aligned by: the whole airfoil, a datum zone, six datum points, or some sections.

    `datum_z_mm` beside another method than "root" asks for the root fit too, and for the bend and twist
    in service that the difference of the two shows."""

    method: Literal["airfoil", "root", "six_point", "sections"] = "airfoil"
    datum_z_mm: tuple[Number, Number] | None = None
    points_mm: Annotated[tuple[Point, ...], Field(min_length=6, max_length=6)] | None = None
    z_mm: Annotated[tuple[Number, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def method_has_its_datum(self) -> Self:
        needed = {"root": "datum_z_mm", "six_point": "points_mm", "sections": "z_mm"}.get(self.method)
        if needed and getattr(self, needed) is None:
            raise ValueError(f'method = "{self.method}" needs {needed}')
        if self.datum_z_mm is not None and self.datum_z_mm[1] <= self.datum_z_mm[0]:
            raise ValueError("datum_z_mm must be [lower, upper]")
        return self


class Algorithms(Settings):
    registration: Literal["default", "thesis"] = "default"
    sections: Literal["default", "thesis"] = "default"
    twin: Literal["default", "thesis"] = "default"


class SectionFit(Settings):
    """How the sections are best fitted for `fit_*` and `profile_form_mm`: weights of the sides, and locks."""

    le: NonNegative = 1.0
    suction: NonNegative = 1.0
    te: NonNegative = 1.0
    pressure: NonNegative = 1.0
    locked: tuple[Literal["x", "y", "rotation"], ...] = ()

    @model_validator(mode="after")
    def weighs_something(self) -> Self:
        if not self.le + self.suction + self.te + self.pressure > 0.0:
            raise ValueError("all weights are 0")
        return self


class Sections(Settings):
    """`tolerance_mm` is what `out_of_tolerance_fraction` counts against, `edge_distances_mm` where
    `le_thickness_at_2_mm` and its like are taken."""

    z_mm: tuple[Number, ...] = ()
    tolerance_mm: Positive = 0.1
    edge_distances_mm: tuple[Positive, ...] = (2.0, 4.0)
    fit: SectionFit = SectionFit()

    @field_validator("z_mm", "edge_distances_mm")
    @classmethod
    def distinct(cls, z_mm: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
        if len(set(z_mm)) != len(z_mm):
            raise ValueError("a section stands twice" if info.field_name == "z_mm" else "one stands twice")
        return z_mm


SectionKeys = Mapping[Annotated[str, AfterValidator(section_key)], Limit]


class SectionLimits(Settings):
    """Limits of every section, and those of single sections, which win key by key."""

    every: SectionKeys = Field(default_factory=dict)
    single: Mapping[float, SectionKeys] = Field(default_factory=dict)

    def at(self, z_mm: float) -> dict[str, Limit]:
        """The limits of the section at `z_mm`, matched numerically."""
        own = next((keys for z, keys in self.single.items() if same_z(z, z_mm)), {})
        return {**self.every, **own}

    @property
    def limited(self) -> set[str]:
        """Every characteristic that has a limit anywhere."""
        return {key for keys in (self.every, *self.single.values()) for key in keys}

    def __bool__(self) -> bool:
        return bool(self.limited)


def same_z(a_mm: float, b_mm: float) -> bool:
    """Whether two spellings of a height mean the same section."""
    return math.isclose(a_mm, b_mm, rel_tol=0.0, abs_tol=1e-6)


def every_and_single(table: object) -> object:
    """`[limits.section]` with its `[limits.section."52.5"]` tables apart."""
    if not isinstance(table, Mapping):
        return table
    single: dict[float, object] = {}
    for key in (key for key in table if as_height(key) is not None):
        z_mm = float(key)
        if any(same_z(z_mm, other) for other in single):
            raise ValueError(f'"{key}" stands twice')
        single[z_mm] = table[key]
    return {"every": {k: v for k, v in table.items() if as_height(k) is None}, "single": single}


def as_height(key: str) -> float | None:
    """The height that a table name spells, or None for the name of a characteristic."""
    try:
        z_mm = float(key)
    except ValueError:
        return None
    return z_mm if math.isfinite(z_mm) else None


class DamageLimits(Settings):
    """Limits of one zone: largest depth, summed volume, number of damages."""

    depth_mm: Limit | None = None
    volume_mm3: Limit | None = None
    count: CountLimit | None = None

    def __bool__(self) -> bool:
        return any((self.depth_mm, self.volume_mm3, self.count))


class Form(Settings):
    deviation_mm: Limit | None = None


class BladeLimits(Settings):
    """Limits of what the sections say together; of the twist from section to section, the largest."""

    lean_x_deg: Limit | None = None
    lean_y_deg: Limit | None = None
    bow_mm: Limit | None = None
    relative_twist_deg: Limit | None = None

    def given(self) -> dict[str, Limit]:
        """The limits that stand here, by characteristic."""
        limits = ((key, getattr(self, key)) for key in type(self).model_fields)
        return {key: limit for key, limit in limits if limit is not None}


class Limits(Settings):
    section: Annotated[SectionLimits, BeforeValidator(every_and_single)] = SectionLimits()
    blade: BladeLimits = BladeLimits()
    form: Form = Form()
    damage: Mapping[DamageZone, DamageLimits] = Field(default_factory=dict)

    def of_zone(self, zone: Zone) -> DamageLimits:
        """The limits of a zone, none of them set when the plan does not name it."""
        return next((limits for name, limits in self.damage.items() if name == zone), DamageLimits())

    def __bool__(self) -> bool:
        sections = self.section or self.blade.given()
        return bool(sections or self.form.deviation_mm or any(self.damage.values()))


class Repair(Settings):
    """`frames`: where the patches are wanted beside the nominal's own frame, each as a file of its own."""

    allowance_mm: NonNegative = 0.0
    frames: tuple[Literal["scan", "fixture"], ...] = ()
    T_fixture_scan: tuple[Row, Row, Row, Row] | None = None

    @model_validator(mode="after")
    def fixture_is_known(self) -> Self:
        if "fixture" in self.frames and self.T_fixture_scan is None:
            raise ValueError('frames with "fixture" need T_fixture_scan')
        if self.T_fixture_scan is not None:
            try:
                check_rigid(np.array(self.T_fixture_scan), "T_fixture_scan")
            except BadInput as error:
                raise ValueError(str(error)) from error
        return self


class Scan(Settings):
    angles_deg: Annotated[tuple[Number, ...], Field(min_length=1, max_length=360)] = tuple(
        float(angle) for angle in range(0, 360, 30)
    )


class BladePlan(Settings):
    """One part number, as its file says it."""

    schema_: Annotated[Literal["bladecell.plan/1"], Field(alias="schema")]
    part_number: Text
    revision: Text
    nominal: Text
    units: Literal["mm", "inch"] = "mm"
    measurement: Measurement
    airfoil: Airfoil = Airfoil()
    coverage: Coverage = Coverage()
    zones: Zones = Zones()
    alignment: AlignmentChoice = AlignmentChoice()
    algorithms: Algorithms = Algorithms()
    sections: Sections = Sections()
    limits: Limits
    repair: Repair = Repair()
    scan: Scan = Scan()
    _path: Path = PrivateAttr(default=Path("plan.toml"))

    def model_post_init(self, context: dict[str, Path] | None) -> None:
        if context:
            self._path = context["path"]

    @property
    def path(self) -> Path:
        """The file that this plan was read from."""
        return self._path

    @property
    def nominal_path(self) -> Path:
        """Where the nominal lies."""
        return (self._path.parent / self.nominal).resolve()

    @model_validator(mode="after")
    def consistent(self) -> Self:
        if not self.limits:
            raise ValueError("limits: the plan has no limit at all")
        if self.limits.section and not self.sections.z_mm:
            raise ValueError("limits.section: no section stands in [sections] z_mm")
        for z_mm in self.limits.section.single:
            if not any(same_z(z_mm, other) for other in self.sections.z_mm):
                raise ValueError(f'limits.section."{z_mm:g}": no such section in [sections] z_mm')
        for key in self.limits.section.limited:
            at = THICKNESS_AT.fullmatch(key)
            if at and at[2] not in {f"{d:g}" for d in self.sections.edge_distances_mm}:
                raise ValueError(f"limits.section.{key}: no such distance in [sections] edge_distances_mm")
        if self.limits.blade.given() and len(self.sections.z_mm) < 2:
            raise ValueError("limits.blade: fewer than two sections stand in [sections] z_mm")
        return self


def read_plan(path: Path) -> BladePlan:
    """The plan that `path` holds; raises `BadPlan`. Its nominal is not opened."""
    plan = read_settings(path, BladePlan, BadPlan)
    check_nominal_path(plan)
    return plan


def check_nominal_path(plan: BladePlan) -> None:
    """Raise `BadPlan` unless the nominal is a file inside the folder tree of its plan."""
    if not plan.nominal_path.is_relative_to(plan.path.parent.resolve()):
        raise BadPlan(plan.path, f"{plan.nominal!r} lies outside the folder of the plan", "nominal")
    if not plan.nominal_path.is_file():
        raise BadPlan(plan.path, f"there is no file {plan.nominal!r}", "nominal")


def check_span(plan: BladePlan, z_low_mm: float, z_high_mm: float) -> None:
    """Raise `BadPlan` unless airfoil, datum and sections lie on a nominal that spans these heights."""
    for where, z_mm in heights(plan):
        if not z_low_mm - SPAN_TOLERANCE_MM <= z_mm <= z_high_mm + SPAN_TOLERANCE_MM:
            raise BadPlan(plan.path, off_span(z_mm, z_low_mm, z_high_mm), where)
    for z_mm in plan.sections.z_mm:
        if not z_low_mm < z_mm < z_high_mm:
            raise BadPlan(plan.path, off_span(z_mm, z_low_mm, z_high_mm), "sections.z_mm")


def heights(plan: BladePlan) -> list[tuple[str, float]]:
    """The heights that may lie on an end of the nominal, with the key that each stands under."""
    named = [("airfoil.z_min_mm", plan.airfoil.z_min_mm), ("airfoil.z_max_mm", plan.airfoil.z_max_mm)]
    datum_mm = plan.alignment.datum_z_mm if plan.alignment.method == "root" else None
    datum = [("alignment.datum_z_mm", z_mm) for z_mm in datum_mm or ()]
    datum += [("alignment.z_mm", z_mm) for z_mm in plan.alignment.z_mm or ()]
    return [(where, z_mm) for where, z_mm in named if z_mm is not None] + datum


def off_span(z_mm: float, z_low_mm: float, z_high_mm: float) -> str:
    return f"{z_mm:g} mm is outside the nominal's span, {z_low_mm:g} to {z_high_mm:g} mm"
