"""What the merging of views leaves open, added to the uncertainty of what the merged views gave. Pure."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, hypot, sqrt
from typing import TYPE_CHECKING

from geometry.types import Measurand, Measured

if TYPE_CHECKING:
    from geometry.damage.damages import Damage
    from geometry.repair.patches import Patch, RepairVolume
    from geometry.sections.airfoil import Section
    from geometry.sections.blade_line import BladeLine, Judged
    from station.measurement import Measurement


def widened(found: Measurement, merge_mm: float) -> Measurement:
    """The measurement with `merge_mm`, the standard uncertainty of a surface point, in each of its sigmas.

    An axis that is off lays every view as far off along its own direction of sight: a part swells or
    shrinks. A length takes it whole, one across the section from both its ends, an angle over half the
    chord, a volume over the skin that was lost.
    """
    return replace(
        found,
        merge_mm=merge_mm,
        sections=tuple(_section(section, merge_mm) for section in found.sections),
        line=None if found.line is None else _line(found.line, found.sections, merge_mm),
        form_mm=wider(found.form_mm, merge_mm),
        damages=None if found.damages is None else tuple(_damage(each, merge_mm) for each in found.damages),
        repairs=None if found.repairs is None else _repairs(found.repairs, merge_mm),
    )


def wider(measured: Measured, more: float) -> Measured:
    """The number with a standard uncertainty added in quadrature, in its own unit."""
    if isinstance(measured, Measurand):
        return replace(measured, sigma=hypot(measured.sigma, more))
    return measured


def _section(section: Section, merge_mm: float) -> Section:
    more = {"mm": merge_mm, "deg": degrees(merge_mm / _half_chord_mm(section))}
    return replace(
        section,
        measurands={
            name: wider(each, _ends(name) * more.get(each.unit, 0.0)) if isinstance(each, Measurand) else each
            for name, each in section.measurands.items()
        },
    )


def _ends(name: str) -> float:
    """Of how many places on the skin a measurand is the distance: chords and thicknesses have two."""
    return 2.0 if "chord" in name or ("thickness" in name and "position" not in name) else 1.0


def _half_chord_mm(section: Section) -> float:
    return 0.5 * section.nominals["chord_mm"]


def _line(line: BladeLine, sections: tuple[Section, ...], merge_mm: float) -> BladeLine:
    heights_mm = [section.z_mm for section in sections if section.stacking is not None]
    span_mm = max(heights_mm, default=0.0) - min(heights_mm, default=0.0)
    lean_deg = degrees(merge_mm / span_mm) if span_mm > 0.0 else 0.0
    twist_deg = sqrt(2.0) * degrees(merge_mm / min(_half_chord_mm(section) for section in sections))
    return replace(
        line,
        lean_x_deg=_judged(line.lean_x_deg, lean_deg),
        lean_y_deg=_judged(line.lean_y_deg, lean_deg),
        bow_mm=_judged(line.bow_mm, merge_mm),
        relative_twist=tuple(
            replace(each, twist_deg=_judged(each.twist_deg, twist_deg)) for each in line.relative_twist
        ),
    )


def _judged(judged: Judged, more: float) -> Judged:
    return replace(judged, measured=wider(judged.measured, more))


def _damage(damage: Damage, merge_mm: float) -> Damage:
    return replace(
        damage,
        depth_mm=wider(damage.depth_mm, merge_mm),
        off_nominal_mm=wider(damage.off_nominal_mm, merge_mm),
        remaining_chord_mm=wider(damage.remaining_chord_mm, 2.0 * merge_mm),
        volume_mm3=wider(damage.volume_mm3, _volume_mm3(damage.area_mm2, merge_mm)),
    )


def _volume_mm3(area_mm2: Measured, merge_mm: float) -> float:
    return area_mm2.value * merge_mm if isinstance(area_mm2, Measurand) else 0.0


def _repairs(repairs: RepairVolume, merge_mm: float) -> RepairVolume:
    more_mm3 = sum(_volume_mm3(patch.area_mm2, merge_mm) for patch in repairs.patches)
    return replace(
        repairs,
        patches=tuple(_patch(patch, merge_mm) for patch in repairs.patches),
        volume_mm3=replace(repairs.volume_mm3, sigma=hypot(repairs.volume_mm3.sigma, more_mm3)),
    )


def _patch(patch: Patch, merge_mm: float) -> Patch:
    volume = patch.volume_mm3
    more_mm3 = _volume_mm3(patch.area_mm2, merge_mm)
    return replace(patch, volume_mm3=replace(volume, sigma=hypot(volume.sigma, more_mm3)))
