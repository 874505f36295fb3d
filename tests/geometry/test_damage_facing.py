"""Which side of a broken surface is metal: thin edges, wide shallow wear, and what cannot be told."""

import numpy as np
import pytest

from geometry.damage.facing import outward_sign
from geometry.errors import CannotRepair
from geometry.types import Floats


def edge(radius_mm: float, flank_mm: float, pitch_mm: float, length_mm: float) -> tuple[Floats, Floats]:
    """Points and outward normals of thin metal that ends in a half round towards +x, spread evenly."""
    arc_mm = np.pi * radius_mm
    s, z = np.meshgrid(
        np.arange(-flank_mm - arc_mm / 2, flank_mm + arc_mm / 2, pitch_mm),
        np.arange(0.0, length_mm, pitch_mm),
    )
    turn = np.clip(s / radius_mm, -np.pi / 2, np.pi / 2)
    back = np.maximum(np.abs(s) - arc_mm / 2, 0.0)
    normals = np.stack([np.cos(turn), np.sin(turn), 0.0 * z], axis=-1)
    points = radius_mm * normals + np.stack([-back, 0.0 * s, z], axis=-1)
    return points.reshape(-1, 3), normals.reshape(-1, 3)


@pytest.mark.parametrize("radius_mm", [0.05, 0.1, 0.5])
@pytest.mark.parametrize("seed", range(4))
def test_an_edge_thinner_than_its_points_lie_apart_keeps_its_two_sides(radius_mm: float, seed: int) -> None:
    points, normals = edge(radius_mm, 1.5, 0.15, 6.0)
    lost, lost_normals = edge(radius_mm + 0.1, 1.5, 0.1, 6.0)
    given = normals * np.random.default_rng(seed).choice([-1.0, 1.0], len(normals))[:, None]
    sign = outward_sign(points, given, lost, lost_normals)
    assert np.mean((sign[:, None] * given * normals).sum(axis=1) > 0.0) > 0.97


def test_what_sees_the_lost_skin_only_edge_on_is_refused() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3)) * [1.0, 1.0, 0.0]
    around = np.column_stack([3.0 * np.cos(turn), 3.0 * np.sin(turn), 0.0 * turn])
    with pytest.raises(CannotRepair, match="which side"):
        outward_sign(points, np.tile([0.0, 0.0, 1.0], (200, 1)), around, around / 3.0)
