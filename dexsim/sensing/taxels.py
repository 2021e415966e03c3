"""What a taxel array does to the force before the host reads it: each imperfection on or off.

A `SensorNoise` names them with their ranges; `SensorModel` is that on one lattice at one control rate, as three pure
functions:

    model = SensorNoise().model((10, 12), fingers=5, control_period=0.03)
    params = model.sample(key)                                # once an episode
    state = model.init()
    state, reading = model.apply(params, state, key, force)   # every control step, [F, N] N

Order of effects, as on the way from skin to host: creep of the rubber (hysteresis), its spread to the neighbours
(crosstalk), gain, bias, drift and noise of the amplifier, dead taxels, activation threshold, counts and saturation of
the converter, and its own sampling rate. Published ranges: Tactile Genesis 2026 (gain 0.85-1.15, 5 % dead taxels,
hysteresis 0.5 at 0.05 s), the hand's own bytes of 0.1 N.

Shapes: F fingers, N taxels a finger.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.config import check_ranges, setting, validate
from dexsim.core.errors import ConfigError
from dexsim.core.pytree import pytree_dataclass

COUNTS = {"none": (-np.inf, np.inf), "uint8": (0.0, 255.0), "int8": (-128.0, 127.0)}
Range = tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """Ranges (low, high), drawn uniformly at every episode start. None switches an effect off."""

    scale: float = setting(1.0, unit="1", low=0.0, high=3.0)
    """Width of all ranges about a perfect sensor; 0 passes the force through untouched, counts included."""
    hysteresis: Range | None = setting((0.0, 0.3), unit="1", low=0.0, high=0.9)
    """Share of a change that comes late, per finger; None: no such effect."""
    hysteresis_time: Range = setting((0.03, 0.2), unit="s", low=1e-3, high=10.0)
    """Time constant of that share."""
    crosstalk: Range | None = setting((0.0, 0.1), unit="1", low=0.0, high=0.8)
    """Share of a taxel's force that its four neighbours on the lattice feel instead, per finger; None: no such
    effect."""
    gain: Range | None = setting((0.85, 1.15), unit="1", low=0.05, high=5.0)
    """Factor on each taxel; None: no such effect."""
    bias: Range | None = setting((-0.03, 0.03), unit="N", low=-10.0, high=10.0)
    """Constant error of each taxel, left over by the tare; None: no such effect."""
    drift: Range | None = setting((0.0, 0.005), unit="N/sqrt(s)", low=0.0, high=1.0)
    """Random walk of each taxel: its standard deviation after one second, per finger; None: no such effect."""
    noise: Range | None = setting((0.005, 0.02), unit="N", low=0.0, high=10.0)
    """Standard deviation of white noise, per finger; None: no such effect."""
    dead: Range | None = setting((0.0, 0.05), unit="1", low=0.0, high=1.0)
    """Probability that a taxel reads zero for the whole episode; None: no such effect."""
    threshold: Range | None = setting((0.03, 0.10), unit="N", low=0.0, high=10.0)
    """Magnitude below which a taxel reads zero, per taxel; None: no such effect."""
    counts: str = setting("uint8", choices=tuple(COUNTS))
    """Integer type of a reading: uint8 for normal, int8 for tangential force; none: no rounding, no saturation."""
    resolution: float = setting(0.1, unit="N", low=1e-6, high=10.0)
    """Force per count: bytes saturate at 25.5 N."""
    rate: Range | None = setting(None, unit="Hz", low=0.1, high=1e4)
    """The array's own sampling rate, below the control rate; between samples the last reading is repeated. None: it
    samples at the control rate."""

    def __post_init__(self):
        validate(self)
        names = [f.name for f in dataclasses.fields(self) if isinstance(getattr(self, f.name), tuple)]
        check_ranges(self, *names)
        if self.gain is not None and min(1 + self.scale * (g - 1) for g in self.gain) < 0:
            raise ConfigError(
                f"SensorNoise.gain = ({self.gain[0]:g}, {self.gain[1]:g}) at scale {self.scale:g} "
                "reaches below 0: narrow one or the other"
            )
        for name, most in (("hysteresis", 1.0), ("crosstalk", 0.8), ("dead", 1.0)):
            span = getattr(self, name)
            if span is not None and self.scale * span[1] > most:
                raise ConfigError(
                    f"SensorNoise.{name} = ({span[0]:g}, {span[1]:g}) at scale {self.scale:g} exceeds "
                    f"{most:g}: narrow one or the other"
                )

    def model(self, grid: tuple[int, int], *, fingers: int, control_period: float) -> SensorModel:
        """This sensor on a lattice of (columns, rows) on each finger, read every `control_period` s."""
        return SensorModel(self, tuple(grid), fingers, control_period)


@pytree_dataclass
class SensorParams:
    """One episode's array; None for what is switched off."""

    hysteresis: jax.Array | None  # [F, 1]
    memory: jax.Array | None  # [F, 1], share of the late part that is still missing after a control step
    crosstalk: jax.Array | None  # [F, 1]
    gain: jax.Array | None  # [F, N]
    bias: jax.Array | None  # [F, N] N
    drift: jax.Array | None  # [F, 1] N a step
    noise: jax.Array | None  # [F, 1] N
    alive: jax.Array | None  # [F, N] bool
    threshold: jax.Array | None  # [F, N] N
    rate: jax.Array | None  # [] samples a control step
    phase: jax.Array | None  # [] in [0, 1), of the array's clock at the first step


@pytree_dataclass
class SensorState:
    """What the array remembers from step to step; None for what is switched off."""

    late: jax.Array | None  # [F, N] N, the force as the late part sees it
    walk: jax.Array | None  # [F, N] N, drift so far
    held: jax.Array | None  # [F, N] N, the last sample
    clock: jax.Array | None  # [] periods of the array since its last sample; below 0 before the first step


@dataclasses.dataclass(frozen=True)
class SensorModel:
    """`SensorNoise` on one lattice at one control rate. Pure functions, for one environment; `vmap` them."""

    config: SensorNoise
    grid: tuple[int, int]
    fingers: int
    control_period: float

    @property
    def shape(self) -> tuple[int, int]:
        """(F, N)."""
        return self.fingers, self.grid[0] * self.grid[1]

    def sample(self, key: jax.Array, scale: jax.Array | float = 1.0) -> SensorParams:
        """Draw one episode's array; `scale` [] is on top of the configuration's and may be traced."""
        c, keys = self.config, iter(jax.random.split(key, 13))
        each, finger, width = self.shape, (self.fingers, 1), self.config.scale * scale

        def draw(span: Range | None, nominal: float, shape: tuple[int, ...]) -> jax.Array | None:
            own = next(keys)
            if span is None:
                return None
            return nominal + width * (jax.random.uniform(own, shape, minval=span[0], maxval=span[1]) - nominal)

        time_key, rate_key = next(keys), next(keys)
        time = jax.random.uniform(time_key, finger, minval=c.hysteresis_time[0], maxval=c.hysteresis_time[1])
        params = SensorParams(
            hysteresis=draw(c.hysteresis, 0.0, finger),
            memory=None if c.hysteresis is None else jnp.exp(-self.control_period / time),
            crosstalk=draw(c.crosstalk, 0.0, finger), gain=draw(c.gain, 1.0, each), bias=draw(c.bias, 0.0, each),
            drift=draw(c.drift, 0.0, finger), noise=draw(c.noise, 0.0, finger), alive=draw(c.dead, 0.0, ()),
            threshold=draw(c.threshold, 0.0, each), rate=None, phase=None,
        )  # fmt: skip
        dead_key, phase_key = next(keys), next(keys)
        found = {}
        if c.drift is not None:
            found["drift"] = params.drift * self.control_period**0.5
        if c.dead is not None:
            found["alive"] = jax.random.uniform(dead_key, each) >= params.alive
        if c.rate is not None:
            found["rate"] = self.control_period * jax.random.uniform(rate_key, (), minval=c.rate[0], maxval=c.rate[1])
            found["phase"] = jax.random.uniform(phase_key, ())
        return dataclasses.replace(params, **found)

    def init(self) -> SensorState:
        """Before the first step: nothing felt, nothing drifted."""
        c, nothing = self.config, jnp.zeros(self.shape)
        slow = c.rate is not None
        return SensorState(
            late=None if c.hysteresis is None else nothing,
            walk=None if c.drift is None else nothing,
            held=nothing if slow else None,
            clock=jnp.full((), -1.0) if slow else None,
        )

    def apply(
        self, params: SensorParams, state: SensorState, key: jax.Array, force: jax.Array
    ) -> tuple[SensorState, jax.Array]:
        """One control step: true forces [F, N] N in, readings [F, N] N out."""
        c = self.config
        if c.scale == 0:
            return state, force
        keys = jax.random.split(key)
        value, late, walk = force, state.late, state.walk
        if c.hysteresis is not None:
            late = force + params.memory * (late - force)
            value = value + params.hysteresis * (late - force)
        if c.crosstalk is not None:
            value = value + params.crosstalk / 4 * neighbour_difference(value, self.grid)
        if c.gain is not None:
            value = value * params.gain
        if c.bias is not None:
            value = value + params.bias
        if c.drift is not None:
            walk = walk + params.drift * jax.random.normal(keys[0], self.shape)
            value = value + walk
        if c.noise is not None:
            value = value + params.noise * jax.random.normal(keys[1], self.shape)
        if c.dead is not None:
            value = jnp.where(params.alive, value, 0.0)
        if c.threshold is not None:
            value = jnp.where(jnp.abs(value) < params.threshold, 0.0, value)
        if c.counts != "none":
            low, high = COUNTS[c.counts]
            value = c.resolution * jnp.clip(jnp.round(value / c.resolution), low, high)
        held, clock = state.held, state.clock
        if c.rate is not None:
            first = clock < 0
            clock = jnp.where(first, params.phase, clock + params.rate)
            value = jnp.where(first | (clock >= 1), value, held)
            held, clock = value, clock - jnp.floor(clock)
        return SensorState(late, walk, held, clock), value


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
