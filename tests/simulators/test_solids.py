"""Slices and files of closed meshes against shapes that are known in closed form."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from simulators.solids import (
    NotASolid,
    Solid,
    loop_area_mm2,
    read_solid,
    slice_loops,
    to_manifold,
    write_point_ply,
    write_stl,
)


def solid_of(mesh: trimesh.Trimesh) -> Solid:
    return Solid(vertices_mm=np.array(mesh.vertices), faces=np.array(mesh.faces))


def test_a_sliced_ball_is_a_circle_that_runs_counter_clockwise() -> None:
    ball = solid_of(trimesh.creation.icosphere(subdivisions=5, radius=10.0))
    (loop,) = slice_loops(ball, 6.0)
    assert loop_area_mm2(loop) == pytest.approx(np.pi * 64.0, rel=2e-3)
    assert np.linalg.norm(loop, axis=1) == pytest.approx(8.0, abs=0.02)


def test_a_slice_through_vertices_is_still_one_whole_loop() -> None:
    box = solid_of(trimesh.creation.box(extents=[2.0, 3.0, 4.0]).subdivide())
    (loop,) = slice_loops(box, 0.0)
    assert loop_area_mm2(loop) == pytest.approx(6.0)


def test_a_tube_has_an_outer_and_an_inner_loop() -> None:
    tube = solid_of(trimesh.creation.annulus(r_min=3.0, r_max=5.0, height=8.0, sections=256))
    areas = sorted(loop_area_mm2(loop) for loop in slice_loops(tube, 0.3))
    assert areas == pytest.approx([-9.0 * np.pi, 25.0 * np.pi], rel=1e-3)


def test_volume_does_not_depend_on_where_the_solid_stands() -> None:
    box = trimesh.creation.box(extents=[2.0, 3.0, 4.0])
    box.apply_translation([1e4, -2e4, 3e4])
    assert solid_of(box).volume_mm3 == pytest.approx(24.0, rel=1e-9)


def test_stl_comes_back_as_the_same_closed_solid(tmp_path: Path) -> None:
    ball = solid_of(trimesh.creation.icosphere(subdivisions=3, radius=10.0))
    path = tmp_path / "ball.stl"
    write_stl(path, ball)
    assert path.stat().st_size == 84 + 50 * len(ball.faces)
    back = read_solid(path)
    assert len(back.vertices_mm) == len(ball.vertices_mm)
    assert back.volume_mm3 == pytest.approx(ball.volume_mm3, rel=1e-6)


def test_points_come_back_in_double_precision(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(17, 3)) * 1e3
    path = tmp_path / "scan.ply"
    write_point_ply(path, points)
    head, _, body = path.read_bytes().partition(b"end_header\n")
    assert b"element vertex 17\n" in head
    assert np.array_equal(np.frombuffer(body, dtype="<f8").reshape(-1, 3), points)


def test_an_open_mesh_is_named_with_its_open_edges(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    path = tmp_path / "open.ply"
    trimesh.Trimesh(box.vertices, box.faces[:-1], process=False).export(path)
    with pytest.raises(NotASolid, match=r"open\.ply: not a closed manifold.* 3 open edges") as caught:
        read_solid(path)
    assert "\n" not in str(caught.value)


def test_a_mesh_inside_out_is_refused() -> None:
    box = trimesh.creation.box()
    with pytest.raises(NotASolid, match="inward"):
        to_manifold(Solid(vertices_mm=np.array(box.vertices), faces=np.array(box.faces)[:, ::-1]))


@pytest.mark.parametrize("name", ["text.stl", "nothing.ply", "what.xyz"])
def test_what_is_no_mesh_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("no mesh at all\n")
    with pytest.raises(NotASolid) as caught:
        read_solid(path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_points_that_are_not_finite_make_no_solid() -> None:
    with pytest.raises(NotASolid, match="finite"):
        Solid(vertices_mm=np.full((4, 3), np.nan), faces=np.zeros((4, 3), dtype=np.int64))
