"""Memory of a policy: what it keeps of an episode's earlier observations.

A memory's state is one array `[..., m]`, all zero at the start of an episode. It is in units of normalised
observations, or an activation. The actor's network sees the present observation and those m numbers.
"""

import jax
import jax.numpy as jnp

from dexsim.core.pytree import align, pytree_dataclass, static
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.networks import Layer


@pytree_dataclass
class History:
    """The last observations as they were, latest first; m = length * n."""

    length: int = static()


@pytree_dataclass
class GRU:
    """A gated recurrent unit (Cho et al. 2014) of H units, with the reset gate after the product; m = H."""

    input: Layer  # n to 3 H: reset gate, update gate, candidate
    recurrent: Layer  # H to 3 H


Memory = History | GRU | None
"""None remembers nothing; its state is None, too."""


def init_memory(key: jax.Array, config: PPOConfig, size: int) -> Memory:
    """The memory that the configuration chooses, for observations [size]."""
    if config.memory == "history":
        return History(config.memory_length - 1)
    if config.memory == "none":
        return None
    units = config.memory_size
    keys = jax.random.split(key, 4)
    orthogonal = jax.nn.initializers.orthogonal()
    return GRU(
        Layer(jax.nn.initializers.lecun_normal()(keys[0], (size, 3 * units), jnp.float32), jnp.zeros(3 * units)),
        Layer(jnp.concatenate([orthogonal(k, (units, units), jnp.float32) for k in keys[1:]], 1), jnp.zeros(3 * units)),
    )


def state_size(memory: Memory, size: int) -> int:
    """Length m of the state, for observations [size]."""
    if memory is None:
        return 0
    return memory.length * size if isinstance(memory, History) else memory.recurrent.kernel.shape[0]


def empty(memory: Memory, size: int, batch: tuple[int, ...] = ()) -> jax.Array | None:
    """The state [*batch, m] at the start of an episode, for observations [size]."""
    return None if memory is None else jnp.zeros((*batch, state_size(memory, size)))


def remember(
    memory: Memory, state: jax.Array | None, x: jax.Array, precision: str = "highest"
) -> tuple[jax.Array | None, jax.Array]:
    """One step.

    Args:
      state: [..., m] before it.
      x: [..., n] normalised observation.

    Returns:
      The state after it, and what the actor's network sees [..., n + m].
    """
    if memory is None or state is None:
        return state, x
    if isinstance(memory, History):
        seen = jnp.concatenate([x, state], -1)
        return seen[..., : state.shape[-1]], seen
    given, past = (
        jnp.matmul(a, layer.kernel, precision=precision) + align(layer.bias, a)
        for a, layer in ((x, memory.input), (state, memory.recurrent))
    )
    (reset, update, new), (past_reset, past_update, past_new) = (jnp.split(a, 3, -1) for a in (given, past))
    update = jax.nn.sigmoid(update + past_update)
    new = jnp.tanh(new + jax.nn.sigmoid(reset + past_reset) * past_new)
    state = update * state + (1 - update) * new
    return state, jnp.concatenate([x, state], -1)


def recall(
    memory: Memory, state: jax.Array | None, x: jax.Array, first: jax.Array | None, precision: str = "highest"
) -> jax.Array:
    """What the actor's network saw [..., n + m], of experience.

    Args:
      state: [N, m] before each row; of a GRU [N, T, m], whose first step alone is taken: gradients go through time.
      x: [N, n] normalised observations; of a GRU sequences [N, T, n].
      first: [N, T] whether a step is the first of an episode; of a GRU alone.
    """
    if not isinstance(memory, GRU):
        return remember(memory, state, x, precision)[1]
    assert state is not None and first is not None, "what a GRU's experience has"

    def step(state, now):
        x, first = now
        return remember(memory, jnp.where(first[:, None], 0.0, state), x, precision)

    swap = lambda a: jnp.swapaxes(a, 0, 1)  # noqa: E731
    return swap(jax.lax.scan(step, state[:, 0], (swap(x), swap(first)))[1])
