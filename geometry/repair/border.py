"""How the sound skin meets a patch: step and angle along its border."""

import numpy as np
from scipy.spatial import cKDTree

from geometry.damage.broken import BrokenSurface
from geometry.damage.local_shape import frames_along
from geometry.repair.lost_piece import Piece
from geometry.types import Measurand, Measured, NotMeasured

BORDER_POINTS = 24  # sound points that tell how the skin meets the patch
SAME_FACE = 0.9  # least cosine between places on one face of the part


def border_of(piece: Piece, broken: BrokenSurface) -> tuple[Measured, Measured]:
    """Largest step (mm) and angle (deg) between the patch's outer skin and the sound skin that it meets.

    At each place of the border a plane through the heights of the nearest `BORDER_POINTS` points that are
    clear of the break and on the same face of the part; the step is its height in their middle.
    """
    feet_mm, normals, height_mm = broken.rim.clear_of(broken.points_mm, 2.0 * float(broken.spacing_mm.max()))
    if len(feet_mm) < BORDER_POINTS:
        unseen = NotMeasured(reason=f"{len(feet_mm)} scan points on the sound skin round the patch")
        return unseen, unseen
    _, index = cKDTree(feet_mm).query(piece.border_mm(), np.arange(1, BORDER_POINTS + 1))
    same = np.einsum("ni,nki->nk", normals[index[:, 0]], normals[index]) > SAME_FACE
    off_mm = feet_mm[index] - (np.einsum("nk,nki->ni", same, feet_mm[index]) / same.sum(1)[:, None])[:, None]
    across = np.einsum("nij,nkj->nki", frames_along(normals[index[:, 0]])[:, :2], off_mm)
    inverse = np.linalg.pinv(same[..., None] * np.concatenate([np.ones((*index.shape, 1)), across], axis=2))
    plane = np.einsum("nik,nk->ni", inverse, height_mm[index])
    sigma = broken.sigma_mm * np.linalg.norm(inverse, axis=2)
    slope, slope_sigma = np.linalg.norm(plane[:, 1:], axis=1), np.linalg.norm(sigma[:, 1:], axis=1)
    i, j = int(np.abs(plane[:, 0]).argmax()), int((slope - slope_sigma).argmax())
    return (
        Measurand(name="border_step_mm", value=abs(float(plane[i, 0])), sigma=float(sigma[i, 0]), unit="mm"),
        Measurand(
            name="border_angle_deg",
            value=float(np.rad2deg(np.arctan(slope[j]))),
            sigma=float(np.rad2deg(slope_sigma[j])),
            unit="deg",
        ),
    )
