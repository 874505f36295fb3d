"""What is measured on a section: the names, what the nominal fixes for them, and their estimates.

A measured section has the nodes of the nominal one, so that an arc chosen on the nominal (an edge, the
thickest part) is the same metal on both. Each measurand has a support, the arc that it needs; where the
support has a gap there is no number.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product

import numpy as np

from geometry.errors import CannotMeasure
from geometry.sections.camber import max_camber, thickest_at, thickness_at
from geometry.sections.chart import SectionSettings
from geometry.sections.chords import Chord, Line, chord, hollow, nose_tail_chord, tangent_chord
from geometry.sections.curve import (
    CamberLine,
    Edge,
    Estimate,
    Pair,
    camber_line,
    centroid,
    centroid_gradient,
    edge,
    edge_radius,
    gauge,
    node_arc,
    node_shares,
    orientation,
    thick_part,
    thickness,
)
from geometry.sections.edge_shape import flat, min_radius
from geometry.sections.form import SIDES, WaveBand, extremes, share_beyond, wave_band
from geometry.sections.section_fit import best_fit
from geometry.types import Bools, Floats, Ints, Unit

_GAUGE = 0.05  # of the chord: this far inside either edge its thickness is taken
_AROUND = 8  # circles before and behind the one whose thickness is asked for
_MISSED_MM = 0.1  # a circle farther from where it was asked for is not the one


def section_measurands(settings: SectionSettings) -> Mapping[str, Unit]:
    """Every measurand of a section by name, with its unit."""
    at = [f"{end}_thickness_at_{d:g}_mm" for end in ("le", "te") for d in settings.edge_distances_mm]
    profiles = [f"{side}_profile_{end}_mm" for side in SIDES for end in ("max", "min")]
    return {
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
        **dict.fromkeys(profiles, "mm"),
        "centroid_x_mm": "mm",
        "centroid_y_mm": "mm",
        "chord_nose_tail_mm": "mm",
        "chord_tangent_mm": "mm",
        "max_thickness_position_mm": "mm",
        "max_camber_mm": "mm",
        **dict.fromkeys(at, "mm"),
        "le_flat_mm": "mm",
        "te_flat_mm": "mm",
        "le_min_radius_mm": "mm",
        "te_min_radius_mm": "mm",
        "waviness_rms_mm": "mm",
        "waviness_height_mm": "mm",
        "out_of_tolerance_fraction": "1",
        "fit_x_mm": "mm",
        "fit_y_mm": "mm",
        "fit_rotation_deg": "deg",
        "profile_form_max_mm": "mm",
        "profile_form_min_mm": "mm",
    }


SECTION_MEASURANDS = section_measurands(SectionSettings())


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """A curve with the lines that several measurands share, drawn when the first of them asks."""

    curve_mm: Floats
    le: Edge
    te: Edge

    @cached_property
    def caliper(self) -> Chord:
        return chord(self.curve_mm, self.le, self.te)

    @cached_property
    def nose_tail(self) -> Line:
        return nose_tail_chord(self.curve_mm, self.le, self.te)


Shape = Callable[[Drawn], Estimate]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Definition:
    """What the nominal section fixes for the measured one: which metal is an edge, a side, the thick part.

    `shapes` are the measurands that need one curve only, the same for a nominal and a measured section;
    `nominals` has the nominal value of every measurand that the nominal has.
    """

    curve_mm: Floats  # (m, 2) corresponding nodes: trailing edge at 0, leading edge at m / 2
    side: Ints  # (m,) index into SIDES
    le: Edge
    te: Edge
    thick: Mapping[str, Pair]  # where each thickness is taken
    waves: WaveBand
    settings: SectionSettings
    shapes: Mapping[str, Shape]
    nominals: Mapping[str, float]

    @property
    def names(self) -> Mapping[str, Unit]:
        return section_measurands(self.settings)

    def supports(self) -> Mapping[str, Bools]:
        """Nodes (m,) that each measurand needs."""
        m = len(self.curve_mm)
        ends = _mark(m, self.le.zone) | _mark(m, self.te.zone)
        needed = dict.fromkeys(self.names, np.ones(m, bool))
        for name in ("chord_mm", "stagger_deg", "chord_nose_tail_mm", "chord_tangent_mm"):
            needed[name] = ends
        for name, end in (("le", self.le), ("te", self.te)):
            needed[f"{name}_radius_mm"] = _mark(m, end.arc)
            needed[f"{name}_flat_mm"] = needed[f"{name}_min_radius_mm"] = _mark(m, end.zone)
        for name, pair in self.thick.items():
            needed[name] = _mark(m, pair.node) | _mark(m, pair.across)
        needed["max_thickness_position_mm"] = needed["max_thickness_mm"] | ends
        for index, side in enumerate(SIDES):
            needed[f"{side}_profile_max_mm"] = needed[f"{side}_profile_min_mm"] = self.side == index
        return needed


def _mark(m: int, nodes: Ints) -> Bools:
    marked = np.zeros(m, bool)
    marked[nodes % m] = True
    return marked


def define(nominal_mm: Floats, side: Ints, settings: SectionSettings) -> Definition:
    """The definition from a nominal curve of corresponding nodes and the side that each is on."""
    nose = len(nominal_mm) // 2
    le, te = edge(nominal_mm, nose), edge(nominal_mm, 0)
    thick = _thick(nominal_mm, le, te, camber_line(nominal_mm, nose), settings)
    shapes = {
        **_chords(nominal_mm, le, te),
        **_edges(nominal_mm, le, te, settings),
        **_thicknesses(thick, settings),
    }
    shapes["max_camber_mm"] = lambda d: max_camber(d.curve_mm, camber_line(d.curve_mm, nose), d.nose_tail)
    drawn = Drawn(curve_mm=nominal_mm, le=le, te=te)
    own = {name: estimate.value for name, estimate in _estimates(drawn, shapes, shapes).items()}
    against = (n for n in section_measurands(settings) if n.startswith(_AGAINST) or "profile" in n)
    share = node_shares(nominal_mm)
    return Definition(
        curve_mm=nominal_mm,
        side=side,
        le=le,
        te=te,
        thick=thick,
        waves=wave_band(node_arc(nominal_mm), share, settings.wave_mm),
        settings=settings,
        shapes=shapes,
        nominals={**dict.fromkeys(against, 0.0), **own},
    )


_AGAINST = ("position", "orientation", "waviness", "out_of_tolerance", "fit")


def _estimates(drawn: Drawn, shapes: Mapping[str, Shape], wanted: Collection[str]) -> dict[str, Estimate]:
    """The estimates of the shapes that are wanted and that the curve has."""
    found = {}
    for name, measure in shapes.items():
        if name in wanted:
            try:
                found[name] = measure(drawn)
            except CannotMeasure:
                continue
    return found


def _thick(
    nominal_mm: Floats, le: Edge, te: Edge, camber: CamberLine, settings: SectionSettings
) -> Mapping[str, Pair]:
    """Where each thickness is taken; what lies nearer to an edge than any inscribed circle is left out."""
    line = chord(nominal_mm, le, te).line
    pairs = {"max_thickness_mm": thick_part(camber)}
    ends = (("le", line.nose_mm, line.along), ("te", line.tail_mm, -line.along))
    for name, from_mm, along in ends:
        place = (camber.centre_mm - from_mm) @ along
        pairs[f"{name}_thickness_mm"] = gauge(camber, from_mm, along, _GAUGE * line.length.value)
        for distance in settings.edge_distances_mm:
            if float(np.abs(place - distance).min()) <= _MISSED_MM:
                pairs[f"{name}_thickness_at_{distance:g}_mm"] = gauge(
                    camber, from_mm, along, distance, _AROUND
                )
    return pairs


def _thicknesses(thick: Mapping[str, Pair], settings: SectionSettings) -> dict[str, Shape]:
    shapes: dict[str, Shape] = {name: partial(_thickness, pair=pair) for name, pair in thick.items()}
    for end, distance in product(("le", "te"), settings.edge_distances_mm):
        name = f"{end}_thickness_at_{distance:g}_mm"
        if name in thick:
            shapes[name] = partial(_thickness_at, pair=thick[name], end=end, distance_mm=distance)
    largest = thick["max_thickness_mm"]
    return {**shapes, "max_thickness_position_mm": lambda d: thickest_at(d.curve_mm, largest, d.nose_tail)}


def _thickness(drawn: Drawn, pair: Pair) -> Estimate:
    return thickness(drawn.curve_mm, pair)


def _thickness_at(drawn: Drawn, pair: Pair, end: str, distance_mm: float) -> Estimate:
    line = drawn.caliper.line
    if end == "le":
        return thickness_at(drawn.curve_mm, pair, (line.nose_mm, line.nose_growth), line.along, distance_mm)
    return thickness_at(drawn.curve_mm, pair, (line.tail_mm, line.tail_growth), -line.along, distance_mm)


def _chords(nominal_mm: Floats, le: Edge, te: Edge) -> dict[str, Shape]:
    shapes: dict[str, Shape] = {
        "chord_mm": lambda d: d.caliper.line.length,
        "stagger_deg": lambda d: _degrees(d.caliper.stagger),
        "chord_nose_tail_mm": lambda d: d.nose_tail.length,
        "centroid_x_mm": partial(_centroid, axis=0),
        "centroid_y_mm": partial(_centroid, axis=1),
    }
    try:
        down = hollow(nominal_mm, le, te)
    except CannotMeasure:
        return shapes
    return {**shapes, "chord_tangent_mm": lambda d: tangent_chord(d.curve_mm, le, te, down)}


def _edges(nominal_mm: Floats, le: Edge, te: Edge, settings: SectionSettings) -> dict[str, Shape]:
    """Radius, flat and smallest radius of both edges; the last over as much arc as the nominal radius."""
    shapes: dict[str, Shape] = {}
    for name, end in (("le", le), ("te", te)):
        shapes[f"{name}_radius_mm"] = partial(_edge_radius, end=end)
        shapes[f"{name}_flat_mm"] = partial(_flat, end=end, flat_mm=settings.flat_mm)
        try:
            window_mm = edge_radius(nominal_mm, end.arc).value
        except CannotMeasure:
            continue
        shapes[f"{name}_min_radius_mm"] = partial(_min_radius, end=end, window_mm=window_mm)
    return shapes


def _edge_radius(drawn: Drawn, end: Edge) -> Estimate:
    return edge_radius(drawn.curve_mm, end.arc)


def _flat(drawn: Drawn, end: Edge, flat_mm: float) -> Estimate:
    return flat(drawn.curve_mm, end, flat_mm)


def _min_radius(drawn: Drawn, end: Edge, window_mm: float) -> Estimate:
    return min_radius(drawn.curve_mm, end, window_mm)


def _centroid(drawn: Drawn, axis: int) -> Estimate:
    """One coordinate of the centroid."""
    gradient = centroid_gradient(drawn.curve_mm)[axis]
    return Estimate(value=float(centroid(drawn.curve_mm)[axis]), gradient=gradient)


def _degrees(angle: Estimate) -> Estimate:
    return Estimate(value=float(np.rad2deg(angle.value)), gradient=np.rad2deg(angle.gradient))


def shape(
    curve_mm: Floats, definition: Definition, wanted: Collection[str] | None = None
) -> dict[str, Estimate]:
    """The estimates that need one curve only, by name: those `wanted`, or all.

    The stagger is told within half a turn of its nominal, also where that points backwards.
    """
    drawn = Drawn(curve_mm=curve_mm, le=definition.le, te=definition.te)
    found = _estimates(drawn, definition.shapes, definition.shapes if wanted is None else wanted)
    if "stagger_deg" in found and "stagger_deg" in definition.nominals:
        turns = round((found["stagger_deg"].value - definition.nominals["stagger_deg"]) / 360.0)
        found["stagger_deg"] = replace(found["stagger_deg"], value=found["stagger_deg"].value - 360.0 * turns)
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


def form(curve_mm: Floats, deviation_mm: Floats, seen: Bools, definition: Definition) -> dict[str, Estimate]:
    """The estimates of how far the profile is off: as it lies, after the section's best fit, and its waves.

    The gradient of `out_of_tolerance_fraction` is 0: its sigma comes from `share_beyond_sigma`. The extremes
    after the fit are the largest of many alike: the sigma of the one node is up to a quarter too large.
    """
    found = extremes(deviation_mm, seen, definition.side)
    if not seen.all():
        return found
    share, settings = node_shares(definition.curve_mm), definition.settings
    fit = best_fit(curve_mm, definition.curve_mm, definition.side, settings.fit)
    top, foot = int(np.argmax(fit.form_mm)), int(np.argmin(fit.form_mm))
    beyond = share_beyond(deviation_mm, share, settings.tolerance_mm)
    return {
        **found,
        "waviness_rms_mm": definition.waves.rms(deviation_mm),
        "waviness_height_mm": definition.waves.height(deviation_mm),
        "out_of_tolerance_fraction": Estimate(value=beyond, gradient=np.zeros(len(share))),
        "fit_x_mm": fit.x,
        "fit_y_mm": fit.y,
        "fit_rotation_deg": _degrees(fit.rotation),
        "profile_form_max_mm": Estimate(value=float(fit.form_mm[top]), gradient=fit.form_gradient(top)),
        "profile_form_min_mm": Estimate(value=float(fit.form_mm[foot]), gradient=fit.form_gradient(foot)),
    }
