"""From an observation to an action: the pure functions of a policy, for use under `jit`, `vmap` and `scan`."""

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import ConfigError
from dexsim.core.pytree import pytree_dataclass
from dexsim_ppo.learner.memory import GRU, carry_size, step_memory, zero_carry
from dexsim_ppo.learner.networks import MLP, apply_mlp
from dexsim_ppo.learner.running_stats import Normalizer, normalize


@pytree_dataclass
class PolicyParams:
    """What `act` needs."""

    layers: MLP
    normalizer: Normalizer
    memory: GRU | None = None


def initial_carry(params: PolicyParams, batch: tuple[int, ...] = ()) -> jax.Array | None:
    """The carry `[*batch, m]` at the start of an episode; None for a policy without memory."""
    return zero_carry(params.memory, batch)


def act(params: PolicyParams, carry: jax.Array | None, obs: jax.Array) -> tuple[jax.Array | None, jax.Array]:
    """One step of a policy, with or without memory.

    Args:
      params: `policy.params`.
      carry: `[..., m]` from the step before; at the start of an episode `policy.initial_carry(...)`.
      obs: actor observation `[..., n]`, SI units.

    Returns:
      The next carry `[..., m]`, and the policy's mode: action `[..., A]` in [-1, 1].

    Raises:
      ConfigError: the observation has another size, or the carry is not that of this policy and batch.
    """
    size, shape = params.normalizer.mean.size, np.shape(obs)
    carried = None if params.memory is None else (*shape[:-1], carry_size(params.memory))
    given = None if carry is None else np.shape(carry)
    if shape[-1:] != (size,) or given != carried:
        raise ConfigError(
            f"expected an actor observation [..., {size}] and a carry of the shape {carried}, got {shape} and {given}: "
            "begin an episode with carry = policy.initial_carry(number of environments)"
        )
    carry, features = step_memory(params.memory, carry, normalize(params.normalizer, obs))
    return carry, jnp.clip(apply_mlp(params.layers, features), -1.0, 1.0)
