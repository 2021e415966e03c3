"""From an observation to an action: the pure functions of a policy, for use under `jit`, `vmap` and `scan`."""

from typing import Any, Literal

import jax
import numpy as np

from dexsim.core.errors import ConfigError
from dexsim.core.pytree import pytree_dataclass, static
from dexsim_ppo.learner.distribution import squash
from dexsim_ppo.learner.memory import Memory, empty, remember
from dexsim_ppo.learner.networks import MLP, apply_mlp
from dexsim_ppo.learner.running_stats import Normalizer, normalize

NEEDS_MEMORY = (
    "this policy has a memory: memory = policy.begin(), then memory, action = policy.act(memory, observation)"
)


@pytree_dataclass
class PolicyParams:
    """What `act` needs."""

    layers: MLP
    normalizer: Normalizer
    squash: Literal["gaussian", "tanh"] = static(default="gaussian")
    """`"gaussian"`: actions are clipped to [-1, 1]; `"tanh"`: squashed."""
    memory: Memory = None


def begin(params: PolicyParams, batch: tuple[int, ...] = ()) -> jax.Array | None:
    """What a policy remembers `[*batch, m]` at the start of an episode; None if it has no memory."""
    return empty(params.memory, params.normalizer.mean.shape[0], batch)


def act(params: PolicyParams, obs: jax.Array) -> jax.Array:
    """The policy's mode: actor observation `[..., n]`, SI units, to action `[..., A]` in [-1, 1].

    Raises:
      ConfigError: the policy has a memory, or observes another number of values.
    """
    return act_from(params, None, obs)[1]


def act_from(params: PolicyParams, memory: jax.Array | None, obs: jax.Array) -> tuple[jax.Array | None, jax.Array]:
    """One step of a policy with or without memory.

    Args:
      memory: `[..., m]`, at the start of an episode that of `begin`.
      obs: actor observation `[..., n]`, SI units.

    Returns:
      Memory after it, and the policy's mode: action `[..., A]` in [-1, 1].

    Raises:
      ConfigError: the memory is not that of this policy and batch, or the policy observes another number of values.
    """
    _check(params, memory, obs)
    memory, seen = remember(params.memory, memory, normalize(params.normalizer, obs))
    return memory, squash(apply_mlp(params.layers, seen), params.squash)


def _check(params: PolicyParams, memory: Any, obs: Any) -> None:
    if isinstance(obs, dict):
        raise ConfigError("the observation is a dictionary: give the actor's part, state.obs['actor']")
    size, shape = params.normalizer.mean.shape[0], np.shape(obs)
    if shape[-1:] != (size,):
        raise ConfigError(f"the policy observes {size} values, [..., {size}]; the observation has the shape {shape}")
    if memory is None and params.memory is not None:
        raise ConfigError(NEEDS_MEMORY)
    kept = jax.eval_shape(lambda: begin(params, shape[:-1]))
    if np.shape(memory) != np.shape(kept):
        wanted = "has no memory: give None" if kept is None else f"has one of the shape {kept.shape}"
        raise ConfigError(f"the memory has the shape {np.shape(memory)}; for this observation the policy {wanted}")
