"""Readers of measurement files: third parties' files are read, everything else is refused with one line."""

import io
import struct
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pye57
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.types import Floats, Mesh
from station.clouds import READERS, BadScan, Scan, read_scan
from station.formats.malformed import Malformed
from station.formats.pcd import pcd_points
from station.formats.ply import ply_points
from station.formats.text import text_points
from station.formats.threemf import threemf
from station.formats.write import ply_cloud, ply_mesh, set_apart, stl
from tests.station.parts import tetrahedron

POINTS = np.array([[1.5, -2.25, 3.0], [0.1, 0.2, 0.3], [-7.0, 8.0, 9.125]])


def scan(folder: Path, name: str, content: bytes) -> Scan:
    (folder / name).write_bytes(content)
    return read_scan(folder / name)


def refusal(folder: Path, name: str, content: bytes) -> str:
    with pytest.raises(BadScan) as caught:
        scan(folder, name, content)
    line = str(caught.value)
    assert line.startswith(str(folder / name))
    assert "\n" not in line
    return line.removeprefix(f"{folder / name}: ")


def ply(body: bytes, *lines: str, kind: str = "binary_little_endian") -> bytes:
    return "\n".join(("ply", f"format {kind} 1.0", *lines, "end_header\n")).encode() + body


XYZ = ("property double x", "property double y", "property double z")


# PLY


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_a_mesh_of_trimesh_is_read(tmp_path: Path, encoding: str) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    content = sphere.export(file_type="ply", encoding=encoding)
    found = scan(tmp_path, "sphere.ply", content)
    np.testing.assert_allclose(found.points_mm, sphere.vertices, atol=1e-6)
    assert found.dropped == 0


def test_our_own_files_are_read_exactly(tmp_path: Path) -> None:
    assert np.array_equal(scan(tmp_path, "a.ply", ply_cloud(POINTS, np.zeros(3))).points_mm, POINTS)
    mesh = tetrahedron()
    assert np.array_equal(ply_points(ply_mesh(mesh)), mesh.vertices_mm)


@pytest.mark.parametrize(("kind", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
@pytest.mark.parametrize(
    ("name", "code"), [("float", "f4"), ("double", "f8"), ("float64", "f8"), ("short", "i2")]
)
def test_either_byte_order_and_any_number_type(kind: str, order: str, name: str, code: str) -> None:
    whole = np.round(POINTS)
    content = ply(
        whole.astype(order + code).tobytes(),
        "comment made by hand",
        "obj_info nothing",
        "element vertex 3",
        *(f"property {name} {axis}" for axis in "xyz"),
        kind=kind,
    )
    assert np.array_equal(ply_points(content), whole)


def test_other_properties_and_elements_are_skipped() -> None:
    camera = struct.pack("<if", 5, 0.5)
    bands = b"".join(struct.pack(f"<B{n}h", n, *range(n)) for n in (2, 0, 3))
    rows = b"".join(struct.pack("<Bdddf", 9, *p, 1.0) for p in POINTS)
    faces = struct.pack("<B3i", 3, 0, 1, 2) * 2
    content = ply(
        camera + bands + rows + faces,
        "element camera 1",
        "property int id",
        "property float focus",
        "element band 3",
        "property list uchar short values",
        "element nothing 99999999999",
        "element vertex 3",
        "property uchar red",
        *XYZ,
        "property float quality",
        "element face 2",
        "property list uchar int vertex_indices",
    )
    assert np.array_equal(ply_points(content), POINTS)


@pytest.mark.parametrize("lengths", [(1, 1, 1), (0, 2, 1)])
def test_lists_may_follow_the_coordinates(lengths: tuple[int, ...]) -> None:
    rows = b"".join(
        struct.pack(f">dddB{n}f", *p, n, *([0.5] * n)) for p, n in zip(POINTS, lengths, strict=True)
    )
    lines = ("element vertex 3", *XYZ, "property list uchar float extra")
    assert np.array_equal(ply_points(ply(rows, *lines, kind="binary_big_endian")), POINTS)
    text = "".join(f"{x} {y} {z} {n}{' 0.5' * n}\r\n" for (x, y, z), n in zip(POINTS, lengths, strict=True))
    assert np.array_equal(ply_points(ply(text.encode(), *lines, kind="ascii")), POINTS)


def test_ascii_rows_of_other_elements_are_skipped() -> None:
    body = b"7 0.5\n" + b"".join(b"%f %f %f 255\n" % tuple(p) for p in POINTS) + b"3 0 1 2\n\n"
    lines = ("element camera 1", "property int id", "property float focus", "element vertex 3", *XYZ)
    more = ("property uchar red", "element face 1", "property list uchar int vertex_indices")
    assert np.array_equal(ply_points(ply(body, *lines, *more, kind="ascii")), POINTS)


WHOLE = ply(POINTS.tobytes(), "element vertex 3", *XYZ)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (WHOLE[:-1], "1 bytes are missing"),
        (WHOLE[:-36], "36 bytes are missing"),
        (WHOLE + b"\0\0", "2 bytes follow the data"),
        (WHOLE.replace(b"vertex 3", b"vertex 2000000000"), "bytes are missing"),
        (WHOLE.replace(b"vertex 3", b"vertex -3"), "want `element NAME COUNT`"),
        (WHOLE.replace(b"vertex 3", b"vertex 9999999999999999999"), "want `element NAME COUNT`"),
        (WHOLE.replace(b"vertex 3", b"vertices 3"), "declares no vertices"),
        (WHOLE.replace(b"double z", b"double w"), "no x, y, z"),
        (WHOLE.replace(b"double z", b"double y"), "declared twice"),
        (WHOLE.replace(b"double z", b"quad z"), "is not a property"),
        (WHOLE.replace(b"little_endian", b"middle_endian"), "format line"),
        (WHOLE.replace(b"end_header", b"endheader"), "has no end"),
        (WHOLE.replace(b"ply", b"plx", 1), "not a PLY"),
        (WHOLE.replace(b"element vertex 3\n", b""), "want an element"),
        (WHOLE.replace(b"element vertex 3", b"element vertex 1\nelement vertex 2"), "twice"),
        (b"", "not a PLY"),
        (b"ply\nend_header\n", "format line"),
        (ply(b"", "element vertex 0", *XYZ), "holds no points"),
        (ply(b"1 2 3\n1 2\n", "element vertex 2", *XYZ, kind="ascii"), "row"),
        (ply(b"1 2 3 4\n", "element vertex 1", *XYZ, kind="ascii"), "4 columns, want 3"),
        (ply(b"1 2 3\n", "element vertex 2", *XYZ, kind="ascii"), "declares 2 rows, the file has 1"),
        (ply(b"1 2 3\n4 5 6\n", "element vertex 1", *XYZ, kind="ascii"), "declares 1 rows"),
        (ply(b"1 2 x\n", "element vertex 1", *XYZ, kind="ascii"), "could not convert"),
        (ply(b"\xff", "element f 1", "property list char int i", "element vertex 0", *XYZ), "negative"),
        (ply(b"\x09", "element f 1", "property list uchar int i", "element vertex 0", *XYZ), "end early"),
        (ply(b"\x00", "element vertex 1", "property list uchar int i", *XYZ), "first list"),
    ],
)
def test_a_damaged_ply_is_refused(tmp_path: Path, content: bytes, what: str) -> None:
    assert what in refusal(tmp_path, "a.ply", content)


def test_a_truncated_scan_never_becomes_half_a_blade(tmp_path: Path) -> None:
    """Open3D returns 1000 points for this file, half of them uninitialised memory."""
    whole = ply_cloud(np.random.default_rng(1).normal(size=(1000, 3)), np.zeros(1000))
    assert "14000 bytes are missing" in refusal(tmp_path, "a.ply", whole[:-14000])


# PCD

PCD = """\
# .PCD v0.7
VERSION 0.7
FIELDS x y z intensity
SIZE 4 4 4 2
TYPE F F F U
COUNT 1 1 1 1
WIDTH 3
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 3
DATA {data}
"""


def pcd(data: str, body: bytes) -> bytes:
    return PCD.format(data=data).encode() + body


PCD_BODY = b"".join(struct.pack("<fffH", *p, 7) for p in POINTS)


def test_pcd_is_read() -> None:
    text = b"".join(b"%f %f %f 7\n" % tuple(p) for p in POINTS)
    assert np.array_equal(pcd_points(pcd("ascii", text)), POINTS)
    assert np.array_equal(pcd_points(pcd("binary", PCD_BODY)), POINTS.astype("f4").astype(float))


def test_pcd_fields_may_have_any_order_count_and_padding() -> None:
    header = (
        b"FIELDS _ z normal y x\nSIZE 1 8 4 8 8\nTYPE U F F F F\nCOUNT 4 1 3 1 1\n"
        b"WIDTH 1\nHEIGHT 3\nDATA binary\n"
    )
    body = b"".join(struct.pack("<4xd12xdd", z, y, x) for x, y, z in POINTS)
    assert np.array_equal(pcd_points(header + body), POINTS)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (pcd("binary", PCD_BODY[:-1]), "1 bytes are missing"),
        (pcd("binary", PCD_BODY + b"."), "1 bytes follow"),
        (pcd("binary_compressed", PCD_BODY), "compressed PCD is refused"),
        (pcd("ascii", b"1 2 3 4\n"), "declares 3 points, the file has 1"),
        (pcd("ascii", b"1 2 3\n" * 3), "3 columns, want 4"),
        (pcd("ascii", b"1 2 3 a\n" * 3), "could not convert"),
        (pcd("binary", PCD_BODY).replace(b"POINTS 3", b"POINTS 4"), "contradict"),
        (pcd("binary", PCD_BODY).replace(b"WIDTH 3", b"WIDTH -3"), "WIDTH wants"),
        (pcd("binary", PCD_BODY).replace(b"COUNT 1 1 1 1", b"COUNT 2 1 1 1"), "contradict"),
        (pcd("binary", PCD_BODY).replace(b"SIZE 4 4", b"SIZE 3 4"), "do not describe"),
        (pcd("binary", PCD_BODY).replace(b"FIELDS x", b"FIELDS w"), "do not describe"),
        (pcd("binary", PCD_BODY).replace(b"DATA", b"DATE"), "no DATA line"),
        (b"WIDTH 0\nHEIGHT 0\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nDATA ascii\n", "holds no points"),
    ],
)
def test_a_damaged_pcd_is_refused(tmp_path: Path, content: bytes, what: str) -> None:
    assert what in refusal(tmp_path, "a.pcd", content)


# Text


@pytest.mark.parametrize(
    "text",
    [
        "1.5 -2.25 3\n0.1 0.2 0.3\n-7 8 9.125\n",
        "1.5\t-2.25\t3\r\n0.1\t0.2\t0.3\r\n-7\t8\t9.125",
        "# a scan\n\n1.5,-2.25,3,255\n0.1,0.2,0.3,0\n// middle\n-7,8,9.125,1\n",
        "x,y,z\n1.5, -2.25, 3\n0.1, 0.2, 0.3\n-7, 8, 9.125\n",
        '"X [mm]";"Y [mm]";"Z [mm]"\n1,5;-2,25;3\n0,1;0,2;0,3\n-7;8;9,125\n',
        "yaw,x_mm,y_mm,z_mm\n9,1.5,-2.25,3\n9,0.1,0.2,0.3\n9,-7,8,9.125\n",
        "id;z;y;x\n1;3;-2,25;1,5\n2;0,3;0,2;0,1\n3;9,125;8;-7\n",
    ],
)
def test_text_is_read(text: str) -> None:
    assert np.array_equal(text_points(text.encode()), POINTS)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "holds no points"),
        ("# nothing\n", "holds no points"),
        ("x y z\n", "holds no points"),
        ("1 2\n", "row"),
        ("1 2 3\n1 2\n", "row"),
        ("1,2,,3\n4,,5,6\n", "could not convert"),
        ("1 2 3\n1 2 three\n", "could not convert"),
        ("x,yaw,z\n1,2,3\n", "neither numbers nor the names"),
        ("x,y,z,X\n1,2,3,4\n", "columns 1 and 4 are both called x"),
        ("a b c\n1 2 3\n", "neither numbers nor the names"),
        ("\0\0\0", "not a text file"),
    ],
)
def test_bad_text_is_refused(tmp_path: Path, text: str, what: str) -> None:
    assert what in refusal(tmp_path, "a.xyz", text.encode())


# What is common to all


def test_points_without_coordinates_are_dropped_and_counted(tmp_path: Path) -> None:
    found = scan(tmp_path, "a.asc", b"1 2 3\nnan 0 0\n0 inf 0\n0 0 1e300\n4 5 6\n")
    assert (len(found.points_mm), found.dropped) == (2, 3)
    nothing = scan(tmp_path, "b.asc", b"nan nan nan\n")
    assert (len(nothing.points_mm), nothing.dropped) == (0, 1)


def test_endings_have_either_case_and_no_other_is_known(tmp_path: Path) -> None:
    assert len(scan(tmp_path, "A.XYZ", b"1 2 3\n").points_mm) == 1
    assert "unknown ending" in refusal(tmp_path, "a.stl", b"1 2 3\n")
    assert "unknown ending" in refusal(tmp_path, "a", b"1 2 3\n")


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(BadScan, match="is not a file"):
        read_scan(tmp_path / "folder.ply")
    with pytest.raises(BadScan, match="there is no such file"):
        read_scan(tmp_path / "none.ply")


def test_e57_is_refused_clearly(tmp_path: Path) -> None:
    assert refusal(tmp_path, "a.e57", b"something else") == "not an E57 file"
    head = b"ASTM-E57" + struct.pack("<IIQ", 1, 0, 4096)
    assert refusal(tmp_path, "a.e57", head) == "the header declares 4096 bytes, the file has 24"


def test_e57_names_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pye57", None)  # as if it were not installed
    whole = b"ASTM-E57" + struct.pack("<IIQ", 1, 0, 24)
    assert "bladecell[e57]" in refusal(tmp_path, "a.e57", whole)


def test_e57_gives_the_points_of_every_scan_and_a_damaged_one_a_line(tmp_path: Path) -> None:
    first, second = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), np.array([[-7.0, 8.5, 9.25]])
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        for points in (first, second):
            file.write_scan_raw({f"cartesian{axis}": points[:, i] for i, axis in enumerate("XYZ")})
    assert np.array_equal(read_scan(tmp_path / "a.e57").points_mm, np.concatenate([first, second]))
    content = (tmp_path / "a.e57").read_bytes()
    assert "declares" in refusal(tmp_path, "b.e57", content[:-1024])
    assert refusal(tmp_path, "c.e57", content[:48] + bytes(len(content) - 48)).startswith("E57: ")


SEEDS = {
    ".ply": [WHOLE, ply(b"1 2 3\n", "element vertex 1", *XYZ, kind="ascii"), ply_mesh(tetrahedron())],
    ".pcd": [pcd("binary", PCD_BODY), pcd("ascii", b"1 2 3 4\n" * 3)],
    ".xyz": [b"1 2 3\n4 5 6\n"],
    ".csv": [b"x;y;z\n1,5;2;3\n", b"1,2,3\n"],
    ".e57": [b"ASTM-E57" + struct.pack("<IIQ", 1, 0, 24)],
}


def read_or_refuse(path: Path) -> Scan | str:
    try:
        return read_scan(path)
    except BadScan as error:
        return str(error)


@pytest.mark.parametrize("content", [b"\x85", b"\x1c", b"\xa0\n1 2 3\n"])
def test_blanks_that_only_characters_know_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "blank.asc").write_bytes(content)
    assert isinstance(read_or_refuse(tmp_path / "blank.asc"), str)


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_any_bytes_give_points_or_a_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    ending = data.draw(st.sampled_from(list(READERS)))
    seed = data.draw(st.sampled_from(SEEDS.get(ending, [b""])))
    at, cut = data.draw(st.integers(0, len(seed))), data.draw(st.integers(0, 20))
    path = tmp_path_factory.getbasetemp() / f"any{ending}"
    path.write_bytes(seed[:at] + data.draw(st.binary(max_size=20)) + seed[at + cut :])
    match read_or_refuse(path):
        case Scan(points_mm=points_mm):
            assert np.isfinite(points_mm).all()
            assert points_mm.shape[1:] == (3,)
        case line:
            assert "\n" not in line


@pytest.mark.parametrize(
    "content",
    [
        WHOLE.replace(b"vertex 3", b"vertex 2000000000"),
        ply(b"\xff\xff\xff\x7f", "element f 1", "property list int int i", "element vertex 3", *XYZ),
        ply(b"", "element f 999999999999999999", "property list uint int i", "element vertex 3", *XYZ),
    ],
)
def test_a_promise_of_many_points_allocates_nothing(content: bytes) -> None:
    tracemalloc.start()
    with pytest.raises(Malformed):
        ply_points(content)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


# Writers, read back by somebody else.


def test_stl_is_closed_for_others() -> None:
    box = trimesh.creation.icosphere(subdivisions=3)
    mesh = Mesh(vertices_mm=np.array(box.vertices) + 100.0, faces=np.array(box.faces, np.int64))
    content = stl([mesh])
    assert len(content) == 84 + 50 * len(mesh.faces)
    again = trimesh.load_mesh(io.BytesIO(content), file_type="stl")
    assert again.is_watertight
    assert again.volume == pytest.approx(box.volume, rel=1e-5)


def folded(gap_mm: float) -> Mesh:
    """A double pyramid far from the origin on a triangle of which one side is `gap_mm` long: with that side
    gone, each pyramid is two facets back to back."""
    ring = [[0.0, 0.0, 0.0], [gap_mm, 0.0, 0.0], [0.5, 1.0, 0.0]]
    vertices: Floats = np.array([*ring, [0.5, 0.5, 1.0], [0.5, 0.5, -1.0]]) + 100.0
    sides = ((0, 1), (1, 2), (2, 0))
    faces = [[a, b, 3] for a, b in sides] + [[b, a, 4] for a, b in sides]
    return Mesh(vertices_mm=vertices, faces=np.array(faces, np.int64))


@pytest.mark.parametrize("gap_mm", [1e-9, 0.0])
def test_an_edge_too_short_for_float32_does_not_fold_the_mesh(gap_mm: float) -> None:
    content = stl([folded(gap_mm)])
    assert len(content) == 84 + 50 * 6
    again = trimesh.load_mesh(io.BytesIO(content), file_type="stl")
    assert again.is_watertight
    assert len(again.vertices) == 5


def test_many_corners_in_one_place_are_all_set_apart() -> None:
    vertices_mm = np.full((50, 3), 100.0, np.float32)
    apart = set_apart(vertices_mm)
    assert len(np.unique(apart, axis=0)) == 50
    assert np.abs(apart - vertices_mm).max() < 50 * 1e-5


def test_an_open_mesh_is_refused() -> None:
    mesh = tetrahedron()
    with pytest.raises(ValueError, match="not closed"):
        stl([Mesh(vertices_mm=mesh.vertices_mm, faces=mesh.faces[:3])])


def test_3mf_has_named_solids_in_millimetres_for_others() -> None:
    box = trimesh.creation.icosphere(subdivisions=2)
    mesh = Mesh(vertices_mm=np.array(box.vertices) + 100.0, faces=np.array(box.faces, np.int64))
    content = threemf({"repair-1 tip": mesh, "a & <b>": tetrahedron()})
    again = trimesh.load(io.BytesIO(content), file_type="3mf")
    assert again.units == "millimeter"
    assert set(again.geometry) == {"repair-1 tip", "a & <b>"}
    assert again.geometry["repair-1 tip"].is_watertight
    assert again.geometry["repair-1 tip"].volume == pytest.approx(box.volume, rel=1e-6)
    assert content == threemf({"repair-1 tip": mesh, "a & <b>": tetrahedron()})


def test_several_meshes_make_one_file() -> None:
    assert len(stl([tetrahedron(), tetrahedron()])) == 84 + 50 * 8


def test_a_cloud_has_its_deviations() -> None:
    loaded = trimesh.load(io.BytesIO(ply_cloud(POINTS, np.array([0.1, -0.2, 0.3]))), file_type="ply")
    raw = loaded.metadata["_ply_raw"]["vertex"]
    assert raw["properties"]["deviation_mm"] == "<f4"
    np.testing.assert_allclose(raw["data"]["deviation_mm"], [0.1, -0.2, 0.3], atol=1e-7)
    np.testing.assert_array_equal(loaded.vertices, POINTS)
