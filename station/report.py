"""The report of one inspection: one HTML file that needs nothing else, for screen and paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from geometry.types import Floats
from station.findings import Finding, spelled
from station.pictures import deviation_views, legend_stops
from station.plans import Limit, same_z
from station.plots import Bar, Curve, SectionPlot, limit_bar, plot_section
from station.tables import Row, rows

if TYPE_CHECKING:
    from geometry.sections.airfoil import Section
    from station.measurement import Measurement
    from station.plans import BladePlan
    from station.verdict import Verdict

TEMPLATES = Path(__file__).parent / "templates"
MAP_HEIGHT_PX = 520
MAP_POINTS = 120_000

SIDES = {"le": "leading edge", "ss": "suction side", "te": "trailing edge", "ps": "pressure side"}

SENTENCES = {
    "PASS": "Serviceable as it is.",
    "REPAIR": "Beyond serviceable, proven repairable.",
    "SCRAP": "Proven beyond repair.",
    "HOLD": "No verdict. The part is held until a person decides or it is inspected again.",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Map:
    """The deviation map: two pictures, and the legend of their colours."""

    views: tuple[str, ...]
    full_mm: float
    stops: tuple[tuple[float, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionPage:
    """What the report shows of one section."""

    section: Section
    plot: SectionPlot | None
    rows: tuple[Row, ...]


def render(result: Mapping[str, Any], measurement: Measurement, verdict: Verdict, plan: BladePlan) -> str:
    """The report as HTML. Every text is escaped; a serial number cannot become markup."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(fixed=fixed, words=words, percent=percent, bar=bar, title=title, sign=sign)
    return environment.get_template("report.html.j2").render(
        result=result,
        sentence=SENTENCES[verdict.verdict.value],
        findings=[f for f in verdict.findings if not f.characteristic.startswith("sections[")],
        sides=SIDES,
        sections=pages(measurement, verdict, plan),
        map=deviation_map(measurement, plan),
        damages=measurement.damages or (),
        looked_for_damage=measurement.damages is not None,
        alignment=measurement.alignment,
        zones=measurement.zones,
        detection=measurement.detection_mm,
        plan=plan,
    )


def pages(measurement: Measurement, verdict: Verdict, plan: BladePlan) -> list[SectionPage]:
    """One page for each section that was measured or tried."""
    table = list(rows(measurement, verdict))
    return [
        SectionPage(
            section=section,
            plot=plot_of(section, measurement, plan),
            rows=tuple(row for row in table if same_z(row.z_mm, section.z_mm)),
        )
        for section in measurement.sections
    ]


def plot_of(section: Section, measurement: Measurement, plan: BladePlan) -> SectionPlot | None:
    """The plot of a section, if any of it was measured."""
    outline = next((each for each in measurement.outlines if same_z(each.z_mm, section.z_mm)), None)
    if outline is None or len(section.profile_mm) == 0:
        return None
    curve = Curve(
        curve_mm=outline.curve_mm,
        profile_mm=section.profile_mm,
        deviation_mm=section.deviation_mm,
        run=section.run,
    )
    ends_mm = {"leading edge": outline.le_mm, "trailing edge": outline.te_mm}
    return plot_section(curve, ends_mm, plan.limits.section.at(section.z_mm).get("profile_mm"))


def deviation_map(measurement: Measurement, plan: BladePlan) -> Map | None:
    """The map of the aligned scan, its full colour at the largest serviceable limit of profile or form."""
    if len(measurement.aligned_mm) < 3:
        return None
    full_mm = max((limit.serviceable for limit in form_limits(plan)), default=0.2) or 0.2
    twin = measurement.twin_mesh
    views = deviation_views(
        thinned(measurement.aligned_mm),
        thinned(measurement.deviation_mm),
        thinned(measurement.aligned_mm[:0] if twin is None else twin.vertices_mm),
        full_mm,
        MAP_HEIGHT_PX,
    )
    return Map(views=tuple(views), full_mm=full_mm, stops=tuple(legend_stops(full_mm)))


def thinned(values: Floats) -> Floats:
    """Every so many of the rows, so that at most `MAP_POINTS` are drawn."""
    return values[:: -(-len(values) // MAP_POINTS) or 1]


def form_limits(plan: BladePlan) -> list[Limit]:
    profile = (plan.limits.section.at(z_mm).get("profile_mm") for z_mm in plan.sections.z_mm)
    return [limit for limit in (plan.limits.form.deviation_mm, *profile) if limit]


def bar(finding: Finding) -> Bar | None:
    """The bar of a finding that has a number and limits."""
    if finding.judged is None or finding.U is None:
        return None
    if finding.serviceable is None or finding.repairable is None:
        return None
    return limit_bar(
        finding.judged, finding.U, Limit(serviceable=finding.serviceable, repairable=finding.repairable)
    )


def fixed(value: float | None, digits: int = 3) -> str:
    """A number with a true minus sign; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}".replace("-", "−")


def percent(value: float) -> str:
    return f"{100.0 * value:.1f} %"


def words(name: str) -> str:
    """`max_thickness_mm` as `max thickness`."""
    return spelled(name)[0]


def sign(unit: str) -> str:
    """A unit behind the name of a characteristic; nothing for a pure number."""
    return {"deg": " °", "1": "", "fraction": ""}.get(unit, f" {unit}")


def title(characteristic: str) -> str:
    """`damage.tip.depth_mm` as `tip depth`."""
    place, _, name = characteristic.rpartition(".")
    where = place.removeprefix("damage.").replace("_", " ")
    return f"{where} {spelled(name)[0]}"
