"""Damage regions of the scan against the twin: zone, kind, depth, area."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from scipy.spatial import cKDTree

from geometry.nominal import ZONE_ORDER, Nominal
from geometry.regions import Field, Region, RegionSettings, find_regions, on_twin, stand_off
from geometry.register import Alignment
from geometry.solid import slice_loops
from geometry.span import on_line_mm
from geometry.twin import Twin
from geometry.types import Bools, Cloud, Floats, Ints, Measurand, Measured, NotMeasured, Zone

PROBABLE = 1.645  # one-sided 95 % quantile of the normal distribution
FOREMOST = 5  # points whose middle one is the metal left of a slab: one alone is noise
NEAR_EDGE_MM = 6.0  # of the edge line, where the edge of the twin is sought
PRECEDENCE = (Zone.TIP, Zone.LEADING_EDGE, Zone.TRAILING_EDGE, Zone.SURFACE)


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
    centroid_mm: Floats  # (3,)
    points: Ints  # indices of the scan points on the damaged surface


@dataclass(frozen=True, slots=True, kw_only=True)
class DamageSettings:
    regions: RegionSettings = field(default_factory=RegionSettings)
    slab_mm: float = 0.4  # of an edge, over which its remaining metal is sought
    touching: float = 0.03  # share of a damage that must lie in a zone for the damage to touch it
    alike: float = 0.35  # least ratio of sizes of the two sides of a bent region
    beside_mm: float = 6.0  # how near those sides lie: about the thickness of an airfoil


def find_damages(
    cloud: Cloud,
    mask: Bools,
    alignment: Alignment,
    nominal: Nominal,
    twin: Twin,
    settings: DamageSettings = DamageSettings(),
) -> tuple[Damage, ...]:
    """The damages of the airfoil, largest first.

    A damage is connected metal that lies off the twin by more than noise and twin allow. What is missing and
    in excess side by side, in like amounts, is one bent region. `mask` is not needed to find them: damage is
    told against the twin, not against the nominal.
    """
    found = stand_off(cloud, alignment, nominal, twin, settings.regions)
    regions = find_regions(found, nominal, twin, settings.regions)
    bent, single = _bent_pairs(regions, found, settings)
    damages = [_described(region, found, nominal, twin, settings) for region in single]
    damages += [_bent(a, b, found, nominal, settings) for a, b in bent]
    return tuple(damages)


def detection_limit(
    cloud: Cloud, twin: Twin, settings: DamageSettings = DamageSettings()
) -> dict[Zone, Measured]:
    """The depth per zone that is found with 95 % probability at the noise and density of this scan.

    A dent is found when the mean over a neighbourhood passes `high` sigmas; it must exceed that by the
    quantile of the noise of one such mean. At a tip or an edge the loss must also reach past the spacing of
    the points, for metal between two points is not seen to be missing.
    """
    regions = settings.regions
    noise_mm = max(twin.noise_mm, float(np.median(cloud.sigma_mm)) / 3.0)
    mean_mm = max(noise_mm / np.sqrt(regions.neighbours + 1), regions.floor_mm)
    if not twin.supported.any():
        return {zone: NotMeasured(reason="no part of the twin is seen") for zone in PRECEDENCE}
    sigma_mm = float(np.hypot(mean_mm, np.quantile(twin.sigma_mm[twin.supported], 0.95)))
    normal_mm = (regions.high + PROBABLE) * sigma_mm
    spacing_mm = _spacing_mm(cloud)
    along_mm = {Zone.TIP: spacing_mm, Zone.LEADING_EDGE: spacing_mm, Zone.TRAILING_EDGE: spacing_mm}
    return {
        zone: Measurand(
            name=f"{zone}_detection",
            value=float(np.hypot(normal_mm, along_mm.get(zone, 0.0))),
            sigma=0.0,
            unit="mm",
        )
        for zone in PRECEDENCE
    }


def _spacing_mm(cloud: Cloud) -> float:
    """Spacing of neighbouring points of the cloud."""
    few = cloud.points_mm[:: max(1, len(cloud) // 5000)]
    distance_mm = np.asarray(cKDTree(cloud.points_mm).query(few, 9)[0])
    return float(np.median(distance_mm[:, -1]) * np.sqrt(np.pi / 8.0))


def _bent_pairs(
    regions: list[Region], found: Field, settings: DamageSettings
) -> tuple[list[tuple[Region, Region]], list[Region]]:
    """Pairs of a missing and an excess region side by side in like amounts, and the regions left over."""
    free = list(regions)
    pairs = []
    for missing in [region for region in regions if region.missing and not len(region.lost)]:
        mates = [
            region for region in free if not region.missing and _mirror(missing, region, found, settings)
        ]
        if mates:
            pairs.append((missing, mates[0]))
            free.remove(missing)
            free.remove(mates[0])
    return pairs, free


def _mirror(missing: Region, excess: Region, found: Field, settings: DamageSettings) -> bool:
    """Whether two regions are the two sides of bent metal: as large, as far off, and near each other."""
    sizes = [float(len(region.points)) for region in (missing, excess)]
    heights = [float(np.abs(found.smooth_mm[region.points]).max()) for region in (missing, excess)]
    if min(sizes) < settings.alike * max(sizes) or min(heights) < settings.alike * max(heights):
        return False
    nearest_mm, _ = cKDTree(found.scan_mm[excess.points]).query(found.scan_mm[missing.points])
    return bool(np.median(nearest_mm) <= settings.beside_mm)


def _described(
    region: Region, found: Field, nominal: Nominal, twin: Twin, settings: DamageSettings
) -> Damage:
    skin_mm = on_twin(nominal, twin)[region.lost]
    points_mm = found.scan_mm[region.points]
    zone = _zone(region, found, nominal, settings.touching)
    kind = DamageKind.MISSING if region.missing else DamageKind.EXCESS
    depth: Measured
    if kind is DamageKind.EXCESS or zone in (Zone.SURFACE, Zone.OUTSIDE):
        depth = _normal_depth(region, found)
    elif zone is Zone.TIP:
        depth = _span_depth(region, found, nominal, twin, settings)
    else:
        depth = _edge_depth(region, found, nominal, twin, zone, settings.slab_mm)
    return Damage(
        zone=zone,
        kind=kind,
        depth_mm=depth,
        area_mm2=_area(region, found, nominal),
        volume_mm3=_volume(region, found),
        length_mm=_length_mm(np.concatenate([points_mm, skin_mm])),
        centroid_mm=np.concatenate([points_mm, skin_mm]).mean(axis=0),
        points=region.points,
    )


def _bent(
    missing: Region, excess: Region, found: Field, nominal: Nominal, settings: DamageSettings
) -> Damage:
    """The damage of a bent region, from both its sides."""
    points = np.sort(np.concatenate([missing.points, excess.points]))
    both = Region(points=points, lost=np.zeros(0, np.int64), missing=True)
    deeper = max((missing, excess), key=lambda side: float(np.abs(found.smooth_mm[side.points]).max()))
    return Damage(
        zone=_zone(both, found, nominal, settings.touching),
        kind=DamageKind.DEFORMATION,
        depth_mm=_normal_depth(deeper, found),
        area_mm2=_area(both, found, nominal),
        volume_mm3=NotMeasured(reason="bent metal is neither missing nor in excess"),
        length_mm=_length_mm(found.scan_mm[points]),
        centroid_mm=found.scan_mm[points].mean(axis=0),
        points=points,
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


def _normal_depth(region: Region, found: Field) -> Measurand:
    """The largest distance normal to the twin.

    The mean over a neighbourhood flattens the bottom of a narrow pit; how much is told by how that mean
    itself falls off over the same neighbourhood, and is given back.
    """
    height_mm = np.abs(found.smooth_mm)
    deepest = region.points[int(np.argmax(height_mm[region.points]))]
    flattened_mm = float(height_mm[deepest] - np.abs(found.smooth_mm[found.neighbours[deepest]]).mean())
    value_mm = float(height_mm[deepest]) + max(flattened_mm, 0.0)
    sigma_mm = float(np.hypot(found.sigma_mm[deepest], 0.5 * flattened_mm))
    return Measurand(name="depth", value=value_mm, sigma=sigma_mm, unit="mm")


def _span_depth(
    region: Region, found: Field, nominal: Nominal, twin: Twin, settings: DamageSettings
) -> Measured:
    """The loss along the span: from the twin's tip down to the lowest point of the broken surface.

    Where the break runs out into the skin, the last of it stands off by less than a region's threshold; a
    break at 45 degrees hides about that much of its height.
    """
    tip_face = nominal.samples.tip_face
    if not tip_face.any():
        return NotMeasured(reason="the span ends short of the tip")
    tip_mm = float(on_twin(nominal, twin)[tip_face, 2].mean())
    lowest = np.sort(found.scan_mm[region.points, 2])[: max(3, len(region.points) // 2000)]
    hidden_mm = settings.regions.low * _median_sigma_mm(region, found)
    sigma_mm = np.hypot(hidden_mm, found.spacing_mm / np.sqrt(12.0))
    return Measurand(
        name="depth",
        value=max(tip_mm - float(lowest.mean()) + hidden_mm, 0.0),
        sigma=float(np.hypot(sigma_mm, np.std(lowest))),
        unit="mm",
    )


def _median_sigma_mm(region: Region, found: Field) -> float:
    return float(np.median(found.sigma_mm[region.points]))


def _edge_depth(
    region: Region, found: Field, nominal: Nominal, twin: Twin, zone: Zone, slab_mm: float
) -> Measured:
    """The largest loss in a section plane, along the chord: from the twin's edge to the metal left."""
    z_mm = found.scan_mm[region.points, 2]
    near_mm = _around(found.scan_mm, region.points, slab_mm)
    flat = np.zeros((len(twin.mesh.faces), 3, 3))
    heights_mm = np.arange(z_mm.min() + 0.5 * slab_mm, z_mm.max(), 0.5 * slab_mm)
    losses = []
    for height_mm in heights_mm if len(heights_mm) else [float(z_mm.mean())]:
        outward, edge_mm = _outward(nominal, zone, float(height_mm))
        slab = near_mm[np.abs(near_mm[:, 2] - height_mm) <= 0.5 * slab_mm, :2] @ outward
        loops = slice_loops(twin.mesh, flat, float(height_mm))
        rim = np.concatenate([loop.points_mm for loop in loops]) if loops else np.zeros((0, 2))
        rim = rim[np.linalg.norm(rim - edge_mm, axis=1) < NEAR_EDGE_MM]
        if len(slab) >= FOREMOST and len(rim):
            losses.append(float((rim @ outward).max() - np.median(np.sort(slab)[-FOREMOST:])))
    if not losses:
        return NotMeasured(reason="no section through the damage has enough points on it")
    sigma_mm = np.hypot(_median_sigma_mm(region, found), found.spacing_mm / np.sqrt(12.0))
    return Measurand(name="depth", value=max(*losses, 0.0), sigma=float(sigma_mm), unit="mm")


def _around(scan_mm: Floats, points: Ints, margin_mm: float) -> Floats:
    """The scan points in the box of some of them."""
    low_mm, high_mm = scan_mm[points].min(axis=0) - margin_mm, scan_mm[points].max(axis=0) + margin_mm
    return np.asarray(scan_mm[((scan_mm >= low_mm) & (scan_mm <= high_mm)).all(axis=1)])


def _outward(nominal: Nominal, zone: Zone, z_mm: float) -> tuple[Floats, Floats]:
    """The direction (2,) along the chord out of an edge at a height, and the edge (2,) there."""
    le_mm, te_mm = (
        on_line_mm(line, np.array([z_mm]))[0] for line in (nominal.le_line_mm, nominal.te_line_mm)
    )
    chord_mm = le_mm - te_mm if zone is Zone.LEADING_EDGE else te_mm - le_mm
    return chord_mm / np.linalg.norm(chord_mm), le_mm if zone is Zone.LEADING_EDGE else te_mm


def _area(region: Region, found: Field, nominal: Nominal) -> Measurand:
    """Area of the skin that the damage has taken: bare skin, or where the break lies close beneath, that
    of the points on it."""
    bare_mm2 = float(nominal.samples.area_mm2[region.lost].sum())
    points_mm2 = len(region.points) * found.spacing_mm**2
    value = bare_mm2 if bare_mm2 > 0.5 * points_mm2 else points_mm2
    border_mm = 4.0 * np.sqrt(value)
    return Measurand(name="area", value=value, sigma=float(border_mm * found.spacing_mm / 2.0), unit="mm2")


def _volume(region: Region, found: Field) -> Measured:
    """Volume between the points and the twin where the points lie close under or over the skin."""
    if len(region.lost):
        return NotMeasured(reason="from its patch")
    depth_mm = np.abs(found.smooth_mm[region.points])
    share_mm2 = found.spacing_mm**2
    sigma = len(depth_mm) * share_mm2 * _median_sigma_mm(region, found)
    value = float(depth_mm.sum()) * share_mm2
    return Measurand(name="volume", value=value, sigma=float(np.hypot(sigma, 0.05 * value)), unit="mm3")


def _length_mm(points_mm: Floats) -> float:
    """Largest extent of the points along their principal axis."""
    centred = points_mm - points_mm.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return float(np.ptp(centred @ axes[:, -1]))
