"""What the screen draws of a measured part: a decimated cloud with its deviations, and the sections.

This runs in the worker, beside the measurement; only small events travel.
"""

from geometry.sections.airfoil import Section
from geometry.types import Measurand, Measured
from station.events import MAX_CLOUD_POINTS, CloudMeasured, SectionMeasured, Value, pack
from station.measurement import Measurement, Outline
from station.plans import BladePlan, Limit, same_z


def draw(plan: BladePlan, measurement: Measurement) -> tuple[CloudMeasured | SectionMeasured, ...]:
    """The events of a measured part; those of what was not measured are absent."""
    cloud = (draw_cloud(plan, measurement),) if len(measurement.aligned_mm) else ()
    sections = (
        draw_section(plan, section, outline)
        for section in measurement.sections
        for outline in measurement.outlines
        if same_z(section.z_mm, outline.z_mm)
    )
    return (*cloud, *sections)


def draw_cloud(plan: BladePlan, measurement: Measurement) -> CloudMeasured:
    """The aligned scan, every k-th point of it."""
    step = -(-len(measurement.aligned_mm) // MAX_CLOUD_POINTS)
    profiles = (plan.limits.section.at(z_mm).get("profile_mm") for z_mm in plan.sections.z_mm)
    serviceable, repairable = band(plan.limits.form.deviation_mm or next(filter(None, profiles), None))
    return CloudMeasured(
        points_mm=pack(measurement.aligned_mm[::step]),
        deviation_mm=pack(measurement.deviation_mm[::step]),
        serviceable_mm=serviceable,
        repairable_mm=repairable,
    )


def draw_section(plan: BladePlan, section: Section, outline: Outline) -> SectionMeasured:
    """One section over its nominal."""
    serviceable, repairable = band(plan.limits.section.at(section.z_mm).get("profile_mm"))
    return SectionMeasured(
        z_mm=section.z_mm,
        status=section.status.value,
        nominal_mm=pack(outline.curve_mm),
        profile_mm=pack(section.profile_mm),
        deviation_mm=pack(section.deviation_mm),
        run=pack(section.run),
        le_mm=(float(outline.le_mm[0]), float(outline.le_mm[1])),
        te_mm=(float(outline.te_mm[0]), float(outline.te_mm[1])),
        serviceable_mm=serviceable,
        repairable_mm=repairable,
        values=tuple(
            shown(name, value, section.nominals.get(name)) for name, value in section.measurands.items()
        ),
    )


def shown(name: str, value: Measured, nominal: float | None) -> Value:
    """One number of a section, or why there is none."""
    if isinstance(value, Measurand):
        return Value(name=name, value=value.value, sigma=value.sigma, unit=value.unit, nominal=nominal)
    return Value(name=name, value=None, sigma=None, unit="", nominal=nominal, reason=value.reason)


def band(limit: Limit | None) -> tuple[float | None, float | None]:
    """Serviceable and repairable, where there is a limit."""
    return (limit.serviceable, limit.repairable) if limit else (None, None)
