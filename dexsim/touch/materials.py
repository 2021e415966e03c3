"""Skins by name: Mooney-Rivlin coefficients of silicones, and the check that they stiffen where the skin is squeezed.

The coefficients were fitted to the tensile tests of the Soft-Robotics-Materials-Database (Marechal et al. 2021) up to
a strain of 0.5. A fit of both terms to tension alone makes C01 negative, and then the modelled skin softens when it is
compressed far: `ecoflex_00_50` loses its stiffness at about a third. Where the data allow it there is a fit with
C01 held at 0 as well, which stiffens throughout; prefer it for touch.
"""

from typing import NamedTuple

import numpy as np

from dexsim.core.errors import ConfigError


class Material(NamedTuple):
    """Two-term Mooney-Rivlin coefficients [Pa]; Young's modulus at small strain is 6 (c10 + c01)."""

    c10: float
    c01: float

    @property
    def modulus(self) -> float:
        """Young's modulus at small strain, Pa."""
        return 6 * (self.c10 + self.c01)


MATERIALS: dict[str, Material] = {
    # C01 held at 0: sound at any compression.
    "ecoflex_00_30": Material(7.6e3, 0.0),
    "dragon_skin_30": Material(96e3, 0.0),
    "sortaclear_40": Material(143e3, 0.0),
    "rtv615": Material(176e3, 0.0),
    # Both terms fitted to tension: sound up to `stable_compression` only.
    "ecoflex_00_30_tension": Material(11.3e3, -5.0e3),
    "ecoflex_00_50_tension": Material(16.0e3, -7.6e3),
    "dragon_skin_10_tension": Material(40.7e3, -23.5e3),
    "dragon_skin_20_tension": Material(127e3, -85e3),
    "dragon_skin_30_tension": Material(151e3, -75e3),
    "mold_star_16_tension": Material(60e3, -23e3),
    "rebound_25_tension": Material(76e3, -33e3),
    "sortaclear_40_tension": Material(168e3, -34e3),
    "rtv615_tension": Material(240e3, -89e3),
}


def material(name: str) -> Material:
    """Look a material up.

    Raises:
      ConfigError: there is none of that name.
    """
    if name not in MATERIALS:
        raise ConfigError(f"material {name!r}: choose from {', '.join(MATERIALS)}")
    return MATERIALS[name]


def stiffness(compression: np.ndarray, c10: float, c01: float) -> np.ndarray:
    """Slope of the stress's magnitude over compression [...], Pa: d/de of 2 (l^-2 - l)(C10 + C01 / l) at l = 1 - e."""
    stretch = 1.0 - np.asarray(compression, float)
    return 2 * ((2 * stretch**-3 + 1) * (c10 + c01 / stretch) + (stretch**-2 - stretch) * c01 / stretch**2)


def stable_compression(c10: float, c01: float) -> float:
    """The compression up to which the stiffness is positive; 1 where it always is, 0 where it never is.

    Times l^4 / 2 the stiffness is C10 l^4 + 2 C10 l + 3 C01, which increases with l: at most one crossing.
    """
    if c10 <= 0 and c01 <= 0 or 3 * (c10 + c01) <= 0:
        return 0.0
    if c01 >= 0:
        return 1.0
    low, high = 0.0, 1.0  # stretch: not stable at low, stable at high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if c10 * (middle**4 + 2 * middle) + 3 * c01 > 0 else (middle, high)
    return 1.0 - high


def check_stiffness(c10: float, c01: float, max_compression: float) -> None:
    """Require that a skin stiffens all the way to `max_compression`.

    Raises:
      ConfigError: it softens, and from which compression on.
    """
    limit = stable_compression(c10, c01)
    if limit <= max_compression:
        raise ConfigError(
            f"Skin.c01 = {c01:g} Pa: with c10 = {c10:g} Pa the skin has no positive stiffness beyond "
            f"{limit:.0%} compression, max_compression is {max_compression:.0%}"
        )
