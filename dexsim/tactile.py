"""The tactile array: taxel penetration, Mooney-Rivlin skin, per-finger force and centre.

Method (paper, section Sim-to-Real Transfer): a taxel touches where it lies below the object's
surface; its share of the finger's force follows the skin's stress at that depth; the finger's
total is the contact force of the physics. `reduce_touch` is the same code for simulated and
measured taxels.

Shapes: F fingers, N taxels a finger. Units: m, N, Pa.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim import rotations, sdf
from dexsim.config import setting, validate
from dexsim.pytree import pytree_dataclass

WEIGHTINGS = ("force", "depth", "none")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Skin:
    """The rubber over the taxels (two-term Mooney-Rivlin) and what the taxels notice of it."""

    c10: float = setting(0.03e6, unit="Pa", low=0.0, high=1e8)
    """First Mooney-Rivlin coefficient; the skin's own value is not published."""
    c01: float = setting(0.0, unit="Pa", low=0.0, high=1e8)
    """Second Mooney-Rivlin coefficient; negative values (tension-only fits) are refused."""
    thickness: float = setting(0.002, unit="m", low=1e-4, high=0.02)
    """Thickness of the compressed layer."""
    margin: float = setting(0.001, unit="m", low=0.0, high=0.01)
    """How far above the object's surface a taxel already feels it: the solver's contact is
    stiffer than the skin, so without it the taxels round a contact would feel nothing."""
    max_compression: float = setting(0.7, unit="1", low=0.05, high=0.95)
    """Compression beyond which the stress no longer grows."""

    def __post_init__(self):
        validate(self)


@pytree_dataclass
class Touch:
    """What the taxels feel, before the sensor's own imperfections."""

    depth: jax.Array  # [F, N] m, compression of the skin (>= 0)
    skin_force: jax.Array  # [F, N] N, by the skin's law alone
    force: jax.Array  # [F, N] N, spread of the physics' total: sum over N is the finger's force


def skin_stress(compression: jax.Array, skin: Skin) -> jax.Array:
    """Magnitude of the uniaxial Mooney-Rivlin stress [...] Pa at a compression [...] in [0, 1).

    sigma = 2 (lambda - lambda^-2) (C10 + C01 / lambda), lambda = 1 - compression.
    """
    stretch = 1.0 - jnp.clip(compression, 0.0, skin.max_compression)
    return 2.0 * (stretch**-2 - stretch) * (skin.c10 + skin.c01 / stretch)


def feel(taxels: jax.Array, area: jax.Array, shape: sdf.Shape, position: jax.Array,
         rotation: jax.Array, finger_force: jax.Array, skin: Skin) -> Touch:
    """Taxel forces from the geometry of the contact and the finger's total force.

    Args:
      taxels: [F, N, 3] m, taxel positions in the palm frame.
      area: [F, N] m^2.
      shape, position [3], rotation [3, 3]: the object and its pose in the palm frame.
      finger_force: [F] N, resultant fingertip-object force of the physics.
      skin: the skin's law.

    A finger whose taxels all lie clear of the object reads zero, whatever its total: it touches
    with a part of the link that carries no taxels.
    """
    local = rotations.rotate_inverse(rotation, taxels - position)
    depth = jnp.maximum(skin.margin - sdf.signed_distance(local, shape), 0.0)
    skin_force = skin_stress(depth / skin.thickness, skin) * area
    return Touch(depth, skin_force, spread(skin_force, finger_force))


def spread(skin_force: jax.Array, finger_force: jax.Array) -> jax.Array:
    """Share each finger's force [F] among its taxels in proportion to `skin_force` [F, N]."""
    total = jnp.sum(skin_force, -1, keepdims=True)
    return finger_force[:, None] * skin_force / jnp.where(total > 0, total, 1.0)


def reduce_touch(force: jax.Array, taxels: jax.Array,
                 weighting: str = "force") -> tuple[jax.Array, jax.Array]:
    """Per-finger total force and contact centre, the same for simulated and measured taxels.

    Args:
      force: [F, N] N (with weighting "depth": the penetration, the paper's simplification).
      taxels: [F, N, 3] m.
      weighting: "force" (or "depth"): mu_i = sum f_ij p_ij / F_i; "none": mean of active taxels.

    Returns:
      F_i [F] and mu_i [F, 3]; the centre is zero for a finger that touches nothing.
    """
    weight = (force > 0).astype(force.dtype) if weighting == "none" else force
    total = jnp.sum(weight, -1)
    centre = jnp.sum(weight[..., None] * taxels, -2) / jnp.where(total > 0, total, 1.0)[:, None]
    return jnp.sum(force, -1), centre


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaxelSensor:
    """What the sensor does to the force on a taxel before the host reads it."""

    noise: float = setting(0.01, unit="N", low=0.0, high=10.0)
    """Standard deviation of white noise on each taxel."""
    threshold: float = setting(0.05, unit="N", low=0.0, high=10.0)
    """Readings below this are reported as zero."""
    resolution: float = setting(0.1, unit="N", low=0.0, high=10.0)
    """Force per count; 0 leaves readings unquantised. The hand reports bytes of 0.1 N."""
    saturation: float = setting(25.5, unit="N", low=0.1, high=1000.0)
    """Largest force a taxel can report."""

    def __post_init__(self):
        validate(self)


def measure_taxels(force: jax.Array, gain: jax.Array, sensor: TaxelSensor,
                   key: jax.Array) -> jax.Array:
    """Measured taxel forces [F, N] N from true ones: gain [F, 1], noise, threshold, counts."""
    reading = force * gain + sensor.noise * jax.random.normal(key, force.shape)
    reading = jnp.where(reading < sensor.threshold, 0.0, reading)
    if sensor.resolution > 0:
        reading = jnp.round(reading / sensor.resolution) * sensor.resolution
    return jnp.clip(reading, 0.0, sensor.saturation)
