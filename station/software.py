"""Which state of this software made a number."""

from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def software_version() -> str:
    try:
        return version("bladecell")
    except PackageNotFoundError:
        return "unknown"


@cache
def software_commit() -> str:
    """The commit of the checkout that this file runs from, or "unknown" for an installed package."""
    git = Path(__file__).resolve().parent.parent / ".git"
    try:
        head = (git / "HEAD").read_text(encoding="ascii").strip()
        name = head.removeprefix("ref: ")
        if name == head:
            return head
        loose = git / name
        if loose.is_file():
            return loose.read_text(encoding="ascii").strip()
        packed = (git / "packed-refs").read_text(encoding="ascii").splitlines()
        return next((line.split()[0] for line in packed if line.endswith(f" {name}")), "unknown")
    except (OSError, UnicodeDecodeError):
        return "unknown"
