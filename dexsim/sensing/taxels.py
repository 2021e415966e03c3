"""What a taxel array does to the force before the host reads it: `TaxelSensor` configures it, `TaxelArray` does it.

    array = TaxelArray(TaxelSensor(gain=(0.85, 1.15)), (10, 12), fingers=5, control_period=0.03)
    params = array.sample(key)                                   # once an episode
    memory = array.init()
    memory, reading = array.apply(params, memory, key, force)    # every control tick, [F, N] N

Order of effects, as on the way from skin to host: creep of the rubber (hysteresis), its spread to the neighbours
(crosstalk), gain, bias, drift and noise of the amplifier, dead taxels, activation threshold, counts and saturation of
the converter, and its own sampling rate. Effects with a range are off by default.

Shapes: F fingers, N taxels a finger.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import Config, Range, setting
from dexsim.core.pytree import pytree_dataclass

DRAWN = ("hysteresis", "crosstalk", "gain", "bias", "drift", "dead", "rate")
"""Effects that are drawn at every episode start where they have a range."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaxelSensor(Config):
    """From the force on a taxel to its reading. Ranges (low, high) are drawn at every episode start.

    Published ranges (Tactile Genesis 2026): gain 0.85 to 1.15, 5 % dead taxels, hysteresis 0.5 at 0.05 s.
    """

    noise: float = setting(0.02, unit="N", low=0.0, high=10.0)
    """Standard deviation of white noise on each taxel, including what the tare leaves of its zero."""
    threshold: float = setting(0.05, unit="N", low=0.0, high=10.0)
    """Readings below this are reported as zero."""
    resolution: float = setting(0.1, unit="N", low=0.0, high=10.0)
    """Force per count; 0 leaves readings unquantised. The hand reports bytes of 0.1 N."""
    saturation: float = setting(25.5, unit="N", low=0.1, high=1000.0)
    """Largest force a taxel can report."""
    hysteresis: Range | None = setting(None, unit="1", low=0.0, high=0.9)
    """Share of a change that arrives late, per finger; None: no such effect."""
    hysteresis_time: Range = setting((0.03, 0.2), unit="s", low=1e-3, high=10.0)
    """Time constant of that share."""
    crosstalk: Range | None = setting(None, unit="1", low=0.0, high=0.8)
    """Share of a taxel's force that its four neighbours feel instead, per finger; None: no such effect."""
    gain: Range | None = setting(None, unit="1", low=0.05, high=5.0)
    """Factor on each taxel, on top of the finger's (`Randomization.taxel_gain`); None: no such effect."""
    bias: Range | None = setting(None, unit="N", low=-10.0, high=10.0)
    """Constant error of each taxel, left over by the tare; None: no such effect."""
    drift: Range | None = setting(None, unit="N/sqrt(s)", low=0.0, high=1.0)
    """Random walk of each taxel: its standard deviation after one second, per finger; None: no such effect."""
    dead: Range | None = setting(None, unit="1", low=0.0, high=1.0)
    """Probability that a taxel reads zero for the whole episode; None: no such effect."""
    rate: Range | None = setting(None, unit="Hz", low=0.1, high=1e4)
    """The array's own sampling rate, below the control rate; between samples the last reading is repeated. None: it
    samples at the control rate."""


@pytree_dataclass
class TaxelParams:
    """One episode's array; None for what is off."""

    hysteresis: jax.Array | None  # [F, 1]
    memory: jax.Array | None  # [F, 1], share of the late part that is still missing after a control tick
    crosstalk: jax.Array | None  # [F, 1]
    gain: jax.Array | None  # [F, N]
    bias: jax.Array | None  # [F, N] N
    drift: jax.Array | None  # [F, 1] N a tick
    alive: jax.Array | None  # [F, N] bool
    rate: jax.Array | None  # [] samples a control tick
    phase: jax.Array | None  # [] in [0, 1), of the array's clock at the first tick


@pytree_dataclass
class TaxelMemory:
    """What the array remembers from tick to tick; None for what is off."""

    late: jax.Array | None  # [F, N] N, the force as the late part sees it
    walk: jax.Array | None  # [F, N] N, drift so far
    held: jax.Array | None  # [F, N] N, the last sample
    clock: jax.Array | None  # [] periods of the array since its last sample; below 0 before the first tick


@dataclasses.dataclass(frozen=True)
class TaxelArray:
    """A `TaxelSensor` on a lattice, read at one control rate. Pure functions, for one environment; `vmap` them."""

    sensor: TaxelSensor
    grid: tuple[int, int]  # columns, rows
    fingers: int
    control_period: float  # s

    @property
    def shape(self) -> tuple[int, int]:
        """(F, N)."""
        return self.fingers, self.grid[0] * self.grid[1]

    def sample(self, key: jax.Array, scale: jax.Array | float = 1.0) -> TaxelParams:
        """Draw one episode's array; `scale` [] in [0, 1] is the width of all ranges about a perfect one."""
        sensor, each, finger = self.sensor, self.shape, (self.fingers, 1)
        keys = dict(zip((*DRAWN, "time", "alive", "phase"), jax.random.split(key, len(DRAWN) + 3), strict=True))

        def draw(name: str, nominal: float, shape: tuple[int, ...]) -> jax.Array | None:
            span = getattr(sensor, name)
            return None if span is None else nominal + scale * (_uniform(keys[name], span, shape) - nominal)

        drift, dead = draw("drift", 0.0, finger), draw("dead", 0.0, ())
        time = _uniform(keys["time"], sensor.hysteresis_time, finger)
        return TaxelParams(
            hysteresis=draw("hysteresis", 0.0, finger),
            memory=None if sensor.hysteresis is None else jnp.exp(-self.control_period / time),
            crosstalk=draw("crosstalk", 0.0, finger),
            gain=draw("gain", 1.0, each),
            bias=draw("bias", 0.0, each),
            drift=None if drift is None else drift * self.control_period**0.5,
            alive=None if dead is None else jax.random.uniform(keys["alive"], each) >= dead,
            rate=None if sensor.rate is None else self.control_period * _uniform(keys["rate"], sensor.rate, ()),
            phase=None if sensor.rate is None else jax.random.uniform(keys["phase"], ()),
        )

    def init(self) -> TaxelMemory:
        """Before the first tick: nothing felt, nothing drifted."""
        sensor, nothing = self.sensor, jnp.zeros(self.shape)
        slow = sensor.rate is not None
        return TaxelMemory(
            late=None if sensor.hysteresis is None else nothing,
            walk=None if sensor.drift is None else nothing,
            held=nothing if slow else None,
            clock=jnp.full((), -1.0) if slow else None,
        )

    def apply(
        self,
        params: TaxelParams,
        memory: TaxelMemory,
        key: jax.Array,
        force: jax.Array,
        finger_gain: jax.Array | float = 1.0,
    ) -> tuple[TaxelMemory, jax.Array]:
        """One control tick: true forces [F, N] N in, readings [F, N] N out; `finger_gain` [F, 1] is on top."""
        sensor, late, walk = self.sensor, memory.late, memory.walk
        value = load = force * finger_gain
        # What is off is None in `params` and `memory` alike.
        if late is not None:
            assert params.memory is not None and params.hysteresis is not None
            late = load + params.memory * (late - load)
            value = value + params.hysteresis * (late - load)
        if params.crosstalk is not None:
            value = value + params.crosstalk / 4 * neighbour_difference(value, self.grid)
        if params.gain is not None:
            value = value * params.gain
        if params.bias is not None:
            value = value + params.bias
        if walk is not None:
            assert params.drift is not None
            walk = walk + params.drift * jax.random.normal(jax.random.fold_in(key, 2), self.shape)
            value = value + walk
        value = value + sensor.noise * jax.random.normal(key, force.shape)
        if params.alive is not None:
            value = jnp.where(params.alive, value, 0.0)
        value = jnp.where(value < sensor.threshold, 0.0, value)
        if sensor.resolution > 0:
            value = jnp.round(value / sensor.resolution) * sensor.resolution
        value = jnp.clip(value, 0.0, sensor.saturation)
        held, clock = memory.held, memory.clock
        if clock is not None:
            assert held is not None and params.phase is not None and params.rate is not None
            first = clock < 0
            clock = jnp.where(first, params.phase, clock + params.rate)
            value = jnp.where(first | (clock >= 1), value, held)
            held, clock = value, clock - jnp.floor(clock)
        return TaxelMemory(late, walk, held, clock), value


def neighbour_difference(force: jax.Array, grid: tuple[int, int]) -> jax.Array:
    """Sum over a taxel's lattice neighbours of their force less its own [F, N]; sums to zero over a finger."""
    map_ = force.reshape(*force.shape[:-1], *grid)
    total = jnp.zeros_like(map_)
    for axis in (-2, -1):
        step = jnp.diff(map_, axis=axis)
        ahead = [(0, 0)] * map_.ndim
        behind = [(0, 0)] * map_.ndim
        ahead[axis], behind[axis] = (0, 1), (1, 0)
        total = total + jnp.pad(step, ahead) - jnp.pad(step, behind)
    return total.reshape(force.shape)


def _uniform(key: jax.Array, span: Range, shape: tuple[int, ...]) -> jax.Array:
    return jax.random.uniform(key, shape, minval=span[0], maxval=span[1])
