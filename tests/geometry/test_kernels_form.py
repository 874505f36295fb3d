"""Local smooth motions and their blend against slow twins."""

import numpy as np
from scipy.spatial import cKDTree

from geometry.kernels.form import blend, local_fits
from geometry.kernels.neighbours import cell_index, counting_sort


def rows(offset_mm, normals):
    return np.column_stack([normals, np.cross(offset_mm, normals), np.ones(len(normals)), offset_mm])


def slow_fit(node, points, normals, values, steps, ridge):
    offset = points - node
    apart = np.linalg.norm(offset, axis=1)
    closeness = np.exp(-4.5 * (apart / apart.max()) ** 2)
    design, weights = rows(offset, normals), closeness
    for _ in range(steps):
        weighted = (design * weights[:, None]).T
        motion = np.linalg.solve(weighted @ design + ridge * len(points) * np.eye(10), weighted @ values)
        residual = values - design @ motion
        scale = max(1.4826 * np.median(np.abs(residual)), 1e-6)
        weights = closeness * np.maximum(1.0 - (residual / (4.685 * scale)) ** 2, 0.0) ** 2
    return motion


def surface(rng, count):
    points = rng.uniform([-20, -10, 0], [20, 10, 60], (count, 3))
    points[:, 1] = 0.02 * points[:, 0] ** 2 + np.sign(points[:, 1])
    normals = np.column_stack([-0.04 * points[:, 0], np.ones(count), np.zeros(count)])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_local_fits_match_their_slow_twin():
    rng = np.random.default_rng(1)
    points, normals = surface(rng, 600)
    values = 0.05 * np.sin(0.2 * points[:, 0]) + rng.normal(scale=0.01, size=600)
    values[::17] += 0.5
    nodes = points[::60].copy()
    members = cKDTree(points).query(nodes, 50)[1].astype(np.int64)
    fast = local_fits(nodes, members, points, normals, values, 4, 1e-3)
    slow = [
        slow_fit(node, points[m], normals[m], values[m], 4, 1e-3)
        for node, m in zip(nodes, members, strict=True)
    ]
    assert np.allclose(fast, slow, atol=1e-10)


def test_the_blend_matches_a_tree_wherever_a_point_lies():
    rng = np.random.default_rng(2)
    nodes, node_normals = surface(rng, 200)
    fits = rng.normal(size=(200, 10))
    points, normals = surface(rng, 300)
    points[:5] += [60.0, -30.0, 100.0]  # far outside the nodes
    low, cell = nodes.min(axis=0), 4.0
    cells = ((nodes.max(axis=0) - low) / cell).astype(np.int64) + 1
    starts, order = counting_sort(cell_index(nodes, low, cell, cells), int(cells.prod()))
    visit = rng.permutation(300)
    fast = np.empty(300)
    fast[visit] = blend(
        points, normals, visit, nodes, node_normals, fits, 6, 10.0, order, starts, low, cell, cells
    )
    tree = cKDTree(np.column_stack([nodes, 10.0 * node_normals]))
    apart, near = tree.query(np.column_stack([points, 10.0 * normals]), 6)
    weights = np.maximum(1.0 - (apart / (1.05 * apart[:, -1:] + 1e-9)) ** 2, 0.0) ** 2
    values = [
        [rows((p - nodes[q])[None], n[None])[0] @ fits[q] for q in qs]
        for p, n, qs in zip(points, normals, near, strict=True)
    ]
    assert np.allclose(fast, (weights * values).sum(axis=1) / weights.sum(axis=1), atol=1e-9)
