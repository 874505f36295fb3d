"""The inspected sections: position, orientation, chord, thickness, edges, profile, each with its sigma.

A measured section has the nodes of the nominal one, so that an arc chosen on the nominal (an edge, the
thickest part) is the same metal on both. Each measurand has a support, the arc that it needs; where the
support has a gap there is no number.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from geometry.chart import SectionSettings, unroll
from geometry.curve import (
    Edge,
    Estimate,
    Pair,
    camber_line,
    centroid,
    centroid_gradient,
    chord,
    edge,
    edge_radius,
    gauge,
    orientation,
    thick_part,
    thickness,
)
from geometry.errors import CannotMeasure
from geometry.nominal import Nominal
from geometry.profile import Gap, Profile, Scan, explain_gaps, reconstruct, whole_gap
from geometry.register import Alignment
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Ints, Measurand, Measured, NotMeasured, Unit

__all__ = [
    "SECTION_MEASURANDS",
    "Section",
    "SectionSettings",
    "SectionStatus",
    "measure_sections",
    "with_damages",
]

_SIDES = ("le", "ss", "te", "ps")  # as `NominalSection.side` numbers them: edges, suction, pressure side
_GAUGE = 0.05  # of the chord: this far inside either edge its thickness is taken

SECTION_MEASURANDS: Mapping[str, Unit] = {
    "position_x_mm": "mm",
    "position_y_mm": "mm",
    "position_mm": "mm",
    "orientation_deg": "deg",
    "profile_max_mm": "mm",
    "profile_min_mm": "mm",
    "chord_mm": "mm",
    "max_thickness_mm": "mm",
    "le_radius_mm": "mm",
    "te_radius_mm": "mm",
    "stagger_deg": "deg",
    "le_thickness_mm": "mm",
    "te_thickness_mm": "mm",
    **{f"{side}_profile_{end}_mm": "mm" for side in _SIDES for end in ("max", "min")},
}


class SectionStatus(StrEnum):
    MEASURED = "measured"
    PARTIAL = "partial"
    IN_DAMAGE = "in_damage"
    NOT_COVERED = "not_covered"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Section:
    """One inspected section, nominal frame.

    `measurands` has every name in SECTION_MEASURANDS; one whose support touches a damage is
    `NotMeasured(..., in_damage=True)`. `nominals` gives the nominal value of each.
    `profile_mm` (m, 2) are points of the measured profile where it was measured, in order,
    `deviation_mm` (m,) their signed distance to the nominal section (positive outside), `run` (m,) numbers
    the unbroken stretches, so that nobody draws a line across a gap.
    """

    z_mm: float
    status: SectionStatus
    reason: str | None
    covered_fraction: float
    measurands: Mapping[str, Measured]
    nominals: Mapping[str, float]
    profile_mm: Floats
    deviation_mm: Floats
    run: Ints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Definition:
    """What the nominal section fixes for the measured one: which metal is an edge, a side, the thick part."""

    curve_mm: Floats  # (m, 2) corresponding nodes: trailing edge at 0, leading edge at m / 2
    side: Ints  # (m,) index into _SIDES
    le: Edge
    te: Edge
    thick: Mapping[str, Pair]  # where each thickness is taken

    def supports(self) -> Mapping[str, Bools]:
        """Nodes (m,) that each measurand needs."""
        m = len(self.curve_mm)
        needed = dict.fromkeys(SECTION_MEASURANDS, np.ones(m, bool))
        needed["chord_mm"] = needed["stagger_deg"] = _mark(m, self.le.zone) | _mark(m, self.te.zone)
        needed["le_radius_mm"], needed["te_radius_mm"] = _mark(m, self.le.arc), _mark(m, self.te.arc)
        for name, pair in self.thick.items():
            needed[name] = _mark(m, pair.node) | _mark(m, pair.across)
        for index, side in enumerate(_SIDES):
            needed[f"{side}_profile_max_mm"] = needed[f"{side}_profile_min_mm"] = self.side == index
        return needed


def _mark(m: int, nodes: Ints) -> Bools:
    marked = np.zeros(m, bool)
    marked[nodes] = True
    return marked


def define(nominal_mm: Floats, side: Ints) -> Definition:
    """The definition from a nominal curve of corresponding nodes and the side that each is on."""
    nose = len(nominal_mm) // 2
    le, te = edge(nominal_mm, nose), edge(nominal_mm, 0)
    camber = camber_line(nominal_mm, nose)
    line = chord(nominal_mm, le, te)
    length = line.length.value
    along = (line.tail_mm - line.nose_mm) / length
    return Definition(
        curve_mm=nominal_mm,
        side=side,
        le=le,
        te=te,
        thick={
            "max_thickness_mm": thick_part(camber),
            "le_thickness_mm": gauge(camber, line.nose_mm, along, _GAUGE * length),
            "te_thickness_mm": gauge(camber, line.tail_mm, -along, _GAUGE * length),
        },
    )


def shape(curve_mm: Floats, definition: Definition) -> dict[str, Estimate]:
    """The estimates that need one curve only, by name; the same for a nominal and a measured section."""
    line = chord(curve_mm, definition.le, definition.te)
    found = {"chord_mm": line.length, "stagger_deg": _degrees(line.stagger)}
    for name, pair in definition.thick.items():
        found[name] = thickness(curve_mm, pair)
    for name, end in (("le_radius_mm", definition.le), ("te_radius_mm", definition.te)):
        try:
            found[name] = edge_radius(curve_mm, end.arc)
        except CannotMeasure:
            continue
    return found


def place(curve_mm: Floats, nominal_mm: Floats) -> dict[str, Estimate]:
    """The estimates of the curve against the nominal, by name: where it is and how it is turned."""
    shift = centroid(curve_mm) - centroid(nominal_mm)
    gradient = centroid_gradient(curve_mm)
    distance = float(np.linalg.norm(shift))
    away = shift / distance if distance > 0.0 else np.array([1.0, 0.0])
    return {
        "position_x_mm": Estimate(value=float(shift[0]), gradient=gradient[0]),
        "position_y_mm": Estimate(value=float(shift[1]), gradient=gradient[1]),
        "position_mm": Estimate(value=distance, gradient=away @ gradient),
        "orientation_deg": _degrees(orientation(curve_mm, nominal_mm)),
    }


def _degrees(angle: Estimate) -> Estimate:
    return Estimate(value=float(np.rad2deg(angle.value)), gradient=np.rad2deg(angle.gradient))


def extremes(deviation_mm: Floats, seen: Bools, side: Ints) -> dict[str, Estimate]:
    """Largest and smallest signed distance to the nominal over the seen nodes: of all, and of each side."""
    parts = {"": seen, **{f"{name}_": seen & (side == index) for index, name in enumerate(_SIDES)}}
    found = {}
    for name, part in parts.items():
        if part.any():
            found[f"{name}profile_max_mm"] = _at(
                deviation_mm, int(np.argmax(np.where(part, deviation_mm, -np.inf)))
            )
            found[f"{name}profile_min_mm"] = _at(
                deviation_mm, int(np.argmin(np.where(part, deviation_mm, np.inf)))
            )
    return found


def _at(deviation_mm: Floats, node: int) -> Estimate:
    gradient = np.zeros(len(deviation_mm))
    gradient[node] = 1.0
    return Estimate(value=float(deviation_mm[node]), gradient=gradient)


def measure_sections(
    cloud: Cloud,
    mask: Bools,
    alignment: Alignment,
    nominal: Nominal,
    z_mm: Sequence[float],
    settings: SectionSettings,
) -> tuple[Section, ...]:
    """The sections in the planes `z_mm` of the nominal frame, in the order asked for.

    `mask` (n,): True = a damaged point. Sigmas hold the noise found about the profile, the number of
    points, the smoothness assumed between them, and the pose.
    """
    scan = Scan(
        points_mm=apply(alignment.T_nominal_scan, cloud.points_mm), sigma_mm=cloud.sigma_mm, mask=mask
    )
    return tuple(_measure(scan, alignment, nominal, float(z), settings) for z in z_mm)


def _measure(
    scan: Scan, alignment: Alignment, nominal: Nominal, z_mm: float, settings: SectionSettings
) -> Section:
    """One section."""
    chart = unroll(nominal, z_mm, settings.band_mm, settings)
    definition = define(chart.curve_mm, chart.side)
    try:
        profile = reconstruct(scan, chart, settings)
    except CannotMeasure as why:
        gaps = explain_gaps(whole_gap(chart), scan, nominal, z_mm, settings)
        return _absent(z_mm, gaps[0], str(why), definition)
    gaps = explain_gaps(profile.gaps, scan, nominal, z_mm, settings)
    return _section(replace(profile, gaps=gaps), definition, alignment)


def _section(profile: Profile, definition: Definition, alignment: Alignment) -> Section:
    """The section of a reconstructed profile."""
    seen = ~profile.open_nodes()
    if not seen.any():
        return _absent(profile.z_mm, profile.gaps[0], "no sound points in the plane", definition)
    estimates = {
        **place(profile.curve_mm, definition.curve_mm),
        **shape(profile.curve_mm, definition),
        **extremes(profile.deviation_mm, seen, definition.side),
    }
    sigmas = _sigmas(profile, estimates, alignment)
    measurands = _judge_supports(profile, definition, estimates, sigmas)
    order, run = _runs(seen)
    missing = sum(gap.width_mm for gap in profile.gaps)
    status, reason = _status(profile.gaps, measurands)
    return Section(
        z_mm=profile.z_mm,
        status=status,
        reason=reason,
        covered_fraction=max(0.0, 1.0 - missing / profile.chart.perimeter_mm),
        measurands=measurands,
        nominals=_nominals(definition),
        profile_mm=profile.curve_mm[order],
        deviation_mm=profile.deviation_mm[order],
        run=run,
    )


def _sigmas(profile: Profile, estimates: Mapping[str, Estimate], alignment: Alignment) -> Mapping[str, float]:
    """Standard uncertainty of each estimate: points and smoothness, and the pose."""
    gradients = np.stack([estimate.gradient for estimate in estimates.values()])
    pose = profile.pose_gradient(gradients, alignment.pivot_mm)
    covariance = profile.covariance(gradients) + pose @ _pose_covariance(alignment) @ pose.T
    sigmas = dict(zip(estimates, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    names = list(estimates)
    xy = [names.index("position_x_mm"), names.index("position_y_mm")]
    return {**sigmas, "position_mm": _distance_sigma(estimates, covariance[np.ix_(xy, xy)])}


def _distance_sigma(estimates: Mapping[str, Estimate], covariance: Floats) -> float:
    """Sigma of the distance of the centroids; when they coincide, that of the worst direction."""
    shift = np.array([estimates["position_x_mm"].value, estimates["position_y_mm"].value])
    worst = float(np.linalg.eigvalsh(covariance)[-1])
    along = float(shift @ covariance @ shift)
    return float(np.sqrt((along + worst**2) / (float(shift @ shift) + worst)))


def _pose_covariance(alignment: Alignment) -> Floats:
    """Covariance (6, 6) of the pose twist; where the surface leaves it free, 1 mm or 0.02 rad."""
    prior = np.array([0.02, 0.02, 0.02, 1.0, 1.0, 1.0]) ** -2.0
    return np.linalg.inv(alignment.information + np.diag(prior)).astype(np.float64)


def _judge_supports(
    profile: Profile,
    definition: Definition,
    estimates: Mapping[str, Estimate],
    sigmas: Mapping[str, float],
) -> Mapping[str, Measured]:
    """Each measurand, or why there is none."""
    open_nodes, lost = profile.open_nodes(), profile.open_nodes(damaged=True)
    measurands: dict[str, Measured] = {}
    for name, needed in definition.supports().items():
        if (lost & needed).any():
            measurands[name] = NotMeasured(reason="a damage lies on the arc it needs", in_damage=True)
        elif (open_nodes & needed).any():
            measurands[name] = NotMeasured(reason="no points on a part of the arc it needs")
        elif name not in estimates:
            measurands[name] = NotMeasured(reason="the edge has no rounding")
        else:
            unit, value = SECTION_MEASURANDS[name], estimates[name].value
            measurands[name] = Measurand(name=name, value=value, sigma=sigmas[name], unit=unit)
    return measurands


def _status(gaps: Sequence[Gap], measurands: Mapping[str, Measured]) -> tuple[SectionStatus, str | None]:
    """The status, with the reason when it is not simply measured."""
    lost = [m for m in measurands.values() if isinstance(m, NotMeasured)]
    if not lost:
        return SectionStatus.MEASURED, None
    widest = max((gap.width_mm for gap in gaps), default=0.0)
    if any(m.in_damage for m in lost):
        return SectionStatus.IN_DAMAGE, f"a damage takes up to {widest:.1f} mm of the profile"
    if len(lost) == len(measurands):
        return SectionStatus.NOT_COVERED, f"no points on up to {widest:.1f} mm of the profile"
    return SectionStatus.PARTIAL, f"no points on up to {widest:.1f} mm of the profile"


def _runs(seen: Bools) -> tuple[Ints, Ints]:
    """The seen nodes in order, starting after a gap, and the number of the stretch that each is in."""
    m = len(seen)
    start = (int(np.argmin(seen)) + 1) % m if not seen.all() else 0
    order = (start + np.arange(m)) % m
    run = np.cumsum(np.diff(seen[order].astype(np.int64), prepend=0) == 1) - 1
    keep = seen[order]
    return order[keep], run[keep].astype(np.int64)


def _nominals(definition: Definition) -> Mapping[str, float]:
    """The nominal value of every measurand that the nominal has."""
    found = shape(definition.curve_mm, definition)
    against = (n for n in SECTION_MEASURANDS if "profile" in n or n.startswith(("position", "orientation")))
    return {**dict.fromkeys(against, 0.0), **{name: e.value for name, e in found.items()}}


def _absent(z_mm: float, gap: Gap, why: str, definition: Definition) -> Section:
    """A section of which nothing was measured."""
    lost = NotMeasured(reason="a damage took this section" if gap.in_damage else why, in_damage=gap.in_damage)
    return Section(
        z_mm=z_mm,
        status=SectionStatus.IN_DAMAGE if gap.in_damage else SectionStatus.NOT_COVERED,
        reason=lost.reason,
        covered_fraction=0.0,
        measurands=dict.fromkeys(SECTION_MEASURANDS, lost),
        nominals=_nominals(definition),
        profile_mm=np.empty((0, 2)),
        deviation_mm=np.empty(0),
        run=np.empty(0, np.int64),
    )


def with_damages(section: Section, touched: bool) -> Section:
    """The section, once the damages are known: what it lacks where one touches it is the damage's."""
    lost = {n: m for n, m in section.measurands.items() if isinstance(m, NotMeasured)}
    if not touched or not lost:
        return section
    taken = {name: NotMeasured(reason="a damage touches this section", in_damage=True) for name in lost}
    return replace(
        section,
        status=SectionStatus.IN_DAMAGE,
        reason="a damage touches this section",
        measurands={**section.measurands, **taken},
    )
