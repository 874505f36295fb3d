"""A cloud seen from two sides as pixels: nearest layer, mean deviation, shade from the depth.

The span lies along the screen, because terminals are wide; the pressure and the suction side stand
one above the other, or side by side where that makes them larger.
"""

import numpy as np
from numpy.typing import NDArray

from station.tui.palette import FIELD, UNMEASURED, Pixels, band_colours, shade
from station.tui.state import CloudPicture

SKIN_MM = 1.5  # points this close behind the nearest one of their pixel belong to the same layer
MARGIN_MM = 4.0
MIN_POINTS = 10
HOLE_NEIGHBOURS = 6  # of 8: fewer nearer neighbours are the outline of the blade

Floats32 = NDArray[np.float32]


def two_sides(cloud: CloudPicture | None, columns: int, rows: int) -> Pixels:
    """An image (rows, columns) of both sides of the blade; the empty field without enough points."""
    image = np.full((rows, columns), FIELD, dtype=np.uint32)
    if cloud is None or len(cloud.points_mm) < MIN_POINTS or rows < 4:
        return image
    chord_rad = _chord_direction_rad(cloud.points_mm)
    across, up, _ = _on_screen(cloud.points_mm, chord_rad)
    if _stack(float(np.ptp(across)), float(np.ptp(up)), columns, rows):
        half = rows // 2
        image[:half] = side(cloud, chord_rad, columns, half)
        image[half : 2 * half] = side(cloud, chord_rad + np.pi, columns, half)
    else:
        half = columns // 2
        image[:, :half] = side(cloud, chord_rad, half, rows)
        image[:, half : 2 * half] = side(cloud, chord_rad + np.pi, half, rows)
    return image


def _stack(width_mm: float, height_mm: float, columns: int, rows: int) -> bool:
    """Whether the two sides are larger one above the other than one beside the other."""
    above = min(columns / (width_mm + MARGIN_MM), rows / 2 / (height_mm + MARGIN_MM))
    beside = min(columns / 2 / (width_mm + MARGIN_MM), rows / (height_mm + MARGIN_MM))
    return above >= beside


def _chord_direction_rad(points_mm: Floats32) -> float:
    """The direction of the widest extent across the span: what faces the screen is then the airfoil."""
    flat = points_mm[:, :2] - points_mm[:, :2].mean(axis=0)
    _, vectors = np.linalg.eigh(flat.T @ flat)
    return float(np.arctan2(vectors[1, 1], vectors[0, 1]))


def side(cloud: CloudPicture, chord_rad: float, columns: int, rows: int) -> Pixels:
    """One view (rows, columns): span to the right, chord upwards, nearest layer in front."""
    across, up, depth = _on_screen(cloud.points_mm, chord_rad)
    width_mm, height_mm = float(np.ptp(across)) + MARGIN_MM, float(np.ptp(up)) + MARGIN_MM
    scale = min((columns - 1) / width_mm, (rows - 1) / height_mm)
    column = np.rint((across - _middle(across)) * scale + (columns - 1) / 2).astype(np.int64)
    row = np.rint((rows - 1) / 2 - (up - _middle(up)) * scale).astype(np.int64)
    pixel = row * columns + column
    nearest = np.full(rows * columns, np.inf, dtype=np.float32)
    np.minimum.at(nearest, pixel, depth)
    front = depth < nearest[pixel] + SKIN_MM
    depth_image = nearest.reshape(rows, columns)
    colours = _colours(cloud, pixel, front, rows * columns).reshape(rows, columns)
    depth_image, colours = _closed(depth_image, colours)
    lit = shade(colours, _light(depth_image, scale))
    return np.where(np.isfinite(depth_image), lit, np.uint32(FIELD)).astype(np.uint32)


def _on_screen(points_mm: Floats32, chord_rad: float) -> tuple[Floats32, Floats32, Floats32]:
    cosine, sine = np.float32(np.cos(chord_rad)), np.float32(np.sin(chord_rad))
    up = points_mm[:, 0] * cosine + points_mm[:, 1] * sine
    depth = points_mm[:, 0] * sine - points_mm[:, 1] * cosine
    return points_mm[:, 2], up, depth


def _middle(values: Floats32) -> float:
    return float(values.min() + values.max()) / 2.0


def _colours(cloud: CloudPicture, pixel: NDArray[np.int64], front: NDArray[np.bool_], size: int) -> Pixels:
    if cloud.deviation_mm is None or not cloud.limit_mm:
        return np.full(size, UNMEASURED, dtype=np.uint32)
    hits = np.bincount(pixel[front], minlength=size)
    total = np.bincount(pixel[front], cloud.deviation_mm[front], size)
    return band_colours((total / np.maximum(hits, 1)).astype(np.float32), cloud.limit_mm)


def _light(depth_mm: Floats32, scale: float) -> Floats32:
    """How much each pixel faces the eye, from the slope of the depth; 1 where a neighbour is missing."""
    filled = np.where(np.isfinite(depth_mm), depth_mm, np.nan)
    down, right = np.gradient(filled * scale) if min(depth_mm.shape) > 1 else (filled * 0, filled * 0)
    facing = 1.0 / np.sqrt(1.0 + np.nan_to_num(down) ** 2 + np.nan_to_num(right) ** 2)
    return (0.5 + 0.5 * facing).astype(np.float32)


def _closed(depth_mm: Floats32, colours: Pixels) -> tuple[Floats32, Pixels]:
    """Both images with each pixel through which the far side shows replaced by its nearest neighbour."""
    rows, columns = colours.shape
    shifts = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    padded_depth = np.pad(depth_mm, 1, constant_values=np.inf)
    padded_colours = np.pad(colours, 1, constant_values=FIELD)
    depths = np.stack([padded_depth[i : i + rows, j : j + columns] for i, j in shifts])
    around = np.stack([padded_colours[i : i + rows, j : j + columns] for i, j in shifts])
    in_front = depths < np.where(np.isfinite(depth_mm), depth_mm - SKIN_MM, np.inf)
    hole = in_front.sum(axis=0) >= HOLE_NEIGHBOURS
    nearest = depths.argmin(axis=0)[None]
    filled = np.take_along_axis(around, nearest, axis=0)[0]
    near_mm = np.take_along_axis(depths, nearest, axis=0)[0]
    return np.where(hole, near_mm, depth_mm), np.where(hole, filled, colours)
