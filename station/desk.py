"""The desk of the geometry worker: recipes prepared once, kernels compiled, then part after part."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from geometry.transforms import about_z, apply
from geometry.types import Floats, View
from station.config import read_calibration
from station.measure import Progress, Views, absorb, conclude
from station.measurement import Measurement
from station.plans import read_plan
from station.recipe import Recipe, axis_of, prepare_recipe

REHEARSED_ANGLES_DEG = (0.0, 180.0)
REHEARSED_POINTS = 10_000  # enough for every step, few enough to be quick
DENT_RADIUS_MM, DENT_MM = 4.0, 1.0  # what is to be repaired at the rehearsal


class GeometryDesk:
    """Folds the views of one part at a time; keeps the last measurement for those who draw or file it."""

    def __init__(self, recipes: Mapping[int, Recipe]) -> None:
        self._recipes = recipes
        self._recipe = next(iter(recipes.values()))
        self._views = Views()
        self._measurement: Measurement | None = None

    def begin(self, recipe: int) -> None:
        """Turn to a new part."""
        self._recipe, self._views, self._measurement = self._recipes[recipe], Views(), None

    def absorb(self, view: View) -> None:
        """Take one view."""
        self._views = absorb(self._views, view)

    def conclude(self, progress: Progress) -> Measurement:
        """The measurement of the views since `begin`."""
        self._measurement = conclude(self._views, self._recipe, time.perf_counter, progress)
        return self._measurement

    def perform(self, task: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """What `task(recipe, measurement, *arguments)` returns for the part measured last."""
        if self._measurement is None:
            raise RuntimeError("no part was measured")
        return task(self._recipe, self._measurement, *arguments)


def make_desk(plans: Mapping[int, Path], calibration: Path) -> GeometryDesk:
    """A warm desk for the recipes in these plan files; raises what a bad one of them raises."""
    axis = axis_of(read_calibration(calibration))
    recipes = {number: prepare_recipe(read_plan(path), axis) for number, path in plans.items()}
    desk = GeometryDesk(recipes)
    rehearse(desk, *next(iter(recipes.items())))
    return desk


def rehearse(desk: GeometryDesk, number: int, recipe: Recipe) -> None:
    """Measures the nominal with a dent once, so that every kernel is compiled before the first part comes."""
    assert recipe.axis is not None
    points_mm = rehearsed_mm(recipe)
    desk.begin(number)
    for index, angle_deg in enumerate(REHEARSED_ANGLES_DEG):
        T_scanner_table = recipe.axis.T_scanner_table0 @ about_z(angle_deg)
        seen_mm = apply(T_scanner_table, points_mm[index :: len(REHEARSED_ANGLES_DEG)])
        desk.absorb(View(index=index, angle_deg=angle_deg, points_mm=seen_mm))
    desk.conclude(lambda step: None)
    desk.begin(number)


def rehearsed_mm(recipe: Recipe) -> Floats:
    """Points (n, 3) of the nominal, nominal frame, with noise and a dent."""
    samples, sigma_mm = recipe.nominal.samples, recipe.plan.measurement.sigma_mm
    few = slice(None, None, -(-len(samples.points_mm) // REHEARSED_POINTS))
    points_mm, normals = samples.points_mm[few], samples.normals[few]
    off_mm = np.random.default_rng(0).normal(0.0, sigma_mm, len(points_mm))
    away_mm = np.linalg.norm(points_mm - points_mm[len(points_mm) // 2], axis=1)
    dented = (away_mm < DENT_RADIUS_MM) & (normals @ normals[len(points_mm) // 2] > 0.5)
    off_mm[dented] -= DENT_MM
    return np.asarray(points_mm + off_mm[:, None] * normals)
