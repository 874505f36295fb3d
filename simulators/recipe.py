"""The plan of a simulated part number, and the verdict that a perfect measurement would reach under it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from simulators.damage_solids import DamageTruth
from simulators.sections import SectionTruth
from simulators.solids import write_stl
from simulators.wear import NominalBlade

Verdict = Literal["PASS", "REPAIR", "SCRAP", "HOLD"]
Limits = Mapping[str, tuple[float, float]]  # characteristic -> serviceable, repairable

SIGMA_MM = 0.015  # that the plan states for a scan point, along the normal
MERGE_MM = 0.005  # and for the merging of views about a calibrated axis
SECTION_LIMITS: Limits = {
    "position_mm": (0.15, 0.60),
    "orientation_deg": (0.40, 1.50),
    "profile_mm": (0.20, 0.80),
    "chord_mm": (0.60, 2.00),
    "max_thickness_mm": (0.25, 0.80),
    "le_radius_mm": (0.25, 0.60),
    "te_radius_mm": (0.25, 0.60),
}
FORM_LIMITS: Limits = {"deviation_mm": (0.25, 0.80)}
DEPTH_LIMITS_MM: Limits = {  # of the thesis' blade; others in proportion to their chord
    "tip": (0.50, 15.0),
    "leading_edge": (0.50, 2.0),
    "trailing_edge": (0.50, 2.0),
    "surface": (0.30, 2.0),
}
VOLUME_LIMITS_MM3: Limits = {
    "tip": (5.0, 1500.0),
    "leading_edge": (3.0, 200.0),
    "trailing_edge": (3.0, 200.0),
    "surface": (3.0, 150.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """One plan: where the airfoil and its inspected sections lie, and how big damages may be."""

    part_number: str
    z_min_mm: float
    z_max_mm: float
    section_z_mm: tuple[float, ...]
    scale: float  # of damage sizes, to the thesis' blade

    def damage_limits(self, zone: str) -> Limits:
        """The limits of one zone."""
        depth, volume = DEPTH_LIMITS_MM[zone], VOLUME_LIMITS_MM3[zone]
        return {
            "depth_mm": (_rounded(depth[0] * self.scale), _rounded(depth[1] * self.scale)),
            "volume_mm3": (_rounded(volume[0] * self.scale**3), _rounded(volume[1] * self.scale**3)),
        }


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def recipe_of(nominal: NominalBlade) -> Recipe:
    """The recipe of a nominal: sections at 10, 50 and 90 % of the thesis' span, at 15, 50, 85 of others."""
    airfoil = nominal.airfoil
    if nominal.shape is None:
        heights = [airfoil.height_mm(fraction) for fraction in (0.15, 0.50, 0.85)]
    else:
        heights = [fraction * nominal.shape.span_mm for fraction in (0.10, 0.50, 0.90)]
    return Recipe(
        part_number=nominal.name,
        z_min_mm=round(airfoil.z_min_mm, 3),
        z_max_mm=airfoil.z_max_mm,
        section_z_mm=tuple(round(z, 3) for z in heights),
        scale=1.0 if nominal.shape is not None else nominal.scale,
    )


def plan_toml(recipe: Recipe, sigma_mm: float = SIGMA_MM) -> str:
    """The plan file's text; its nominal is `nominal.stl` beside it."""
    tip_mm, edge_mm = _rounded(5.0 * recipe.scale), _rounded(3.0 * recipe.scale)
    lines = [
        'schema = "bladecell.plan/1"',
        f'part_number = "{recipe.part_number}"',
        'revision = "A"',
        'nominal = "nominal.stl"',
        'units = "mm"',
        "",
        "[measurement]",
        f"sigma_mm = {sigma_mm!r}",
        "coverage_factor = 2.0",
        f"merge_mm = {MERGE_MM!r}",
        "",
        "[airfoil]",
        f"z_min_mm = {recipe.z_min_mm!r}",
        f"z_max_mm = {recipe.z_max_mm!r}",
        "",
        "[zones]",
        f"tip_mm = {tip_mm!r}",
        f"edge_mm = {edge_mm!r}",
        "",
        "[sections]",
        f"z_mm = {list(recipe.section_z_mm)!r}",
        *_table("limits.section", SECTION_LIMITS),
        *_table("limits.form", FORM_LIMITS),
    ]
    for zone in DEPTH_LIMITS_MM:
        lines += _table(f"limits.damage.{zone}", recipe.damage_limits(zone))
    lines += ["", "[scan]", f"angles_deg = {list(range(0, 360, 30))!r}"]
    return "\n".join(lines) + "\n"


def _table(name: str, limits: Limits) -> list[str]:
    rows = [f"{key} = {{ serviceable = {a!r}, repairable = {b!r} }}" for key, (a, b) in limits.items()]
    return ["", f"[{name}]", *rows]


def write_plan(folder: Path, nominal: NominalBlade, sigma_mm: float = SIGMA_MM) -> Path:
    """Write plan.toml and nominal.stl into `folder`; returns the plan's path."""
    folder.mkdir(parents=True, exist_ok=True)
    write_stl(folder / "nominal.stl", nominal.airfoil.solid)
    plan = folder / "plan.toml"
    plan.write_text(plan_toml(recipe_of(nominal), sigma_mm), encoding="utf-8")
    return plan


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One true value beside its limits."""

    name: str
    value: float
    serviceable: float
    repairable: float


def findings(
    recipe: Recipe, sections: Sequence[SectionTruth], damages: Sequence[DamageTruth], form_mm: float
) -> list[Finding]:
    """Everything that a perfect measurement would judge: form with its bends, sections that no other damage
    touches, damages."""
    damages = [damage for damage in damages if damage.kind != "deformation"]
    found = [_finding("form.deviation_mm", form_mm, FORM_LIMITS["deviation_mm"])]
    for section in sections:
        if not any(damage.z_low_mm <= section.z_mm <= damage.z_high_mm for damage in damages):
            deviations = section.deviations()
            found += [
                _finding(f"sections[{section.z_mm}].{key}", deviations[key], limits)
                for key, limits in SECTION_LIMITS.items()
            ]
    for zone in DEPTH_LIMITS_MM:
        there = [damage for damage in damages if damage.zone == zone]
        if there:
            limits = recipe.damage_limits(zone)
            depth, volume = max(d.depth_mm for d in there), sum(d.volume_mm3 for d in there)
            found.append(_finding(f"damage.{zone}.depth_mm", depth, limits["depth_mm"]))
            found.append(_finding(f"damage.{zone}.volume_mm3", volume, limits["volume_mm3"]))
    return found


def _finding(name: str, value: float, limits: tuple[float, float]) -> Finding:
    return Finding(name=name, value=value, serviceable=limits[0], repairable=limits[1])


def decide(found: Sequence[Finding], *, stranger: bool, hidden: bool) -> Verdict:
    """The contract's decision without uncertainty.

    `stranger`: another part, which no alignment explains; `hidden`: required surface unseen.
    """
    if stranger:
        return "HOLD"
    if any(finding.value > finding.repairable for finding in found):
        return "SCRAP"
    if hidden:
        return "HOLD"
    return "REPAIR" if any(finding.value > finding.serviceable for finding in found) else "PASS"
