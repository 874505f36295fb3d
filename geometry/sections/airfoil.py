"""The inspected sections: position, orientation, chord, thickness, edges, profile, each with its sigma."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import lru_cache

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.errors import CannotMeasure
from geometry.registration.alignment import Alignment, pose_covariance
from geometry.sections.chart import Chart, SectionSettings, unroll
from geometry.sections.curve import Estimate, centroid, node_shares
from geometry.sections.form import (
    PROFILE_EXTREMES,
    SIDES,
    extreme_sigmas,
    flattened_mm,
    share_beyond_sigma,
    with_pose,
)
from geometry.sections.measurands import SECTION_MEASURANDS, Definition, define, form, place, shape
from geometry.sections.profile import (
    Gap,
    Profile,
    Scan,
    ZoneArc,
    cover_zones,
    explain_gaps,
    reconstruct,
    scan_of,
    whole_gap,
)
from geometry.threads import one_blas_thread
from geometry.types import Bools, Cloud, Floats, Ints, Measurand, Measured, NotMeasured

__all__ = [
    "SECTION_MEASURANDS",
    "Section",
    "SectionSettings",
    "SectionStatus",
    "Stacking",
    "ZoneArc",
    "measure_sections",
    "with_damages",
]

_RIM_MM = 1.0  # of a gap
_AT_ONCE = 2  # sections; none knows of another, and most of their time is spent in compiled code


class SectionStatus(StrEnum):
    MEASURED = "measured"
    PARTIAL = "partial"
    IN_DAMAGE = "in_damage"
    NOT_COVERED = "not_covered"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stacking:
    """Where a section stands and how it is turned, apart for what it shares with the others of its part.

    All are (3,) or over them: centroid x, y (mm) and turn against the nominal (rad). `covariance` (3, 3) is
    that of its own points, `pose` (3, 6) the growth with the alignment's twist about its pivot.
    """

    measured: Floats
    nominal: Floats
    covariance: Floats
    pose: Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Section:
    """One inspected section, nominal frame.

    `measurands` has every name of `section_measurands`; one whose support touches a damage is
    `NotMeasured(..., in_damage=True)`. `nominals` gives the nominal value of each that the nominal has.
    `band_mm` are the heights between which points took part, taken as smooth in z, and `band_points` how many
    they were: None and 0 where none did.
    `zones` tells of "le", "ss", "te" and "ps" how much of the arc has points. `stacking` is there when both
    position and orientation are.
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
    zones: Mapping[str, ZoneArc] = field(default_factory=dict)
    stacking: Stacking | None = None
    band_mm: tuple[float, float] | None = None
    band_points: int = 0


@one_blas_thread
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
    scan = scan_of(cloud, mask, alignment.T_nominal_scan)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return tuple(pool.map(lambda z: _measure(scan, alignment, nominal, float(z), settings), z_mm))


def _measure(
    scan: Scan, alignment: Alignment, nominal: Nominal, z_mm: float, settings: SectionSettings
) -> Section:
    """One section."""
    chart, definition = _prepared(nominal, z_mm, settings)
    try:
        profile = reconstruct(scan, chart, settings)
    except CannotMeasure as why:
        gaps = explain_gaps(whole_gap(chart), scan, nominal, z_mm, settings)
        return _absent(z_mm, gaps[0], str(why), definition)
    gaps = explain_gaps(profile.gaps, scan, nominal, z_mm, settings)
    return _section(replace(profile, gaps=gaps), definition, alignment)


@lru_cache(maxsize=128)
def _prepared(nominal: Nominal, z_mm: float, settings: SectionSettings) -> tuple[Chart, Definition]:
    """What the nominal alone gives for one section; a blade of the same part finds it ready."""
    chart = unroll(nominal, z_mm, settings.widest_band_mm, settings)
    return chart, define(chart.curve_mm, chart.side, settings)


def _section(profile: Profile, definition: Definition, alignment: Alignment) -> Section:
    """The section of a reconstructed profile."""
    seen = ~profile.open_nodes()
    if not seen.any():
        return _absent(profile.z_mm, profile.gaps[0], "no sound points in the plane", definition)
    lost = _lost(profile, definition)
    estimates = {
        **place(profile.curve_mm, definition.curve_mm),
        **shape(profile.curve_mm, definition, definition.names.keys() - lost),
        **form(profile.curve_mm, profile.deviation_mm, seen, definition),
    }
    uncertainty = _uncertainty(profile, estimates, alignment)
    measurands = _measured(definition, lost, estimates, _sigmas(profile, seen, definition, uncertainty))
    order, run = _runs(seen)
    status, reason = _status(profile.gaps, definition, measurands)
    return Section(
        z_mm=profile.z_mm,
        status=status,
        reason=reason,
        covered_fraction=max(
            0.0, 1.0 - sum(gap.width_mm for gap in profile.gaps) / profile.chart.perimeter_mm
        ),
        measurands=measurands,
        nominals=definition.nominals,
        profile_mm=profile.curve_mm[order],
        deviation_mm=profile.deviation_mm[order],
        run=run,
        zones=dict(zip(SIDES, profile.zones, strict=True)),
        stacking=_stacking(profile, definition, uncertainty) if seen.all() else None,
        band_mm=profile.band_mm,
        band_points=profile.band_points,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Uncertainty:
    """The estimates with their covariance: of points and smoothness, and growth with the pose."""

    estimates: Mapping[str, Estimate]
    own: Floats  # (n, n)
    pose: Floats  # (n, 6)
    pose_covariance: Floats  # (6, 6)
    node_sigma_mm: Floats  # (NODES,) of each node's displacement, the pose's share in it

    @property
    def covariance(self) -> Floats:
        whole: Floats = self.own + self.pose @ self.pose_covariance @ self.pose.T
        return whole

    def rows(self, *names: str) -> Ints:
        every = list(self.estimates)
        return np.array([every.index(name) for name in names])


def _uncertainty(profile: Profile, estimates: Mapping[str, Estimate], alignment: Alignment) -> _Uncertainty:
    gradients = np.stack([estimate.gradient for estimate in estimates.values()])
    growth = profile.chart.pose_growth(profile.curve_mm, alignment.pivot_mm)
    twist = pose_covariance(alignment)
    return _Uncertainty(
        estimates=estimates,
        own=profile.covariance(gradients),
        pose=gradients @ growth,
        pose_covariance=twist,
        node_sigma_mm=with_pose(profile.node_sigmas(), growth, twist),
    )


def _sigmas(
    profile: Profile, seen: Bools, definition: Definition, uncertainty: _Uncertainty
) -> Mapping[str, float]:
    """Standard uncertainty of each estimate; apart for those that are no smooth function of the nodes.

    An extreme of the profile bears what smoothing may have taken off it.
    """
    covariance, estimates = uncertainty.covariance, uncertainty.estimates
    sigmas = {
        **dict(zip(estimates, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        **extreme_sigmas(profile.deviation_mm, seen, definition.side, uncertainty.node_sigma_mm),
    }
    supports, trusted = definition.supports(), ~profile.open_nodes(margin_mm=_RIM_MM)
    for name in (name for name in estimates if name.endswith(PROFILE_EXTREMES)):
        flat_mm = _flattened_mm(name, estimates[name], profile, supports[name] & trusted)
        sigmas[name] = float(np.hypot(sigmas[name], flat_mm))
    xy = uncertainty.rows("position_x_mm", "position_y_mm")
    sigmas["position_mm"] = _distance_sigma(estimates, covariance[np.ix_(xy, xy)])
    if "waviness_rms_mm" in estimates:
        waves, share = definition.waves, node_shares(definition.curve_mm)
        amplitudes = profile.covariance(waves.harmonics * waves.share_mm)
        along, rms_mm = sigmas["waviness_rms_mm"], estimates["waviness_rms_mm"].value
        sigmas["waviness_rms_mm"] = waves.rms_sigma(rms_mm, along, amplitudes)
        sigmas["out_of_tolerance_fraction"] = share_beyond_sigma(
            profile.deviation_mm, uncertainty.node_sigma_mm, share, definition.settings.tolerance_mm
        )
    return sigmas


def _flattened_mm(name: str, extreme: Estimate, profile: Profile, trusted: Bools) -> float:
    """What smoothing may have taken off an extreme; points elsewhere tell of it on the `trusted` nodes only.

    Next to a gap those of its rim do not, nor of an extreme after the best fit, whose distances are others.
    """
    sign = 1.0 if name.endswith("_max_mm") else -1.0
    return flattened_mm(
        sign * profile.deviation_mm,
        int(np.argmax(np.abs(extreme.gradient))),
        sign * profile.left_over_mm,
        profile.left_over_sigma_mm,
        elsewhere=trusted & ("_form_" not in name),
    )


def _stacking(profile: Profile, definition: Definition, uncertainty: _Uncertainty) -> Stacking:
    rows = uncertainty.rows("position_x_mm", "position_y_mm", "orientation_deg")
    unit = np.array([1.0, 1.0, np.deg2rad(1.0)])
    turn = np.deg2rad(uncertainty.estimates["orientation_deg"].value)
    return Stacking(
        measured=np.append(centroid(profile.curve_mm), turn),
        nominal=np.append(centroid(definition.curve_mm), 0.0),
        covariance=uncertainty.own[np.ix_(rows, rows)] * np.outer(unit, unit),
        pose=uncertainty.pose[rows] * unit[:, None],
    )


def _distance_sigma(estimates: Mapping[str, Estimate], covariance: Floats) -> float:
    """Sigma of the distance of the centroids; when they coincide, that of the worst direction."""
    shift = np.array([estimates["position_x_mm"].value, estimates["position_y_mm"].value])
    worst = float(np.linalg.eigvalsh(covariance)[-1])
    along = float(shift @ covariance @ shift)
    return float(np.sqrt((along + worst**2) / (float(shift @ shift) + worst)))


def _lost(profile: Profile, definition: Definition) -> Mapping[str, NotMeasured]:
    """The measurands whose support has a gap, with the reason."""
    open_nodes, damaged = profile.open_nodes(), profile.open_nodes(damaged=True)
    lost = {}
    for name, needed in definition.supports().items():
        if (damaged & needed).any():
            lost[name] = NotMeasured(reason="a damage lies on the arc it needs", in_damage=True)
        elif (open_nodes & needed).any():
            lost[name] = NotMeasured(reason="no points on a part of the arc it needs")
    return lost


def _measured(
    definition: Definition,
    lost: Mapping[str, NotMeasured],
    estimates: Mapping[str, Estimate],
    sigmas: Mapping[str, float],
) -> Mapping[str, Measured]:
    """Each measurand, or why there is none."""
    measurands: dict[str, Measured] = {}
    for name, unit in definition.names.items():
        if name in lost:
            measurands[name] = lost[name]
        elif name in estimates:
            value = estimates[name].value
            measurands[name] = Measurand(name=name, value=value, sigma=sigmas[name], unit=unit)
        else:
            measurands[name] = NotMeasured(reason=_without(name, definition))
    return measurands


def _without(name: str, definition: Definition) -> str:
    """Why a section seen all round lacks a measurand."""
    return "the edge has no rounding" if name in definition.nominals else "the nominal has no such value"


def _status(
    gaps: Sequence[Gap], definition: Definition, measurands: Mapping[str, Measured]
) -> tuple[SectionStatus, str | None]:
    """The status, with the reason when it is not simply measured; the nominal's own lacks do not count."""
    wanted = [m for name, m in measurands.items() if name in definition.nominals]
    lost = [m for m in wanted if isinstance(m, NotMeasured)]
    if not lost:
        return SectionStatus.MEASURED, None
    widest = max((gap.width_mm for gap in gaps), default=0.0)
    if any(m.in_damage for m in lost):
        return SectionStatus.IN_DAMAGE, f"a damage takes up to {widest:.1f} mm of the profile"
    if len(lost) == len(wanted):
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


def _absent(z_mm: float, gap: Gap, why: str, definition: Definition) -> Section:
    """A section of which nothing was measured."""
    zones = cover_zones(definition.curve_mm, definition.side, np.empty(0), 0.0)
    lost = NotMeasured(reason="a damage took this section" if gap.in_damage else why, in_damage=gap.in_damage)
    return Section(
        z_mm=z_mm,
        status=SectionStatus.IN_DAMAGE if gap.in_damage else SectionStatus.NOT_COVERED,
        reason=lost.reason,
        covered_fraction=0.0,
        measurands=dict.fromkeys(definition.names, lost),
        nominals=definition.nominals,
        profile_mm=np.empty((0, 2)),
        deviation_mm=np.empty(0),
        run=np.empty(0, np.int64),
        zones=dict(zip(SIDES, zones, strict=True)),
    )


def with_damages(section: Section, touched: bool) -> Section:
    """The section, once the damages are known: what it lacks where one touches it is the damage's."""
    wanted = section.nominals.keys() & section.measurands.keys()
    lost = [name for name in wanted if isinstance(section.measurands[name], NotMeasured)]
    if not touched or not lost:
        return section
    taken = {name: NotMeasured(reason="a damage touches this section", in_damage=True) for name in lost}
    return replace(
        section,
        status=SectionStatus.IN_DAMAGE,
        reason="a damage touches this section",
        measurands={**section.measurands, **taken},
    )
