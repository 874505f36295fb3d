"""PLY: ascii and binary of either byte order, any properties and elements beside the coordinates."""

import struct
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from geometry.types import Floats, Ints
from station.formats.malformed import Malformed, numbers

MAX_HEADER_BYTES = 1 << 16
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
STRUCT_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Property:
    """A number, or a list of numbers if `length` is the type of its length."""

    name: str
    kind: str
    length: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Element:
    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(p.length for p in self.properties)


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    byte_order: str  # of struct and numpy; empty for ascii
    elements: tuple[Element, ...]
    size: int  # bytes of the header


def ply_points(content: bytes) -> Floats:
    """The vertices (n, 3) as they stand in the file; raises `Malformed`."""
    header = read_header(content)
    vertex = [element for element in header.elements if element.name == "vertex"]
    if len(vertex) != 1:
        raise Malformed("the header declares no vertices" if not vertex else "vertices are declared twice")
    places = coordinate_places(vertex[0])
    if header.byte_order:
        return binary_points(content, header, places)
    return ascii_points(content[header.size :], header, places)


def read_header(content: bytes) -> Header:
    """The parsed header; raises `Malformed` with the line that is wrong."""
    end = content.find(b"\nend_header", 0, MAX_HEADER_BYTES)
    newline = content.find(b"\n", end + 1)
    if not content.startswith(b"ply") or end < 0 or newline < 0:
        raise Malformed("not a PLY file, or its header has no end")
    lines = content[:end].decode("latin-1").splitlines()
    words = [(n, line.split()) for n, line in enumerate(lines, 1)][1:]
    words = [(n, w) for n, w in words if w and w[0] not in ("comment", "obj_info")]
    if not words or words[0][1][0] != "format" or words[0][1][1:2] == [] or words[0][1][1] not in BYTE_ORDERS:
        raise Malformed("header: the format line is missing or unknown")
    return Header(byte_order=BYTE_ORDERS[words[0][1][1]], elements=read_elements(words[1:]), size=newline + 1)


def read_elements(words: list[tuple[int, list[str]]]) -> tuple[Element, ...]:
    """The declared elements, each with its properties, in order."""
    starts = [i for i, (_, w) in enumerate(words) if w[0] == "element"]
    if words and starts[:1] != [0]:
        raise Malformed(f"header line {words[0][0]}: want an element")
    return tuple(read_element(words[a:b]) for a, b in pairwise([*starts, len(words)]))


def read_element(words: list[tuple[int, list[str]]]) -> Element:
    """One element line with the property lines that follow it."""
    n, line = words[0]
    if len(line) != 3 or not (line[2].isascii() and line[2].isdigit()) or len(line[2]) > 18:
        raise Malformed(f"header line {n}: want `element NAME COUNT`")
    properties = tuple(read_property(n, line) for n, line in words[1:])
    if len({p.name for p in properties}) != len(properties):
        raise Malformed(f"header line {n}: a property of {line[1]!r} is declared twice")
    return Element(name=line[1], count=int(line[2]), properties=properties)


def read_property(n: int, line: list[str]) -> Property:
    match line:
        case ["property", "list", length, kind, name] if TYPES.get(length, "f")[0] in "iu" and kind in TYPES:
            return Property(name=name, kind=TYPES[kind], length=TYPES[length])
        case ["property", kind, name] if kind in TYPES:
            return Property(name=name, kind=TYPES[kind])
    raise Malformed(f"header line {n}: {' '.join(line)[:60]!r} is not a property")


def coordinate_places(vertex: Element) -> list[int]:
    """The positions of x, y and z among the properties; they must stand before any list."""
    names = [p.name for p in vertex.properties]
    fixed = next((i for i, p in enumerate(vertex.properties) if p.length), len(names))
    if not all(name in names[:fixed] for name in "xyz"):
        raise Malformed("vertices have no x, y, z before their first list")
    return [names.index(name) for name in "xyz"]


def ascii_points(body: bytes, header: Header, places: list[int]) -> Floats:
    """The vertices of a text body, one row a line; as many rows as the header declares, no more."""
    rows = [row for row in body.splitlines() if row.strip()]
    counts = [element.count if element.properties else 0 for element in header.elements]
    if sum(counts) != len(rows):
        raise Malformed(f"the header declares {sum(counts)} rows, the file has {len(rows)}")
    index = next(i for i, element in enumerate(header.elements) if element.name == "vertex")
    vertex, start = header.elements[index], sum(counts[:index])
    mine = rows[start : start + vertex.count]
    if vertex.has_lists:
        return numbers(mine, places)
    table = numbers(mine, None)
    if len(mine) and table.shape[1] != len(vertex.properties):
        raise Malformed(f"vertex rows have {table.shape[1]} columns, want {len(vertex.properties)}")
    return table[:, places] if len(mine) else table


def binary_points(content: bytes, header: Header, places: list[int]) -> Floats:
    """The vertices of a binary body whose size is exactly what the header declares."""
    at, points = header.size, np.empty((0, 3))
    for element in header.elements:
        starts = row_starts(content, at, element, header.byte_order)
        if element.name == "vertex" and element.count:
            points = gather(content, starts[:-1], element, places, header.byte_order)
        at = int(starts[-1])
    if at != len(content):
        raise Malformed(f"{len(content) - at} bytes follow the data that the header declares")
    return points


def row_starts(content: bytes, at: int, element: Element, order: str) -> Ints:
    """Where each row of an element begins and, last, where the element ends.

    An element without properties takes no bytes, whatever its count."""
    if not element.properties:
        return np.array([at])
    least = sum(int(p.length[1] if p.length else p.kind[1]) for p in element.properties)
    missing = at + element.count * least - len(content)
    if missing > 0:
        declared = f"the header declares {element.count} of {element.name!r}"
        raise Malformed(f"{declared}, {missing} bytes are missing")
    if not element.has_lists:
        return at + least * np.arange(element.count + 1)
    return equal_rows(content, at, element, order) if element.count else np.array([at])


def equal_rows(content: bytes, at: int, element: Element, order: str) -> Ints:
    """Where rows with lists begin; quick when all lists are as long as the first, as in triangle meshes."""
    ends = walk(content, at, element, order, rows=1)
    stride = ends[-1] - at
    lists = [p for p in element.properties if p.length]
    if len(lists) == 1 and element.properties[0] is lists[0] and at + stride * element.count <= len(content):
        bytes_ = np.frombuffer(content, np.uint8, stride * element.count, at).reshape(-1, stride)
        width = int((lists[0].length or "u1")[1])
        if bool((bytes_[:, :width] == bytes_[0, :width]).all()):
            return at + stride * np.arange(element.count + 1)
    return np.array(walk(content, at, element, order, rows=element.count))


def walk(content: bytes, at: int, element: Element, order: str, rows: int) -> list[int]:
    """Where each of `rows` rows begins, and where the last ends, following the length of every list."""
    starts = [at]
    steps = [
        (struct.Struct(order + STRUCT_CODES[p.length]) if p.length else None, int(p.kind[1]))
        for p in element.properties
    ]
    for _ in range(rows):
        for length, size in steps:
            if length is None:
                at += size
                continue
            if at + length.size > len(content):
                raise Malformed(f"the data of {element.name!r} end early")
            items = length.unpack_from(content, at)[0]
            if items < 0:
                raise Malformed(f"a list of {element.name!r} has a negative length")
            at += length.size + items * size
        if at > len(content):
            raise Malformed(f"the data of {element.name!r} end early")
        starts.append(at)
    return starts


def gather(content: bytes, starts: Ints, vertex: Element, places: list[int], order: str) -> Floats:
    """x, y, z (n, 3) of the rows at `starts`."""
    head = np.dtype([(p.name, order + p.kind) for p in vertex.properties[: max(places) + 1]])
    strides = np.diff(starts)
    if len(strides) == 0 or bool((strides == strides[0]).all()):
        stride = int(strides[0]) if len(strides) else head.itemsize
        table = np.ndarray(len(starts), head, content, int(starts[0]), (stride,))
    else:
        raw = np.frombuffer(content, np.uint8)[starts[:, None] + np.arange(head.itemsize)]
        table = np.ascontiguousarray(raw).view(head)[:, 0]
    return np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
