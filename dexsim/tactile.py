"""The tactile array: taxel penetration, Mooney-Rivlin skin, per-finger force and centre.

Method (paper, section Sim-to-Real Transfer): a taxel touches where it lies below the object's
surface; its share of the finger's force follows the skin's stress at that depth; the finger's
total is the contact force of the physics. `reduce_touch` is the same code for simulated and
measured taxels.

Shapes: F fingers, N taxels a finger. Units: m, N, Pa.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from dexsim import materials, rotations, sdf
from dexsim.bare_skin import Surface, taxels_only
from dexsim.config import setting, validate
from dexsim.distance import signed_distance
from dexsim.hand import Hand, HandPose
from dexsim.pytree import pytree_dataclass

WEIGHTINGS = ("force", "depth", "none")
LAWS = ("mooney_rivlin", "linear")
TOTALS = ("solver", "pressing", "skin")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Skin:
    """The rubber over the taxels (two-term Mooney-Rivlin) and what the taxels notice of it."""

    c10: float = setting(0.003e6, unit="Pa", low=0.0, high=1e8)
    """First Mooney-Rivlin coefficient; the skin's own value is not published. It is the fingertips'
    stiffness in the physics, too (`contact.follow_skin`): some 2 N/mm on a face, 1 on an edge."""
    c01: float = setting(0.0, unit="Pa", low=-1e8, high=1e8)
    """Second Mooney-Rivlin coefficient. Negative values (fits to tension alone) are refused where
    they would make the skin soften before `max_compression`."""
    thickness: float = setting(0.003, unit="m", low=1e-4, high=0.02)
    """Thickness of the compressed layer."""
    margin: float = setting(0.003, unit="m", low=0.0, high=0.01)
    """How far above the object's surface a taxel already feels it: the rubber over the lattice, and
    what the solver's geoms stand out by (`PhysicsConfig.cover`)."""
    max_compression: float = setting(0.7, unit="1", low=0.05, high=0.95)
    """Compression beyond which the stress no longer grows."""
    law: str = setting("mooney_rivlin", choices=LAWS)
    """linear: the slope at small strain throughout (Winkler's elastic foundation)."""
    total: str = setting("solver", choices=TOTALS)
    """Where a finger's total comes from: the physics' contact force, spread by the skin's law (solver:
    its magnitude, friction included; pressing: the part that presses into the skin, which is all that
    a taxel of one axis feels), or the skin itself, whose stress times area is then the force on each
    taxel."""
    bare: bool = False
    """Whether the fingertips' skin beyond the taxels bears its share of a finger's total, which nothing reads
    (`dexsim.bare_skin`), or all of it lies on taxels that are near, as in the paper."""

    def __post_init__(self):
        validate(self)
        materials.check_stiffness(self.c10, self.c01, self.max_compression)


def skin_of(material: str, **settings) -> Skin:
    """A skin of a named material (`materials.MATERIALS`), with other settings as given.

    Raises:
      ConfigError: no such material, or one that softens before `max_compression`.
    """
    c10, c01 = materials.material(material)
    return Skin(c10=c10, c01=c01, **settings)


@pytree_dataclass
class Touch:
    """What the taxels feel, before the sensor's own imperfections."""

    depth: jax.Array  # [F, N] m, compression of the skin (>= 0)
    skin_force: jax.Array  # [F, N] N, by the skin's law alone
    force: jax.Array  # [F, N] N, by default a spread of the physics' total (see `Skin.total`)


def skin_stress(compression: jax.Array, skin: Skin) -> jax.Array:
    """Magnitude of the uniaxial stress [...] Pa at a compression [...] in [0, 1).

    Mooney-Rivlin: sigma = 2 (lambda - lambda^-2) (C10 + C01 / lambda), lambda = 1 - compression.
    """
    compression = jnp.clip(compression, 0.0, skin.max_compression)
    if skin.law == "linear":
        return 6.0 * (skin.c10 + skin.c01) * compression
    stretch = 1.0 - compression
    return 2.0 * (stretch**-2 - stretch) * (skin.c10 + skin.c01 / stretch)


def feel(
    taxels: jax.Array,
    area: jax.Array,
    thing: Any,
    position: jax.Array,
    rotation: jax.Array,
    finger_force: jax.Array,
    skin: Skin,
) -> Touch:
    """Taxel forces from the geometry of the contact and the finger's total force.

    Args:
      taxels: [F, N, 3] m, taxel positions in the palm frame.
      area: [F, N] m^2.
      thing, position [3], rotation [3, 3]: the object, prepared for any method of
        `dexsim.distance` (a `sdf.Shape` is as it is), and its pose in the palm frame.
      finger_force: [F] N, resultant fingertip-object force of the physics.
      skin: the skin's law.

    A finger whose taxels all lie clear of the object reads zero, whatever its total: it touches
    with a part of the link that carries no taxels.
    """
    return _press(sdf.to_local(taxels, position, rotation), area, thing, finger_force, skin)


def feel_links(
    hand: Hand,
    pose: HandPose,
    thing: Any,
    position: jax.Array,
    rotation: jax.Array,
    finger_force: jax.Array,
    skin: Skin,
    surface: Surface | None = None,
) -> Touch:
    """`feel` for all taxels of a posed hand, or other points of its fingertips' skin.

    Straight from the links' frames to the object's: one transform a finger instead of two a taxel, and no taxel
    position in memory.
    """
    surface = surface or taxels_only(hand)
    turn = rotations.compose(jnp.swapaxes(rotation, -1, -2), pose.tip_rotation)
    shift = rotations.rotate_inverse(rotation, pose.body_position[hand.tip_body] - position)
    # Without the barrier XLA would compose the rotations anew for every taxel.
    turn, shift = jax.lax.optimization_barrier((turn, shift))
    taxel = [jnp.asarray(surface.position[..., axis]) for axis in range(3)]
    local = [sum(turn[:, row, axis, None] * taxel[axis] for axis in range(3)) + shift[:, row, None] for row in range(3)]
    return _press(jnp.stack(local, -1), jnp.asarray(surface.area), thing, finger_force, skin)


def _press(points: jax.Array, area: jax.Array, thing: Any, finger_force: jax.Array, skin: Skin) -> Touch:
    """`feel` for points [F, N, 3] in the object's frame."""
    depth = jnp.maximum(skin.margin - signed_distance(points, thing), 0.0)
    skin_force = skin_stress(depth / skin.thickness, skin) * area
    force = skin_force if skin.total == "skin" else spread(skin_force, finger_force)
    return Touch(depth, skin_force, force)


def spread(skin_force: jax.Array, finger_force: jax.Array) -> jax.Array:
    """Share each finger's force [F] among its taxels in proportion to `skin_force` [F, N]."""
    total = jnp.sum(skin_force, -1, keepdims=True)
    return finger_force[:, None] * skin_force / jnp.where(total > 0, total, 1.0)


def taxel_share(skin_force: jax.Array, taxels: int) -> jax.Array:
    """What part [F, 1] of each finger's load rests on the first `taxels` of its points [F, P]; 0 without touch."""
    borne = jnp.sum(skin_force, -1, keepdims=True)
    return jnp.sum(skin_force[:, :taxels], -1, keepdims=True) / jnp.where(borne > 0, borne, 1.0)


def reduce_touch(force: jax.Array, taxels: jax.Array, weighting: str = "force") -> tuple[jax.Array, jax.Array]:
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


def reduce_touch_links(
    force: jax.Array, hand: Hand, pose: HandPose, weighting: str = "force"
) -> tuple[jax.Array, jax.Array]:
    """`reduce_touch` in the links' frames: the mean first, then one transform a finger."""
    total, mean = reduce_touch(force, jnp.asarray(hand.taxel_position), weighting)
    centre = pose.body_position[hand.tip_body] + rotations.rotate(pose.tip_rotation, mean)
    return total, jnp.where(total[:, None] > 0, centre, 0.0)


def split_force(force: jax.Array, normals: jax.Array, finger_force: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Each finger's force along and across the contact, for three-axis touch.

    Args:
      force: [F, N] N, normal forces on the taxels; they say where the contact is.
      normals: [F, N, 3] outward taxel normals, palm frame (`hand.taxel_normals`).
      finger_force: [F, 3] N, the physics' force vector on the finger, palm frame.

    Returns:
      [F] N pressed into the skin, and [F, 3] N tangential; both zero for a finger that touches
      nothing.
    """
    inward = -jnp.sum(force[..., None] * normals, -2)
    square = jnp.sum(inward**2, -1, keepdims=True)
    touching = square > 0
    inward = inward / jnp.sqrt(jnp.where(touching, square, 1.0))
    pressed = jnp.sum(finger_force * inward, -1)
    return pressed, jnp.where(touching, finger_force - pressed[:, None] * inward, 0.0)


def press_only(touch: Touch, normals: jax.Array, finger_force: jax.Array) -> Touch:
    """The same touch with only the pressing part of the fingers' forces shared among the taxels.

    Args:
      normals: [F, N, 3] outward taxel normals, in any frame.
      finger_force: [F, 3] N, the physics' force vector on the finger, in the same one.
    """
    pressed, _ = split_force(touch.skin_force, normals, finger_force)
    return dataclasses.replace(touch, force=spread(touch.skin_force, jnp.maximum(pressed, 0.0)))


def taxel_vectors(force: jax.Array, finger_force: jax.Array) -> jax.Array:
    """The force vector [F, 3] of each finger shared among its taxels [F, N, 3] like `force`."""
    total = jnp.sum(force, -1, keepdims=True)
    share = force / jnp.where(total > 0, total, 1.0)
    return share[..., None] * finger_force[:, None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaxelSensor:
    """What the sensor does to the force on a taxel before the host reads it."""

    noise: float = setting(0.02, unit="N", low=0.0, high=10.0)
    """Standard deviation of white noise on each taxel, with what is left of its zero after the tare."""
    threshold: float = setting(0.05, unit="N", low=0.0, high=10.0)
    """Readings below this are reported as zero."""
    resolution: float = setting(0.1, unit="N", low=0.0, high=10.0)
    """Force per count; 0 leaves readings unquantised. The hand reports bytes of 0.1 N."""
    saturation: float = setting(25.5, unit="N", low=0.1, high=1000.0)
    """Largest force a taxel can report."""

    def __post_init__(self):
        validate(self)


def measure_taxels(force: jax.Array, gain: jax.Array, sensor: TaxelSensor, key: jax.Array) -> jax.Array:
    """Measured taxel forces [F, N] N from true ones: gain [F, 1], noise, threshold, counts."""
    reading = force * gain + sensor.noise * jax.random.normal(key, force.shape)
    reading = jnp.where(reading < sensor.threshold, 0.0, reading)
    if sensor.resolution > 0:
        reading = jnp.round(reading / sensor.resolution) * sensor.resolution
    return jnp.clip(reading, 0.0, sensor.saturation)


def measure_tangential(
    tangential: jax.Array, force: jax.Array, gain: jax.Array, sensor: TaxelSensor, key: jax.Array
) -> jax.Array:
    """What three-axis taxels report of a finger's tangential force, summed over them.

    Each taxel bears its share with noise and whole counts (a signed byte of them), so a load that
    is spread thinly reads too low.

    Args:
      tangential: [F, 3] N, true.
      force: [F, N] N, normal forces: how it is shared.
      gain: [F, 1] or [F, N].
      sensor: noise and resolution.
      key: of the noise.

    Returns:
      [F, 3] N.
    """
    share = taxel_vectors(force, tangential) * gain[..., None]
    share = share + sensor.noise * jax.random.normal(key, share.shape)
    if sensor.resolution > 0:
        counts = jnp.clip(jnp.round(share / sensor.resolution), -128.0, 127.0)
        share = counts * sensor.resolution
    return jnp.sum(share, -2)
