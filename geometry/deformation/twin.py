"""The damage-free twin: the nominal deformed non-rigidly onto the sound part of the scan."""

from dataclasses import dataclass

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.deformation.freeform import Freeform
from geometry.deformation.ground import Ground, prepare_ground
from geometry.deformation.kriging import Sample, Wear, fit_wear, likeliest_prior, sample_of, typical_prior
from geometry.deformation.moved_mesh import at_nodes, at_vertices, form_deviation
from geometry.deformation.offset import Offset, fit_offset
from geometry.deformation.votes import (
    NO_NOISE_MM,
    Found,
    binned,
    compare,
    gather,
    ripple_mm,
    screen,
    skin_at_rims,
)
from geometry.errors import CannotFitTwin
from geometry.kernels.neighbours import near_each_other
from geometry.registration.alignment import Alignment
from geometry.robust import TUKEY, biweight, spread
from geometry.threads import one_blas_thread
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Ints, Measured, Mesh

LOOSE_ROUNDS = 2  # at first more stands out than damage: form that the field has not taken up yet
SETTLED = 0.995  # of the sound points stay where they are
HELD = 0.2  # of the usual number of points makes a place trusted
EVERY = 2  # a round fits every other place
RIPPLE_CELLS = 0.5  # of the lattice, over which ripple is alike
FACETS = 0.01  # of `damage_mm`: the nominal's facets and normals are no better


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinSettings:
    """Where damage begins, and how fine the fit is.

    Form is smooth wear, whose reach the scan itself tells, plus ripples shallower than `damage_mm`; what
    stands out of the smooth fit by more is damage, and does not shape the twin.
    """

    cells: int = 400  # of the lattice over the airfoil's box that carries the wear
    rounds: int = 8  # of the fit of the wear, at most
    points: int = 30_000  # subsample of those rounds
    places: int = 400  # of those, on the surface, whose displacements tell how far wear reaches
    damage_mm: float = 0.03
    nodes: int = 9000  # of the offset field; its spacing follows from the airfoil's area
    draws: int = 64  # posterior draws behind the sigmas
    min_supported: float = 0.3  # of the airfoil's area; with less under sound points there is no twin
    seed: int = 0  # of the subsample and the draws


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twin:
    """The blade as it would be today had it not been damaged: the nominal mesh, long edges halved, deformed.

    `sigma_mm` (vertices,): standard uncertainty along the normal, growing into what was not seen.
    `supported` (vertices,): sound scan points vote there; elsewhere the twin is extrapolated.
    `form_mm`: largest |twin - nominal| over the sound required surface.
    """

    mesh: Mesh  # closed, nominal frame
    nominal_face: Ints  # (faces,) the nominal's face that each face lies on, ascending
    displacement_mm: Floats  # (vertices, 3)
    sigma_mm: Floats  # (vertices,)
    supported: Bools  # (vertices,)
    form_mm: Measured
    sound: Bools  # (scan points,) shaped the twin
    noise_mm: float  # scatter of the sound points about the surface, one standard deviation
    sound_rms_mm: float  # sound scan points against the twin
    iterations: int
    converged: bool


@one_blas_thread
def fit_twin(
    cloud: Cloud, mask: Bools, alignment: Alignment, nominal: Nominal, settings: TwinSettings
) -> Twin:
    """The twin of a scan, in the nominal frame.

    `mask` (points,) is True where the registration saw damage; it starts the fit, which then judges
    what stands out. Two steps: smooth wear moves and swells the airfoil as a whole and runs on over what is
    missing; an offset along the normal takes up the ripple where it is seen.
    Raises `CannotFitTwin` when sound points do not hold enough of the airfoil.
    """
    scan_mm = apply(alignment.T_nominal_scan, cloud.points_mm)
    order = near_each_other(scan_mm)  # what is asked together then lies in the cache
    scan_mm, mask, point_sigma_mm = scan_mm[order], mask[order], cloud.sigma_mm[order]
    rng = np.random.default_rng(settings.seed)
    ground = prepare_ground(nominal, min(settings.nodes, max(len(cloud) // 4, 100)), settings.cells)
    rough, rounds, converged = _fit_rounds(scan_mm, mask, ground, settings, rng)
    found = compare(scan_mm, rough.freeform, ground)
    near_damage = screen(found, ground, settings.damage_mm, 0)  # what is there tells most of what is lost
    skin = skin_at_rims(scan_mm, near_damage, found, ground.nodes, settings.damage_mm)
    sample = _sample(found, skin, rough, settings.damage_mm, settings.damage_mm, ground)
    prior = likeliest_prior(sample, rough.prior, ground.lattice, settings.places)
    wear = fit_wear(sample, prior, ground.lattice)
    change = wear.freeform.since(rough.freeform)
    sound = screen(found.after(change, ground.nodes), ground, settings.damage_mm, 1)
    offset, noise_mm, rms_mm = _fit_ripple(found, change, sound, point_sigma_mm, ground, settings, rng)
    values = at_nodes(wear, offset, ground, settings.places)
    displacement_mm, sigma_mm, supported = at_vertices(ground, wear, offset, values)
    return Twin(
        mesh=Mesh(
            vertices_mm=ground.refined.mesh.vertices_mm + displacement_mm, faces=ground.refined.mesh.faces
        ),
        nominal_face=ground.refined.parent,
        displacement_mm=displacement_mm,
        sigma_mm=sigma_mm,
        supported=supported,
        form_mm=form_deviation(values, ground.nodes, alignment),
        sound=sound[np.argsort(order)],
        noise_mm=noise_mm,
        sound_rms_mm=rms_mm,
        iterations=rounds,
        converged=converged,
    )


def _fit_rounds(
    scan_mm: Floats, mask: Bools, ground: Ground, settings: TwinSettings, rng: np.random.Generator
) -> tuple[Wear, int, bool]:
    """The wear that moves the nominal onto a part of the points, the rounds it took, and whether it settled.

    Each round compares, screens and solves; the wear, its prior and what it leaves out settle together.
    """
    chosen = rng.permutation(len(scan_mm))[: settings.points]
    points_mm = scan_mm[chosen]
    found = compare(points_mm, None, ground)
    sound = found.usable & ~mask[chosen]
    before_mm = np.zeros(len(ground.nodes.points_mm))
    prior = typical_prior(ground.lattice)
    wear: Wear | None = None
    for rounds in range(1, settings.rounds + 1):
        loose_mm = settings.damage_mm * max(1, LOOSE_ROUNDS + 1 - rounds)
        sample = _sample(found, sound, wear, loose_mm, settings.damage_mm, ground, settling=True)
        if rounds == LOOSE_ROUNDS:  # the first tells where the blade is, not yet how it is worn
            prior = likeliest_prior(sample, prior, ground.lattice, settings.places // 2)
        wear = fit_wear(sample, prior, ground.lattice)
        after_mm = wear.freeform.along(ground.nodes.points_mm, ground.nodes.normals)
        moved_mm = np.abs(after_mm - before_mm)[found.owner[sound]]  # beyond, only the last fit matters
        if rounds > LOOSE_ROUNDS and settled(moved_mm, settings.damage_mm):
            return wear, rounds, True
        before_mm = after_mm
        found = compare(points_mm, wear.freeform, ground)
        sound = screen(found, ground, loose_mm, 0)
    if wear is None:
        raise CannotFitTwin("no round was allowed")
    return wear, settings.rounds, False


def settled(moved_mm: Floats, damage_mm: float) -> bool:
    """Whether a round moved hardly any of the sound points (n,): a place at a rim that comes and goes would
    do so for ever, and tells next to nothing."""
    most_mm = float(np.quantile(moved_mm, SETTLED)) if len(moved_mm) else 0.0
    return most_mm <= 0.2 * damage_mm and float(moved_mm.max(initial=0.0)) <= damage_mm


def _sample(
    found: Found,
    sound: Bools,
    before: Wear | None,
    loose_mm: float,
    damage_mm: float,
    ground: Ground,
    settling: bool = False,
) -> Sample:
    """The displacements that the means of the sound points show; those that stand out count for less.

    While rounds are `settling` only some of the coarse nodes are asked, always the same ones, so that rounds
    compare; and those that few points hold count for little, else one point more or less, which the next
    round takes back, keeps them from settling.

    While the free form is off, feet lie aside by about as much, and where the surface bends that reads as
    metal lost: such places count for little until it fits.
    """
    votes = gather(found, sound, ground.coarse_of[found.owner], ground.coarse)  # what is sound has an owner
    residual_mm, goal_mm = votes.along_mm, votes.along_mm
    if before is not None:
        goal_mm = residual_mm + before.freeform.along(votes.centre_mm, votes.normals)
    share_mm2 = votes.noise_mm**2 / np.maximum(votes.count, 1.0)
    usual = float(np.median(votes.count[votes.count > 0.0]))
    least = max(1.0, HELD * usual)  # fewer lie on the rim of a break, and shallow on it
    some = votes.count >= least
    misfit_mm2 = max(spread(residual_mm[some]) ** 2 - float(np.median(share_mm2[some])), NO_NOISE_MM**2)
    aside_mm2 = (0.5 * votes.bend_per_mm * misfit_mm2) ** 2
    weight = biweight(
        residual_mm, TUKEY * np.sqrt(misfit_mm2 + share_mm2 + aside_mm2 + (0.5 * loose_mm) ** 2)
    )
    asked = some
    if settling:
        weight *= np.clip(votes.count / least - 1.0, 0.0, 1.0)
        asked = some & (np.arange(len(some)) % EVERY == 0)
    held = asked & (weight > 1e-3)
    variance_mm2 = (share_mm2 + aside_mm2 + (FACETS * damage_mm) ** 2)[held] / weight[held]
    return sample_of(ground.lattice, votes.centre_mm[held], votes.normals[held], goal_mm[held], variance_mm2)


def _fit_ripple(
    found: Found,
    change: Freeform,
    sound: Bools,
    sigma_mm: Floats,
    ground: Ground,
    settings: TwinSettings,
    rng: np.random.Generator,
) -> tuple[Offset, float, float]:
    """The offset field that the sound points ask for, their scatter, and what it leaves, root mean square.

    The points were compared before the last `change` of the free form; each counts by its own sigma.
    """
    votes = gather(found.after(change, ground.nodes), sound, found.owner, ground.nodes)
    relative = sigma_mm[sound] / float(np.median(sigma_mm[sound]))
    bins = binned(found, sound, votes.noise_mm * relative, ground.nodes)
    offset = fit_offset(
        ground.plate,
        bins.feet_mm,
        bins.normals,
        bins.along_mm - change.along(bins.feet_mm, bins.normals),
        bins.sigma_mm,
        bins.count,
        prior_sigma_mm=ripple_mm(votes, ground.graph),
        length_mm=RIPPLE_CELLS * ground.lattice.cell_mm,
        draws=settings.draws,
        rng=rng,
    )
    supported = float(offset.nodes.area_mm2[offset.held].sum() / offset.nodes.area_mm2.sum())
    if not supported >= settings.min_supported:
        raise CannotFitTwin(f"sound points hold {supported:.0%} of the airfoil")
    left_mm2 = bins.scatter_mm2 + float(np.average(offset.misfit_mm**2, weights=bins.count))
    return offset, votes.noise_mm, float(np.sqrt(left_mm2))
