"""The skin over the taxels: a two-term Mooney-Rivlin law, and materials by name.

Units: m, N, Pa.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import Config, setting
from dexsim.errors import ConfigError

MATERIALS = {"ecoflex_00_30": 7.6e3, "dragon_skin_30": 96e3, "sortaclear_40": 143e3, "rtv615": 176e3}
"""C10 [Pa] of silicones, C01 held at 0: fitted to the tensile tests of the Soft-Robotics-Materials-Database (Marechal
et al. 2021) up to a strain of 0.5. A fit of both terms to tension alone makes C01 negative, and the skin soften when
it is compressed far."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Skin(Config):
    """The rubber over the taxels (two-term Mooney-Rivlin) and what the taxels notice of it."""

    c10: float = setting(0.003e6, unit="Pa", low=0.0, high=1e8)
    """First Mooney-Rivlin coefficient; that of the XHand's skin is not published. The fingertips' stiffness in the
    physics follows from it (`Physics.tip_stiffness`): a face presses an outer finger with 1 N at 1 mm and 6 N at 2 mm,
    its rim with half of that."""
    c01: float = setting(0.0, unit="Pa", low=-1e8, high=1e8)
    """Second Mooney-Rivlin coefficient. Negative values (fits to tension alone) are refused where
    they would make the skin soften before `max_compression`."""
    thickness: float = setting(0.003, unit="m", low=1e-4, high=0.02)
    """Thickness of the compressed layer."""
    margin: float = setting(0.003, unit="m", low=0.0, high=0.01)
    """Distance above the object's surface at which a taxel begins to feel it, and the solver's contact begins: the
    thickness of the rubber over lattice and fingertip."""
    max_compression: float = setting(0.7, unit="1", low=0.05, high=0.95)
    """Compression beyond which the stress no longer grows."""
    law: str = setting("mooney_rivlin", choices=("mooney_rivlin", "linear"))
    """linear: the slope at small strain throughout (Winkler's elastic foundation)."""
    total: str = setting("pressing", choices=("pressing", "solver"))
    """Which part of the physics' contact force a finger's taxels share: what presses into the skin, which is all
    that a one-axis taxel feels (pressing), or the magnitude with friction (solver), as in the paper."""

    def __post_init__(self):
        super().__post_init__()
        # Times l^4 / 2 the slope of the stress over compression is C10 l^4 + 2 C10 l + 3 C01, which grows with the
        # stretch l: where it is positive at the largest compression, it is so before.
        stretch = 1.0 - self.max_compression
        if self.c10 * (stretch**4 + 2 * stretch) + 3 * self.c01 <= 0:
            raise ConfigError(
                f"Skin.c01 = {self.c01:g} Pa: with c10 = {self.c10:g} Pa the skin has no positive stiffness at the "
                f"max_compression of {self.max_compression:.0%}"
            )


def skin_of(material: str, **settings) -> Skin:
    """A skin of a named material of `MATERIALS`, with other settings as given.

    Raises:
      ConfigError: no such material.
    """
    if material not in MATERIALS:
        raise ConfigError(f"material {material!r}: choose from {', '.join(MATERIALS)}")
    return Skin(c10=MATERIALS[material], **settings)


def skin_stress(compression: jax.Array, skin: Skin) -> jax.Array:
    """Magnitude of the uniaxial stress [...] Pa at a compression [...] in [0, 1).

    Mooney-Rivlin: sigma = 2 (lambda - lambda^-2) (C10 + C01 / lambda), lambda = 1 - compression.
    """
    compression = jnp.clip(compression, 0.0, skin.max_compression)
    if skin.law == "linear":
        return 6.0 * (skin.c10 + skin.c01) * compression
    stretch = 1.0 - compression
    return 2.0 * (stretch**-2 - stretch) * (skin.c10 + skin.c01 / stretch)
