"""The damage-free twin: the nominal deformed non-rigidly onto the sound part of the scan."""

from dataclasses import dataclass

from geometry.types import Bools, Floats, Measured, Mesh


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twin:
    """The blade as it would be today had it not been damaged; same faces as the nominal mesh.

    `sigma_mm` (vertices,): standard uncertainty along the normal, growing into what was not seen.
    `supported` (vertices,): sound scan points vote there; elsewhere the twin is extrapolated.
    `form_mm`: largest |twin - nominal| over the sound required surface.
    """

    mesh: Mesh  # closed, nominal frame
    displacement_mm: Floats  # (vertices, 3)
    sigma_mm: Floats  # (vertices,)
    supported: Bools  # (vertices,)
    form_mm: Measured
    sound_rms_mm: float  # sound scan points against the twin
    iterations: int
    converged: bool
