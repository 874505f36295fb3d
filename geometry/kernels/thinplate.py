"""Scattered nodes on a surface: thinning, neighbours, interpolation weights and bending rows.

Two surface points differ by rho^2 = |dx|^2 / spacing^2 + |dn|^2 / TURN^2, position and normal together: nodes
crowd where the surface turns, and the two sides of a thin edge are never neighbours.
"""

import numpy as np
from numba import njit

from geometry.types import Bools, Floats, Ints

TURN = 0.75  # length of a difference of unit normals that counts as one spacing


@njit(cache=True, nogil=True, inline="always")
def _rho2(points, normals, i, others, other_normals, j, spacing):  # type: ignore[no-untyped-def]
    away, turned = 0.0, 0.0
    for axis in range(3):
        dx = points[i, axis] - others[j, axis]
        dn = normals[i, axis] - other_normals[j, axis]
        away += dx * dx
        turned += dn * dn
    return away / (spacing * spacing) + turned / (TURN * TURN)


@njit(cache=True, nogil=True, inline="always")
def _cell(point, low, edge, cells, out):  # type: ignore[no-untyped-def]
    for axis in range(3):
        out[axis] = min(max(int(np.floor((point[axis] - low[axis]) / edge)), 0), cells[axis] - 1)


@njit(cache=True, nogil=True)
def thin(points: Floats, normals: Floats, spacing: float, low: Floats, cells: Ints) -> Bools:
    """Flags (n,) of points of which no two are nearer than rho = 1, taken greedily in the order given.

    `cells` cubes of edge `spacing` from `low` cover the points.
    """
    kept = np.zeros(len(points), np.bool_)
    head = np.full(cells[0] * cells[1] * cells[2], -1, np.int64)
    following = np.full(len(points), -1, np.int64)
    at = np.empty(3, np.int64)
    for i in range(len(points)):
        _cell(points[i], low, spacing, cells, at)
        free = True
        for a in range(max(at[0] - 1, 0), min(at[0] + 2, cells[0])):
            for b in range(max(at[1] - 1, 0), min(at[1] + 2, cells[1])):
                for c in range(max(at[2] - 1, 0), min(at[2] + 2, cells[2])):
                    j = head[(a * cells[1] + b) * cells[2] + c]
                    while j >= 0 and free:
                        free = _rho2(points, normals, i, points, normals, j, spacing) >= 1.0
                        j = following[j]
        if free:
            kept[i] = True
            own = (at[0] * cells[1] + at[1]) * cells[2] + at[2]
            following[i] = head[own]
            head[own] = i
    return kept


@njit(cache=True, nogil=True)
def within(
    points: Floats,
    normals: Floats,
    nodes: Floats,
    node_normals: Floats,
    order: Ints,
    starts: Ints,
    low: Floats,
    cells: Ints,
    spacing: float,
    reach: float,
    width: int,
) -> tuple[Ints, Floats]:
    """Up to `width` nodes (n, width; -1 none) within rho < `reach` of each point and their rho (n, width).

    Where there are more the nearest are taken. `order` and `starts` list the nodes by cubic cells of edge
    reach x spacing from `low`.
    """
    found = np.full((len(points), width), -1, np.int64)
    rho = np.full((len(points), width), np.inf)
    at = np.empty(3, np.int64)
    edge, limit = reach * spacing, reach * reach
    for i in range(len(points)):
        _cell(points[i], low, edge, cells, at)
        count = 0
        for a in range(max(at[0] - 1, 0), min(at[0] + 2, cells[0])):
            for b in range(max(at[1] - 1, 0), min(at[1] + 2, cells[1])):
                row = (a * cells[1] + b) * cells[2]
                first, last = starts[row + max(at[2] - 1, 0)], starts[row + min(at[2] + 2, cells[2])]
                for q in range(first, last):
                    j = order[q]
                    r2 = _rho2(points, normals, i, nodes, node_normals, j, spacing)
                    if r2 >= limit or (count == width and r2 >= rho[i, width - 1]):
                        continue
                    t = min(count, width - 1)
                    while t > 0 and rho[i, t - 1] > r2:
                        rho[i, t], found[i, t] = rho[i, t - 1], found[i, t - 1]
                        t -= 1
                    rho[i, t], found[i, t] = r2, j
                    count = min(count + 1, width)
        for t in range(count):
            rho[i, t] = np.sqrt(rho[i, t])
    return found, rho


@njit(cache=True, nogil=True)
def _unroll(origin: Floats, frame: Floats, node: Floats, node_normal: Floats) -> tuple[float, float]:
    """Tangent coordinates of a node, at the arc length that its chord and the turn of the normal make."""
    u, v, chord2, cosine = 0.0, 0.0, 0.0, 0.0
    for axis in range(3):
        d = node[axis] - origin[axis]
        u += d * frame[0, axis]
        v += d * frame[1, axis]
        chord2 += d * d
        cosine += frame[2, axis] * node_normal[axis]
    flat = np.sqrt(u * u + v * v)
    if flat == 0.0:
        return 0.0, 0.0
    half = 0.5 * np.arccos(min(max(cosine, -1.0), 1.0))
    bend = half / np.sin(half) if half > 1e-4 else 1.0
    stretch = np.sqrt(chord2) * bend / flat
    return u * stretch, v * stretch


@njit(cache=True, nogil=True)
def _frame(normal: Floats, frame: Floats) -> None:
    """Fill `frame` with two tangents and the normal, rows."""
    least = 0
    for axis in range(3):
        frame[2, axis] = normal[axis]
        if abs(normal[axis]) < abs(normal[least]):
            least = axis
    length = 0.0
    for axis in range(3):
        frame[0, axis] = (1.0 if axis == least else 0.0) - normal[least] * normal[axis]
        length += frame[0, axis] ** 2
    for axis in range(3):
        frame[0, axis] /= np.sqrt(length)
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        frame[1, axis] = frame[2, b] * frame[0, c] - frame[2, c] * frame[0, b]


@njit(cache=True, nogil=True)
def linear_weights(
    points: Floats,
    normals: Floats,
    nodes: Floats,
    node_normals: Floats,
    found: Ints,
    rho: Floats,
    reach: float,
) -> Floats:
    """Weights (n, width) that interpolate a linear function of the unrolled surface from the nodes found.

    Moving least squares of degree 1 under (1 - (rho / reach)^2)^2; rows sum to 1, or to 0 without nodes.
    """
    weights = np.zeros(found.shape)
    frame = np.empty((3, 3))
    width = found.shape[1]
    u, v, w = np.empty(width), np.empty(width), np.empty(width)
    for i in range(len(points)):
        _frame(normals[i], frame)
        m00, m01, m02, m11, m12, m22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        count = 0
        while count < width and found[i, count] >= 0:
            j = found[i, count]
            u[count], v[count] = _unroll(points[i], frame, nodes[j], node_normals[j])
            w[count] = (1.0 - (rho[i, count] / reach) ** 2) ** 2 + 1e-9
            m00 += w[count]
            m01 += w[count] * u[count]
            m02 += w[count] * v[count]
            m11 += w[count] * u[count] * u[count]
            m12 += w[count] * u[count] * v[count]
            m22 += w[count] * v[count] * v[count]
            count += 1
        if count == 0:
            continue
        ridge = 1e-3 * (m11 + m22) + 1e-30  # too few nodes, or nodes in line: falls back on their mean
        m11 += ridge
        m22 += ridge
        det = m11 * m22 - m12 * m12
        a, b = (m01 * m22 - m02 * m12) / det, (m02 * m11 - m01 * m12) / det
        total = m00 - a * m01 - b * m02
        for t in range(count):
            weights[i, t] = w[t] * (1.0 - a * u[t] - b * v[t]) / total
    return weights


@njit(cache=True, nogil=True)
def bending_rows(nodes: Floats, normals: Floats, found: Ints, rho: Floats, reach: float) -> Floats:
    """Rows (n, 3, width) that give s_uu, sqrt(2) s_uv, s_vv at each node from the nodes found, itself
    among them.

    A quadric through the node's own value is fitted to its neighbours by weighted least squares over the
    unrolled surface. Zero rows where the neighbours do not determine one.
    """
    count, width = found.shape
    rows = np.zeros((count, 3, width))
    frame, normal_matrix = np.empty((3, 3)), np.empty((5, 5))
    basis = np.empty((width, 5))
    w = np.empty(width)
    scales = np.array([2.0, np.sqrt(2.0), 2.0])
    for i in range(count):
        _frame(normals[i], frame)
        normal_matrix[:] = 0.0
        used, own, size = 0, -1, 0.0
        while used < width and found[i, used] >= 0:
            j = found[i, used]
            if j == i:
                own = used
                basis[used, :] = 0.0
                w[used] = 0.0
            else:
                u, v = _unroll(nodes[i], frame, nodes[j], normals[j])
                size = max(size, np.sqrt(u * u + v * v))
                basis[used, 0], basis[used, 1] = u, v
                w[used] = (1.0 - (rho[i, used] / reach) ** 2) ** 2
            used += 1
        if own < 0 or used < 7:
            continue
        for t in range(used):
            u, v = basis[t, 0] / size, basis[t, 1] / size
            basis[t, 0], basis[t, 1], basis[t, 2], basis[t, 3], basis[t, 4] = u, v, u * u, u * v, v * v
            for a in range(5):
                for b in range(5):
                    normal_matrix[a, b] += w[t] * basis[t, a] * basis[t, b]
        for a in range(5):
            normal_matrix[a, a] *= 1.0 + 1e-6
            normal_matrix[a, a] += 1e-12
        inverse = np.linalg.inv(normal_matrix)
        for m in range(3):
            for t in range(used):
                if t == own:
                    continue
                value = 0.0
                for a in range(5):
                    value += inverse[2 + m, a] * basis[t, a]
                value *= w[t] * scales[m] / (size * size)
                rows[i, m, t] = value
                rows[i, m, own] -= value
    return rows


@njit(cache=True, nogil=True)
def back_substitute(bands: Floats, right: Floats) -> Floats:
    """The solutions (n, k) of L^T x = right (n, k); `bands` (n, width) holds the columns of the lower L, each
    from its diagonal down."""
    count, width = bands.shape
    values = right.copy()
    for i in range(count - 1, -1, -1):
        row = values[i]
        for below in range(1, min(width, count - i)):
            factor = bands[i, below]
            if factor != 0.0:
                other = values[i + below]
                for k in range(len(row)):
                    row[k] -= factor * other[k]
        for k in range(len(row)):
            row[k] /= bands[i, 0]
    return values
