"""Proximal policy optimisation (Schulman et al. 2017).

`make_train(env, config)` returns two compiled functions: `init(key) -> TrainState` and
`step(state) -> (state, metrics)`. One step collects [T, B] experience, estimates advantages, and makes
`epochs` passes over it in `minibatches` parts. `TrainState` holds everything that training depends on:
saving and loading that one pytree resumes training exactly.

The parts that follow are those of an iteration: `experience`, then `learn`. `apart` runs them as programs of their own.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dexsim.core.compilation import check_float32, jit
from dexsim.core.errors import ConfigError
from dexsim_ppo.learner import distribution
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.curriculum import Curriculum, next_scale
from dexsim_ppo.learner.devices.apart import ENGINES, ApartStep, start_apart
from dexsim_ppo.learner.devices.sharding import (
    Part,
    block_count,
    copied,
    in_blocks,
    moments,
    of_part,
    sequences_in_blocks,
    shardings,
    start_on,
    whole_shape,
)
from dexsim_ppo.learner.gae import compute_gae
from dexsim_ppo.learner.loss import Metrics, Samples, actor_step, critic_value
from dexsim_ppo.learner.networks import Params, rescale_output
from dexsim_ppo.learner.rollout import Decision, Rollout, Tally, bound_rewards, collect
from dexsim_ppo.learner.running_stats import (
    Normalizer,
    RunningStats,
    make_normalizer,
    merge_moments,
    value_std,
)
from dexsim_ppo.learner.state import TrainState, init_environments, init_learner, init_state
from dexsim_ppo.learner.types import CurriculumEnvironment, Environment
from dexsim_ppo.learner.update import Learner, update


class Training(NamedTuple):
    """The compiled functions of `make_train`."""

    init: Callable[[jax.Array], TrainState]
    shapes: Callable[[jax.Array], TrainState]
    """Shapes, types and, on several devices, shardings of what `init` returns, without computing it."""
    plain_step: Callable[[TrainState], tuple[TrainState, Metrics]]
    """`step` before compilation."""
    step: Callable[[TrainState], tuple[TrainState, Metrics]]
    """Donates its argument: do not use that state again. Metrics are [iterations_per_call]."""


def make_train(
    env: Environment, config: PPOConfig, curriculum: Curriculum | None = None, mesh: Mesh | None = None
) -> Training:
    """Compiled `init` and `step` for this environment; with a mesh, over its devices (`learner.devices.sharding`).

    Raises:
      ConfigError: JAX is set to float64.
    """
    check_float32()
    if curriculum is not None and not curriculum.on:
        curriculum = None

    def init(key: jax.Array) -> TrainState:
        return strong_types(init_state(env, config, key, curriculum, mesh))

    def step(state: TrainState) -> tuple[TrainState, Metrics]:
        state, metrics = jax.lax.scan(
            lambda s, _: train_iteration(env, config, s, curriculum, mesh),
            state,
            None,
            length=config.iterations_per_call,
        )
        state = strong_types(state)
        if mesh is not None:
            state = jax.lax.with_sharding_constraint(state, shardings(state, mesh))
        return state, copied(metrics, mesh)

    def shapes(key: jax.Array) -> TrainState:
        found = jax.eval_shape(init, key)
        if mesh is None:
            return found
        return jax.tree.map(
            lambda x, where: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where), found, shardings(found, mesh)
        )

    compiled_step: Callable = jit(step, backend=env.backend, donate_argnums=0)
    if mesh is None:
        compiled_init = jit(init, once=True)
    elif env.backend in ENGINES:
        compiled_init = start_apart(
            mesh,
            lambda key: strong_types(init_learner(env, config, key, curriculum)),
            lambda key, part: strong_types(init_environments(env, config, key, curriculum, part=part)),
        )
        compiled_step = ApartStep(
            lambda state, part: strong_types(experience(env, config, state, part=part)),
            lambda state, rollout, tally: strong_types(learn(env, config, state, rollout, tally, curriculum, mesh)),
            mesh,
            config.iterations_per_call,
            env.backend,
        )
    else:
        compiled_init = start_on(mesh, init, shapes)
    # Leaves may share a buffer (actor and critic may observe the same array), and no buffer can be donated
    # twice: copies separate them.
    return Training(
        init=lambda key: jax.tree.map(jnp.copy, compiled_init(key)),
        shapes=shapes,
        plain_step=step,
        step=compiled_step,
    )


def train_iteration(
    env: Environment,
    config: PPOConfig,
    state: TrainState,
    curriculum: Curriculum | None = None,
    mesh: Mesh | None = None,
) -> tuple[TrainState, Metrics]:
    """Collect, estimate advantages, update; with a curriculum, widen or narrow the ranges."""
    (env_state, memory), rollout, tally = experience(env, config, state, mesh)
    state = dataclasses.replace(state, env_state=env_state, memory=memory)
    return learn(env, config, state, rollout, tally, curriculum, mesh)


def experience(
    env: Environment, config: PPOConfig, state: TrainState, mesh: Mesh | None = None, part: Part | None = None
) -> tuple[tuple[Any, jax.Array | None], Rollout, Tally]:
    """What an iteration collects; `state` may hold a part of the environments."""
    normalizers = make_normalizers(env, config, state.observation_stats)
    return collect_rollout(env, config, state, normalizers, jax.random.split(state.key, 3)[1], mesh, part)


def learn(
    env: Environment,
    config: PPOConfig,
    state: TrainState,
    rollout: Rollout,
    tally: Tally,
    curriculum: Curriculum | None = None,
    mesh: Mesh | None = None,
) -> tuple[TrainState, Metrics]:
    """The state after an iteration with this experience, and its metrics."""
    key, _, update_key = jax.random.split(state.key, 3)
    # Those of the collection, so that the first minibatch's probability ratio is exactly one.
    normalizers, metrics = make_normalizers(env, config, state.observation_stats), tally.metrics()
    if config.normalize_value:
        rollout, bounded = bound_rewards(rollout, state.value_stats, config.reward_scale)
        metrics |= {"bounded_rewards": bounded}
    ready = prepare(config, state.value_stats, state.observation_stats, state.params, rollout, mesh)
    learner, update_metrics = update(
        config,
        normalizers,
        ready.samples,
        update_key,
        Learner(ready.params, state.adam, state.learning_rate, state.skipped_updates),
        mesh,
    )
    metrics |= update_metrics | {
        "explained_variance": ready.explained_variance,
        "action_std": jnp.mean(jnp.exp(learner.params.log_std)),
        "learning_rate": learner.learning_rate,
        "skipped_updates": learner.skipped_updates,
    }
    scale, env_state = state.scale, state.env_state
    if curriculum is not None:
        assert scale is not None, "the state of a training with a curriculum"
        scale, success = update_scale(curriculum, scale, metrics)
        metrics |= {"curriculum/scale": scale, "curriculum/success": success}
        env_state = jax.vmap(cast(CurriculumEnvironment, env).set_randomization_scale, (0, None))(env_state, scale)
    return TrainState(
        params=learner.params,
        adam=learner.adam,
        learning_rate=learner.learning_rate,
        observation_stats=ready.observation_stats,
        value_stats=ready.value_stats,
        env_state=env_state,
        key=key,
        iteration=state.iteration + 1,
        skipped_updates=learner.skipped_updates,
        scale=scale,
        memory=state.memory,
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
    env: Environment,
    config: PPOConfig,
    state: TrainState,
    normalizers: dict[str, Normalizer],
    key: jax.Array,
    mesh: Mesh | None = None,
    part: Part | None = None,
) -> tuple[tuple[Any, jax.Array | None], Rollout, Tally]:
    """States and memory afterwards, experience [T, B, ...] under the current policy, and what metrics follow from;
    values are in reward units."""
    params, std = state.params, value_std(state.value_stats)

    def act(key, obs, memory):
        memory, mean = actor_step(config, params, normalizers, obs, memory)
        noise = of_part(jax.random.normal(key, whole_shape(mean.shape, part)), part)
        action = distribution.sample(noise, mean, params.log_std)
        decision = Decision(action, mean, distribution.log_prob(action, mean, params.log_std))
        return decision, distribution.squash(action, config.distribution), memory

    def value(obs, memory):
        return state.value_stats.mean + std * critic_value(config, params, normalizers, obs, memory)

    return collect(env, state.env_state, key, act, value, config.rollout_length, mesh, state.memory)


# --- advantages ---------------------------------------------------------------------------------------


class Ready(NamedTuple):
    """What is learnt from, and the statistics that include it."""

    samples: Samples
    params: Params  # their critic's output in the units of `value_stats`
    value_stats: RunningStats
    observation_stats: dict[str, RunningStats]
    explained_variance: jax.Array  # [] share of the returns' variance that the critic's values explain


def prepare(
    config: PPOConfig,
    value_stats: RunningStats,
    observation_stats: dict[str, RunningStats],
    params: Params,
    rollout: Rollout,
    mesh: Mesh | None = None,
) -> Ready:
    """Advantages and normalised value targets in blocks [K, T * B / K], with a GRU as sequences [K, B / K, T]; updates
    the statistics."""
    advantage, target = compute_gae(
        config.reward_scale * rollout.reward,
        rollout.value,
        rollout.next_value,
        rollout.terminated,
        rollout.truncated,
        discount=config.discount,
        gae_lambda=config.gae_lambda,
    )
    seen = {group: rollout.obs[group] for group in observation_stats}
    means, variances = moments(
        {"obs": seen, "advantage": advantage, "target": target, "error": target - rollout.value}, mesh
    )
    size = advantage.size
    observation_stats = {
        group: merge_moments(stats, means["obs"][group], variances["obs"][group], size)
        for group, stats in observation_stats.items()
    }
    if config.normalize_value:
        new = merge_moments(value_stats, means["target"], variances["target"], size)
        critic = rescale_output(params.critic, value_stats.mean, value_std(value_stats), new.mean, value_std(new))
        params, value_stats = dataclasses.replace(params, critic=critic), new
    mean, std = value_stats.mean, value_std(value_stats)
    samples = Samples(
        obs=rollout.obs,
        decision=rollout.decision,
        advantage=(advantage - means["advantage"]) / (jnp.sqrt(variances["advantage"]) + 1e-8),
        value=(rollout.value - mean) / std,
        target=(target - mean) / std,
        memory=rollout.memory,
    )
    blocks = block_count(config, mesh)
    if config.memory != "gru":
        samples = in_blocks(samples, blocks)
    else:
        ended = rollout.terminated | rollout.truncated
        # What is remembered at the rollout's first step is zero where an episode begins with it.
        samples = dataclasses.replace(samples, first=jnp.zeros_like(ended).at[1:].set(ended[:-1]))
        samples = sequences_in_blocks(samples, blocks)
    explained = 1 - variances["error"] / variances["target"]
    return Ready(samples, params, value_stats, observation_stats, explained)


def strong_types(tree: Any) -> Any:
    """Remove weak types, which the next state would not have: JAX would compile the step twice."""

    def strong(x):
        return x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else jax.lax.convert_element_type(x, x.dtype)

    return jax.tree.map(strong, tree)
