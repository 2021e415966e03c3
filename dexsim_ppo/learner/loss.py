"""PPO's objective over one minibatch: clipped surrogate, value loss and regularisers."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from dexsim.core.pytree import pytree_dataclass
from dexsim_ppo.learner import distribution
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.distribution import Decision
from dexsim_ppo.learner.networks import Params, apply_mlp, scan_memory, step_memory
from dexsim_ppo.learner.running_stats import Normalizer, RunningStats, make_normalizer, normalize
from dexsim_ppo.learner.types import Environment

Metrics = dict[str, jax.Array]
Observation = Mapping[str, jax.Array]  # by group, "actor" and "critic"
Normalizers = Mapping[str, Normalizer]


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
    carry: jax.Array | None = None  # of the actor's memory before the step
    first: jax.Array | None = None  # whether the step is the first of an episode, with a GRU


def make_normalizers(env: Environment, stats: dict[str, RunningStats]) -> Normalizers:
    """One observation normaliser per group."""
    return {group: make_normalizer(stats[group], layout) for group, layout in env.observation_layout.items()}


def actor_mean(config: PPOConfig, params: Params, normalizers: Normalizers, samples: Samples) -> jax.Array:
    """Mean of the Gaussian, `[..., A]`."""
    x = normalize(normalizers["actor"], samples.obs["actor"])
    features = scan_memory(params.memory, samples.carry, x, samples.first, config.matmul_precision)
    return apply_mlp(params.actor, features, config.matmul_precision)


def actor_step(
    config: PPOConfig, params: Params, normalizers: Normalizers, obs: Observation, carry: jax.Array | None
) -> tuple[jax.Array | None, jax.Array]:
    """The carry after an observation, and the mean of the Gaussian `[..., A]`."""
    x = normalize(normalizers["actor"], obs["actor"])
    carry, features = step_memory(params.memory, carry, x, config.matmul_precision)
    return carry, apply_mlp(params.actor, features, config.matmul_precision)


def critic_value(
    config: PPOConfig, params: Params, normalizers: Normalizers, obs: Observation, carry: jax.Array | None = None
) -> jax.Array:
    """Normalised value, `[...]`. The critic also sees the actor's carry before this observation."""
    x = normalize(normalizers["critic"], obs["critic"])
    x = x if carry is None else jnp.concatenate([x, carry], -1)
    return apply_mlp(params.critic, x, config.matmul_precision)[..., 0]


def loss(
    params: Params, config: PPOConfig, normalizers: Normalizers, batch: Samples, old_log_std: jax.Array
) -> tuple[jax.Array, Metrics]:
    """The objective [] and its metrics over one minibatch."""
    # Clipped surrogate (Schulman et al. 2017, equation 7): no gradient where the ratio has left the clip the good way.
    mean = actor_mean(config, params, normalizers, batch)
    ratio = jnp.exp(distribution.log_prob(batch.decision.action, mean, params.log_std) - batch.decision.log_prob)
    clipped = jnp.clip(ratio, 1 - config.clip_ratio, 1 + config.clip_ratio)
    policy_loss = -jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))

    value = critic_value(config, params, normalizers, batch.obs, batch.carry)
    errors = (value - batch.target) ** 2
    if config.value_clip > 0:  # the worse of the clipped and the plain error, as in the authors' code
        near = batch.value + jnp.clip(value - batch.value, -config.value_clip, config.value_clip)
        errors = jnp.maximum(errors, (near - batch.target) ** 2)
    value_loss = 0.5 * jnp.mean(errors)

    entropy = distribution.entropy(params.log_std)
    bounds_loss = jnp.mean(distribution.bounds_loss(mean))
    # The value loss has no weight: the critic has parameters of its own, and Adam divides by a gradient's size.
    total = policy_loss + value_loss + config.bounds_coefficient * bounds_loss - config.entropy_coefficient * entropy
    kl = distribution.kl_divergence(batch.decision.mean, old_log_std, mean, params.log_std)
    return total, {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "bounds_loss": bounds_loss,
        "entropy": entropy,
        "kl": jnp.mean(kl),
        "clip_fraction": jnp.mean((jnp.abs(ratio - 1) > config.clip_ratio).astype(jnp.float32)),
    }
