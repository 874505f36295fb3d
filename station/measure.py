"""Views -> Measurement: the whole geometry chain, one verb a line.

The measurement is a fold: `absorb` each view as it lands, `conclude` after the last. Live, replayed and
inspected parts go through the same functions, hence equal numbers from equal points. Time is an argument:
`clock` gives seconds, `progress` hears the name of each step as it begins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.coverage import measure_coverage
from geometry.damage.damages import Damage, DamageKind, find_damages
from geometry.damage.detection import detection_limit
from geometry.deformation.twin import Twin
from geometry.errors import CannotMeasure
from geometry.registration.alignment import Alignment
from geometry.registration.register import mask_damage
from geometry.repair.patches import Patch, RepairVolume, find_repairs
from geometry.scan.clean import CleanSettings, clean
from geometry.scan.fuse import fuse
from geometry.scan.overlap import refine_axis
from geometry.sections.airfoil import Section, with_damages
from geometry.sections.blade_line import blade_line
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Measured, NotMeasured, View, Zone
from station.measurement import NO_TWIN, Measurement
from station.methods import align, cut_sections, make_twin
from station.recipe import Recipe
from station.widen import widened

T = TypeVar("T")
Clock = Callable[[], float]
Progress = Callable[[str], None]

BEND_MARGIN_MM = 2.0  # the mask of the registration reaches so far beyond metal that is bent
DAMAGE_MARGIN_MM = 0.5  # a section this near to a damage needs points that lie on it
AXIS_SIGMAS = 6.0  # a scanner that was knocked; no calibration is that unlucky
VIEW_BIAS_SIGMAS = 3.0  # a view that lies farther off the others was not taken where the table said


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """The views of one part so far."""

    views: tuple[View, ...] = ()


def absorb(state: Views, view: View) -> Views:
    """The state with one more view."""
    return Views(views=(*state.views, view))


def conclude(state: Views, recipe: Recipe, clock: Clock, progress: Progress) -> Measurement:
    """The measurement of all views, taken in the order of their indices."""
    if recipe.axis is None:
        raise ValueError("views cannot be merged without the calibration of the turntable's axis")
    run = Run(clock=clock, progress=progress)
    views = sorted(state.views, key=lambda view: view.index)
    merged = run.step("fuse", fused, views, recipe)
    if merged is None:
        return run.measurement(sum(len(view.points_mm) for view in views))
    cloud, merge_mm = merged
    return widened(measured(cloud, recipe, run), merge_mm)


def measure_cloud(cloud: Cloud, recipe: Recipe, clock: Clock, progress: Progress) -> Measurement:
    """The measurement of a cloud that was merged elsewhere."""
    found = measured(cloud, recipe, Run(clock=clock, progress=progress))
    merge_mm = recipe.plan.measurement.merge_mm
    return widened(found, merge_mm) if merge_mm > 0.0 else found


def measured(cloud: Cloud, recipe: Recipe, run: Run) -> Measurement:
    """The procedure. A step that lacks what an earlier one should have given does not run."""
    nominal = recipe.nominal
    points = run.step("clean", clean, cloud, CleanSettings())
    aligned = run.step("register", align, points, recipe)
    alignment = aligned.alignment if aligned else None
    mask = run.step("mask", mask_damage, points, alignment, nominal)
    twin = run.step("twin", make_twin, points, mask, alignment, recipe)
    damages = run.step("damage", find_damages, points, mask, alignment, nominal, twin, recipe.damage_settings)
    detection = run.step(
        "detection", detection_limit, points, alignment, nominal, twin, recipe.damage_settings.regions
    )
    repairs = run.step("repair", find_repairs, twin, points, alignment, damages, recipe.repair_settings)
    sections = run.step(
        "sections", inspected, points, mask, alignment, recipe, twin=twin, damages=damages, repairs=repairs
    )
    line = run.step("line", blade_line, sections, alignment)
    zones = run.step(
        "coverage",
        measure_coverage,
        points,
        alignment,
        nominal,
        twin=twin,
        repairs=repairs,
        settings=recipe.coverage_settings,
        damages=damages or (),
    )
    shown = run.step("deviation", deviations, points, alignment, nominal)
    found = run.measurement(len(cloud))
    return replace(
        found,
        alignment=alignment,
        service=aligned.service if aligned else None,
        aligned_mm=shown[0] if shown else found.aligned_mm,
        deviation_mm=shown[1] if shown else found.deviation_mm,
        sections=sections or (),
        line=line,
        outlines=recipe.outlines,
        twin_mesh=twin.mesh if twin else None,
        form_mm=twin.form_mm if twin else NO_TWIN,
        residual_mm=twin.noise_mm if twin else None,
        damages=None if damages is None else with_volumes(damages, repairs),
        layered_fraction=layered_fraction(damages or (), len(points) if points else 0),
        detection_mm=detection.depth_mm if detection else found.detection_mm,
        detection_mm2=detection.area_mm2 if detection else found.detection_mm2,
        repairs=repairs,
        zones=zones or (),
    )


@dataclass(slots=True, kw_only=True)
class Run:
    """The steps of one measurement as they are made: how long each took, and which could not be."""

    clock: Clock
    progress: Progress
    failures: dict[str, str] = field(default_factory=dict)
    timing_s: dict[str, float] = field(default_factory=dict)

    def step(self, name: str, verb: Callable[..., T], *needs: object, **options: object) -> T | None:
        """What `verb` gives, or None if one of its `needs` is missing or it cannot measure."""
        if any(need is None for need in needs):
            return None
        self.progress(name)
        begun_s = self.clock()
        try:
            return verb(*needs, **options)
        except CannotMeasure as why:
            self.failures[name] = str(why)
            return None
        finally:
            self.timing_s[name] = self.clock() - begun_s

    def measurement(self, points: int) -> Measurement:
        """A measurement with nothing but what went wrong and how long it took."""
        return Measurement(points=points, failures=dict(self.failures), timing_s=dict(self.timing_s))


def fused(views: Sequence[View], recipe: Recipe) -> tuple[Cloud, float]:
    """The views as one cloud, on the axis on which they agree best, and how far that leaves a point open, mm.

    Raises `CannotMeasure` where the calibration denies that axis, or a view disagrees with the others."""
    sigma_mm = recipe.plan.measurement.sigma_mm
    assert recipe.axis is not None
    refined = refine_axis(views, recipe.axis, sigma_mm)
    if not refined.moved_sigmas <= AXIS_SIGMAS:
        raise CannotMeasure(f"the views' axis lies {refined.moved_sigmas:.1f} sigmas off its calibration")
    for overlap in refined.overlaps:
        if not overlap.bias_mm <= VIEW_BIAS_SIGMAS * sigma_mm:
            raise CannotMeasure(f"view {overlap.view} lies {overlap.bias_mm:.3f} mm off the others")
    return fuse(views, refined.axis, sigma_mm), refined.surface_mm


def as_cloud(points_mm: Floats, sigma_mm: float) -> Cloud:
    """Points of a merged file as a cloud."""
    count = len(points_mm)
    return Cloud(points_mm=points_mm, sigma_mm=np.full(count, sigma_mm), view=np.zeros(count, np.int64))


def inspected(
    points: Cloud,
    mask: Bools,
    alignment: Alignment,
    recipe: Recipe,
    *,
    twin: Twin | None,
    damages: Sequence[Damage] | None,
    repairs: RepairVolume | None,
) -> tuple[Section, ...]:
    """The sections, measured on all metal that no limit of damage judges."""
    if twin is not None and damages is not None:
        mask = damaged_metal(points, mask, twin, damages)
    sections = cut_sections(points, mask, alignment, recipe)
    if damages is None:
        return sections
    spans = [
        damaged_span_mm(index, damage, recipe.nominal, repairs)
        for index, damage in enumerate(damages)
        if damage.kind is not DamageKind.DEFORMATION
    ]
    return tuple(settled(section, touches(section.z_mm, spans)) for section in sections)


def damaged_metal(points: Cloud, mask: Bools, twin: Twin, damages: Sequence[Damage]) -> Bools:
    """The scan points that limits of damage judge, and what neither twin nor nominal explains.

    Deformed metal, and what is next to it, counts as sound: its limits are those of sections and form."""
    damaged = mask & ~twin.sound
    for damage in damages:
        if damage.kind is DamageKind.DEFORMATION:
            left = np.flatnonzero(damaged)
            apart_mm, _ = cKDTree(points.points_mm[damage.points]).query(points.points_mm[left])
            damaged[left[apart_mm <= BEND_MARGIN_MM]] = False
    for damage in damages:
        if damage.kind is not DamageKind.DEFORMATION:
            damaged[damage.points] = True
    return damaged


def damaged_span_mm(
    index: int, damage: Damage, nominal: Nominal, repairs: RepairVolume | None
) -> tuple[float, float]:
    """The heights between which a damage lies: its points, its patch, and up to the end of a lost tip."""
    low_mm, high_mm = damage.span_mm
    for patch in repairs.patches if repairs else ():
        if patch.damage == index:
            z_mm = patch.mesh.vertices_mm[:, 2]
            low_mm, high_mm = min(low_mm, float(z_mm.min())), max(high_mm, float(z_mm.max()))
    if damage.zone is Zone.TIP and damage.kind is DamageKind.MISSING:
        high_mm = max(high_mm, nominal.z_max_mm)
    return low_mm, high_mm


def touches(z_mm: float, spans_mm: Sequence[tuple[float, float]]) -> bool:
    """Whether a plane passes through a damage or closely by."""
    return any(low - DAMAGE_MARGIN_MM <= z_mm <= high + DAMAGE_MARGIN_MM for low, high in spans_mm)


def settled(section: Section, touched: bool) -> Section:
    """The section once the damages are known: only a damage that was found excuses what is missing."""
    if touched:
        return with_damages(section, touched)
    measurands = {name: unexcused(measured) for name, measured in section.measurands.items()}
    return replace(section, measurands=measurands)


def unexcused(measured: Measured) -> Measured:
    if isinstance(measured, NotMeasured) and measured.in_damage:
        return NotMeasured(reason=f"{measured.reason}, but no damage was found there")
    return measured


def layered_fraction(damages: Sequence[Damage], points: int) -> float:
    """The share of the scan points that lie on damages where the scan is in layers."""
    return sum(len(damage.points) for damage in damages if damage.layered) / max(points, 1)


def with_volumes(damages: Sequence[Damage], repairs: RepairVolume | None) -> tuple[Damage, ...]:
    """The damages, volume and lost skin of each taken from its patch, or with the reason why it has none."""
    if repairs is None:
        return tuple(damages)
    patches = {patch.damage: patch for patch in repairs.patches}
    return tuple(with_volume(d, patches.get(i), repairs.failures.get(i)) for i, d in enumerate(damages))


def with_volume(damage: Damage, patch: Patch | None, failure: str | None) -> Damage:
    if patch is not None:
        return replace(damage, volume_mm3=patch.volume_mm3, area_mm2=patch.area_mm2)
    if failure is not None and isinstance(damage.volume_mm3, NotMeasured):
        return replace(damage, volume_mm3=NotMeasured(reason=failure))
    return damage


def deviations(points: Cloud, alignment: Alignment, nominal: Nominal) -> tuple[Floats, Floats]:
    """The points in the nominal frame (n, 3) and their signed distance (n,) to the nominal."""
    aligned_mm = apply(alignment.T_nominal_scan, points.points_mm)
    return aligned_mm, nominal.closest(aligned_mm).distance_mm
