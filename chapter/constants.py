"""Material and geometry of the chapter's arm (section 4.1), mass per length as printed and as it must be.

The chapter calls rho the mass per unit length (section 2.1) and gives 1.1e3 kg/m3, a density (theory, 1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

YOUNG_PA = 5e3
RADIUS_M = 0.025
LENGTH_M = 1.0
DENSITY_KG_M3 = 1.1e3
AREA_M2 = math.pi * RADIUS_M**2
SECOND_MOMENT_M4 = math.pi * RADIUS_M**4 / 4.0


@dataclass(frozen=True)
class Constants:
    """What multiplies the terms of equations (1) to (5), SI units."""

    name: str
    axial_n: float
    """E A in N."""
    bending_n_m2: float
    """E I in N m2."""
    mass_kg_m: float
    """rho, mass per unit length."""


PRINTED = Constants("printed", YOUNG_PA * AREA_M2, YOUNG_PA * SECOND_MOMENT_M4, DENSITY_KG_M3)
"""rho = 1.1e3 taken as kg/m, which is 509 times the arm's mass."""
CORRECTED = Constants("corrected", PRINTED.axial_n, PRINTED.bending_n_m2, DENSITY_KG_M3 * AREA_M2)
"""rho A = 2.16 kg/m."""
