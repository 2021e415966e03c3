"""A curriculum: randomisation ranges widen as the success rate grows."""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import Config, setting
from dexsim.core.errors import ConfigError


@dataclasses.dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Config):
    """How the scale of the randomisation ranges follows the success rate. The scale is part of the training state."""

    on: bool = setting(False)
    """Widen the ranges during training; otherwise they have their full width from the start."""
    metric: str = setting("")
    """Training metric that measures success, such as episode/successes. Empty: the share of ended episodes that
    reached their time limit."""
    start: float = setting(0.1, unit="1", low=0.0, high=1.0)
    """Initial scale."""
    widen_above: float = setting(0.8, unit="1", low=0.0, high=1e6)
    """Success at or above which the ranges widen."""
    narrow_below: float = setting(0.4, unit="1", low=0.0, high=1e6)
    """Success below which the ranges narrow."""
    step: float = setting(0.02, unit="1", low=0.0001, high=1.0)
    """Change of the scale per iteration."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.narrow_below > self.widen_above:
            raise ConfigError(
                f"CurriculumConfig.narrow_below = {self.narrow_below:g}: must not exceed widen_above = "
                f"{self.widen_above:g}"
            )


def next_scale(scale: jax.Array, success: jax.Array, curriculum: CurriculumConfig) -> jax.Array:
    """The next scale [] in [0, 1], from the current scale [] and the success [].

    A NaN success (no episode has ended) leaves the scale unchanged.
    """
    narrower = jnp.where(success < curriculum.narrow_below, -curriculum.step, 0.0)
    step = jnp.where(success >= curriculum.widen_above, curriculum.step, narrower)
    return jnp.clip(scale + step, 0.0, 1.0)
