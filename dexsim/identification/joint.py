"""One joint with its drive, simulated from commanded targets: what identification fits.

    I qdd = friction(drive(target delayed, q, qd))

The joint alone: its inertia about the axis is constant (the diagonal of the hand's mass matrix, rotor included), the
other joints stand still, nothing touches, no weight. Integrated as the physics does, semi-implicit Euler at the
physics' time step with the same drive, so that what is fitted here means the same there.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.actuator.drive import Actuator, apply_friction, joint_torque, pd_torque, torque_limit
from dexsim.calibration.fit import check_signals
from dexsim.errors import CalibrationError


class Parameter(NamedTuple):
    """A parameter of the joint, in its unit."""

    unit: str
    typical: float  # size below which it hardly matters on this kind of hand; makes relative errors
    low: float  # bounds of the search
    high: float
    nominal: float | None = None  # value where nobody gives one; None: it must be given


PARAMETERS = {
    "stiffness": Parameter("Nm/rad", 1.0, 0.01, 100.0),
    "damping": Parameter("Nm s/rad", 0.05, 0.0, 10.0),
    "dead_band": Parameter("rad", 0.005, 0.0, math.inf, 0.0),
    "stall_torque": Parameter("Nm", 0.4, 0.01, 10.0),
    "no_load_speed": Parameter("rad/s", 10.0, 0.5, 100.0),
    "efficiency": Parameter("1", 0.5, 0.2, 1.5, 1.0),
    "encoder_bias": Parameter("rad", 0.01, -0.2, 0.2, 0.0),
    "coulomb_friction": Parameter("Nm", 0.01, 0.0, 1.0, 0.0),
    "viscous_friction": Parameter("Nm s/rad", 0.005, 0.0, 1.0, 0.0),
    "inertia": Parameter("kg m^2", 1e-3, 1e-5, 0.1),
}
"""Parameters of the model. Beside them it has `start`, rad: the true angle at the first sample."""

_SAMPLES, _MOTION = 200, 0.02  # that a log needs; rad that the joint must have moved
_SATURATED = 0.6, 0.97  # share of the samples that may have this share of the largest torque


@dataclasses.dataclass(frozen=True)
class JointLog:
    """A recording of one joint that moved alone, a sample every `period` s.

    Raises CalibrationError: it cannot tell, being too short, not numbers, in another unit, without motion or saturated.
    """

    period: float  # s
    target: np.ndarray  # [T] rad, commanded at each sample
    position: np.ndarray  # [T] rad, measured at the same instants
    torque: np.ndarray | None = None  # [T] Nm, of the motor by its calibrated current
    name: str = "joint"

    def __post_init__(self) -> None:
        channels = {"target": (self.target, "rad"), "position": (self.position, "rad")}
        if self.torque is not None:
            channels["torque"] = self.torque, "Nm"
        check_signals(self.name, _SAMPLES, channels, *_SATURATED)
        if not 1e-4 <= self.period <= 0.2:
            raise CalibrationError(f"{self.name}: period of {self.period:g} s: give seconds, from 0.0001 to 0.2")
        moved, commanded = np.ptp(self.position), np.ptp(self.target)
        if min(moved, commanded) < _MOTION or not commanded / 20 < moved < 20 * commanded:
            raise CalibrationError(
                f"{self.name}: commanded over {commanded:.3g} rad, moved over {moved:.3g} rad: at least {_MOTION} rad "
                "of motion is needed, target and position in the same unit"
            )


@functools.partial(jax.jit, static_argnames=("substeps", "blur"))
def simulate(
    values: dict[str, jax.Array],
    target: jax.Array,
    latency: jax.Array,
    timestep: jax.Array,
    substeps: int,
    segment: jax.Array | None = None,
    blur: float = 0.0,
) -> tuple[jax.Array, jax.Array]:
    """Measured angle [T] rad (encoder bias included) and motor torque [T] Nm at each command, before noise.

    Args:
      values: every name in `PARAMETERS`, scalars, and `start`, which may be [T], that of each sample's segment.
      target: [T] rad, a new one every `substeps` sub-steps; at rest before the first.
      latency: [] int, sub-steps until a target acts.
      timestep: s, of a sub-step.
      segment: [T] int; at the first sample of each segment the joint is put to its `start` and to rest. None: one.
      blur: rad, width of the dead-band's edges, for a gradient that sees it; 0 is the true model.
    """
    drive = Actuator(**{name: values[name] for name in PARAMETERS if name != "inertia"})
    count = target.shape[0]
    index = jnp.arange(count * substeps) - latency
    acting = target[jnp.clip(index // substeps, 0)].reshape(count, substeps)
    before = jnp.concatenate([acting[:1, 0], acting[:-1, -1]])
    rate = values["inertia"] / timestep

    def motor(target: jax.Array, position: jax.Array, velocity: jax.Array) -> jax.Array:
        if not blur:
            return joint_torque(drive, target, 0.0, position, velocity)
        error = target - (position + values["encoder_bias"])
        share = jax.nn.sigmoid((jnp.abs(error) - drive.dead_band) * (4.0 / blur))
        torque, limit = share * pd_torque(drive, error, 0.0, 0.0, velocity), torque_limit(drive, velocity)
        return drive.efficiency * jnp.clip(torque, -limit, limit)

    segment = jnp.zeros(count, jnp.int32) if segment is None else segment
    begins = jnp.concatenate([jnp.ones(1, bool), segment[1:] != segment[:-1]])
    starts = jnp.broadcast_to(values["start"], (count,))

    def tick(state: tuple, inputs: tuple) -> tuple[tuple, tuple]:
        position, velocity = state
        target_of, last, begin, start = inputs
        position, velocity = jnp.where(begin, start, position), jnp.where(begin, 0.0, velocity)
        reading = (position + values["encoder_bias"], motor(last, position, velocity))
        for substep in range(substeps):
            torque = motor(target_of[substep], position, velocity)
            velocity = velocity + apply_friction(drive, torque, velocity, rate) / rate
            position = position + timestep * velocity
        return (position, velocity), reading

    rest = (starts[0], jnp.zeros_like(starts[0]))
    return jax.lax.scan(tick, rest, (acting, before, begins, starts))[1]


def segments(log: JointLog, before: int = 8, least: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """Where a log may be begun anew because the joint rests: segment [T] int32, and its resting angle [S] rad.

    A joint in a dead-band or held by friction remembers where it came to rest; a simulation that misses that place by a
    little goes astray from there on. So each time the target has stood still for `before` samples, and the joint too, a
    segment of at least `least` samples begins.
    """
    position = np.asarray(log.position, float)
    noise = 1.4826 * np.median(np.abs(np.diff(position, 2))) / np.sqrt(6) + 1e-5
    changes = np.flatnonzero(np.diff(log.target) != 0) + 1
    firsts, angles = [0], [np.mean(position[: min(changes[0], before)])]
    for last, change in zip([0, *changes[:-1]], changes, strict=True):
        first = change - before
        if last > first or first - firsts[-1] < least or len(position) - first < least:
            continue
        early, late = position[first:change].reshape(2, -1).mean(1)
        if abs(early - late) < 4.0 * noise / np.sqrt(before / 4):
            firsts.append(int(first))
            angles.append(np.mean(position[first:change]))
    segment = np.zeros(len(position), np.int32)
    segment[firsts[1:]] = 1
    return np.cumsum(segment, dtype=np.int32), np.array(angles)


def with_defaults(values: Mapping[str, float], log: JointLog) -> dict[str, jax.Array]:
    """All parameters and the start, with nominal values for those left out. Raises CalibrationError: a name that is no
    parameter, or a missing parameter without a nominal value."""
    full = {name: parameter.nominal for name, parameter in PARAMETERS.items()}
    full["start"] = float(log.position[0]) - values.get("encoder_bias", 0.0)
    if unknown := sorted(set(values) - set(full)):
        raise CalibrationError(f"no parameter {unknown[0]!r}: choose from {', '.join(full)}")
    full |= values
    if missing := [name for name, value in full.items() if value is None]:
        raise CalibrationError(f"{log.name}: no value for {missing[0]}")
    return {name: jnp.float32(value) for name, value in full.items()}
