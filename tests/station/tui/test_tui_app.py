"""The screen as an operator uses it: every size shows the verdict, keys send intents, faults stay small."""

import asyncio
import subprocess
import sys

import pytest
from textual.pilot import Pilot

from station import events
from station.tui.app import OperatorScreen, choose_glyphs
from station.tui.widgets.blade import BladeCloud
from station.tui.widgets.verdict import Verdict
from tests.station.tui import scenes

SIZES = [(80, 24), (120, 36), (160, 45)]


def screen_text(app: OperatorScreen) -> str:
    return "\n".join(strip.text for strip in app.screen._compositor.render_strips(app.size))


async def show(app: OperatorScreen, pilot: Pilot[None], sequence: list[events.Event]) -> str:
    """The screen's text after the events, once its footer stands and two looks at it are alike."""
    for event in sequence:
        app.take(event)
    text = ""
    async with asyncio.timeout(20):
        while True:
            app.refresh_page()
            await pilot.pause(0.1)
            before, text = text, screen_text(app)
            if app.screen.query("FooterKey") and without_clock(text) == without_clock(before):
                return text


def without_clock(text: str) -> str:
    return text.partition("\n")[2]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scene", ["repair", "pass", "scrap", "hold"])
async def test_every_size_shows_verdict_reason_and_stop(size: tuple[int, int], scene: str) -> None:
    app = OperatorScreen("127.0.0.1", 9)
    async with app.run_test(size=size) as pilot:
        app.workers.cancel_all()
        text = await show(app, pilot, scenes.SCENES[scene]())
        assert scene.upper() in text
        assert any(widget.display and widget.region.area > 200 for widget in app.screen.query(Verdict))
        assert "STOP SEQUENCE" in text
        assert "SIMULATION" in text


async def test_an_alarm_is_on_every_size() -> None:
    for size in SIZES:
        app = OperatorScreen("127.0.0.1", 9)
        async with app.run_test(size=size) as pilot:
            app.workers.cancel_all()
            assert "A101" in await show(app, pilot, [*scenes.ready(), scenes.alarm()])


async def test_without_a_station_nothing_looks_present() -> None:
    app = OperatorScreen("127.0.0.1", 9)
    async with app.run_test(size=(160, 45)) as pilot:
        app.workers.cancel_all()
        await show(app, pilot, scenes.SCENES["pass"]())
        app.lose()
        text = await show(app, pilot, [])
        assert "STALE" in text
        assert not any(widget.display for widget in app.screen.query(Verdict))


@pytest.mark.parametrize("serial", ["SN[/", "a[b=[c]]", "[bold]X", "\x1b[2J", "\u202eSSAP"])
async def test_no_string_from_outside_is_markup_or_moves_the_cursor(serial: str) -> None:
    app = OperatorScreen("127.0.0.1", 9)
    sent = events.PartStarted(
        serial=serial, sequence=1, recipe=1, part_number="P", views=1, record_no=1, at_utc=scenes.AT
    )
    async with app.run_test(size=(160, 45)) as pilot:
        app.workers.cancel_all()
        received = events.decode(events.encode(sent))
        assert isinstance(received, events.PartStarted)
        text = await show(app, pilot, [*scenes.ready(), received])
        assert received.serial in text
        assert "\x1b" not in text
        assert "\u202e" not in text


async def test_a_fault_in_a_drawing_costs_that_drawing_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: BladeCloud, columns: int, rows: int) -> None:
        raise ZeroDivisionError("no such picture")

    monkeypatch.setattr(BladeCloud, "draw", broken)
    app = OperatorScreen("127.0.0.1", 9)
    async with app.run_test(size=(160, 45)) as pilot:
        app.workers.cancel_all()
        text = await show(app, pilot, scenes.SCENES["repair"]())
        assert "cannot draw BladeCloud: no such picture" in text
        assert "REPAIR" in text


@pytest.mark.parametrize(
    ("key", "words"),
    [("f1", "not an emergency stop"), ("f2", "check cable"), ("f5", "HPC-004417"), ("f6", "trailing edge")],
)
async def test_every_page_opens_and_goes_back(key: str, words: str) -> None:
    app = OperatorScreen("127.0.0.1", 9)
    async with app.run_test(size=(160, 45)) as pilot:
        app.workers.cancel_all()
        await show(app, pilot, [*scenes.SCENES["hold"]()])
        await pilot.press(key)
        assert words in await show(app, pilot, [scenes.alarm()])
        await pilot.press("escape")
        assert "SEQUENCE" in await show(app, pilot, [scenes.alarm()])


async def test_keys_send_intents_and_the_stream_is_followed() -> None:
    received: list[object] = []

    async def station(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for event in scenes.ready():
            writer.write(events.encode(event))
        while line := await reader.readline():
            received.append(events.decode_intent(line))
        writer.close()

    server = await asyncio.start_server(station, "127.0.0.1", 0, limit=events.MAX_LINE_BYTES)
    async with server:
        app = OperatorScreen("127.0.0.1", server.sockets[0].getsockname()[1])
        async with app.run_test(size=(120, 36)) as pilot:
            async with asyncio.timeout(5):
                while not app.state.live:
                    await pilot.pause(0.02)
            await pilot.press("f3", "f4", "f9", "f12", "s", "x")
            async with asyncio.timeout(5):
                while len(received) < 4:
                    await pilot.pause(0.02)
            app.workers.cancel_all()
    kinds = [type(intent) for intent in received]
    assert kinds == [events.Acknowledge, events.Start, events.Reset, events.Stop]


def test_the_screen_is_light() -> None:
    heavy = "{'geometry.registration.register', 'open3d', 'numba', 'scipy', 'pymodbus', 'serial'}"
    code = f"import station.tui.app, sys; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("asked", "environment", "chosen"),
    [
        (None, {"TERM": "xterm-256color", "LANG": "en_US.UTF-8"}, "blocks"),
        (None, {"TERM": "linux", "LANG": "en_US.UTF-8"}, "ascii"),
        (None, {"TERM": "xterm", "LANG": "C"}, "ascii"),
        ("blocks", {"TERM": "linux"}, "blocks"),
        (None, {}, "blocks"),
    ],
)
def test_poor_terminals_get_plain_glyphs(asked: str | None, environment: dict[str, str], chosen: str) -> None:
    assert choose_glyphs(asked, environment) == chosen
