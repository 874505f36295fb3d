"""The twin beside its peers on one problem, and how its cost grows with the points.

    python -m benchmarks.twin_peers [--full]

Peers: the non-rigid registrations of trimesh after Amberg (2007) and Sumner (2004), at their own settings and
as tuned here for this part, and the thesis' own method. (pymeshlab and MeshLib are no dependencies here and
do not take part.) All get the same nominal vertices, the same 258,520 scan points of section 5.5 with 0.01 mm
of noise along the normal, and the same mask of damage; trimesh's get the points that the mask leaves, for
they take none. trimesh scales a mesh to about one: a threshold of 0.01 is about 1 mm.

Tuned Amberg: stiffness from 0.01 down to 0.0001, no pull of normals, matches within 0.01. Tuned Sumner:
matches within 0.01, weights of data up to 1000. Distances (mm) are those of the vertices on the airfoil's
side to the true undamaged surface: mean of all, where metal is sound, where it is lost; a coarse mesh bears
the sagitta of its facets. CPU seconds are of one thread, with their ratio to the product's. The product is
timed twice: the first part of a part number also prepares what its nominal alone tells, which is then kept;
ratios are to the second, all that every further part costs. Growth is the exponent of the time in the number
of vertices since the size before. Asked: 50 times faster than nricp_amberg at 20,000 vertices, which --full
measures (half an hour).
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import trimesh
from trimesh.registration import nricp_amberg, nricp_sumner

from benchmarks import twin as study
from geometry.blade.nominal import Nominal
from geometry.damage.damages import find_damages
from geometry.deformation.twin import TwinSettings, fit_twin
from geometry.repair.patches import RepairSettings, find_repairs
from geometry.thesis.stiff_twin import ThesisTwinSettings, fit_twin_thesis
from geometry.types import Floats
from tests.geometry import twin_blades as blades
from tests.geometry.poses import in_place

NOISE_MM = 0.01
PITCHES_MM = {2000: 2.9, 5000: 1.65, 10_000: 1.11, 20_000: 0.755}  # of the nominal's mesh, by its vertices
TURN = 0.35  # rad between neighbours round a section, at most
QUICK = (2000, 5000)
SCAN_PITCHES_MM = {50_000: 0.425, 125_000: 0.268, 250_000: 0.19, 500_000: 0.1342, 1_000_000: 0.0949}
FEWER = (50_000, 250_000)

Peer = Callable[[trimesh.Trimesh, trimesh.Trimesh], Floats]

PEERS: dict[str, Peer] = {
    "Amberg, own settings": lambda source, target: nricp_amberg(source, target, use_faces=False),
    "Amberg, tuned": lambda source, target: nricp_amberg(
        source,
        target,
        use_faces=False,
        steps=[[stiffness, 0.0, 0.0, 10] for stiffness in (0.01, 0.002, 0.0005, 0.0001)],
        distance_threshold=0.01,
        eps=1e-5,
    ),
    "Sumner, own settings": lambda source, target: nricp_sumner(source, target, use_faces=False),
    "Sumner, tuned": lambda source, target: nricp_sumner(
        source,
        target,
        use_faces=False,
        steps=[[data, 0.001, 1.0, 0, 0] for data in (1.0, 10.0, 100.0, 1000.0)],
        distance_threshold=0.01,
    ),
}


def seconds(make: Callable[[], Floats]) -> tuple[Floats, float]:
    start_s = time.process_time()
    moved_mm = make()
    return moved_mm, time.process_time() - start_s


def product(known: study.Case, nominal: Nominal) -> Floats:
    """The nominal's vertices where the product's twin has them."""
    twin = fit_twin(known.cloud, known.broken, in_place(), nominal, TwinSettings())
    return at_nominal(twin.mesh.vertices_mm, nominal)


def thesis(known: study.Case, nominal: Nominal) -> Floats:
    """The same of the thesis' twin, with as many nodes as the mesh has vertices."""
    settings = ThesisTwinSettings(nodes=len(nominal.mesh.vertices_mm))
    twin = fit_twin_thesis(known.cloud, known.broken, in_place(), nominal, settings)
    return at_nominal(twin.mesh.vertices_mm, nominal)


def at_nominal(vertices_mm: Floats, nominal: Nominal) -> Floats:
    """A refined mesh keeps the vertices of the nominal first."""
    return vertices_mm[: len(nominal.mesh.vertices_mm)]


def compare(
    pitch_mm: float, known: study.Case, before: dict[str, tuple[int, float]]
) -> dict[str, tuple[int, float]]:
    """Print all methods on one mesh; returns its size and each time. `before`: those of the size before."""
    nominal = study.nominal_of(pitch_mm, TURN)
    vertices_mm, faces = nominal.mesh.vertices_mm, nominal.mesh.faces
    target = trimesh.Trimesh(known.cloud.points_mm[~known.broken], np.zeros((0, 3), int), process=False)
    methods: dict[str, Callable[[], Floats]] = {
        "bladecell, 1st part": lambda: product(known, nominal),
        "bladecell": lambda: product(known, nominal),
        "thesis": lambda: thesis(known, nominal),
    }
    for name, peer in PEERS.items():
        source = trimesh.Trimesh(vertices_mm, faces, process=False)
        methods[name] = partial(peer, source, target)
    show("nominal", vertices_mm, 0.0, 1.0, known, nominal)
    spent = {}
    for name, method in methods.items():
        moved_mm, spent_s = seconds(method)
        spent[name] = (len(vertices_mm), spent_s)
        product_s = spent.get("bladecell", spent[name])[1]
        show(name, moved_mm, spent_s, product_s, known, nominal, growth(spent[name], before.get(name)))
    return spent


def growth(now: tuple[int, float], before: tuple[int, float] | None) -> str:
    """The exponent of time in size between two (size, seconds)."""
    if before is None:
        return ""
    return f"{np.log(now[1] / before[1]) / np.log(now[0] / before[0]):6.2f}"


def show(
    name: str,
    moved_mm: Floats,
    spent_s: float,
    product_s: float,
    known: study.Case,
    nominal: Nominal,
    grown: str = "",
) -> None:
    """One line of the table."""
    before_mm = nominal.mesh.vertices_mm
    side = (before_mm[:, 2] > nominal.z_min_mm) & (before_mm[:, 2] < blades.SPAN_MM - 1e-3)
    off_mm, lost = np.abs(known.truth.distance(moved_mm[side])), study.gone(known, before_mm[side])
    means = " ".join(f"{off.mean():8.4f}" for off in (off_mm, off_mm[~lost], off_mm[lost]))
    ratio = spent_s / product_s
    print(f"{len(before_mm):8d}  {name:20} {means} {spent_s:8.2f} {ratio:6.1f}x {grown}", flush=True)


def cost(pitch_mm: float, nominal: Nominal) -> None:
    """One line: seconds of twin, damage and repair for a scan of this spacing."""
    known = study.case(blades.SHAPES["service"], pitch_mm, NOISE_MM, 1)
    marks_s = [time.process_time()]
    twin = fit_twin(known.cloud, known.broken, in_place(), nominal, TwinSettings())
    marks_s.append(time.process_time())
    damages = find_damages(known.cloud, known.broken, in_place(), nominal, twin)
    marks_s.append(time.process_time())
    find_repairs(twin, known.cloud, in_place(), damages, RepairSettings())
    marks_s.append(time.process_time())
    each_us = 1e6 * (marks_s[-1] - marks_s[0]) / len(known.cloud)
    spent = " ".join(f"{s:7.2f}" for s in np.diff(marks_s))
    print(f"{len(known.cloud):8d} {spent} {marks_s[-1] - marks_s[0]:7.2f} {each_us:9.1f}", flush=True)


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--full", action="store_true", help="to 20,000 vertices and a million points")
    full = options.parse_args().full
    known = study.case(blades.SHAPES["service"], study.PITCH_MM, NOISE_MM, 1, study.POINTS)
    warm = study.nominal_of(3.0, TURN)
    small = study.case(blades.SHAPES["service"], 1.0, NOISE_MM, 0)
    product(small, warm)
    thesis(small, warm)
    print(
        f"{'vertices':>8}  {'method':20} {'all':>8} {'sound':>8} {'lost':>8} {'CPU s':>8} {'ratio':>7} growth"
    )
    before: dict[str, tuple[int, float]] = {}
    for size, pitch_mm in PITCHES_MM.items():
        if full or size in QUICK:
            before = compare(pitch_mm, known, before)
    print(f"\n{'points':>8} {'twin':>7} {'damage':>7} {'repair':>7} {'all s':>7} {'us a point':>10}")
    fine = study.nominal_of(0.7, 0.12)
    product(known, fine)  # prepares it
    for points, pitch_mm in SCAN_PITCHES_MM.items():
        if full or points in FEWER:
            cost(pitch_mm, fine)


if __name__ == "__main__":
    main()
