"""The least damage of each zone that a scan shows."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from geometry.blade.nominal import ZONE_ORDER, Nominal
from geometry.damage.depth import dense, outline_mm
from geometry.damage.regions import RegionSettings, local_spacing_of, noise_of
from geometry.deformation.twin import Twin
from geometry.registration.alignment import Alignment
from geometry.scan.neighbourhood import nearest_of
from geometry.transforms import apply
from geometry.types import Cloud, Floats, Measurand, Measured, NotMeasured, Zone

PRECEDENCE = (Zone.TIP, Zone.LEADING_EDGE, Zone.TRAILING_EDGE, Zone.SURFACE)
PROBABLE = 1.645  # one-sided 95 % quantile of the normal distribution
HOLLOW_SPACINGS = 12.0  # width of the hollow, in usual point spacings, that the detection limit is stated for
LEAST_SPACINGS = 4.0  # that width in the spacings of the thinnest place: fewer points are no region
BESIDE = 0.965  # of what a neighbourhood in the middle of a hollow shows, one about the nearest point does
SPAN = (0.1, 0.3, 0.5, 0.7, 0.9)  # shares of the span that is seen, at which the edges are asked
TIP = 0.98  # and the tip
SHOWN = 0.8  # of the mean depth of a strip: few points fall on it, and by chance (simulated, for 95 %)


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionLimits:
    """The least damage that is surely found: so deep in each zone, and so large."""

    depth_mm: Mapping[Zone, Measured]
    area_mm2: Measured


def detection_limit(
    cloud: Cloud,
    alignment: Alignment,
    nominal: Nominal,
    twin: Twin,
    settings: RegionSettings = RegionSettings(),
) -> DetectionLimits:
    """The depth per zone, and the area, that are found with 95 % probability at this noise and density.

    Stated for a hollow that runs out smoothly over `HOLLOW_SPACINGS` of the usual spacings; a narrower one
    must be deeper. It is found when the mean over a neighbourhood, which flattens it, passes `high` sigmas;
    it must exceed that by the quantile of the noise of one such mean. On a side this holds in the place where
    the points lie farthest apart. Edges and a thin tip must lose more, for their loss leaves a narrow strip:
    theirs is stated for the usual spacing, and not at all where a place is too thin for any hollow.
    """
    if not twin.supported.any():
        unseen = NotMeasured(reason="no part of the twin is seen")
        return DetectionLimits(depth_mm=dict.fromkeys(PRECEDENCE, unseen), area_mm2=unseen)
    mean_mm = max(noise_of(cloud, twin) / np.sqrt(settings.neighbours + 1), settings.floor_mm)
    sigma_mm = float(np.hypot(mean_mm, np.quantile(twin.sigma_mm[twin.supported], 0.95)))
    mean_limit_mm = (settings.high + PROBABLE) * sigma_mm
    neighbours = nearest_of(cloud, min(settings.neighbours + 1, len(cloud)))
    local_mm = local_spacing_of(cloud, neighbours)
    usual_mm = float(np.median(local_mm))
    width_mm = HOLLOW_SPACINGS * usual_mm
    found: dict[Zone, Measured] = {}
    for zone, thinnest_mm in _thinnest_mm(
        apply(alignment.T_nominal_scan, cloud.points_mm), local_mm, nominal, twin
    ):
        spacing_mm = thinnest_mm if zone is Zone.SURFACE else usual_mm
        across_mm = spacing_mm * float(np.sqrt(neighbours.shape[1] * 4.0 / np.pi))
        hollow_mm = mean_limit_mm / (BESIDE * kept(across_mm / width_mm))
        if width_mm < LEAST_SPACINGS * thinnest_mm:
            found[zone] = NotMeasured(reason=f"points lie {thinnest_mm:.2f} mm apart in places")
        else:
            found[zone] = _limit(zone, _limit_mm(zone, hollow_mm, across_mm, width_mm, twin))
    area_mm2 = Measurand(name="area_detection", value=0.25 * np.pi * width_mm**2, sigma=0.0, unit="mm2")
    return DetectionLimits(depth_mm=found, area_mm2=area_mm2)


def _thinnest_mm(
    scan_mm: Floats, local_mm: Floats, nominal: Nominal, twin: Twin
) -> Iterator[tuple[Zone, float]]:
    """For each zone the spacing that the points of its sound surface exceed only over less than a hollow."""
    usual_mm = float(np.median(local_mm))
    thin = np.flatnonzero(twin.sound & (local_mm > usual_mm))
    codes = nominal.zone_of(scan_mm[thin])
    hollow_mm2 = 0.25 * np.pi * (HOLLOW_SPACINGS * usual_mm) ** 2
    for zone in PRECEDENCE:
        there_mm = np.sort(local_mm[thin[codes == ZONE_ORDER.index(zone)]])[::-1]
        within = int(np.searchsorted(np.cumsum(there_mm**2), hollow_mm2))
        yield zone, float(there_mm[within]) if within < len(there_mm) else usual_mm


def _limit_mm(zone: Zone, hollow_mm: float, across_mm: float, width_mm: float, twin: Twin) -> float:
    match zone:
        case Zone.SURFACE:
            return hollow_mm
        case Zone.TIP:
            return tip_limit_mm(twin, hollow_mm, across_mm, width_mm)
        case _:
            return edge_limit_mm(twin, hollow_mm, across_mm)


def kept(share: float) -> float:
    """Mean depth of a hollow, cosine-shaped and 1 deep in its middle, over a disc there whose width is so
    large a share of the hollow's."""
    if share > 1.0:
        return (0.5 - 2.0 / np.pi**2) / share**2
    turn = np.pi * share
    return float(0.5 + np.sin(turn) / turn + (np.cos(turn) - 1.0) / turn**2)


def _limit(zone: Zone, value_mm: float) -> Measured:
    if not np.isfinite(value_mm):
        return NotMeasured(reason="no loss of an edge would show")
    return Measurand(name=f"{zone}_detection", value=value_mm, sigma=0.0, unit="mm")


def edge_limit_mm(twin: Twin, hollow_mm: float, across_mm: float) -> float:
    """Loss of an edge, along the chord, that shows as well as a smooth hollow of `hollow_mm` in a face.

    A file leaves a strip across the edge, as wide as the section is thick there. Its depth normal to the twin
    is two thirds of the loss on the mean, or where its own sides are nearer, their distance; and where it is
    narrower than a neighbourhood, `across_mm`, the sound skin beside it takes part. Of both edges the one
    that shows least; infinite where none could.
    """
    return max(
        _first(loss_mm, np.minimum(2.0 / 3.0 * loss_mm, 0.25 * wide_mm) * shares, hollow_mm)
        for share in SPAN
        for loss_mm, wide_mm, shares in _ends(twin, share, across_mm)
    )


def tip_limit_mm(twin: Twin, hollow_mm: float, across_mm: float, length_mm: float) -> float:
    """Loss of the tip, along the span, over `length_mm` that shows as well at its thin ends."""
    return max(
        hollow_mm / float(np.interp(0.5 * length_mm, from_end_mm, shares))
        for from_end_mm, _, shares in _ends(twin, TIP, across_mm)
    )


def _ends(twin: Twin, share: float, across_mm: float) -> list[tuple[Floats, Floats, Floats]]:
    """For both ends of a section: ways from the end along its longest axis, how thick the section is there at
    most, and the share of a neighbourhood that so wide a strip fills, as far as it shows."""
    seen_mm = twin.mesh.vertices_mm[twin.supported, 2]
    outline = dense(outline_mm(twin.mesh, float(seen_mm.min() + share * np.ptp(seen_mm))))
    centred_mm = outline - outline.mean(axis=0)
    side, along = np.linalg.eigh(centred_mm.T @ centred_mm)[1].T
    found = []
    for sign in (1.0, -1.0):
        order = np.argsort(-sign * centred_mm @ along)
        from_end_mm = -sign * (centred_mm[order] @ along)
        aside_mm = centred_mm[order] @ side
        wide_mm = np.maximum.accumulate(aside_mm) - np.minimum.accumulate(aside_mm)
        found.append((from_end_mm - from_end_mm[0], wide_mm, SHOWN * np.minimum(wide_mm / across_mm, 1.0)))
    return found


def _first(loss_mm: Floats, shown_mm: Floats, hollow_mm: float) -> float:
    enough = np.flatnonzero(shown_mm >= hollow_mm)
    return float(loss_mm[enough[0]]) if len(enough) else np.inf
