"""The skin over the taxels: a two-term Mooney-Rivlin law, and materials by name.

Units: m, N, Pa.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import Config, setting
from dexsim.touch import materials

LAWS = ("mooney_rivlin", "linear")
TOTALS = ("pressing", "solver")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Skin(Config):
    """The rubber over the taxels (two-term Mooney-Rivlin) and what the taxels notice of it."""

    c10: float = setting(0.003e6, unit="Pa", low=0.0, high=1e8)
    """First Mooney-Rivlin coefficient; that of the XHand's skin is not published. The fingertips' stiffness in the
    physics follows from it (`contact.follow_skin`): a face presses an outer finger with 1 N at 1 mm and 6 N at 2 mm,
    its rim with half of that."""
    c01: float = setting(0.0, unit="Pa", low=-1e8, high=1e8)
    """Second Mooney-Rivlin coefficient. Negative values (fits to tension alone) are refused where
    they would make the skin soften before `max_compression`."""
    thickness: float = setting(0.003, unit="m", low=1e-4, high=0.02)
    """Thickness of the compressed layer."""
    margin: float = setting(0.003, unit="m", low=0.0, high=0.01)
    """Distance above the object's surface at which a taxel begins to feel it: the thickness of the rubber over the
    lattice. `PhysicsConfig.pad_thickness` is the same distance for the solver."""
    max_compression: float = setting(0.7, unit="1", low=0.05, high=0.95)
    """Compression beyond which the stress no longer grows."""
    law: str = setting("mooney_rivlin", choices=LAWS)
    """linear: the slope at small strain throughout (Winkler's elastic foundation)."""
    total: str = setting("pressing", choices=TOTALS)
    """Which part of the physics' contact force a finger's taxels share: what presses into the skin, which is all
    that a one-axis taxel feels (pressing), or the magnitude with friction (solver), as in the paper."""
    untaxelled: bool = False
    """True: the fingertips' skin beyond the taxels bears its share of a finger's total, which no taxel reads, and of
    the contact's stiffness (`dexsim.touch.surface`). False: the skin ends with the taxels, which share all of it, as
    in the paper; beyond them fingertips are as soft as `contact.SOFTEST` lets them be."""

    def __post_init__(self):
        super().__post_init__()
        materials.check_stiffness(self.c10, self.c01, self.max_compression)


def skin_of(material: str, **settings) -> Skin:
    """A skin of a named material (`materials.MATERIALS`), with other settings as given.

    Raises:
      ConfigError: no such material, or one that softens before `max_compression`.
    """
    c10, c01 = materials.material(material)
    return Skin(c10=c10, c01=c01, **settings)


def skin_stress(compression: jax.Array, skin: Skin) -> jax.Array:
    """Magnitude of the uniaxial stress [...] Pa at a compression [...] in [0, 1).

    Mooney-Rivlin: sigma = 2 (lambda - lambda^-2) (C10 + C01 / lambda), lambda = 1 - compression.
    """
    compression = jnp.clip(compression, 0.0, skin.max_compression)
    if skin.law == "linear":
        return 6.0 * (skin.c10 + skin.c01) * compression
    stretch = 1.0 - compression
    return 2.0 * (stretch**-2 - stretch) * (skin.c10 + skin.c01 / stretch)
