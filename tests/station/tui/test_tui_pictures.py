"""The drawings: strips fill their cells, colours mean what the legend says, gaps stay open."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from station import events
from station.tui import blade_picture, canvas, letters, palette, section_picture
from station.tui.state import CloudPicture
from tests.station.tui import scenes


def flat_plate(deviation_mm: float | None) -> CloudPicture:
    grid = np.stack(np.meshgrid(np.linspace(0, 40, 80), [0.0], np.linspace(0, 100, 200)), axis=-1).reshape(
        -1, 3
    )
    deviation = None if deviation_mm is None else np.full(len(grid), deviation_mm, dtype=np.float32)
    return CloudPicture(points_mm=grid.astype(np.float32), deviation_mm=deviation, limit_mm=0.2)


@given(
    st.integers(1, 60),
    st.integers(1, 20),
    st.randoms(use_true_random=False),
)
@settings(max_examples=30)
def test_half_block_strips_fill_their_cells(columns: int, rows: int, chance: object) -> None:
    pixels = (
        np.random.default_rng(columns * rows).integers(0, 0xFFFFFF, (2 * rows, columns)).astype(np.uint32)
    )
    strips = canvas.half_blocks(pixels)
    assert len(strips) == rows
    assert {strip.cell_length for strip in strips} == {columns}


def test_braille_dots_land_in_the_unicode_cell() -> None:
    dots = np.zeros((4, 2), dtype=bool)
    dots[0, 0] = dots[3, 1] = True
    (strip,) = canvas.braille(dots, np.zeros((1, 1), dtype=np.uint32))
    assert strip.text == chr(0x2800 + 0x01 + 0x80)


@pytest.mark.parametrize(("deviation_mm", "colour"), [(0.3, palette.OVER), (-0.3, palette.UNDER)])
def test_beyond_the_limit_the_colour_leaves_the_ramp(deviation_mm: float, colour: int) -> None:
    image = blade_picture.two_sides(flat_plate(deviation_mm), 60, 40)
    drawn = image[image != palette.FIELD]
    assert len(drawn) > 500
    assert np.mean(drawn == colour) > 0.9


def test_an_unmeasured_cloud_has_no_deviation_colour() -> None:
    image = blade_picture.two_sides(flat_plate(None), 60, 40)
    red, green, blue = ((image[image != palette.FIELD] >> shift) & 0xFF for shift in (16, 8, 0))
    assert np.ptp(np.stack([red, green, blue]).astype(int), axis=0).max() < 40


def test_too_few_points_draw_nothing() -> None:
    few = CloudPicture(points_mm=np.zeros((3, 3), dtype=np.float32))
    assert (blade_picture.two_sides(few, 20, 10) == palette.FIELD).all()


@pytest.mark.parametrize("verdict", ["PASS", "REPAIR", "SCRAP", "HOLD"])
def test_the_word_fills_its_panel_and_never_leaves_it(verdict: str) -> None:
    picture = letters.verdict_bitmap(verdict, 53, 22)
    assert picture.shape == (22, 53)
    assert picture.any()
    assert letters.verdict_bitmap(verdict, 10, 4).shape == (4, 10)


def test_words_differ_in_shape_not_only_in_colour() -> None:
    pictures = [letters.verdict_bitmap(word, 60, 24)[:, :22] for word in ("PASS", "REPAIR", "SCRAP", "HOLD")]
    for i, first in enumerate(pictures):
        for second in pictures[i + 1 :]:
            assert (first ^ second).sum() > 20


def test_a_section_keeps_its_proportions() -> None:
    section = scenes.section_event(52.5, "measured", 1)
    image = section_picture.section_dots(section, section_picture.whole(section), 80, 30)
    rows, columns = np.nonzero(image.dots)
    curve = events.unpack(section.nominal_mm, 2)
    drawn = np.ptp(columns) / np.ptp(rows)
    true = np.ptp(curve[:, 0]) / np.ptp(curve[:, 1])
    assert 0.5 * true < drawn < 1.2 * true


def test_no_line_crosses_a_gap() -> None:
    """Two short stretches on opposite ends: nothing may be drawn between them but the nominal."""
    curve = np.column_stack(
        [20 * np.cos(np.linspace(0, 2 * np.pi, 400)), 8 * np.sin(np.linspace(0, 2 * np.pi, 400))]
    )[:-1]
    ends = np.concatenate([curve[:20], curve[190:210]])
    section = events.SectionMeasured(
        z_mm=1.0,
        status="partial",
        nominal_mm=events.pack(curve),
        profile_mm=events.pack(ends),
        deviation_mm=events.pack(np.full(40, 0.05)),
        run=events.pack(np.repeat([0, 1], 20)),
        le_mm=(-20.0, 0.0),
        te_mm=(20.0, 0.0),
        serviceable_mm=None,
        repairable_mm=None,
        values=(),
    )
    image = section_picture.section_dots(section, section_picture.whole(section), 80, 30)
    middle = image.dots[50:70, 70:90]
    assert not middle.any()
