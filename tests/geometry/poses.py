"""Alignments that nothing was registered for: the scan was made where the nominal is, or turned by hand."""

import numpy as np

from geometry.registration.alignment import Alignment
from geometry.types import Floats


def in_place(
    T: Floats | None = None, pivot_z_mm: float = 0.0, information: Floats | None = None
) -> Alignment:
    """The alignment `T`, by default that of a scan in the nominal frame, all but certain unless told."""
    return Alignment(
        method="airfoil",
        T_nominal_scan=np.eye(4) if T is None else T,
        pivot_mm=np.array([0.0, 0.0, pivot_z_mm]),
        information=np.eye(6) * 1e8 if information is None else information,
        weak_directions=(),
        rms_mm=0.01,
        noise_mm=0.01,
        inlier_fraction=1.0,
        explained_fraction=1.0,
        runner_up_ratio=5.0,
        iterations=1,
        converged=True,
    )
