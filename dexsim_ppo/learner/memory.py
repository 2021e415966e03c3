"""A policy's memory: a gated recurrent unit (Cho et al. 2014), or none.

Its carry is one array `[..., m]`, zero at the start of an episode. The actor's network sees the normalised observation
and the carry after it: n + m numbers. A policy without memory has None for both, and sees n.
"""

import jax
import jax.numpy as jnp

from dexsim.core.pytree import align, pytree_dataclass
from dexsim_ppo.learner.networks import Layer


@pytree_dataclass
class GRU:
    """A gated recurrent unit of m units. The reset gate acts after the product, as in cuDNN and PyTorch."""

    input: Layer  # n to 3 m: reset gate, update gate, candidate
    recurrent: Layer  # m to 3 m


def init_gru(key: jax.Array, size: int, units: int) -> GRU:
    """A unit for observations [size]."""
    keys = jax.random.split(key, 4)
    orthogonal = jax.nn.initializers.orthogonal()
    return GRU(
        Layer(jax.nn.initializers.lecun_normal()(keys[0], (size, 3 * units), jnp.float32), jnp.zeros(3 * units)),
        Layer(jnp.concatenate([orthogonal(k, (units, units), jnp.float32) for k in keys[1:]], 1), jnp.zeros(3 * units)),
    )


def carry_size(memory: GRU | None) -> int:
    """Length m of the carry; 0 without memory."""
    return 0 if memory is None else memory.recurrent.kernel.shape[0]


def zero_carry(memory: GRU | None, batch: tuple[int, ...] = ()) -> jax.Array | None:
    """The carry [*batch, m] at the start of an episode."""
    return None if memory is None else jnp.zeros((*batch, carry_size(memory)))


def step_memory(
    memory: GRU | None, carry: jax.Array | None, x: jax.Array, precision: str = "highest"
) -> tuple[jax.Array | None, jax.Array]:
    """One step.

    Args:
      carry: [..., m] before it.
      x: [..., n] normalised observation.

    Returns:
      The carry after it, and what the actor's network sees [..., n + m].
    """
    if memory is None or carry is None:
        return carry, x
    now, past = (
        jnp.matmul(a, layer.kernel, precision=precision) + align(layer.bias, a)
        for a, layer in ((x, memory.input), (carry, memory.recurrent))
    )
    (reset, update, new), (past_reset, past_update, past_new) = (jnp.split(a, 3, -1) for a in (now, past))
    update = jax.nn.sigmoid(update + past_update)
    new = jnp.tanh(new + jax.nn.sigmoid(reset + past_reset) * past_new)
    carry = update * carry + (1 - update) * new
    return carry, jnp.concatenate([x, carry], -1)


def scan_memory(
    memory: GRU | None, carry: jax.Array | None, x: jax.Array, first: jax.Array | None, precision: str = "highest"
) -> jax.Array:
    """What the actor's network saw [N, T, n + m] in rollouts; gradients go back through all T steps.

    Args:
      carry: [N, T, m] before each step, of which the first is taken.
      x: [N, T, n] normalised observations; without memory [..., n].
      first: [N, T] whether a step is the first of an episode, which begins with a zero carry.
    """
    if memory is None or carry is None or first is None:
        return x

    def step(carry, inputs):
        x, first = inputs
        return step_memory(memory, jnp.where(first[:, None], 0.0, carry), x, precision)

    swap = lambda a: jnp.swapaxes(a, 0, 1)  # noqa: E731
    return swap(jax.lax.scan(step, carry[:, 0], (swap(x), swap(first)))[1])
