"""Networks of actor and critic, multilayer perceptrons and a gated recurrent unit, as plain functions on pytrees.

Matrix products name their precision: on NVIDIA GPUs JAX's default is TF32, and its 10-bit mantissa
kept cube reorientation from being learned.
"""

import itertools

import jax
import jax.numpy as jnp

from dexsim.core.pytree import align, pytree_dataclass


@pytree_dataclass
class Layer:
    """An affine map."""

    kernel: jax.Array  # [in, out]
    bias: jax.Array  # [out]


MLP = tuple[Layer, ...]


@pytree_dataclass
class GRU:
    """A gated recurrent unit of m units. The reset gate acts after the product, as in cuDNN and PyTorch."""

    input: Layer  # n to 3 m: reset gate, update gate, candidate
    recurrent: Layer  # m to 3 m


@pytree_dataclass
class Params:
    """All trained parameters."""

    actor: MLP
    log_std: jax.Array  # [A], of the Gaussian before clipping
    critic: MLP
    memory: GRU | None = None  # of the actor


def init_mlp(key: jax.Array, sizes: tuple[int, ...], output_gain: float) -> MLP:
    """Orthogonal kernels, of gain sqrt(2) in hidden layers, and zero biases for `sizes[0] -> sizes[1] -> ...`."""
    layers = []
    keys = jax.random.split(key, len(sizes) - 1)
    for i, shape in enumerate(itertools.pairwise(sizes)):
        gain = output_gain if i == len(sizes) - 2 else 2.0**0.5
        layers.append(Layer(jax.nn.initializers.orthogonal(gain)(keys[i], shape, jnp.float32), jnp.zeros(shape[1])))
    return tuple(layers)


def elu(x: jax.Array) -> jax.Array:
    """`jax.nn.elu` within 1e-7, in half the time on a CPU: by `exp`, not `expm1`."""
    return jnp.where(x > 0, x, jnp.exp(jnp.where(x > 0, 0.0, x)) - 1)


def apply_mlp(layers: MLP, x: jax.Array, precision: str = "highest") -> jax.Array:
    """ELU network: `x` [..., in] to [..., out]. `precision` names a `jax.lax.Precision`."""
    for i, layer in enumerate(layers):
        x = jnp.matmul(x, layer.kernel, precision=precision)
        x = x + align(layer.bias, x)
        if i < len(layers) - 1:
            x = elu(x)
    return x


def rescale_output(layers: MLP, mean: jax.Array, std: jax.Array, new_mean: jax.Array, new_std: jax.Array) -> MLP:
    """Change the last layer so that `new_std * out + new_mean` equals the old `std * out + mean`.

    Preserves the critic's predictions when the value normaliser changes (PopArt, van Hasselt et al. 2016).
    """
    *others, last = layers
    bias = (last.bias * std + mean - new_mean) / new_std
    return (*others, Layer(last.kernel * (std / new_std), bias))


# --- memory -------------------------------------------------------------------------------------------
# The carry of a policy with memory is one array [..., m], zero at the start of an episode. The actor's network sees the
# normalised observation and the carry after it: n + m numbers. A policy without memory has None for both, and sees n.


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
    """One step: the carry [..., m] after the normalised observation `x` [..., n], and what the actor's network sees
    [..., n + m]."""
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
    """What the actor's network saw [N, T, n + m] in rollouts of observations `x` [N, T, n]; gradients go back through
    all T steps. It begins with the first `carry` [N, T, m], and with zero where a step is the `first` [N, T] of an
    episode. Without memory `x` itself."""
    if memory is None or carry is None or first is None:
        return x

    def step(carry, inputs):
        x, first = inputs
        return step_memory(memory, jnp.where(first[:, None], 0.0, carry), x, precision)

    swap = lambda a: jnp.swapaxes(a, 0, 1)  # noqa: E731
    return swap(jax.lax.scan(step, carry[:, 0], (swap(x), swap(first)))[1])
