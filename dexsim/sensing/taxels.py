"""What a taxel array does to the force before the host reads it: `TaxelSensor` configures it, `TaxelArray` does it.

    array = TaxelArray(TaxelSensor(gain=(0.85, 1.15)), hand, control_period=0.03)
    params = array.sample(key)                                   # once an episode
    memory = array.init()
    memory, reading = array.apply(params, memory, key, force)    # every control tick, [F, N] N

Order of effects, as on the way from skin to host: creep of the rubber (hysteresis), its spread to the neighbours
(crosstalk), gain, bias, drift and noise of the amplifier, dead taxels, activation threshold, counts and saturation of
the converter, and its own sampling rate. Effects with a range are off by default.

Shapes: F fingers, N taxels a finger.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import Config, Range, setting
from dexsim.core.ranges import uniform
from dexsim.hand.description import Hand

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


TaxelParams = dict[str, jax.Array]
"""One episode's array, without what is off: hysteresis, crosstalk, memory (the late part's share that is still missing
after a tick) and drift (N a tick) [F, 1]; gain, bias (N) and alive (bool) [F, N]; rate (samples a tick) and phase of
the array's clock []."""
TaxelMemory = dict[str, jax.Array]
"""What the array remembers, without what is off: late (the force as the late part sees it), walk (the drift so far) and
held (the last sample) [F, N] N; clock [], periods since that sample, below 0 before the first tick."""


@dataclasses.dataclass(frozen=True)
class TaxelArray:
    """A `TaxelSensor` on a hand, read at one control rate. Pure functions, for one environment; `vmap` them."""

    sensor: TaxelSensor
    hand: Hand
    control_period: float  # s

    def sample(self, key: jax.Array, scale: jax.Array | float = 1.0) -> TaxelParams:
        """Draw one episode's array; `scale` [] in [0, 1] is the width of all ranges about a perfect one."""
        sensor, each, finger = self.sensor, self.hand.taxel_area.shape, (self.hand.num_fingers, 1)
        keys = dict(zip((*DRAWN, "time", "alive", "phase"), jax.random.split(key, len(DRAWN) + 3), strict=True))
        params: TaxelParams = {}
        for name in DRAWN[:-1]:
            if (span := getattr(sensor, name)) is not None:
                shape, nominal = {"gain": each, "bias": each, "dead": ()}.get(name, finger), float(name == "gain")
                params[name] = nominal + scale * (uniform(keys[name], span, None, shape) - nominal)
        if "hysteresis" in params:
            time = uniform(keys["time"], sensor.hysteresis_time, None, finger)
            params["memory"] = jnp.exp(-self.control_period / time)
        if "drift" in params:
            params["drift"] *= self.control_period**0.5
        if "dead" in params:
            params["alive"] = jax.random.uniform(keys["alive"], each) >= params.pop("dead")
        if sensor.rate is not None:
            params["rate"] = self.control_period * uniform(keys["rate"], sensor.rate, None)
            params["phase"] = jax.random.uniform(keys["phase"], ())
        return params

    def init(self) -> TaxelMemory:
        """Before the first tick: nothing felt, nothing drifted."""
        sensor, nothing = self.sensor, jnp.zeros(self.hand.taxel_area.shape)
        memory = {"late": sensor.hysteresis, "walk": sensor.drift, "held": sensor.rate}
        clock = {} if sensor.rate is None else {"clock": jnp.full((), -1.0)}
        return {name: nothing for name, effect in memory.items() if effect is not None} | clock

    def apply(
        self,
        params: TaxelParams,
        memory: TaxelMemory,
        key: jax.Array,
        force: jax.Array,
        finger_gain: jax.Array | float = 1.0,
    ) -> tuple[TaxelMemory, jax.Array]:
        """One control tick: true forces [F, N] N in, readings [F, N] N out; `finger_gain` [F, 1] is on top."""
        sensor, memory = self.sensor, dict(memory)
        value = load = force * finger_gain
        if "late" in memory:
            memory["late"] = load + params["memory"] * (memory["late"] - load)
            value = value + params["hysteresis"] * (memory["late"] - load)
        if "crosstalk" in params:
            value = value + params["crosstalk"] / 4 * neighbour_difference(value, self.hand.taxel_grid)
        if "gain" in params:
            value = value * params["gain"]
        if "bias" in params:
            value = value + params["bias"]
        if "walk" in memory:
            memory["walk"] += params["drift"] * jax.random.normal(jax.random.fold_in(key, 2), force.shape)
            value = value + memory["walk"]
        value = value + sensor.noise * jax.random.normal(key, force.shape)
        if "alive" in params:
            value = jnp.where(params["alive"], value, 0.0)
        value = jnp.where(value < sensor.threshold, 0.0, value)
        if sensor.resolution > 0:
            value = jnp.round(value / sensor.resolution) * sensor.resolution
        value = jnp.clip(value, 0.0, sensor.saturation)
        if "clock" in memory:
            first = memory["clock"] < 0
            clock = jnp.where(first, params["phase"], memory["clock"] + params["rate"])
            value = jnp.where(first | (clock >= 1), value, memory["held"])
            memory |= {"held": value, "clock": clock - jnp.floor(clock)}
        return memory, value


def neighbour_difference(force: jax.Array, grid: tuple[int, int]) -> jax.Array:
    """Sum over a taxel's lattice neighbours of their force less its own [F, N]; sums to zero over a finger."""
    map_ = force.reshape(*force.shape[:-1], *grid)
    wide = jnp.pad(map_, [(0, 0)] * (map_.ndim - 2) + [(1, 1)] * 2, mode="edge")
    around = wide[..., :-2, 1:-1] + wide[..., 2:, 1:-1] + wide[..., 1:-1, :-2] + wide[..., 1:-1, 2:]
    return (around - 4 * map_).reshape(force.shape)
