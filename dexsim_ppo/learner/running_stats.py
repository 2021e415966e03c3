"""Running mean and variance, and normalisers made from them."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.layout import LayoutEntry
from dexsim.core.pytree import align, pytree_dataclass, static

# The count is capped here; from then on the mean is exponential over about this many samples. Without the
# cap a float32 count would freeze at 2**24, and an int32 count overflow after an hour on a GPU.
MEMORY = 2**27
STD_FLOOR = 1e-2
"""In observation units, of what a normaliser divides by: an entry that hardly varies is not blown up."""
FIXED = -1
"""Count of statistics that no sample changes."""


@pytree_dataclass
class RunningStats:
    """Mean and population variance of vectors [n], over `count` samples."""

    count: jax.Array  # int32 []
    mean: jax.Array  # [n]
    variance: jax.Array  # [n]


@pytree_dataclass
class Normalizer:
    """The map `clip((x - mean) / std)` on vectors [n]."""

    mean: jax.Array
    std: jax.Array
    clip: float = static(default=5.0)


def init_stats(shape: tuple[int, ...]) -> RunningStats:
    """Statistics before the first sample: mean 0, variance 1."""
    return RunningStats(count=jnp.zeros((), jnp.int32), mean=jnp.zeros(shape), variance=jnp.ones(shape))


def merge_moments(stats: RunningStats, mean: jax.Array, variance: jax.Array, size: int) -> RunningStats:
    """Merge `size` samples of this mean and variance [n] (Chan et al. 1979).

    Elements that are not finite stay unchanged.
    """
    fixed, count = stats.count == FIXED, jnp.minimum(stats.count, MEMORY) + size
    weight = jnp.where(fixed, 0.0, size / count.astype(jnp.float32))
    delta = mean - stats.mean
    mean = stats.mean + weight * delta
    variance = (1 - weight) * stats.variance + weight * variance + weight * (1 - weight) * delta**2
    ok, count = jnp.isfinite(mean) & jnp.isfinite(variance), jnp.where(fixed, FIXED, count)
    return RunningStats(count, jnp.where(ok, mean, stats.mean), jnp.where(ok, variance, stats.variance))


def make_normalizer(stats: RunningStats, layout: Sequence[LayoutEntry]) -> Normalizer:
    """Normaliser of one observation group [n].

    Entries with a fixed scale are only divided by it: with running statistics, a channel that is silent
    until first contact would see that contact as an outlier.
    """
    scale = np.concatenate([np.full(entry.size, entry.scale or 0.0, np.float32) for entry in layout])
    std = jnp.sqrt(stats.variance + STD_FLOOR**2)
    fixed = scale > 0
    return Normalizer(mean=jnp.where(fixed, 0.0, stats.mean), std=jnp.where(fixed, scale, std))


def recover_stats(normalizer: Normalizer) -> RunningStats:
    """Statistics [n] from which `make_normalizer` makes this normaliser, for entries without a fixed scale.

    Fixed: other inputs would be another policy, sooner than a fine-tuning's small steps make up for.
    """
    variance = jnp.maximum(normalizer.std**2 - STD_FLOOR**2, 0.0)
    return RunningStats(jnp.int32(FIXED), jnp.copy(normalizer.mean), variance)


def normalize(normalizer: Normalizer, x: jax.Array) -> jax.Array:
    """Normalised and clipped `x` [..., n]."""
    z = (x - align(normalizer.mean, x)) / align(normalizer.std, x)
    return jnp.clip(z, -normalizer.clip, normalizer.clip)


def value_std(stats: RunningStats) -> jax.Array:
    """Standard deviation of returns [], kept away from zero."""
    return jnp.sqrt(stats.variance + 1e-6)
