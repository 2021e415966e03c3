"""A curriculum: the width of the environments' ranges follows success."""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import setting, validate
from dexsim.core.errors import ConfigError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Curriculum:
    """How the scale of the ranges follows success; the scale is part of the training state."""

    on: bool = setting(False)
    """Widen the ranges while training; off, they have their full width from the beginning."""
    metric: str = setting("")
    """What counts as success: by default the share of ended episodes that lived to their time limit,
    else a metric of training by name, such as episode/goals_per_minute."""
    start: float = setting(0.1, unit="1", low=0.0, high=1.0)
    """Scale at the beginning."""
    widen_above: float = setting(0.8, unit="1", low=0.0, high=1e6)
    """Success from which the ranges grow."""
    narrow_below: float = setting(0.4, unit="1", low=0.0, high=1e6)
    """Success below which they shrink."""
    step: float = setting(0.02, unit="1", low=0.0001, high=1.0)
    """Change of the scale at each update."""

    def __post_init__(self):
        validate(self)
        if self.narrow_below > self.widen_above:
            raise ConfigError(
                f"Curriculum.narrow_below = {self.narrow_below:g}: must not exceed widen_above = {self.widen_above:g}"
            )


def next_scale(scale: jax.Array, success: jax.Array, curriculum: Curriculum) -> jax.Array:
    """The scale [] in [0, 1] after an update with this rate of success [] in [0, 1].

    A rate that is not a number (no episode has ended) leaves the scale as it is.
    """
    step = jnp.where(
        success >= curriculum.widen_above,
        curriculum.step,
        jnp.where(success < curriculum.narrow_below, -curriculum.step, 0.0),
    )
    return jnp.clip(scale + step, 0.0, 1.0)
