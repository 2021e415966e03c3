"""PPO's objective over one minibatch: clipped surrogate, value loss and regularisers."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from dexsim.core.pytree import align, pytree_dataclass
from dexsim_ppo.learner import distribution
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.memory import recall, remember
from dexsim_ppo.learner.networks import Params, apply_mlp
from dexsim_ppo.learner.rollout import Decision
from dexsim_ppo.learner.running_stats import Normalizer, normalize

Metrics = dict[str, jax.Array]


@pytree_dataclass
class Samples:
    """Experience as the update sees it: arrays [K, T * B / K, ...] in blocks of environments, a minibatch [N, ...].

    With a GRU they are [K, B / K, T, ...] and [N, T, ...].
    """

    obs: dict[str, jax.Array]
    decision: Decision
    advantage: jax.Array
    value: jax.Array  # normalised
    target: jax.Array  # normalised
    memory: jax.Array | None = None  # state of the actor's memory before the step
    first: jax.Array | None = None  # whether the step is the first of an episode, with a GRU


def actor_mean(
    config: PPOConfig,
    params: Params,
    normalizers: dict[str, Normalizer],
    obs: dict[str, jax.Array],
    memory: jax.Array | None = None,
    first: jax.Array | None = None,
) -> jax.Array:
    """Mean of the Gaussian, `[..., A]`; `memory` and `first` as in `Samples`."""
    x = normalize(normalizers["actor"], obs["actor"])
    seen = recall(params.memory, memory, x, first, config.matmul_precision)
    return apply_mlp(params.actor, seen, config.matmul_precision)


def actor_step(
    config: PPOConfig,
    params: Params,
    normalizers: dict[str, Normalizer],
    obs: Mapping[str, jax.Array],
    memory: jax.Array | None,
) -> tuple[jax.Array | None, jax.Array]:
    """The memory after an observation, and the mean of the Gaussian `[..., A]`."""
    x = normalize(normalizers["actor"], obs["actor"])
    memory, seen = remember(params.memory, memory, x, config.matmul_precision)
    return memory, apply_mlp(params.actor, seen, config.matmul_precision)


def critic_value(
    config: PPOConfig,
    params: Params,
    normalizers: dict[str, Normalizer],
    obs: dict[str, jax.Array],
    memory: jax.Array | None = None,
) -> jax.Array:
    """Normalised value, `[...]`. The critic also sees what the actor remembered before this observation."""
    x = normalize(normalizers["critic"], obs["critic"])
    x = x if memory is None else jnp.concatenate([x, memory], -1)
    return apply_mlp(params.critic, x, config.matmul_precision)[..., 0]


def loss(
    params: Params, config: PPOConfig, normalizers: dict[str, Normalizer], batch: Samples, old_log_std: jax.Array
) -> tuple[jax.Array, Metrics]:
    """The objective [] and its metrics over one minibatch."""
    mean = actor_mean(config, params, normalizers, batch.obs, batch.memory, batch.first)
    ratio = jnp.exp(distribution.log_prob(batch.decision.action, mean, params.log_std) - batch.decision.log_prob)
    clipped = jnp.clip(ratio, 1 - config.clip_ratio, 1 + config.clip_ratio)
    policy_loss = -jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))

    value = critic_value(config, params, normalizers, batch.obs, batch.memory)
    errors = (value - batch.target) ** 2
    if config.value_clip > 0:
        near = batch.value + jnp.clip(value - batch.value, -config.value_clip, config.value_clip)
        errors = jnp.maximum(errors, (near - batch.target) ** 2)
    value_loss = 0.5 * jnp.mean(errors)

    entropy, bounds_loss = distribution.entropy(params.log_std), jnp.float32(0)
    if config.distribution == "tanh":
        noise = (batch.decision.action - batch.decision.mean) * align(jnp.exp(-old_log_std), mean)
        entropy += jnp.mean(distribution.tanh_log_det(mean + noise * align(jnp.exp(params.log_std), mean)))
    else:
        bounds_loss = jnp.mean(distribution.bounds_loss(mean))

    total = (
        policy_loss
        + config.value_coefficient * value_loss
        + config.bounds_coefficient * bounds_loss
        - config.entropy_coefficient * entropy
    )
    kl = distribution.kl_divergence(batch.decision.mean, old_log_std, mean, params.log_std)
    return total, {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "bounds_loss": bounds_loss,
        "entropy": entropy,
        "kl": jnp.mean(kl),
        "clip_fraction": jnp.mean((jnp.abs(ratio - 1) > config.clip_ratio).astype(jnp.float32)),
    }
