"""PCD 0.7 of the Point Cloud Library: ascii and binary."""

import re
from dataclasses import dataclass

import numpy as np

from geometry.types import Floats
from station.formats.malformed import Malformed, numbers

MAX_HEADER_BYTES = 1 << 16
KINDS = {f"{letter}{size}" for letter in "IU" for size in (1, 2, 4, 8)} | {"F4", "F8"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    fields: tuple[str, ...]
    kinds: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    data: str
    size: int


def pcd_points(content: bytes) -> Floats:
    """The points (n, 3) as they stand in the file; raises `Malformed`. The viewpoint is not applied."""
    header = read_header(content)
    if header.data == "ascii":
        return ascii_points(content[header.size :], header)
    if header.data == "binary":
        return binary_points(content, header)
    raise Malformed("compressed PCD is refused, its size is unknown before it is unpacked: save as binary")


def read_header(content: bytes) -> Header:
    """The parsed header; raises `Malformed` with the entry that is wrong."""
    data = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", content[:MAX_HEADER_BYTES], re.MULTILINE)
    if data is None:
        raise Malformed("not a PCD file, or its header has no DATA line")
    lines = content[: data.start()].decode("latin-1").splitlines()
    entries = {w[0]: w[1:] for w in (line.split() for line in lines) if w and not w[0].startswith("#")}
    fields, count = entries.get("FIELDS", []), len(entries.get("FIELDS", []))
    kinds = [k + s for k, s in zip(entries.get("TYPE", []), entries.get("SIZE", []), strict=False)]
    if not all(name in fields for name in "xyz") or len(kinds) != count or not set(kinds) <= KINDS:
        raise Malformed("header: FIELDS, SIZE and TYPE do not describe x, y, z")
    counts = natural(entries, "COUNT", count) if "COUNT" in entries else [1] * count
    width, height = *natural(entries, "WIDTH", 1), *natural(entries, "HEIGHT", 1)
    points = natural(entries, "POINTS", 1)[0] if "POINTS" in entries else width * height
    if points != width * height or any(counts[fields.index(name)] != 1 for name in "xyz"):
        raise Malformed("header: POINTS, WIDTH, HEIGHT and COUNT contradict each other")
    return Header(
        fields=tuple(fields),
        kinds=tuple(kinds),
        counts=tuple(counts),
        points=points,
        data=data[1].decode("latin-1"),
        size=data.end(),
    )


def natural(entries: dict[str, list[str]], key: str, count: int) -> list[int]:
    """The `count` whole numbers of a header entry."""
    words = entries.get(key, [])
    if len(words) != count or not all(w.isascii() and w.isdigit() and len(w) < 19 for w in words):
        raise Malformed(f"header: {key} wants {count} whole number(s)")
    return [int(word) for word in words]


def ascii_points(body: bytes, header: Header) -> Floats:
    rows = [row for row in body.splitlines() if row.strip()]
    if len(rows) != header.points:
        raise Malformed(f"the header declares {header.points} points, the file has {len(rows)} rows")
    table = numbers(rows, None)
    if rows and table.shape[1] != sum(header.counts):
        raise Malformed(f"rows have {table.shape[1]} columns, want {sum(header.counts)}")
    first = np.cumsum((0, *header.counts))
    return table[:, [first[header.fields.index(name)] for name in "xyz"]] if rows else table


def binary_points(content: bytes, header: Header) -> Floats:
    stride = sum(int(k[1]) * n for k, n in zip(header.kinds, header.counts, strict=True))
    surplus = len(content) - header.size - header.points * stride
    if surplus:
        raise Malformed(f"the header declares {header.points} points of {stride} bytes, {excess(surplus)}")
    starts = np.cumsum([0, *(int(k[1]) * n for k, n in zip(header.kinds, header.counts, strict=True))])
    places = [header.fields.index(name) for name in "xyz"]
    layout = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": ["<" + header.kinds[i].lower() for i in places],
            "offsets": [int(starts[i]) for i in places],
            "itemsize": stride,
        }
    )
    table = np.frombuffer(content, layout, header.points, header.size)
    return np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)


def excess(surplus: int) -> str:
    return f"{surplus} bytes follow them" if surplus > 0 else f"{-surplus} bytes are missing"
