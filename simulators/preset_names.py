"""What the presets are called; apart from their making, so that a wrong name is refused at once."""

DEMO = ("PASS", "REPAIR", "SCRAP")
PRESETS = (
    "PASS",
    "PASS-nick",
    "REPAIR",
    "REPAIR-weld",
    "REPAIR-bent",
    "SCRAP",
    "HOLD-hole",
    "HOLD-wrong-part",
)


def preset_named(text: str) -> str:
    """The preset of that name in any case; "hold" alone is the part with a hole in its scan."""
    names = {name.upper(): name for name in (*PRESETS, "demo")} | {"HOLD": "HOLD-hole"}
    if text.upper() not in names:
        raise ValueError(f"preset {text!r} is none of {', '.join(PRESETS)}, demo")
    return names[text.upper()]
