"""Proximal policy optimisation (Schulman et al. 2017).

`make_train(env, config)` returns two compiled functions: `init(key) -> TrainState` and
`step(state) -> (state, metrics)`. One step collects [T, B] experience, estimates advantages, and makes
`epochs` passes over it in `minibatches` parts. `TrainState` holds everything that training depends on:
saving and loading that one pytree resumes training exactly.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dexsim.core.compilation import check_float32, jit
from dexsim.core.layout import layout_size
from dexsim.errors import ConfigError
from dexsim_ppo.learner.adapter import adapt
from dexsim_ppo.learner.config import CurriculumConfig, PPOConfig
from dexsim_ppo.learner.loss import Metrics, Samples, make_normalizers
from dexsim_ppo.learner.networks import Params, carry_size, init_gru, init_mlp, rescale_output, zero_carry
from dexsim_ppo.learner.rollout import Rollout, bound_rewards, collect_rollout
from dexsim_ppo.learner.running_stats import init_stats, merge_moments, value_std
from dexsim_ppo.learner.sharding import batched, block_count, copied, in_blocks, init_on_mesh, moments, shardings
from dexsim_ppo.learner.types import AdamState, Environment, TrainState
from dexsim_ppo.learner.update import Learner, update


class Training(NamedTuple):
    """The compiled functions of `make_train`."""

    init: Callable[[jax.Array], TrainState]
    shapes: Callable[[jax.Array], TrainState]
    """Shapes, types and, on several devices, shardings of what `init` returns, without computing it."""
    step: Callable[[TrainState], tuple[TrainState, Metrics]]
    """Donates its argument: do not use that state again. Metrics are [iterations_per_call]."""


def make_train(
    env: Any,
    config: PPOConfig,
    curriculum: CurriculumConfig = CurriculumConfig(),  # noqa: B008
    mesh: Mesh | None = None,
    start: Callable[[TrainState], TrainState] | None = None,
) -> Training:
    """Compiled `init` and `step`.

    Args:
      env: an `Environment`, or any object with the members that `learner.adapter` lists.
      mesh: devices to spread the environments over (`learner.sharding`); None for one.
      start: from a fresh learner's state to that which training starts from; None for the same.
    """
    check_float32()
    env = adapt(env)

    def init(key: jax.Array) -> TrainState:
        state = init_state(env, config, key, curriculum, mesh)
        return strong_types(start(state) if start else state)

    def step(state: TrainState) -> tuple[TrainState, Metrics]:
        iterate = lambda s, _: train_iteration(env, config, s, curriculum, mesh)  # noqa: E731
        state, metrics = jax.lax.scan(iterate, state, None, length=config.iterations_per_call)
        state = strong_types(state)
        if mesh is not None:
            state = jax.lax.with_sharding_constraint(state, shardings(state, mesh))
        return state, copied(metrics, mesh)

    def shapes(key: jax.Array) -> TrainState:
        state = jax.eval_shape(init, key)
        if mesh is None:
            return state
        return jax.tree.map(
            lambda x, where: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where), state, shardings(state, mesh)
        )

    compiled_init = jit(init, once=True) if mesh is None else functools.partial(init_on_mesh, mesh, init)
    # Leaves may share a buffer (actor and critic may observe the same array), and no buffer can be donated
    # twice: copies separate them.
    return Training(
        init=lambda key: jax.tree.map(jnp.copy, compiled_init(key)),
        shapes=shapes,
        step=cast(Callable, jit(step, backend=env.backend, donate_argnums=0)),
    )


def init_state(
    env: Environment, config: PPOConfig, key: jax.Array, curriculum: CurriculumConfig, mesh: Mesh | None
) -> TrainState:
    """A fresh learner, and freshly reset environments [B, ...] with staggered clocks."""
    params_key, reset_key, stagger_key, key = jax.random.split(key, 4)
    sizes = {group: layout_size(layout) for group, layout in env.observation_layout.items()}
    memory = None
    if config.memory == "gru":
        memory = init_gru(jax.random.fold_in(params_key, 1), sizes["actor"], config.memory_size)
    actor = (sizes["actor"] + carry_size(memory), *config.actor_layers, env.action_size)
    critic = (sizes["critic"] + carry_size(memory), *config.critic_layers, 1)
    actor_key, critic_key = jax.random.split(params_key)
    params = Params(
        actor=init_mlp(actor_key, actor, output_gain=0.01),  # a small gain: the first actions are nearly pure noise
        log_std=jnp.full(env.action_size, jnp.log(config.initial_std)),
        critic=init_mlp(critic_key, critic, output_gain=1.0),
        memory=memory,
    )
    zeros = jax.tree.map(jnp.zeros_like, params)
    resets, staggers = (jax.random.split(key, config.num_envs) for key in (reset_key, stagger_key))
    scale = jnp.float32(curriculum.start) if curriculum.on else None
    reset = env.reset if scale is None else functools.partial(cast(Any, env).reset, scale=scale)
    return TrainState(
        params=params,
        average=(params.actor, params.memory),
        adam=AdamState(jnp.int32(0), zeros, zeros),
        learning_rate=jnp.float32(config.learning_rate),
        observation_stats={group: init_stats((size,)) for group, size in sizes.items()},
        value_stats=init_stats(()),
        env_state=batched(env.randomize_episode_time, mesh)(batched(reset, mesh)(resets), staggers),
        key=key,
        iteration=jnp.int32(0),
        skipped_updates=jnp.int32(0),
        scale=scale,
        carry=zero_carry(memory, (config.num_envs,)),
    )


def train_iteration(
    env: Environment, config: PPOConfig, state: TrainState, curriculum: CurriculumConfig, mesh: Mesh | None
) -> tuple[TrainState, Metrics]:
    """Collect, estimate advantages, update; with a curriculum, widen or narrow the ranges."""
    key, _, update_key = jax.random.split(state.key, 3)
    (env_state, carry), rollout, metrics = collect_rollout(env, config, state, mesh)
    # Those of the collection, so that the first minibatch's probability ratio is exactly one.
    normalizers = make_normalizers(env, state.observation_stats)
    rollout, bounded = bound_rewards(rollout, state.value_stats)
    samples, state, explained = prepare(config, state, rollout, mesh)
    learner = Learner(state.params, state.adam, state.learning_rate, state.skipped_updates)
    learner, update_metrics = update(config, normalizers, samples, update_key, learner, mesh)
    metrics |= update_metrics | {
        "bounded_rewards": bounded,
        "explained_variance": explained,
        "action_std": jnp.mean(jnp.exp(learner.params.log_std)),
        "learning_rate": learner.learning_rate,
        "skipped_updates": learner.skipped_updates,
    }
    scale = state.scale
    if scale is not None:
        scale, success = update_scale(curriculum, scale, metrics)
        metrics |= {"curriculum/scale": scale, "curriculum/success": success}
        env_state = jax.vmap(cast(Any, env).set_randomization_scale, (0, None))(env_state, scale)
    return dataclasses.replace(
        state,
        average=average_weights(state.average, learner.params, state.iteration),
        env_state=env_state,
        key=key,
        iteration=state.iteration + 1,
        scale=scale,
        carry=carry,
        **learner._asdict(),
    ), metrics


def average_weights(average: tuple, params: Params, iteration: jax.Array) -> tuple:
    """Actor and memory averaged over about the last tenth of the iterations, so that no length has to be chosen
    (polynomial-decay averaging, Shamir and Zhang 2013)."""
    weight = 10.0 / (iteration.astype(jnp.float32) + 10.0)
    return jax.tree.map(lambda old, new: old + weight * (new - old), average, (params.actor, params.memory))


def update_scale(curriculum: CurriculumConfig, scale: jax.Array, metrics: Metrics) -> tuple[jax.Array, jax.Array]:
    """The next scale [] of the curriculum, in [0, 1], and the success [] of this iteration. A NaN success (no episode
    has ended) leaves the scale unchanged. Raises ConfigError: the curriculum names a metric that does not exist."""
    if not curriculum.metric:
        success = 1 - metrics["terminated_share"]
    elif curriculum.metric in metrics:
        success = metrics[curriculum.metric]
    else:
        raise ConfigError(f"CurriculumConfig.metric = {curriculum.metric!r}: choose from {', '.join(sorted(metrics))}")
    narrower = jnp.where(success < curriculum.narrow_below, -curriculum.step, 0.0)
    step = jnp.where(success >= curriculum.widen_above, curriculum.step, narrower)
    return jnp.clip(scale + step, 0.0, 1.0), success


def prepare(
    config: PPOConfig, state: TrainState, rollout: Rollout, mesh: Mesh | None = None
) -> tuple[Samples, TrainState, jax.Array]:
    """Advantages and normalised value targets in blocks [K, T * B / K], with a GRU as sequences [K, B / K, T]; the
    state with statistics that include them, and a critic whose output is in the units of `value_stats`; and the share
    [] of the returns' variance that the critic's values explain."""
    advantage, target = compute_gae(config, rollout)
    observations = {group: rollout.obs[group] for group in state.observation_stats}
    values = {"obs": observations, "advantage": advantage, "target": target, "error": target - rollout.value}
    means, variances = moments(values, mesh)
    size = advantage.size
    observation_stats = {
        group: merge_moments(stats, means["obs"][group], variances["obs"][group], size)
        for group, stats in state.observation_stats.items()
    }
    old_mean, old_std = state.value_stats.mean, value_std(state.value_stats)
    value_stats = merge_moments(state.value_stats, means["target"], variances["target"], size)
    mean, std = value_stats.mean, value_std(value_stats)
    critic = rescale_output(state.params.critic, old_mean, old_std, mean, std)
    samples = Samples(
        obs=rollout.obs,
        decision=rollout.decision,
        advantage=(advantage - means["advantage"]) / (jnp.sqrt(variances["advantage"]) + 1e-8),
        value=(rollout.value - mean) / std,
        target=(target - mean) / std,
        carry=rollout.carry,
    )
    blocks = block_count(config, mesh)
    if rollout.carry is not None:
        ended = rollout.terminated | rollout.truncated
        # The carry at the rollout's first step is zero already where an episode begins with it.
        samples = dataclasses.replace(samples, first=jnp.zeros_like(ended).at[1:].set(ended[:-1]))
    samples = in_blocks(samples, blocks, sequences=rollout.carry is not None)
    explained = 1 - variances["error"] / variances["target"]
    params = dataclasses.replace(state.params, critic=critic)
    state = dataclasses.replace(state, params=params, value_stats=value_stats, observation_stats=observation_stats)
    return samples, state, explained


def compute_gae(config: PPOConfig, rollout: Rollout) -> tuple[jax.Array, jax.Array]:
    """Advantages and value targets [T, B]: generalised advantage estimation (Schulman et al. 2016).

    Either ending cuts the sum over later steps. A terminated step has no value after it; a truncated one
    bootstraps from the value of its true final observation.
    """
    # `where`, not a product: the value of a diverged final state may be NaN.
    bootstrap = jnp.where(rollout.terminated, 0.0, rollout.next_value)
    delta = rollout.reward + config.discount * bootstrap - rollout.value
    ended = (rollout.terminated | rollout.truncated).astype(rollout.reward.dtype)
    decay = config.discount * config.gae_lambda * (1.0 - ended)

    def backward(advantage, step):
        delta_t, decay_t = step
        advantage = delta_t + decay_t * advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, decay), reverse=True, unroll=8)
    return advantage, advantage + rollout.value


def strong_types(tree: Any) -> Any:
    """Remove weak types, which the next state would not have: JAX would compile the step twice."""

    def strong(x):
        return x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else jax.lax.convert_element_type(x, x.dtype)

    return jax.tree.map(strong, tree)
