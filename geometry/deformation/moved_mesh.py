"""The nominal's mesh moved by the fitted fields, and what they say of the form along the way."""

from dataclasses import dataclass

import numpy as np

from geometry.deformation.freeform import swell
from geometry.deformation.ground import Ground
from geometry.deformation.kriging import Wear
from geometry.deformation.offset import Nodes, Offset
from geometry.registration.alignment import Alignment, variance_along
from geometry.types import Bools, Floats, Ints, Measurand, Measured, NotMeasured

CARE = 1.25  # wear need not follow one prior everywhere: so much is its sigma widened where nothing is seen
OPEN = 0.25  # of the ripple's variance left: with less the data hold wear and ripple together


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NodeValues:
    """The twin at the nodes."""

    moved_mm: Floats  # (nodes,) along the normal, from the nominal
    sigma_mm: Floats  # (nodes,)
    held: Bools  # (nodes,)


def at_nodes(wear: Wear, offset: Offset, ground: Ground, places: int) -> NodeValues:
    """Both fields together; where the offset is not held by data the uncertainty of the wear shows."""
    nodes, coarse = offset.nodes, ground.coarse
    open_fraction = np.minimum((offset.sigma_mm / offset.prior_sigma_mm) ** 2, 1.0)
    asked = np.flatnonzero(ground.from_coarse.T @ (open_fraction > OPEN))
    feet = (coarse.points_mm[asked], coarse.normals[asked])
    spread_mm2 = np.zeros(len(coarse.points_mm))
    spread_mm2[asked] = CARE**2 * (wear.sigma_mm(*feet) ** 2 + wear.doubt_mm(*feet, places) ** 2)
    wear_mm2 = np.maximum(ground.from_coarse @ spread_mm2, 0.0)
    return NodeValues(
        moved_mm=wear.freeform.along(nodes.points_mm, nodes.normals) + offset.value_mm,
        sigma_mm=np.sqrt(offset.sigma_mm**2 + ground.bulge_mm**2 + open_fraction * wear_mm2),
        held=offset.held,
    )


def form_deviation(values: NodeValues, nodes: Nodes, alignment: Alignment) -> Measured:
    """Largest |twin - nominal| along the normal where sound points hold it; its sigma includes the pose's."""
    if not values.held.any():
        return NotMeasured(reason="no sound surface")
    worst = int(np.argmax(np.where(values.held, np.abs(values.moved_mm), -1.0)))
    pose_mm2 = variance_along(alignment, nodes.points_mm[worst], nodes.normals[worst])
    return Measurand(
        name="form_deviation",
        value=float(np.abs(values.moved_mm[worst])),
        sigma=float(np.sqrt(values.sigma_mm[worst] ** 2 + pose_mm2)),
        unit="mm",
    )


def at_vertices(
    ground: Ground, wear: Wear, offset: Offset, values: NodeValues
) -> tuple[Floats, Floats, Bools]:
    """Displacement (n, 3), sigma (n,) and support (n,) of the vertices of the refined mesh.

    Where no node is near, off the airfoil, nothing is known but the wear's prior.
    """
    vertices_mm, vertex = ground.refined.mesh.vertices_mm, ground.side_vertex
    normals, carry, count = ground.side_normals, ground.to_sides, len(vertices_mm)
    shift, swelling = wear.freeform.shift(vertices_mm)
    along_mm = swelling[vertex] * swell(normals) + carry @ offset.value_mm
    near = _largest(vertex, np.asarray(carry @ np.ones(carry.shape[1])), count) > 0.5
    variance = np.maximum(carry @ values.sigma_mm**2, float(values.sigma_mm.min()) ** 2)
    sigma_mm = np.sqrt(_largest(vertex, variance, count))
    sigma_mm[~near] = np.linalg.norm([wear.prior.shift_mm, wear.prior.swelling_mm, offset.prior_sigma_mm])
    held = -_largest(vertex, -(carry @ values.held.astype(np.float64)), count) > 0.5
    return shift + _least_move(vertex, normals, along_mm, count), sigma_mm, held & near


def _largest(vertex: Ints, values: Floats, count: int) -> Floats:
    """The largest of the values (k,) that fall on each vertex."""
    result = np.full(count, -np.inf)
    np.maximum.at(result, vertex, values)
    return result


def _least_move(vertex: Ints, normals: Floats, along_mm: Floats, count: int) -> Floats:
    """The shortest move (count, 3) of each vertex that gives every side through it its offset along its
    normal."""
    damping = 1e-2  # of sides that nearly face each other, as at a sharp trailing edge
    moves = along_mm[:count, None] * normals[:count]
    creased, place = np.unique(vertex[count:], return_inverse=True)
    at = np.concatenate([np.arange(len(creased)), place])
    rows = np.concatenate([creased, np.arange(count, len(vertex))])
    system, right = np.zeros((len(creased), 3, 3)), np.zeros((len(creased), 3))
    np.add.at(system, at, normals[rows][:, :, None] * normals[rows][:, None, :])
    np.add.at(right, at, along_mm[rows][:, None] * normals[rows])
    moves[creased] = np.linalg.solve(system + damping * np.eye(3), right[:, :, None])[:, :, 0]
    return moves
