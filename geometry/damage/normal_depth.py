"""How deep a damage of a side is: normal to the twin, from the skin that was lost."""

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.damage.regions import Field, Region
from geometry.damage.skin import Skin
from geometry.deformation.twin import Twin
from geometry.types import Floats, Ints, Measurand, Mesh

BORDERING = 1.5  # spacings from lost skin within which its break begins
ON_SKIN = 5.0  # sigmas of a point within which it lies on the twin: of many, none strays farther
LEAST = 6  # neighbours of a place that tell how deep it is
A_SIDE = 0.1  # of the lost skin that makes it a side of its own: metal that is gone from both is pierced


def normal_depth(region: Region, found: Field, nominal: Nominal, twin: Twin) -> Measurand:
    """The largest distance normal to the twin, from the lost skin where metal is missing: below half of the
    metal's thickness the skin of its other side is nearer.

    The mean over a neighbourhood tells where the bottom is, and flattens it; how deep it is tells the quadric
    through the points around.
    """
    height_mm = _heights(region, found, nominal, twin)
    near = found.neighbours[region.points]
    of_it = (near >= 0) & np.isfinite(height_mm[near])
    mean_mm = np.ma.masked_array(height_mm[near], ~of_it).mean(axis=1).filled(0.0)
    place = int(np.argmax(np.abs(mean_mm) * (of_it.sum(axis=1) >= LEAST)))
    deepest, around = region.points[place], near[place][of_it[place]]
    off_mm = found.scan_mm[around] - found.scan_mm[deepest]
    across, along = np.linalg.eigh(off_mm.T @ off_mm)[1][:, :0:-1].T
    depth_mm = np.abs(height_mm[around])
    fitted_mm, sagitta_mm = _bottom(off_mm @ across, off_mm @ along, depth_mm, found.spacing_mm)
    scatter_mm = float(np.std(depth_mm - fitted_mm))
    sigma_mm = float(np.linalg.norm([found.sigma_mm[deepest], 0.5 * scatter_mm, sagitta_mm]))
    return Measurand(name="depth", value=float(fitted_mm.max()), sigma=sigma_mm, unit="mm")


def _heights(region: Region, found: Field, nominal: Nominal, twin: Twin) -> Floats:
    """Signed distances (n,) of the scan points to the twin, those of a break to the skin that it has lost.

    Where both sides are gone that is the farther one: a hole is as deep as the metal is thick. Of sound skin
    under lost skin, on the other side of the metal, there is none: NaN.
    """
    if not (region.missing and len(region.lost)):
        return found.height_mm
    height_mm = found.height_mm.copy()
    about = np.unique(found.neighbours[region.points])
    about = about[about >= 0]
    points_mm, clear_mm = found.scan_mm[about], ON_SKIN * found.noise_mm
    inside = np.isin(about, region.points)
    broken = inside & (np.abs(found.height_mm[about]) > clear_mm)
    face, sample = _faces_over(region.lost, found, twin)
    for side in _sides(region.lost, nominal):
        own = face[np.isin(sample, side)]
        if not len(own):
            continue
        skin = Skin(Mesh(vertices_mm=twin.mesh.vertices_mm, faces=twin.mesh.faces[own]))
        apart_mm, feet_mm, foot = skin.closest(points_mm)
        if np.abs(apart_mm[inside]).min() <= BORDERING * found.spacing_mm:  # else it was not seen
            inward_mm = ((points_mm - feet_mm) * skin.normals[foot]).sum(axis=1)
            height_mm[about[broken]] = np.minimum(height_mm[about], inward_mm)[broken]
            height_mm[about[~broken & (inward_mm < -clear_mm)]] = np.nan
    return height_mm


def _sides(lost: Ints, nominal: Nominal) -> list[Ints]:
    """The lost samples, those apart that look opposite ways, a few of them left out."""
    normals, area_mm2 = nominal.samples.normals[lost], nominal.samples.area_mm2[lost]
    axis = np.linalg.eigh((normals * area_mm2[:, None]).T @ normals)[1][:, -1]
    above = normals @ axis > 0.0
    return [lost[side] for side in (above, ~above) if area_mm2[side].sum() > A_SIDE * area_mm2.sum()]


def _faces_over(lost: Ints, found: Field, twin: Twin) -> tuple[Ints, Ints]:
    """The faces of the twin about the lost samples, and the sample that is nearest to each."""
    low_mm, high_mm = found.skin_mm[lost].min(axis=0), found.skin_mm[lost].max(axis=0)
    middle_mm = twin.mesh.vertices_mm[twin.mesh.faces].mean(axis=1)
    boxed = np.flatnonzero(((middle_mm >= low_mm - 1.0) & (middle_mm <= high_mm + 1.0)).all(axis=1))
    return boxed, np.asarray(cKDTree(found.skin_mm).query(middle_mm[boxed])[1])


def _bottom(u_mm: Floats, v_mm: Floats, depth_mm: Floats, spacing_mm: float) -> tuple[Floats, float]:
    """Depths (n,) on the full quadric through points, and how far it bends from one point to the next."""
    terms = np.stack([np.ones_like(u_mm), u_mm, v_mm, u_mm**2, u_mm * v_mm, v_mm**2], axis=1)
    coefficients = np.linalg.lstsq(terms, depth_mm, rcond=1e-6)[0]
    bend_per_mm = np.linalg.norm(
        [2.0 * coefficients[3], 2.0 * coefficients[5], np.sqrt(2.0) * coefficients[4]]
    )
    return np.asarray(terms @ coefficients), float(bend_per_mm) * spacing_mm**2 / np.sqrt(8.0)
