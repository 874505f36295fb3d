"""Draws the operator screen cell by cell into a PNG: `python -m tests.station.tui.picture OUT.png`."""

import argparse
import asyncio
from pathlib import Path

import matplotlib
from PIL import Image, ImageDraw, ImageFont
from rich.color import Color

from station.tui.app import OperatorScreen
from station.tui.state import lost
from tests.station.tui.scenes import SCENES

CELL_X, CELL_Y = 10, 20
INK, FIELD = (200, 204, 208), (30, 33, 36)
BRAILLE = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3))
Rgb = tuple[int, int, int]


def fonts() -> list[ImageFont.FreeTypeFont]:
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return [
        ImageFont.truetype(str(folder / name), 16)
        for name in ("DejaVuSansMono.ttf", "DejaVuSansMono-Bold.ttf")
    ]


def rgb(color: Color | None, default: Rgb) -> Rgb:
    return default if color is None or color.is_default else tuple(color.get_truecolor())


def draw_screen(app: OperatorScreen) -> Image.Image:
    width, height = app.size
    image = Image.new("RGB", (width * CELL_X, height * CELL_Y), FIELD)
    pen, faces = ImageDraw.Draw(image), fonts()
    for row, strip in enumerate(app.screen._compositor.render_strips(app.size)):
        column = 0
        for segment in strip:
            style = segment.style
            ink, field = rgb(style and style.color, INK), rgb(style and style.bgcolor, FIELD)
            if style and style.reverse:
                ink, field = field, ink
            if style and style.dim:
                ink = tuple((a + b) // 2 for a, b in zip(ink, field, strict=True))
            for character in segment.text:
                draw_cell(
                    pen,
                    faces[bool(style and style.bold)],
                    column * CELL_X,
                    row * CELL_Y,
                    character,
                    ink,
                    field,
                )
                column += 1
    return image


def draw_cell(
    pen: ImageDraw.ImageDraw,
    face: ImageFont.FreeTypeFont,
    x: int,
    y: int,
    character: str,
    ink: Rgb,
    field: Rgb,
) -> None:
    pen.rectangle((x, y, x + CELL_X - 1, y + CELL_Y - 1), fill=field)
    code = ord(character)
    if character == "▀":
        pen.rectangle((x, y, x + CELL_X - 1, y + CELL_Y // 2 - 1), fill=ink)
    elif 0x2800 <= code <= 0x28FF:
        for bit, (dx, dy) in enumerate(BRAILLE):
            if (code - 0x2800) >> bit & 1:
                pen.ellipse((x + 1 + dx * 5, y + 1 + dy * 5, x + 3 + dx * 5, y + 3 + dy * 5), fill=ink)
    elif character in "─━":
        pen.rectangle((x, y + 9, x + CELL_X - 1, y + (10 if character == "─" else 11)), fill=ink)
    elif character in "│┃":
        pen.rectangle((x + 4, y, x + 5, y + CELL_Y - 1), fill=ink)
    elif character != " ":
        pen.text((x, y), character, fill=ink, font=face)


async def picture(scene: str, size: tuple[int, int], keys: list[str], *, stale: bool = False) -> Image.Image:
    app = OperatorScreen("127.0.0.1", 9)
    async with app.run_test(size=size) as pilot:
        app.workers.cancel_all()
        for event in SCENES[scene]():
            app.take(event)
        if stale:
            app.state = lost(app.state)
        app.refresh_page()
        await pilot.pause()
        await pilot.press(*keys)
        app._mark_dirty()
        app.refresh_page()
        await pilot.pause(0.3)
        return draw_screen(app)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scene", choices=sorted(SCENES), default="repair")
    parser.add_argument("--size", default="160x45")
    parser.add_argument("--keys", nargs="*", default=[])
    parser.add_argument("--stale", action="store_true")
    asked = parser.parse_args()
    columns, rows = (int(part) for part in asked.size.split("x"))
    image = asyncio.run(picture(asked.scene, (columns, rows), asked.keys, stale=asked.stale))
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    image.save(asked.out, optimize=True)


if __name__ == "__main__":
    main()
