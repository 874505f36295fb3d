"""Damage regions of the scan against the twin: zone, kind, depth, area."""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import ZONE_ORDER, Nominal
from geometry.damage.bends import BendSettings, bend_depth, bend_off_nominal, bent_pairs
from geometry.damage.depth import EdgeLoss, edge_loss, lowest_mm, reaches_edge, span_depth
from geometry.damage.detection import PRECEDENCE
from geometry.damage.excess import excess_volume
from geometry.damage.layers import in_layers
from geometry.damage.normal_depth import normal_depth
from geometry.damage.regions import (
    Field,
    Region,
    RegionSettings,
    find_regions,
    stand_off,
)
from geometry.damage.skin import skin_of
from geometry.deformation.twin import Twin
from geometry.registration.alignment import Alignment
from geometry.threads import one_blas_thread
from geometry.types import Bools, Cloud, Floats, Ints, Measurand, Measured, NotMeasured, Zone

NOT_AN_EDGE = NotMeasured(reason="no loss of an edge")
NOT_SOUGHT = NotMeasured(reason="was not looked for")
NOT_BENT = NotMeasured(reason="not bent")
IN_LAYERS = NotMeasured(reason="the scan shows the skin over it as well")
SIZELESS = EdgeLoss(depth_mm=IN_LAYERS, remaining_chord_mm=IN_LAYERS)
ALONE = NotMeasured(reason="no other damage")
EDGES = (Zone.LEADING_EDGE, Zone.TRAILING_EDGE)
PROVEN = 2.0  # sigmas of the loss of an edge


class DamageKind(StrEnum):
    MISSING = "missing"
    EXCESS = "excess"
    DEFORMATION = "deformation"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Damage:
    """One damage, nominal frame. Depth: tip along the span from the twin's tip; edges in the
    section plane from the twin's edge; surface normal to the twin. A volume that could not be
    proven is `NotMeasured`, and so is a depth."""

    zone: Zone
    kind: DamageKind
    depth_mm: Measured
    area_mm2: Measured  # of the lost skin
    volume_mm3: Measured
    length_mm: float  # largest extent
    span_mm: tuple[float, float]  # lowest and highest of its points, along the span
    centroid_mm: Floats  # (3,)
    points: Ints  # indices of the scan points on the damaged surface
    remaining_chord_mm: Measured = NOT_AN_EDGE  # least, of a section there
    above_root_mm: Measured = NOT_SOUGHT  # its lowest point over z_min
    spacing_mm: Measured = ALONE  # straight to the nearest other damage
    layered: bool = False  # the scan shows the skin there as well
    off_nominal_mm: Measured = NOT_BENT  # how far bent metal lies off the nominal, which limits of form judge


@dataclass(frozen=True, slots=True, kw_only=True)
class DamageSettings:
    regions: RegionSettings = field(default_factory=RegionSettings)
    bends: BendSettings = field(default_factory=BendSettings)
    max_gap_mm: float = 1.5  # a larger hole in the scan of metal in excess leaves its volume open
    touching: float = 0.03  # share of a damage that must lie in a zone for the damage to touch it


@one_blas_thread
def find_damages(
    cloud: Cloud,
    mask: Bools,
    alignment: Alignment,
    nominal: Nominal,
    twin: Twin,
    settings: DamageSettings = DamageSettings(),
) -> tuple[Damage, ...]:
    """The damages of the airfoil, largest first.

    A damage is connected metal that lies off the twin by more than noise and twin allow. What is missing on
    one side of the metal and in excess on the other, in like amounts, is one bent region. `mask` is not
    needed to find them: damage is told against the twin, not against the nominal.
    """
    found = stand_off(cloud, alignment, nominal, twin, settings.regions)
    regions = find_regions(found, nominal, settings.regions)
    bent, single = bent_pairs(regions, found, nominal, settings.bends)
    damages = [_single(region, found, nominal, twin, settings) for region in single]
    damages += [_bent(a, b, found, nominal, twin, alignment, settings) for a, b in bent]
    return _spaced(damages, found)


def _single(region: Region, found: Field, nominal: Nominal, twin: Twin, settings: DamageSettings) -> Damage:
    """The damage of a region. Metal that is missing under skin which was scanned as well has no size."""
    body_mm = np.concatenate([found.scan_mm[region.points], found.skin_mm[region.lost]])
    zone = _zone(region, found, nominal, settings.touching)
    lowest = lowest_mm(region, found, twin)
    layered = in_layers(region, found, nominal, skin_of(twin.mesh))
    sizeless = layered and region.missing  # under a fibre there is skin
    loss = SIZELESS if sizeless else _loss(region, found, nominal, twin, zone, lowest)
    return Damage(
        zone=zone,
        kind=DamageKind.MISSING if region.missing else DamageKind.EXCESS,
        depth_mm=loss.depth_mm,
        area_mm2=_area(region, found, nominal),
        volume_mm3=IN_LAYERS if sizeless else _volume(region, found, twin, settings),
        length_mm=_length_mm(body_mm),
        span_mm=_span_mm(region, found),
        centroid_mm=body_mm.mean(axis=0),
        points=region.points,
        remaining_chord_mm=loss.remaining_chord_mm,
        above_root_mm=_above_root(lowest, nominal),
        layered=layered,
    )


def _loss(
    region: Region, found: Field, nominal: Nominal, twin: Twin, zone: Zone, lowest: Measured
) -> EdgeLoss:
    """The depth of a damage by the rule of its zone, and the chord left where that is an edge.

    Beside an edge that is whole a pit is as deep as on a side: nothing of the edge went back.
    """
    if region.missing and zone is Zone.TIP:
        return EdgeLoss(depth_mm=_tip_depth(lowest, found, nominal), remaining_chord_mm=NOT_AN_EDGE)
    if region.missing and zone in EDGES and reaches_edge(region, found, nominal, zone):
        loss = edge_loss(region, found, nominal, twin, zone)
        if isinstance(loss.depth_mm, NotMeasured) or loss.depth_mm.value > PROVEN * loss.depth_mm.sigma:
            return loss
    return EdgeLoss(depth_mm=normal_depth(region, found, nominal, twin), remaining_chord_mm=NOT_AN_EDGE)


def _tip_depth(lowest: Measured, found: Field, nominal: Nominal) -> Measured:
    tip_face = nominal.samples.tip_face
    if not tip_face.any():
        return NotMeasured(reason="the span ends short of the tip")
    return span_depth(float(found.skin_mm[tip_face, 2].mean()), lowest)


def _above_root(lowest: Measured, nominal: Nominal) -> Measured:
    if isinstance(lowest, NotMeasured):
        return lowest
    return replace(lowest, name="above_root", value=lowest.value - nominal.z_min_mm)


def _spaced(damages: list[Damage], found: Field) -> tuple[Damage, ...]:
    """The damages, each with its distance to the nearest other one; borders are known to half a spacing."""
    if len(damages) < 2:
        return tuple(damages)
    trees = [cKDTree(found.scan_mm[damage.points]) for damage in damages]
    apart_mm = np.full((len(damages),) * 2, np.inf)
    for i, j in combinations(range(len(damages)), 2):
        few, many = sorted((trees[i], trees[j]), key=lambda tree: int(tree.n))
        apart_mm[i, j] = apart_mm[j, i] = np.min(many.query(few.data)[0])
    sigma_mm = float(found.spacing_mm / np.sqrt(6.0))
    return tuple(
        replace(
            damage, spacing_mm=Measurand(name="spacing", value=float(nearest_mm), sigma=sigma_mm, unit="mm")
        )
        for damage, nearest_mm in zip(damages, apart_mm.min(axis=1), strict=True)
    )


def _bent(
    missing: Region,
    excess: Region,
    found: Field,
    nominal: Nominal,
    twin: Twin,
    alignment: Alignment,
    settings: DamageSettings,
) -> Damage:
    """The damage of a bent region, from both its sides."""
    points = np.sort(np.concatenate([missing.points, excess.points]))
    both = Region(points=points, lost=np.zeros(0, np.int64), missing=True)
    deeper = max((missing, excess), key=lambda side: float(np.abs(found.smooth_mm[side.points]).max()))
    return Damage(
        zone=_zone(both, found, nominal, settings.touching),
        kind=DamageKind.DEFORMATION,
        depth_mm=bend_depth(deeper, found),
        area_mm2=_area(both, found, nominal),
        volume_mm3=NotMeasured(reason="bent metal is neither missing nor in excess"),
        length_mm=_length_mm(found.scan_mm[points]),
        span_mm=_span_mm(both, found),
        centroid_mm=found.scan_mm[points].mean(axis=0),
        points=points,
        layered=any(in_layers(side, found, nominal, skin_of(twin.mesh)) for side in (missing, excess)),
        off_nominal_mm=bend_off_nominal(both, found, nominal, alignment),
    )


def _zone(region: Region, found: Field, nominal: Nominal, touching: float) -> Zone:
    """The first zone in the order tip, leading edge, trailing edge, surface that the damage touches."""
    codes = np.concatenate([nominal.zone_of(found.scan_mm[region.points]), nominal.samples.zone[region.lost]])
    weight = np.concatenate(
        [
            np.full(len(region.points), found.spacing_mm**2),
            nominal.samples.area_mm2[region.lost],
        ]
    )
    share = np.bincount(codes, weight, len(ZONE_ORDER)) / weight.sum()
    for zone in PRECEDENCE:
        if share[ZONE_ORDER.index(zone)] > touching:
            return zone
    return Zone.OUTSIDE


def _area(region: Region, found: Field, nominal: Nominal) -> Measurand:
    """Area of the skin that the damage has taken: bare skin, which begins half a point spacing inside the
    border, or where the break lies close beneath, that of the points on it."""
    bare_mm2 = float(nominal.samples.area_mm2[region.lost].sum())
    points_mm2 = len(region.points) * found.spacing_mm**2
    strip_mm2 = 2.0 * np.sqrt(max(bare_mm2, points_mm2)) * found.spacing_mm  # along four equal sides
    value = bare_mm2 + strip_mm2 if bare_mm2 > 0.5 * points_mm2 else points_mm2
    return Measurand(name="area", value=float(value), sigma=float(strip_mm2), unit="mm2")


def _volume(region: Region, found: Field, twin: Twin, settings: DamageSettings) -> Measured:
    """Volume between the points and the twin: of metal in excess, or missing close under the skin."""
    if not region.missing:
        return excess_volume(region, found, twin, settings.max_gap_mm)
    if len(region.lost):
        return NotMeasured(reason="from its patch")
    depth_mm = np.abs(found.smooth_mm[region.points])
    share_mm2 = found.spacing_mm**2
    sigma = len(depth_mm) * share_mm2 * float(np.median(found.sigma_mm[region.points]))
    value = float(depth_mm.sum()) * share_mm2
    return Measurand(name="volume", value=value, sigma=float(np.hypot(sigma, 0.05 * value)), unit="mm3")


def _span_mm(region: Region, found: Field) -> tuple[float, float]:
    z_mm = found.scan_mm[region.points, 2]
    return float(z_mm.min()), float(z_mm.max())


def _length_mm(points_mm: Floats) -> float:
    """Largest extent of the points along their principal axis."""
    centred = points_mm - points_mm.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return float(np.ptp(centred @ axes[:, -1]))
