"""Proximal policy optimisation (Schulman et al. 2017).

`make_train(env, config)` returns two compiled functions: `init(key) -> TrainState` and
`step(state) -> (state, metrics)`. One step collects [T, B] experience, estimates advantages, and makes
`epochs` passes over it in `minibatches` parts. `TrainState` holds everything that training depends on:
saving and loading that one pytree resumes training exactly.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from dexsim.core.compilation import jit
from dexsim.core.errors import ConfigError
from dexsim.core.pytree import pytree_dataclass
from dexsim_ppo.learner import adam, distribution
from dexsim_ppo.learner.adam import AdamState
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.curriculum import Curriculum, next_scale
from dexsim_ppo.learner.gae import compute_gae
from dexsim_ppo.learner.loss import Metrics, Samples, actor_mean, critic_value, loss
from dexsim_ppo.learner.networks import Params, init_params, rescale_output
from dexsim_ppo.learner.rollout import Decision, Rollout, bound_rewards, collect
from dexsim_ppo.learner.running_stats import (
    Normalizer,
    RunningStats,
    init_stats,
    make_normalizer,
    update_stats,
    value_std,
)
from dexsim_ppo.learner.types import CurriculumEnvironment, Environment, layout_size


@pytree_dataclass
class TrainState:
    """All that training carries from one iteration to the next."""

    params: Params
    adam: AdamState
    learning_rate: jax.Array  # []
    observation_stats: dict[str, RunningStats]
    value_stats: RunningStats  # of returns []
    env_state: Any  # [B, ...]
    key: jax.Array
    iteration: jax.Array  # int32 []
    skipped_updates: jax.Array  # int32 [], minibatches whose gradient was not finite
    scale: jax.Array | None = None  # [] width of the randomisation ranges, with a curriculum


class Training(NamedTuple):
    """The compiled functions of `make_train`."""

    init: Callable[[jax.Array], TrainState]
    shapes: Callable[[jax.Array], TrainState]
    """Shapes and types of what `init` returns, without computing it."""
    plain_step: Callable[[TrainState], tuple[TrainState, Metrics]]
    """`step` before compilation."""
    step: Callable[[TrainState], tuple[TrainState, Metrics]]
    """Donates its argument: do not use that state again. Metrics are [iterations_per_call]."""


def make_train(env: Environment, config: PPOConfig, curriculum: Curriculum | None = None) -> Training:
    """Compiled `init` and `step` for this environment."""
    if curriculum is not None and not curriculum.on:
        curriculum = None

    def init(key: jax.Array) -> TrainState:
        return strong_types(init_state(env, config, key, curriculum))

    def step(state: TrainState) -> tuple[TrainState, Metrics]:
        state, metrics = jax.lax.scan(
            lambda s, _: train_iteration(env, config, s, curriculum), state, None, length=config.iterations_per_call
        )
        return strong_types(state), metrics

    compiled_init = jit(init, once=True)
    # Leaves may share a buffer (actor and critic may observe the same array), and no buffer can be donated
    # twice: copies separate them.
    return Training(
        init=lambda key: jax.tree.map(jnp.copy, compiled_init(key)),
        shapes=lambda key: jax.eval_shape(init, key),
        plain_step=step,
        step=jit(step, backend=env.backend, donate_argnums=0),
    )


def init_state(env: Environment, config: PPOConfig, key: jax.Array, curriculum: Curriculum | None = None) -> TrainState:
    """A fresh learner, and freshly reset environments with staggered clocks."""
    params_key, reset_key, stagger_key, key = jax.random.split(key, 4)
    sizes = {group: layout_size(fields) for group, fields in env.observation_layout.items()}
    params = init_params(
        params_key,
        actor_sizes=(sizes["actor"], *config.actor_layers, env.action_size),
        critic_sizes=(sizes["critic"], *config.critic_layers, 1),
        initial_std=config.initial_std,
    )
    scale, reset = None, env.reset
    if curriculum is not None:
        scale = jnp.float32(curriculum.start)
        reset = functools.partial(cast(CurriculumEnvironment, env).reset, scale=scale)
    env_state = jax.vmap(reset)(jax.random.split(reset_key, config.num_envs))
    env_state = jax.vmap(env.stagger)(env_state, jax.random.split(stagger_key, config.num_envs))
    return TrainState(
        params=params,
        adam=adam.init(params),
        learning_rate=jnp.float32(config.learning_rate),
        observation_stats={group: init_stats((size,)) for group, size in sizes.items()},
        value_stats=init_stats(()),
        env_state=env_state,
        key=key,
        iteration=jnp.int32(0),
        skipped_updates=jnp.int32(0),
        scale=scale,
    )


def train_iteration(
    env: Environment, config: PPOConfig, state: TrainState, curriculum: Curriculum | None = None
) -> tuple[TrainState, Metrics]:
    """Collect, estimate advantages, update; with a curriculum, widen or narrow the ranges."""
    key, collect_key, update_key = jax.random.split(state.key, 3)
    # Shared by collection and update, so that the first minibatch's probability ratio is exactly one.
    normalizers = make_normalizers(env, config, state.observation_stats)
    env_state, rollout, metrics = collect_rollout(env, config, state, normalizers, collect_key)
    if config.normalize_value:
        rollout, bounded = bound_rewards(rollout, state.value_stats, config.reward_scale)
        metrics |= {"bounded_rewards": bounded}
    value_stats, params, samples = prepare(config, state.value_stats, state.params, rollout)
    learner, update_metrics = update(
        config,
        normalizers,
        samples,
        update_key,
        Learner(params, state.adam, state.learning_rate, state.skipped_updates),
    )
    metrics |= update_metrics | {
        "explained_variance": 1 - jnp.var(samples.target - samples.value) / jnp.var(samples.target),
        "action_std": jnp.mean(jnp.exp(learner.params.log_std)),
        "learning_rate": learner.learning_rate,
        "skipped_updates": learner.skipped_updates,
    }
    scale = state.scale
    if curriculum is not None:
        assert scale is not None, "the state of a training with a curriculum"
        scale, success = update_scale(curriculum, scale, metrics)
        metrics |= {"curriculum/scale": scale, "curriculum/success": success}
        env_state = jax.vmap(cast(CurriculumEnvironment, env).widen, (0, None))(env_state, scale)
    stats = {
        group: update_stats(state.observation_stats[group], rollout.obs[group]) for group in state.observation_stats
    }
    return TrainState(
        params=learner.params,
        adam=learner.adam,
        learning_rate=learner.learning_rate,
        observation_stats=stats,
        value_stats=value_stats,
        env_state=env_state,
        key=key,
        iteration=state.iteration + 1,
        skipped_updates=learner.skipped_updates,
        scale=scale,
    ), metrics


def update_scale(curriculum: Curriculum, scale: jax.Array, metrics: Metrics) -> tuple[jax.Array, jax.Array]:
    """The next scale [] of the curriculum, and the success [] of this iteration.

    Raises:
      ConfigError: the curriculum names a metric that does not exist.
    """
    if not curriculum.metric:
        success = 1 - metrics["terminated_share"]
    elif curriculum.metric in metrics:
        success = metrics[curriculum.metric]
    else:
        raise ConfigError(f"Curriculum.metric = {curriculum.metric!r}: choose from {', '.join(sorted(metrics))}")
    return next_scale(scale, success, curriculum), success


# --- collect ------------------------------------------------------------------------------------------


def make_normalizers(env: Environment, config: PPOConfig, stats: dict[str, RunningStats]) -> dict[str, Normalizer]:
    """One observation normaliser per group."""
    return {
        group: make_normalizer(
            stats[group], fields, std_floor=config.observation_std_floor, clip=config.observation_clip
        )
        for group, fields in env.observation_layout.items()
    }


def collect_rollout(
    env: Environment, config: PPOConfig, state: TrainState, normalizers: dict[str, Normalizer], key: jax.Array
) -> tuple[Any, Rollout, Metrics]:
    """Experience [T, B, ...] under the current policy; values are in reward units."""
    params, std = state.params, value_std(state.value_stats)

    def act(key, obs):
        mean = actor_mean(config, params, normalizers, obs)
        action = distribution.sample(key, mean, params.log_std)
        decision = Decision(action, mean, distribution.log_prob(action, mean, params.log_std))
        return decision, jnp.tanh(action) if config.distribution == "tanh" else jnp.clip(action, -1.0, 1.0)

    def value(obs):
        return state.value_stats.mean + std * critic_value(config, params, normalizers, obs)

    return collect(env, state.env_state, key, act, value, config.rollout_length)


# --- advantages ---------------------------------------------------------------------------------------


def prepare(
    config: PPOConfig, value_stats: RunningStats, params: Params, rollout: Rollout
) -> tuple[RunningStats, Params, Samples]:
    """Advantages and normalised value targets as flat rows [T * B]; updates the value normaliser."""
    advantage, target = compute_gae(
        config.reward_scale * rollout.reward,
        rollout.value,
        rollout.next_value,
        rollout.terminated,
        rollout.truncated,
        discount=config.discount,
        gae_lambda=config.gae_lambda,
    )
    if config.normalize_value:
        new = update_stats(value_stats, target)
        critic = rescale_output(params.critic, value_stats.mean, value_std(value_stats), new.mean, value_std(new))
        params, value_stats = Params(params.actor, params.log_std, critic), new
    mean, std = value_stats.mean, value_std(value_stats)
    samples = Samples(
        obs=rollout.obs,
        decision=rollout.decision,
        advantage=(advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8),
        value=(rollout.value - mean) / std,
        target=(target - mean) / std,
    )
    return value_stats, params, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)


# --- update -------------------------------------------------------------------------------------------


class Learner(NamedTuple):
    """What the minibatch loop carries."""

    params: Params
    adam: AdamState
    learning_rate: jax.Array
    skipped_updates: jax.Array


def update(
    config: PPOConfig, normalizers: dict[str, Normalizer], samples: Samples, key: jax.Array, learner: Learner
) -> tuple[Learner, Metrics]:
    """All epochs over shuffled minibatches, then the learning rate of the next iteration.

    Metrics are means over all minibatches, except the KL divergence: its mean over the last epoch.
    """
    rows = config.steps_per_iteration
    keys = jax.random.split(key, config.epochs)
    order = jax.vmap(lambda key: jax.random.permutation(key, rows))(keys)
    order = order.reshape(config.epochs * config.minibatches, rows // config.minibatches)
    old_log_std, moves = learner.params.log_std, actor_learns(config, learner)

    def minibatch(learner, indices):
        batch = jax.tree.map(lambda x: x[indices], samples)
        grads, metrics = jax.grad(loss, has_aux=True)(learner.params, config, normalizers, batch, old_log_std)
        learner, norms = apply_gradients(config, learner, grads)
        return learner, metrics | norms

    learner, metrics = jax.lax.scan(minibatch, learner, order)
    last_epoch = metrics["kl"][-config.minibatches :]
    metrics = jax.tree.map(jnp.nanmean, metrics) | {"kl": jnp.nanmean(last_epoch)}
    rate = adapt_learning_rate(config, learner.learning_rate, metrics["kl"])
    if config.critic_first:  # A policy that does not move says nothing about the rate.
        rate = jnp.where(moves, rate, learner.learning_rate)
    return learner._replace(learning_rate=rate), metrics


def apply_gradients(config: PPOConfig, learner: Learner, grads: Params) -> tuple[Learner, Metrics]:
    """Clip the gradients and step. A minibatch whose gradient is not finite is skipped and counted."""
    actor_grads, actor_norm = adam.clip_by_global_norm((grads.actor, grads.log_std), config.max_grad_norm)
    critic_grads, critic_norm = adam.clip_by_global_norm(grads.critic, config.max_grad_norm)
    rate, moves = learner.learning_rate, actor_learns(config, learner)
    if config.critic_first:
        rate = jnp.where(moves, rate, config.learning_rate_max)
    params, moments = adam.update(Params(*actor_grads, critic_grads), learner.adam, learner.params, rate)
    # Projected after the step, not clipped in the loss: beyond a clip the gradient is zero, and it could not return.
    log_std = jnp.clip(params.log_std, jnp.log(config.std_min), jnp.log(config.std_max))
    params = Params(params.actor, log_std, params.critic)
    if config.critic_first:  # Adam's moments already follow the gradient, so that the actor's first step is small.
        held = jax.tree.map(functools.partial(jnp.where, moves), params, learner.params)
        params = Params(held.actor, held.log_std, params.critic)
    ok = jnp.isfinite(actor_norm) & jnp.isfinite(critic_norm)
    new = learner._replace(params=params, adam=moments)
    learner = jax.tree.map(functools.partial(jnp.where, ok), new, learner)
    skipped = learner.skipped_updates + (1 - ok.astype(jnp.int32))
    return learner._replace(skipped_updates=skipped), {"actor_grad_norm": actor_norm, "critic_grad_norm": critic_norm}


def actor_learns(config: PPOConfig, learner: Learner) -> jax.Array:
    """Whether the initial iterations for the critic alone are over: bool []."""
    return learner.adam.count >= config.critic_first * config.epochs * config.minibatches


def adapt_learning_rate(config: PPOConfig, rate: jax.Array, kl: jax.Array) -> jax.Array:
    """The next learning rate []: lower above twice the target KL, higher below half of it, within its bounds.

    `kl` [] measures the whole iteration. Adapting after every minibatch would overshoot: once beyond the
    target, each further minibatch of the iteration would lower the rate again.
    """
    if config.kl_target == 0:
        return rate
    slower = jnp.maximum(rate / 1.5, config.learning_rate_min)
    faster = jnp.minimum(rate * 1.5, config.learning_rate_max)
    rate = jnp.where(kl > 2 * config.kl_target, slower, rate)
    return jnp.where(kl < 0.5 * config.kl_target, faster, rate)


def strong_types(tree: Any) -> Any:
    """Remove weak types, which the next state would not have: JAX would compile the step twice."""

    def strong(x):
        return x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else jax.lax.convert_element_type(x, x.dtype)

    return jax.tree.map(strong, tree)
