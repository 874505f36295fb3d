"""The deviation map: the aligned scan seen from both sides, as PNG. The same points give the same bytes."""

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from geometry.types import Floats, Ints

Pixels = NDArray[np.uint8]

INSIDE = np.array([[28, 70, 140], [104, 150, 208], [232, 233, 234]], float)  # towards metal lost
OUTSIDE = np.array([[232, 233, 234], [226, 156, 100], [168, 60, 20]], float)  # towards metal in excess
PAPER, SHADOW = 255, 196
DOT = [(1, 1), (0, 1), (1, 0), (0, 0)]  # the pixels that a point covers, its own last


def deviation_views(
    points_mm: Floats, deviation_mm: Floats, whole_mm: Floats, full_mm: float, height: int
) -> list[str]:
    """Data addresses of two pictures, from either side of the blade, its tip upwards.

    `full_mm` is the deviation that has the full colour; `whole_mm` (m, 3) are points of the blade before it
    was damaged, drawn as a shadow where no scan point covers them."""
    chordwise, outward = plan_axes(points_mm)
    shadow_mm = whole_mm[whole_mm[:, 2] >= points_mm[:, 2].min()]
    drawn_mm = np.concatenate([shadow_mm, points_mm])
    colour = np.concatenate([np.full((len(shadow_mm), 3), SHADOW, np.uint8), colours(deviation_mm, full_mm)])
    layer = np.repeat([0, 1], [len(shadow_mm), len(points_mm)])
    views = [(chordwise, outward), (-chordwise, -outward)]
    return [data_address(png(seen_from(drawn_mm, colour, layer, *axes, height))) for axes in views]


def plan_axes(points_mm: Floats) -> tuple[Floats, Floats]:
    """Unit vectors of the sections' long and short direction, both level."""
    level = points_mm[:, :2] - points_mm[:, :2].mean(axis=0)
    _, vectors = np.linalg.eigh(level.T @ level)
    long = np.array([*vectors[:, 1], 0.0])
    return long, np.cross(long, [0.0, 0.0, 1.0])


def colours(deviation_mm: Floats, full_mm: float) -> Pixels:
    """Colours (n, 3) of deviations: blue where metal is lost, grey on nominal, brown where there is more."""
    place = np.clip(deviation_mm / full_mm, -1.0, 1.0)
    inside = mixed(INSIDE, 2.0 * (place + 1.0))
    outside = mixed(OUTSIDE, 2.0 * place)
    return np.where(place[:, None] < 0.0, inside, outside).round().astype(np.uint8)


def mixed(stops: Floats, place: Floats) -> Floats:
    """Colours (n, 3) along three stops at 0, 1 and 2."""
    place = np.clip(place, 0.0, 2.0)
    return np.stack([np.interp(place, [0.0, 1.0, 2.0], stops[:, channel]) for channel in range(3)], axis=1)


def seen_from(
    points_mm: Floats, colour: Pixels, layer: Ints, across: Floats, towards: Floats, height: int
) -> Pixels:
    """Picture (height, width, 3) of the points, the higher layer and then the nearest to the eye on top."""
    x_mm, z_mm, depth_mm = points_mm @ across, points_mm[:, 2], points_mm @ towards
    pitch_mm = (np.ptp(z_mm) or 1.0) / (height - 5)
    column = ((x_mm - x_mm.min()) / pitch_mm).astype(np.int64) + 2
    row = ((z_mm.max() - z_mm) / pitch_mm).astype(np.int64) + 2
    order = np.lexsort([depth_mm, layer])
    picture = np.full((height, int(column.max()) + 3, 3), PAPER, np.uint8)
    for down, right in DOT:
        picture[row[order] + down, column[order] + right] = colour[order]
    return picture


def png(pixels: Pixels) -> bytes:
    """The picture as PNG (8-bit RGB, no filter)."""
    height, width, _ = pixels.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def data_address(image: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(image).decode("ascii")


def legend_stops(full_mm: float) -> list[tuple[float, str]]:
    """Fractions along the legend, from metal lost to metal in excess, with their colours."""
    places = np.linspace(-full_mm, full_mm, 9)
    found: Ints = colours(places, full_mm).astype(np.int64)
    return [(i / 8, f"rgb({r},{g},{b})") for i, (r, g, b) in enumerate(found.tolist())]
