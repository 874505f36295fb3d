"""The examples of docs/wire, by name: bytes and lines that the encoders under test never made."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs" / "wire"


def blocks(kind: str) -> dict[str, str]:
    """The fenced blocks of a kind, by name."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md")))
    return dict(re.findall(rf"```{kind} ([\w-]+)\n(.*?)```", text, re.DOTALL))


@pytest.fixture(scope="session")
def manual_bytes() -> dict[str, bytes]:
    return {name: bytes.fromhex(block) for name, block in blocks("hex").items()}


@pytest.fixture(scope="session")
def manual_lines() -> dict[str, list[str]]:
    return {name: block.splitlines() for name, block in blocks("lines").items()}
