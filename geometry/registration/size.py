"""Is the scan about as large as the nominal? A cloud in metres or inches must not be called a poor fit."""

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.errors import CannotRegister
from geometry.types import Floats

LEAST, MOST = 0.1, 10.0  # of the nominal's airfoil; the nearest wrong unit, the inch, is 25 times off
STRAYS = 1.0  # per cent at either end of an axis that tell nothing


def check_size(points_mm: Floats, nominal: Nominal) -> None:
    """Raise `CannotRegister` for a scan (n, 3) that is ten times smaller or larger than the airfoil."""
    low_mm, high_mm = np.percentile(points_mm, [STRAYS, 100.0 - STRAYS], axis=0)
    scan_mm = float(np.linalg.norm(high_mm - low_mm))
    airfoil_mm = float(np.linalg.norm(np.ptp(nominal.samples.points_mm, axis=0)))
    if not LEAST <= scan_mm / airfoil_mm <= MOST:
        raise CannotRegister(
            f"the scan spans {scan_mm:.3g} mm, the airfoil {airfoil_mm:.3g} mm: is it in another unit?"
        )
