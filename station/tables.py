"""Sections as a table: one row a measurand, beside its nominal, its limits and its outcome."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING

from geometry.types import Measurand
from station.findings import Finding, characteristic
from station.plans import same_z

if TYPE_CHECKING:
    from geometry.sections.airfoil import Section
    from station.measurement import Measurement
    from station.verdict import Verdict

COLUMNS = (
    "z_mm",
    "characteristic",
    "unit",
    "actual",
    "nominal",
    "deviation",
    "sigma",
    "U",
    "serviceable",
    "repairable",
    "outcome",
    "reason",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One measurand of one section; `finding` where the plan limits it."""

    z_mm: float
    name: str
    unit: str
    actual: float | None
    nominal: float | None
    sigma: float | None
    finding: Finding | None
    reason: str | None

    @property
    def deviation(self) -> float | None:
        return None if self.actual is None or self.nominal is None else self.actual - self.nominal


def rows(measurement: Measurement, verdict: Verdict) -> Iterator[Row]:
    """Every measurand of every section, what the plan limits first."""
    for section in measurement.sections:
        findings = findings_at(section.z_mm, verdict)
        for name in (*findings, *(name for name in section.measurands if name not in findings)):
            yield row(section, name, findings.get(name))


def findings_at(z_mm: float, verdict: Verdict) -> dict[str, Finding]:
    """The findings of one section by the name of the characteristic."""
    found = {}
    for finding in verdict.findings:
        place, _, name = finding.characteristic.rpartition(".")
        if place.startswith("sections[") and same_z(float(place[9:-1]), z_mm):
            found[name] = finding
    return found


def row(section: Section, name: str, finding: Finding | None) -> Row:
    each, nominal = characteristic(section, name)
    measured = next((m for m in each if finding and getattr(m, "value", None) == finding.value), each[0])
    number = measured if isinstance(measured, Measurand) else None
    return Row(
        z_mm=section.z_mm,
        name=name,
        unit=number.unit if number else name.rpartition("_")[2],
        actual=number.value if number else None,
        nominal=nominal if isfinite(nominal) else None,
        sigma=number.sigma if number else None,
        finding=finding,
        reason=None if isinstance(measured, Measurand) else measured.reason,
    )


def sections_csv(measurement: Measurement, verdict: Verdict) -> str:
    """The rows as CSV with a header; an empty cell was not measured, and `reason` says why."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for each in rows(measurement, verdict):
        writer.writerow("" if cell is None else cell for cell in cells(each))
    return text.getvalue()


def cells(row: Row) -> tuple[object, ...]:
    finding = row.finding
    return (
        row.z_mm,
        row.name,
        row.unit,
        row.actual,
        row.nominal,
        row.deviation,
        row.sigma,
        finding.U if finding else None,
        finding.serviceable if finding else None,
        finding.repairable if finding else None,
        finding.outcome.value if finding else None,
        row.reason,
    )
