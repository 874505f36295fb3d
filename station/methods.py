"""The verbs of the geometry that a plan chooses by name, each with the settings of that plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.deformation.twin import Twin, TwinSettings, fit_twin
from geometry.errors import CannotFitTwin, CannotMeasure, CannotRegister
from geometry.registration.alignment import Alignment
from geometry.registration.datums import (
    ServiceMotion,
    register_root,
    register_sections,
    register_six_point,
    service_motion,
)
from geometry.registration.register import register
from geometry.sections.airfoil import Section, measure_sections
from geometry.thesis.fine_tuned import register_thesis
from geometry.thesis.rwlls_sections import ThesisSectionSettings, measure_sections_thesis
from geometry.thesis.stiff_twin import fit_twin_thesis
from geometry.transforms import apply, inverse
from geometry.types import Bools, Cloud, NotMeasured
from station.plans import AlignmentChoice
from station.recipe import Recipe

AGREED_MM = 0.05  # anywhere on the surface, between two ways to the same pose


@dataclass(frozen=True, slots=True, kw_only=True)
class Aligned:
    """The alignment that everything is judged by, and how the airfoil stands against its root in service.

    `service` is None where the plan names no datum zone.
    """

    alignment: Alignment
    service: ServiceMotion | NotMeasured | None


def align(cloud: Cloud, recipe: Recipe) -> Aligned:
    """The fit on the airfoil, then the one on the datum that the plan names.

    Raises `CannotRegister` for a datum on damage or unseen; without the root zone only `service` is lost.
    """
    choice, nominal = recipe.plan.alignment, recipe.nominal
    service: ServiceMotion | NotMeasured
    airfoil = register(cloud, nominal)
    if recipe.plan.algorithms.registration == "thesis":
        airfoil = agreeing(register_thesis(cloud, nominal), airfoil, nominal)
    alignment = on_datum(cloud, airfoil, nominal, choice)
    if choice.datum_z_mm is None:
        return Aligned(alignment=alignment, service=None)
    try:
        rooted = choice.method == "root"
        root = alignment if rooted else register_root(cloud, nominal, airfoil, choice.datum_z_mm)
        service = in_service(root, airfoil, nominal)
    except CannotMeasure as why:
        service = NotMeasured(reason=str(why))
    return Aligned(alignment=alignment, service=service)


def agreeing(thesis: Alignment, default: Alignment, nominal: Nominal) -> Alignment:
    """The thesis' pose, where the default's is the same; raises `CannotRegister` otherwise.

    Pairs of points hold a blade along its own screw by their spacing alone. Nothing that the thesis' method
    knows of its pose shows such a slide.
    """
    points_mm = nominal.samples.points_mm
    moved_mm = apply(thesis.T_nominal_scan @ inverse(default.T_nominal_scan), points_mm) - points_mm
    off_mm = float(np.linalg.norm(moved_mm, axis=1).max())
    if not off_mm <= AGREED_MM:
        raise CannotRegister(f"the thesis' pose lies {off_mm:.2f} mm off the one that the ends confirm")
    return thesis


def in_service(root: Alignment, airfoil: Alignment, nominal: Nominal) -> ServiceMotion | NotMeasured:
    """How the airfoil stands against its root; only where the root zone tells a whole pose."""
    if root.weak_directions or not root.converged:
        return NotMeasured(reason="the datum zone leaves a direction free")
    return service_motion(root, airfoil, nominal)


def on_datum(cloud: Cloud, airfoil: Alignment, nominal: Nominal, choice: AlignmentChoice) -> Alignment:
    """The alignment that the plan judges by, found from the fit on the whole airfoil."""
    match choice.method:
        case "root" if choice.datum_z_mm is not None:
            return register_root(cloud, nominal, airfoil, choice.datum_z_mm)
        case "six_point" if choice.points_mm is not None:
            return register_six_point(cloud, nominal, airfoil, np.array(choice.points_mm))
        case "sections" if choice.z_mm is not None:
            return register_sections(cloud, nominal, airfoil, choice.z_mm)
        case "airfoil":
            return airfoil
    raise ValueError(f"alignment {choice.method} without its datum")


def make_twin(cloud: Cloud, mask: Bools, alignment: Alignment, recipe: Recipe) -> Twin:
    """The damage-free twin by the method of the plan; raises `CannotFitTwin` for one that did not settle."""
    if recipe.plan.algorithms.twin == "thesis":
        twin = fit_twin_thesis(cloud, mask, alignment, recipe.nominal)
    else:
        twin = fit_twin(cloud, mask, alignment, recipe.nominal, TwinSettings())
    if not twin.converged:
        raise CannotFitTwin("the twin did not converge")
    return twin


def cut_sections(cloud: Cloud, mask: Bools, alignment: Alignment, recipe: Recipe) -> tuple[Section, ...]:
    """The sections of the plan by the method of the plan."""
    settings, z_mm = recipe.section_settings, recipe.plan.sections.z_mm
    if recipe.plan.algorithms.sections == "thesis":
        thesis = ThesisSectionSettings(sections=settings)
        return measure_sections_thesis(cloud, mask, alignment, recipe.nominal, z_mm, thesis)
    return measure_sections(cloud, mask, alignment, recipe.nominal, z_mm, settings)
