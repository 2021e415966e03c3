"""Environments spread over several devices: which arrays are split, which are copied to all.

The environments [B] are split over one mesh axis, all else is the same everywhere. The environments' own functions run
under `shard_map`, since physics engines are opaque to XLA, and so do gradients and moments, which are averaged as one
array: between processes on CPUs each array of a reduction costs milliseconds, whatever its size. The few other sums
over all environments are XLA's to place. So an iteration is the same arithmetic on any number of devices, up to
the order of sums.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from dexsim.core.compilation import jit
from dexsim.core.pytree import align
from dexsim.errors import ConfigError
from dexsim_ppo.learner.config import PPOConfig

AXIS = "devices"
# Parts of the environments, each of which shuffles its own rows: results are the same on all numbers that divide it.
BLOCKS = 16
_WHOLE, _SPLIT = PartitionSpec(), PartitionSpec(AXIS)
Tree = TypeVar("Tree")


def make_mesh(devices: int, config: PPOConfig) -> Mesh | None:
    """So many devices of all processes together, 0 for all; None for one device of one process, which needs no mesh.
    Raises ConfigError: there are fewer, some process would have none, or environments or minibatches do not divide by
    them."""
    available = jax.devices()
    count = devices or len(available)
    if count > len(available) or (jax.process_count() > 1 and count < len(available)):
        raise ConfigError(
            f"TrainArguments.devices = {devices}: expected at most {len(available)} in {jax.process_count()} processes"
        )
    if config.num_envs % count:
        raise ConfigError(f"PPOConfig.num_envs = {config.num_envs}: must be a multiple of the {count} devices")
    if (size := config.rows // config.minibatches) % count:
        raise ConfigError(
            f"PPOConfig.minibatches = {config.minibatches}: leaves {size} rows each, no multiple of the {count} devices"
        )
    if count == 1:
        return None
    return jax.make_mesh((count,), (AXIS,), axis_types=(AxisType.Auto,), devices=available[:count])


def batched(function: Callable, mesh: Mesh | None) -> Callable:
    """`jax.vmap(function)` whose batch is split over the mesh; arguments and results are [B, ...]."""
    return _on_mesh(jax.vmap(function), mesh, _SPLIT, _SPLIT)


def averaged(function: Callable, mesh: Mesh | None) -> Callable:
    """`function(shared, split)` on each device's part of `split` [N, ...], its results averaged over the devices."""
    return _on_mesh(lambda *parts: _average(function(*parts), mesh), mesh, (_WHOLE, _SPLIT), _WHOLE)


def moments(tree: Any, mesh: Mesh | None) -> tuple[Any, Any]:
    """Mean and variance [...] of each array [T, B, ...] over steps and environments, with two reductions in all."""

    def part(tree: Any) -> tuple[Any, Any]:
        mean = _average(jax.tree.map(lambda x: jnp.mean(x, (0, 1)), tree), mesh)
        variance = jax.tree.map(lambda x, m: jnp.mean((x - align(m, x)) ** 2, (0, 1)), tree, mean)
        return mean, _average(variance, mesh)

    return _on_mesh(part, mesh, PartitionSpec(None, AXIS), _WHOLE)(tree)


def _on_mesh(function: Callable, mesh: Mesh | None, inputs: Any, outputs: Any) -> Callable:
    """`function` on each device's part of its arguments."""
    if mesh is None:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False)


def _average(tree: Tree, mesh: Mesh | None) -> Tree:
    """The mean over the devices, which travels as one array."""
    if mesh is None:
        return tree
    flat, restore = ravel_pytree(tree)
    return restore(jax.lax.pmean(flat, AXIS))


def block_count(config: PPOConfig, mesh: Mesh | None) -> int:
    """Blocks of environments (K): each device has as many, and each minibatch as many rows of each."""
    rows, devices = config.rows // config.minibatches, mesh.size if mesh else 1
    count = math.gcd(BLOCKS, config.num_envs, rows)
    return devices if count % devices else count


def in_blocks(tree: Tree, count: int, sequences: bool) -> Tree:
    """Arrays [T, B, ...] by blocks of environments: rows [K, T * B / K, ...] or `sequences` [K, B / K, T, ...]."""
    if sequences:
        return jax.tree.map(lambda x: x.swapaxes(0, 1).reshape(count, -1, len(x), *x.shape[2:]), tree)

    def rows(x: jax.Array) -> jax.Array:
        x = x.reshape(x.shape[0], count, -1, *x.shape[2:]).swapaxes(0, 1)
        return x.reshape(count, -1, *x.shape[3:])

    return jax.tree.map(rows, tree)


def copied(tree: Tree, mesh: Mesh | None) -> Tree:
    """The whole `tree` on every device."""
    return tree if mesh is None else jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, _WHOLE))


def shardings(state: Any, mesh: Mesh) -> Any:
    """The sharding of each array of a `TrainState`: the environments' are split, all others copied."""
    whole, split = NamedSharding(mesh, _WHOLE), NamedSharding(mesh, _SPLIT)
    return dataclasses.replace(
        jax.tree.map(lambda _: whole, state),
        env_state=jax.tree.map(lambda _: split, state.env_state),
        carry=jax.tree.map(lambda _: split, state.carry),
    )


def init_on_mesh(mesh: Mesh, init: Callable[[jax.Array], Any], key: jax.Array) -> Any:
    """`init(key)`, a `TrainState`, compiled for the devices of a mesh."""
    split = shardings(jax.eval_shape(init, key), mesh)
    compiled = jit(lambda data: init(jax.random.wrap_key_data(data)), once=True, out_shardings=split)
    return compiled(np.asarray(jax.random.key_data(key)))  # plain numbers are the same array for all processes


def place(tree: Tree, like: Any) -> Tree:
    """A copy of `tree`, which every process has whole, as arrays sharded as those of `like`, where these are."""
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    keys = jax.tree.map(is_key, tree)
    plain = jax.tree.map(lambda x: np.asarray(jax.random.key_data(x) if is_key(x) else x), tree)
    typed = lambda x, key: jax.random.wrap_key_data(x) if key else jnp.copy(x)  # noqa: E731
    split = jax.tree.map(lambda x: x.sharding, like)
    return jax.jit(lambda plain: jax.tree.map(typed, plain, keys), out_shardings=split)(plain)
