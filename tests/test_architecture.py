"""The walls of the house hold at run time too: what a module drags in, and what the tree contains."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("geometry", "drivers", "simulators", "station")

LIGHT = {
    "station.__main__": {"numpy", "open3d", "textual", "numba", "scipy", "pymodbus"},
    "drivers.wire.turntable": {"serial", "pymodbus", "asyncio"},
    "drivers.wire.scanner": {"serial", "pymodbus", "asyncio"},
    "drivers.wire.plc": {"serial", "pymodbus", "asyncio"},
    "station.verdict": {"open3d", "textual", "pymodbus"},
    "station.tui.app": {"open3d", "numba", "scipy", "pymodbus", "serial", "geometry.registration.register"},
    "station.cycle": {"textual", "open3d"},
    "geometry.types": {"open3d", "numba", "pydantic"},
}


def modules_after_import(name: str) -> set[str]:
    code = f"import {name}, sys; print('\\n'.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    return set(done.stdout.split())


@pytest.mark.parametrize("name", sorted(LIGHT))
def test_a_module_drags_in_no_heavy_room(name: str) -> None:
    assert not modules_after_import(name) & LIGHT[name]


def source_files() -> list[Path]:
    return [path for room in ROOMS for path in (ROOT / room).rglob("*.py")]


def test_every_package_file_is_a_docstring_only() -> None:
    for path in source_files():
        if path.name == "__init__.py":
            assert path.read_text(encoding="utf-8").strip().count('"""') == 2, path
            assert path.read_text(encoding="utf-8").strip().endswith('"""'), path


def test_no_room_is_a_drawer_for_everything() -> None:
    drawers = {"utils", "common", "helpers", "base", "manager"}
    assert not [path for path in source_files() if path.stem in drawers]


def test_the_lock_names_no_address_and_every_package_has_a_hash() -> None:
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    assert "://" not in text
    assert "--index" not in text
    pins = [line for line in text.splitlines() if "==" in line and not line.startswith((" ", "#"))]
    assert pins
    assert all(line.rstrip().endswith("\\") for line in pins), "a pin without a hash"


def test_third_parties_are_fenced() -> None:
    fences = {
        "import serial": {"drivers/line.py"},
        "pymodbus": {"drivers/plc.py", "drivers/scanner.py", "simulators/plc.py", "simulators/scanner.py"},
        "import open3d": {"geometry/blade/nominal.py", "simulators/optics.py"},
    }
    for word, allowed in fences.items():
        users = {
            path.relative_to(ROOT).as_posix()
            for path in source_files()
            if any(
                line.strip().startswith(("import ", "from ")) and word in line
                for line in path.read_text(encoding="utf-8").splitlines()
            )
        }
        assert users <= allowed, (word, users - allowed)
