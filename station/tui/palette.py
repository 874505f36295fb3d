"""Colours and themes. Normal is quiet grey; a saturated colour always means something, and always
has a second code (a word, a shape, an arrow), because one man in twelve cannot rely on the hue."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from textual.theme import Theme

Pixels = NDArray[np.uint32]  # 0xRRGGBB

FIELD: Final = 0x1E2124
INK: Final = 0xC8CCD0
DIM: Final = 0x7D858C
FAINT: Final = 0x4A5056
UNMEASURED: Final = 0x8E979E

# Nine bands of the serviceable deviation, blue through grey to brown; the alarm colours are not among
# them. Outside the limits the colour leaves the ramp: violet under, pink over.
BANDS: Final = (0x1450BE, 0x3C82DC, 0x78AFEB, 0xB0CCE2, 0xA8ACB0, 0xDCC8A0, 0xC8A070, 0xA87848, 0x84562C)
UNDER: Final = 0x963CFF
OVER: Final = 0xFF3CA0

VERDICT_FIELD: Final = {"PASS": 0x2F6FB5, "REPAIR": 0xE8B030, "SCRAP": 0xB3261E, "HOLD": 0x6B5B8C}
VERDICT_INK: Final = {"PASS": 0xFFFFFF, "REPAIR": 0x101010, "SCRAP": 0xFFFFFF, "HOLD": 0xFFFFFF}
VERDICT_SHAPE: Final = {"PASS": "✔", "REPAIR": "▲", "SCRAP": "✖", "HOLD": "?"}

PRIORITY_COLOUR: Final = {1: "#ff5a36", 2: "#ff5a36", 3: "#e8b030", 4: "#8fa3b0"}
PRIORITY_CODE: Final = {1: "▲1 URGENT", 2: "▲2 HIGH", 3: "◆3 MEDIUM", 4: "●4 LOW"}

DARK: Final = Theme(
    name="station-dark",
    dark=True,
    primary="#8fa3b0",
    secondary="#8fa3b0",
    accent="#d0d4d8",
    foreground="#c8ccd0",
    background="#1e2124",
    surface="#25292d",
    panel="#2d3236",
    success="#9aa0a6",
    warning="#e8b030",
    error="#ff5a36",
)


def band_colours(deviation_mm: NDArray[np.float32], limit_mm: float) -> Pixels:
    """The colour of each deviation: nine bands inside the limit, two words' colours outside."""
    bands = np.asarray(BANDS, dtype=np.uint32)
    index = np.clip((deviation_mm / limit_mm + 1.0) * 0.5 * len(bands), 0, len(bands) - 1).astype(np.int64)
    colours = bands[index]
    colours[deviation_mm > limit_mm] = OVER
    colours[deviation_mm < -limit_mm] = UNDER
    return colours


def shade(colours: Pixels, light: NDArray[np.float32], steps: int = 8) -> Pixels:
    """Colours darkened by `light` (0..1), in few steps so that neighbours share a run of one style."""
    factor = np.round(np.clip(light, 0.0, 1.0) * steps) / steps
    channels = [((colours >> shift) & 0xFF) * factor for shift in (16, 8, 0)]
    red, green, blue = (channel.astype(np.uint32) for channel in channels)
    return np.asarray((red << 16) | (green << 8) | blue, dtype=np.uint32)
