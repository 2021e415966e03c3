"""What is drawn anew at every episode start, apart from the object itself.

One dataclass of ranges and one `sample_hand`. With `scale` 0 it gives the nominal hand exactly. The
scale may be traced, so that a curriculum widens the ranges while training (`CurriculumConfig`).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.actuator.drive import Actuator
from dexsim.core.config import Config, Range, setting
from dexsim.core.pytree import pytree_dataclass
from dexsim.core.ranges import sample_extreme, uniforms
from dexsim.errors import ConfigError
from dexsim.hand.description import Hand

_DEVIATIONS = ("encoder_bias", "gravity_tilt")  # given by one number, the largest deviation to either side
# Which of an episode's 20 keys draws which of `NOMINAL`; the ripples' number and phase have two more.
_KEYS, _RIPPLE_COUNT, _RIPPLE_PHASE = np.array([*range(7), 12, 13, 16, 17, *range(7, 12), 19]), 14, 15


@dataclasses.dataclass(frozen=True, kw_only=True)
class Randomization(Config):
    """Ranges (low, high), drawn uniformly for every joint or finger at every episode start."""

    scale: float = setting(1.0, unit="1", low=0.0, high=3.0)
    """Width of all ranges about their nominal values; 0 switches randomisation of hands and motors off, not that of
    objects (`ObjectConfig`), nor the errors of single taxels (`Sensing.taxel`)."""
    stiffness: float = setting(3.0, unit="Nm/rad", low=0.01, high=100.0)
    """Nominal proportional gain k_p (not published for this hand)."""
    damping: float = setting(0.1, unit="Nm s/rad", low=0.0, high=10.0)
    """Nominal derivative gain k_d."""
    stiffness_factor: Range = setting((0.8, 1.2), nominal=1.0, unit="1", low=0.05, high=10.0)
    """Factor on k_p."""
    damping_factor: Range = setting((0.7, 1.3), nominal=1.0, unit="1", low=0.0, high=10.0)
    """Factor on k_d."""
    dead_band: Range = setting((0.0, 0.01), nominal=0.0, unit="rad", low=0.0, high=0.2)
    """Backlash threshold epsilon; nominal 0."""
    torque_factor: Range = setting((0.9, 1.1), nominal=1.0, unit="1", low=0.05, high=5.0)
    """Factor on the stall torque."""
    speed_factor: Range = setting((0.9, 1.1), nominal=1.0, unit="1", low=0.05, high=5.0)
    """Factor on the no-load speed."""
    efficiency: Range = setting((0.85, 1.0), nominal=1.0, unit="1", low=0.05, high=2.0)
    """Efficiency eta; nominal 1."""
    latency: Range = setting((0.0, 0.02), nominal=0.0, unit="s", low=0.0, high=0.2)
    """Delay from command to motor, common to all joints, in whole sub-steps; nominal 0. At most
    two control ticks are modelled."""
    latency_spread: Range = setting((0.0, 0.005), nominal=0.0, unit="s", low=0.0, high=0.2)
    """Further delay of each joint by itself (the bus serves them in turn); nominal 0."""
    ripple: Range = setting((0.0, 0.03), nominal=0.0, unit="1", low=0.0, high=0.3)
    """Amplitude of the torque ripple, as a share of the torque; nominal 0."""
    ripple_count: Range = setting((20.0, 200.0), unit="1/rad", low=0.0, high=2000.0)
    """Ripples per radian of the joint. Neither it nor the phase has a nominal value."""
    coulomb_friction: Range = setting((0.0, 0.03), nominal=0.0, unit="1", low=0.0, high=0.3)
    """Coulomb friction as a share of the joint's stall torque; nominal 0."""
    viscous_friction: Range = setting((0.0, 0.01), nominal=0.0, unit="Nm s/rad", low=0.0, high=1.0)
    """Viscous friction, on top of the damping in the hand's MJCF; nominal 0."""
    sensing_latency: Range = setting((0.0, 0.02), nominal=0.0, unit="s", low=0.0, high=0.2)
    """Age of the readings; nominal 0. At most one control tick is modelled."""
    encoder_bias: float = setting(0.01, nominal=0.0, unit="rad", low=0.0, high=0.2)
    """Largest constant error of a joint angle, in its reading and in its motor's loop."""
    torque_gain: Range = setting((0.9, 1.1), nominal=1.0, unit="1", low=0.05, high=5.0)
    """Factor on a joint's torque reading: error of the current-to-torque calibration."""
    taxel_gain: Range = setting((0.9, 1.1), nominal=1.0, unit="1", low=0.05, high=5.0)
    """Factor on a finger's taxel readings."""
    gravity_tilt: float = setting(0.1, nominal=0.0, unit="rad", low=0.0, high=1.6)
    """Largest tilt of the hand against gravity: pitch and roll (`tilted_down`)."""
    pad_thickness_delta: Range = setting((-0.003, 0.0), nominal=0.0, unit="m", low=-0.01, high=0.01)
    """Change of the rubber's thickness over all fingertips (`Skin.margin`); nominal 0. The maker's fingertip ends
    within 0.5 mm of the taxels, soft rubber yields before it bears load: how far out a contact begins is not known.
    Thicknesses below 0 count as 0."""
    extremes: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of hands (and of their IMUs) with every value at an end of its range, but for the ripples' number
    and phase; see `dexsim.core.ranges`."""
    beyond: float = setting(0.0, unit="1", low=0.0, high=3.0)
    """How far outside its range a hand at an extreme has its values: up to this share of the end's distance from
    nominal. For evaluation on hands that training never had: `extremes` 1 and `beyond` above 0."""

    def __post_init__(self):
        super().__post_init__()
        if self.beyond and not self.extremes:
            raise ConfigError(
                f"Randomization.beyond = {self.beyond:g} needs extremes above 0: only hands at an extreme lie beyond"
            )
        width = self.scale * (1 + self.beyond)
        where = f"at scale {self.scale:g} and beyond {self.beyond:g}"
        if self.gravity_tilt * width > 1.5:  # At a right angle gravity would turn over.
            raise ConfigError(f"Randomization.gravity_tilt = {self.gravity_tilt:g} rad {where}: reaches 1.5 rad")
        for name in (name for name, nominal in NOMINAL.items() if nominal):  # factors
            low, high = getattr(self, name)
            if 1 + width * (low - 1) < 0:
                raise ConfigError(f"Randomization.{name} = ({low:g}, {high:g}) {where}: reaches below 0")


NOMINAL: dict[str, float] = {
    field.name: field.metadata["nominal"]
    for field in dataclasses.fields(Randomization)
    if field.metadata["nominal"] is not None
}
"""The nominal hand: a value for every range of `Randomization` but the ripples' number, which has none."""


@pytree_dataclass
class HandParams:
    """One episode's hand; J joints, F fingers."""

    actuator: Actuator  # [J] leaves
    latency: jax.Array  # [J] sub-steps
    sensing_latency: jax.Array  # [] fraction of a control tick
    torque_gain: jax.Array  # [J]
    taxel_gain: jax.Array  # [F, 1]
    tilt: jax.Array  # [2] rad
    pad_thickness_delta: jax.Array  # [] m, on top of `Skin.margin`


def sample_hand(
    key: jax.Array,
    config: Randomization,
    hand: Hand,
    *,
    timestep: float,
    control_period: float,
    scale: jax.Array | float = 1.0,
) -> HandParams:
    """Draw one episode's hand.

    Args:
      timestep, control_period: s, of a physics sub-step and a control tick.
      scale: [] in [0, 1], on top of `config.scale`; may be traced. 0 is the nominal hand, exactly.
    """
    # A row of values for every name: as many as the hand has joints or fingers, and two at least.
    shape, nominal = (max(hand.num_joints, hand.num_fingers, 2),), np.array(list(NOMINAL.values()), np.float32)
    spans = [getattr(config, name) for name in NOMINAL]
    spans = [(-span, span) if name in _DEVIATIONS else span for name, span in zip(NOMINAL, spans, strict=True)]
    keys, extreme = jax.random.split(key, 20), sample_extreme(key, config.extremes)
    raw = uniforms(keys[_KEYS], spans, extreme, shape, nominal=list(NOMINAL.values()), beyond=config.beyond)
    rows = nominal[:, None] + config.scale * scale * (raw - nominal[:, None])
    drawn = dict(zip(NOMINAL, rows, strict=True))
    values, joints = {name: row[: hand.num_joints] for name, row in drawn.items()}, (hand.num_joints,)
    limit, gain, (low, high) = jnp.asarray(hand.torque_limit), jnp.asarray(hand.gain), config.ripple_count
    actuator = Actuator(
        stiffness=config.stiffness * gain * values["stiffness_factor"],
        damping=config.damping * gain * values["damping_factor"],
        dead_band=values["dead_band"],
        stall_torque=limit * values["torque_factor"],
        no_load_speed=jnp.asarray(hand.speed_limit) * values["speed_factor"],
        efficiency=values["efficiency"],
        ripple=values["ripple"],
        ripple_count=jax.random.uniform(keys[_RIPPLE_COUNT], joints, minval=low, maxval=high),
        ripple_phase=jax.random.uniform(keys[_RIPPLE_PHASE], joints, maxval=2 * jnp.pi),
        encoder_bias=values["encoder_bias"],
        coulomb_friction=limit * values["coulomb_friction"],
        viscous_friction=values["viscous_friction"],
    )
    latency = values["latency"][0] + values["latency_spread"]
    return HandParams(
        actuator=actuator,
        latency=jnp.minimum(latency, 2 * control_period) / timestep,
        sensing_latency=jnp.clip(values["sensing_latency"][0] / control_period, 0.0, 1.0),
        torque_gain=values["torque_gain"],
        taxel_gain=drawn["taxel_gain"][: hand.num_fingers, None],
        tilt=drawn["gravity_tilt"][:2],
        pad_thickness_delta=values["pad_thickness_delta"][0],
    )


def tilted_down(down: np.ndarray, tilt: jax.Array) -> jax.Array:
    """Where gravity points for a hand whose mount is off.

    Args:
      down: [3] unit vector, where it should point in the palm frame.
      tilt: [2] rad, about the palm's own y axis, made level, and about the level axis across it: how far a mount is
        off is known by pitch and roll, and the ends of their ranges lie there.

    Returns:
      [3] unit vector.
    """
    lateral = np.eye(3)[1 if abs(down[1]) < 0.9 else 2]
    ahead = np.cross(down, lateral)
    ahead /= np.linalg.norm(ahead)
    off = down + jnp.tan(tilt[0]) * ahead + jnp.tan(tilt[1]) * np.cross(down, ahead)
    return off / jnp.linalg.norm(off)
