"""What is drawn anew at every episode start, apart from the object itself.

One dataclass of ranges and one `sample`. With `scale` 0 it gives the nominal hand exactly.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.actuator import Actuator
from dexsim.config import check_ranges, setting, validate
from dexsim.errors import ConfigError
from dexsim.hand import Hand
from dexsim.pytree import pytree_dataclass


@dataclasses.dataclass(frozen=True, kw_only=True)
class Randomization:
    """Ranges (low, high), drawn uniformly for every joint or finger at every episode start."""

    scale: float = setting(1.0, unit="1", low=0.0, high=3.0)
    """Width of all ranges about their nominal values; 0 switches randomisation off."""
    stiffness: float = setting(3.0, unit="Nm/rad", low=0.01, high=100.0)
    """Nominal proportional gain k_p (not published for this hand)."""
    damping: float = setting(0.1, unit="Nm s/rad", low=0.0, high=10.0)
    """Nominal derivative gain k_d."""
    stiffness_factor: tuple[float, float] = setting((0.8, 1.2), unit="1", low=0.05, high=10.0)
    """Factor on k_p."""
    damping_factor: tuple[float, float] = setting((0.7, 1.3), unit="1", low=0.0, high=10.0)
    """Factor on k_d."""
    dead_band: tuple[float, float] = setting((0.0, 0.01), unit="rad", low=0.0, high=0.2)
    """Backlash threshold epsilon; nominal 0."""
    torque_factor: tuple[float, float] = setting((0.9, 1.1), unit="1", low=0.05, high=5.0)
    """Factor on the stall torque."""
    speed_factor: tuple[float, float] = setting((0.9, 1.1), unit="1", low=0.05, high=5.0)
    """Factor on the no-load speed."""
    efficiency: tuple[float, float] = setting((0.85, 1.0), unit="1", low=0.05, high=2.0)
    """Efficiency eta; nominal 1."""
    latency: tuple[float, float] = setting((0.0, 0.02), unit="s", low=0.0, high=0.2)
    """Delay from command to motor, in whole sub-steps; nominal 0."""
    sensing_latency: tuple[float, float] = setting((0.0, 0.02), unit="s", low=0.0, high=0.2)
    """Age of the readings; nominal 0. At most one control tick is modelled."""
    encoder_bias: float = setting(0.01, unit="rad", low=0.0, high=0.2)
    """Largest constant error of a joint angle reading."""
    torque_gain: tuple[float, float] = setting((0.9, 1.1), unit="1", low=0.05, high=5.0)
    """Factor on a joint's torque reading: error of the current-to-torque calibration."""
    taxel_gain: tuple[float, float] = setting((0.9, 1.1), unit="1", low=0.05, high=5.0)
    """Factor on a finger's taxel readings."""
    gravity_tilt: float = setting(0.1, unit="rad", low=0.0, high=1.6)
    """Largest tilt of the hand against gravity, about each horizontal axis."""

    def __post_init__(self):
        validate(self)
        check_ranges(self, "stiffness_factor", "damping_factor", "dead_band", "torque_factor",
                     "speed_factor", "efficiency", "latency", "sensing_latency", "torque_gain",
                     "taxel_gain")
        for name in ("stiffness_factor", "damping_factor", "torque_factor", "speed_factor",
                     "efficiency", "torque_gain", "taxel_gain"):
            low, high = getattr(self, name)
            if min(1 + self.scale * (low - 1), 1 + self.scale * (high - 1)) < 0:
                raise ConfigError(f"Randomization.{name} = ({low:g}, {high:g}) at scale "
                                  f"{self.scale:g} reaches below 0: narrow one or the other")


@pytree_dataclass
class Draw:
    """One episode's hand."""

    actuator: Actuator  # [J] leaves
    latency: jax.Array  # [] int32, sub-steps
    sensing_latency: jax.Array  # [] fraction of a control tick
    encoder_bias: jax.Array  # [J] rad
    torque_gain: jax.Array  # [J]
    taxel_gain: jax.Array  # [F, 1]
    tilt: jax.Array  # [2] rad


def sample(key: jax.Array, config: Randomization, hand: Hand, *, timestep: float,
           control_period: float) -> Draw:
    """Draw one episode's hand."""
    keys = iter(jax.random.split(key, 12))
    joints, fingers = hand.num_joints, hand.num_fingers

    def draw(span: tuple[float, float], nominal: float, shape: tuple[int, ...]) -> jax.Array:
        value = jax.random.uniform(next(keys), shape, minval=span[0], maxval=span[1])
        return nominal + config.scale * (value - nominal)

    actuator = Actuator(
        stiffness=config.stiffness * draw(config.stiffness_factor, 1.0, (joints,)),
        damping=config.damping * draw(config.damping_factor, 1.0, (joints,)),
        dead_band=draw(config.dead_band, 0.0, (joints,)),
        stall_torque=hand.torque_limit * draw(config.torque_factor, 1.0, (joints,)),
        no_load_speed=hand.speed_limit * draw(config.speed_factor, 1.0, (joints,)),
        efficiency=draw(config.efficiency, 1.0, (joints,)))
    bias = (-config.encoder_bias, config.encoder_bias)
    tilt = (-config.gravity_tilt, config.gravity_tilt)
    return Draw(
        actuator=actuator,
        latency=jnp.round(draw(config.latency, 0.0, ()) / timestep).astype(jnp.int32),
        sensing_latency=jnp.clip(draw(config.sensing_latency, 0.0, ()) / control_period, 0.0, 1.0),
        encoder_bias=draw(bias, 0.0, (joints,)),
        torque_gain=draw(config.torque_gain, 1.0, (joints,)),
        taxel_gain=draw(config.taxel_gain, 1.0, (fingers, 1)),
        tilt=draw(tilt, 0.0, (2,)))
