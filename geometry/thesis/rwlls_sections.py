"""Inspected sections measured on profiles reconstructed as in chapter 4 of the thesis.

The measurands and their definitions are those of `airfoil`; the curve is another one. The method needs
the whole profile: where a damage touches it or points are missing, nothing of the section is measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.errors import CannotMeasure
from geometry.registration.alignment import Alignment, pose_covariance
from geometry.sections.airfoil import Section, SectionStatus
from geometry.sections.chart import NODES, Chart, SectionSettings, outward_normals, unroll
from geometry.sections.curve import Estimate, node_shares
from geometry.sections.form import extreme_sigmas, share_beyond_sigma, with_pose
from geometry.sections.measurands import Definition, define, form, place, shape
from geometry.sections.motion import find_motion
from geometry.sections.profile import Gap, Scan, explain_gaps, find_gaps, scan_of
from geometry.thesis.rwlls_profile import ClosedProfile, RwllsSettings, reconstruct_thesis
from geometry.types import Bools, Cloud, Floats, Ints, Measurand, Measured, NotMeasured

_UNSTATED = ("le_min_radius_mm", "te_min_radius_mm")  # no sigma would hold: the spline undulates there
_SAMPLES = 4 * NODES  # of the reconstructed curve, among which the nodes find theirs

_REACH = 0.5  # segments of the spline


@dataclass(frozen=True, slots=True, kw_only=True)
class ThesisSectionSettings:
    """How sections are measured by the thesis' method; of `sections` what concerns nominal and gaps."""

    sections: SectionSettings = field(default_factory=SectionSettings)
    profile: RwllsSettings = field(default_factory=RwllsSettings)
    near_mm: float = 1.0  # on both sides of the plane: points that a reconstruction sees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Traced:
    """A reconstructed profile on the nodes of the nominal section."""

    curve_mm: Floats  # (NODES, 2) nominal frame
    deviation_mm: Floats  # (NODES,) signed distance to the nominal section, positive outside
    t: Floats  # (NODES,) parameter on the reconstructed curve


def measure_sections_thesis(
    cloud: Cloud,
    mask: Bools,
    alignment: Alignment,
    nominal: Nominal,
    z_mm: Sequence[float],
    settings: ThesisSectionSettings = ThesisSectionSettings(),
) -> tuple[Section, ...]:
    """The sections in the planes `z_mm` of the nominal frame, in the order asked for.

    `mask` (n,): True = a damaged point. Sigmas hold the noise found about the profile, propagated through
    domains and spline, what the local curves disagree by, and the pose.
    """
    scan = scan_of(cloud, mask, alignment.T_nominal_scan)
    return tuple(_measure(scan, alignment, nominal, float(z), settings) for z in z_mm)


def _measure(
    scan: Scan, alignment: Alignment, nominal: Nominal, z_mm: float, settings: ThesisSectionSettings
) -> Section:
    """One section."""
    chart = unroll(nominal, z_mm, settings.near_mm, settings.sections)
    definition = define(chart.curve_mm, chart.side, settings.sections)
    near = scan.between(z_mm - settings.near_mm, z_mm + settings.near_mm)
    try:
        points_mm, arc_mm = _sound_points(scan, near, chart, settings)
    except CannotMeasure as why:
        return _lost(z_mm, definition, 0.0, NotMeasured(reason=str(why)))
    gaps = find_gaps(chart, arc_mm, settings.sections.max_gap_mm)
    gaps = explain_gaps(gaps, scan, nominal, z_mm, settings.sections)
    covered = max(0.0, 1.0 - sum(gap.width_mm for gap in gaps) / chart.perimeter_mm)
    if gaps:
        return _lost(z_mm, definition, covered, _why(gaps))
    if scan.mask[near].any():
        return _lost(z_mm, definition, covered, NotMeasured(reason="damaged points lie on the profile"))
    try:
        uncertainty_mm = float(np.median(scan.cloud.sigma_mm[near]))
        profile = reconstruct_thesis(points_mm, z_mm, uncertainty_mm, settings.profile)
    except CannotMeasure as why:
        return _lost(z_mm, definition, covered, NotMeasured(reason=str(why)))
    return _section(profile, trace(profile, points_mm, chart), chart, definition, alignment)


def _sound_points(
    scan: Scan, near: Ints, chart: Chart, settings: ThesisSectionSettings
) -> tuple[Floats, Floats]:
    """The undamaged points near plane and nominal section, and where on its arc they stand."""
    sound = scan.points_mm(near[~scan.mask[near]])
    if len(sound) < settings.profile.min_points:
        raise CannotMeasure(f"no sound points within {settings.near_mm:g} mm of the plane")
    foot = chart.project(find_motion(chart, sound).undo(sound))
    kept = np.abs(foot[:, 1]) <= settings.sections.capture_mm
    return sound[kept], chart.arc_at(foot[kept, 0])


def _why(gaps: Sequence[Gap]) -> NotMeasured:
    widest = max(gap.width_mm for gap in gaps)
    if any(gap.in_damage for gap in gaps):
        return NotMeasured(reason=f"a damage takes up to {widest:.1f} mm of the profile", in_damage=True)
    return NotMeasured(reason=f"no points on up to {widest:.1f} mm of the profile")


def trace(profile: ClosedProfile, points_mm: Floats, chart: Chart) -> Traced:
    """The profile on the nominal's nodes: each where the curve meets the node's normal.

    The part's own rigid motion, found from `points_mm` (n, 3), is undone first.
    """
    motion = find_motion(chart, points_mm)
    t = np.arange(_SAMPLES) / _SAMPLES
    height = np.full(_SAMPLES, chart.section_z_mm)
    foot = chart.project(motion.undo(np.column_stack([profile.curve_mm(t), height])))
    order = np.argsort(foot[:, 0], kind="stable")
    node, nodes = foot[order, 0], np.arange(NODES, dtype=np.float64)
    deviation = np.interp(nodes, node, foot[order, 1], period=NODES)
    around = np.unwrap(t[order], period=1.0)
    wrapped = np.concatenate([[around[-1] - 1.0], around, [around[0] + 1.0]])
    places = np.concatenate([[node[-1] - NODES], node, [node[0] + NODES]])
    curve = motion.do(chart.curve_mm + outward_normals(chart.curve_mm) * deviation[:, None])
    against = chart.project(np.column_stack([curve, np.full(NODES, chart.section_z_mm)]))
    return Traced(curve_mm=curve, deviation_mm=against[:, 1], t=np.interp(nodes, places, wrapped) % 1.0)


def _section(
    profile: ClosedProfile, traced: Traced, chart: Chart, definition: Definition, alignment: Alignment
) -> Section:
    """The section of a whole profile."""
    whole = np.ones(NODES, bool)
    estimates = {
        **place(traced.curve_mm, definition.curve_mm),
        **shape(traced.curve_mm, definition, definition.shapes.keys() - set(_UNSTATED)),
        **form(traced.curve_mm, traced.deviation_mm, whole, definition),
    }
    sigmas = _sigmas(profile, traced, chart, definition, estimates, alignment)
    measurands: dict[str, Measured] = {
        name: Measurand(name=name, value=estimates[name].value, sigma=sigmas[name], unit=unit)
        if name in estimates
        else NotMeasured(reason=_without(name, definition))
        for name, unit in definition.names.items()
    }
    all_there = estimates.keys() | _UNSTATED >= definition.nominals.keys()
    return Section(
        z_mm=chart.section_z_mm,
        status=SectionStatus.MEASURED if all_there else SectionStatus.PARTIAL,
        reason=None if all_there else "the profile lacks what the nominal has",
        covered_fraction=1.0,
        measurands=measurands,
        nominals=definition.nominals,
        profile_mm=traced.curve_mm,
        deviation_mm=traced.deviation_mm,
        run=np.zeros(NODES, np.int64),
    )


def _without(name: str, definition: Definition) -> str:
    """Why a whole section lacks a measurand."""
    if name in _UNSTATED:
        return "the thesis' spline undulates too much at an edge for its smallest radius"
    return f"the {'profile' if name in definition.nominals else 'nominal'} has no such value"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Noise:
    """What the noise of the points does to the traced profile."""

    profile: ClosedProfile
    t: Floats  # (NODES,)
    normals: Floats  # (NODES, 2) of the traced curve

    def covariance(self, gradients: Floats) -> Floats:
        """Covariance (n, n) of n linear functions (n, NODES) of the nodes' normal displacements."""
        order = np.argsort(self.t, kind="stable")
        growth = self.profile.growth(self.t[order], self.normals[order], gradients[:, order])
        missed = gradients * self.profile.misfit_mm(self.t)
        covariance: Floats = (
            self.profile.noise_mm**2 * (growth.T @ growth) + missed @ self._alike() @ missed.T
        )
        return covariance

    def _alike(self) -> Floats:
        """Correlation (NODES, NODES) of what the profile misses: it changes sign from segment to segment."""
        apart = np.abs((self.t[:, None] - self.t + 0.5) % 1.0 - 0.5) * len(self.profile.control_mm)
        alike: Floats = np.exp(-0.5 * (apart / _REACH) ** 2)
        return alike

    def node_sigmas(self) -> Floats:
        """Standard uncertainty (NODES,) of each node's displacement, from every 16th."""
        some = np.arange(0, NODES, 16)
        sigma = np.sqrt(self.covariance(np.eye(NODES)[some]).diagonal())
        return np.interp(np.arange(NODES), some, sigma, period=NODES)


def _sigmas(
    profile: ClosedProfile,
    traced: Traced,
    chart: Chart,
    definition: Definition,
    estimates: Mapping[str, Estimate],
    alignment: Alignment,
) -> Mapping[str, float]:
    """Standard uncertainty of each estimate: noise, disagreement of the local curves, and the pose."""
    gradients = np.stack([estimate.gradient for estimate in estimates.values()])
    noise = _Noise(profile=profile, t=traced.t, normals=outward_normals(traced.curve_mm))
    growth, twist = chart.pose_growth(traced.curve_mm, alignment.pivot_mm), pose_covariance(alignment)
    covariance = noise.covariance(gradients) + gradients @ growth @ twist @ growth.T @ gradients.T
    node_sigma_mm = with_pose(noise.node_sigmas(), growth, twist)
    names, waves = list(estimates), definition.waves
    sigmas = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    xy = [names.index("position_x_mm"), names.index("position_y_mm")]
    shift = np.array([estimates[names[i]].value for i in xy])
    rms_mm, along = estimates["waviness_rms_mm"].value, sigmas["waviness_rms_mm"]
    share, tolerance_mm = node_shares(definition.curve_mm), definition.settings.tolerance_mm
    return {
        **sigmas,
        **extreme_sigmas(traced.deviation_mm, np.ones(NODES, bool), definition.side, node_sigma_mm),
        "position_mm": _distance_sigma(shift, covariance[np.ix_(xy, xy)]),
        "waviness_rms_mm": waves.rms_sigma(rms_mm, along, noise.covariance(waves.harmonics * waves.share_mm)),
        "out_of_tolerance_fraction": share_beyond_sigma(
            traced.deviation_mm, node_sigma_mm, share, tolerance_mm
        ),
    }


def _distance_sigma(shift_mm: Floats, covariance: Floats) -> float:
    """Sigma of the length of a shift (2,); of one that is nothing, that of the worst direction."""
    worst = float(np.linalg.eigvalsh(covariance)[-1])
    along = float(shift_mm @ covariance @ shift_mm)
    return float(np.sqrt((along + worst**2) / (float(shift_mm @ shift_mm) + worst)))


def _lost(z_mm: float, definition: Definition, covered: float, why: NotMeasured) -> Section:
    """A section of which nothing was measured."""
    return Section(
        z_mm=z_mm,
        status=SectionStatus.IN_DAMAGE if why.in_damage else SectionStatus.NOT_COVERED,
        reason=why.reason,
        covered_fraction=covered,
        measurands=dict.fromkeys(definition.names, why),
        nominals=definition.nominals,
        profile_mm=np.empty((0, 2)),
        deviation_mm=np.empty(0),
        run=np.empty(0, np.int64),
    )
