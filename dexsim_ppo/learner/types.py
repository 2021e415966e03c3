"""What the trainer knows of an environment, and nothing more."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np


class Field(NamedTuple):
    """One named slice of an observation vector."""

    name: str
    size: int
    scale: float | None
    """A fixed divisor in the field's own unit; None asks for running statistics."""


Fields = Sequence[Any]
"""Fields of one observation group, in order: anything with `name`, `size` and `scale`."""


class State(Protocol):
    """State of one environment: a pytree. Callers add batch axes with `jax.vmap`."""

    obs: Mapping[str, jax.Array]
    """`"actor"` [n] and `"critic"` [m]; after `step`, before `restart`: the true final observation."""
    reward: jax.Array
    terminated: jax.Array
    """bool []: the episode ended for good; nothing follows. Wins over `truncated`."""
    truncated: jax.Array
    """bool []: the time limit cut the episode; the return goes on beyond it."""
    metrics: Mapping[str, jax.Array]
    """Scalars of this step; `"return"` and `"length"` are running sums over the episode."""


class Environment(Protocol):
    """Pure functions of one environment's state."""

    name: str
    backend: str
    config: Any
    action_size: int
    observation_layout: Mapping[str, Fields]
    control_period: float
    """Length of one control tick, s."""
    evaluation_steps: int
    """Length of an evaluation episode in ticks."""

    evaluation: str
    """What `summarize` is given: "series" of every tick, or "totals" that the task keeps by itself."""

    def reset(self, key: jax.Array) -> Any:
        """A new episode. One that can follow a curriculum also takes `scale` [] in [0, 1]."""
        ...

    def step(self, state: Any, action: jax.Array) -> Any:
        """Advance by one control tick with an action [A], clipped to [-1, 1]; no automatic restart."""
        ...

    def restart(self, state: Any, done: jax.Array) -> Any:
        """Begin a new episode where `done`, else return the state as it is, but for random keys."""
        ...

    def widen(self, state: Any, scale: jax.Array) -> Any:
        """Let the next episodes be drawn from ranges of this width []; only with a curriculum."""
        ...

    def stagger(self, state: Any, key: jax.Array) -> Any:
        """Move the episode clock to a random time, so that a batch does not truncate in step."""
        ...

    def evaluation_starts(self, key: jax.Array, count: int) -> Any:
        """States [count] at which the task's evaluation episodes start."""
        ...

    def summarize(self, metrics: Mapping[str, np.ndarray], alive: np.ndarray) -> dict[str, Any]:
        """The task's report from evaluation metrics [T, N] and the mask [T, N] of live steps; with "totals"
        from the metrics of each episode's last tick [N] and the ticks it lived [N]."""
        ...

    def snapshot(self, state: Any) -> Any:
        """What one frame of video shows."""
        ...


def layout_size(fields: Fields) -> int:
    """Length of the observation vector that these fields make up."""
    return sum(field.size for field in fields)
