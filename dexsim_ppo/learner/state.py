"""All that training carries from one iteration to the next, and how it begins."""

import dataclasses
import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dexsim.core.pytree import pytree_dataclass
from dexsim_ppo.learner import adam
from dexsim_ppo.learner.adam import AdamState
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.curriculum import Curriculum
from dexsim_ppo.learner.devices.sharding import Part, batched, of_part
from dexsim_ppo.learner.memory import empty, init_memory, state_size
from dexsim_ppo.learner.networks import Params, init_params
from dexsim_ppo.learner.running_stats import RunningStats, init_stats
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
    memory: jax.Array | None = None  # [B, m] state of the policy's memory


def init_state(
    env: Environment,
    config: PPOConfig,
    key: jax.Array,
    curriculum: Curriculum | None = None,
    mesh: Mesh | None = None,
) -> TrainState:
    """A fresh learner, and freshly reset environments with staggered clocks."""
    environments = init_environments(env, config, key, curriculum, mesh)
    return dataclasses.replace(init_learner(env, config, key, curriculum), env_state=environments)


def init_learner(
    env: Environment, config: PPOConfig, key: jax.Array, curriculum: Curriculum | None = None
) -> TrainState:
    """The state of a fresh learner, without environments."""
    params_key, _, _, key = jax.random.split(key, 4)
    sizes = {group: layout_size(fields) for group, fields in env.observation_layout.items()}
    memory = init_memory(jax.random.fold_in(params_key, 1), config, sizes["actor"])
    remembered = state_size(memory, sizes["actor"])
    params = init_params(
        params_key,
        actor_sizes=(sizes["actor"] + remembered, *config.actor_layers, env.action_size),
        critic_sizes=(sizes["critic"] + remembered, *config.critic_layers, 1),
        initial_std=config.initial_std,
        memory=memory,
    )
    return TrainState(
        params=params,
        adam=adam.init(params),
        learning_rate=jnp.float32(config.learning_rate),
        observation_stats={group: init_stats((size,)) for group, size in sizes.items()},
        value_stats=init_stats(()),
        env_state=None,
        key=key,
        iteration=jnp.int32(0),
        skipped_updates=jnp.int32(0),
        scale=None if curriculum is None else jnp.float32(curriculum.start),
        memory=empty(memory, sizes["actor"], (config.num_envs,)),
    )


def init_environments(
    env: Environment,
    config: PPOConfig,
    key: jax.Array,
    curriculum: Curriculum | None = None,
    mesh: Mesh | None = None,
    part: Part | None = None,
) -> Any:
    """Freshly reset environments [B, ...] with staggered clocks, or a part of them."""
    _, reset_key, stagger_key, _ = jax.random.split(key, 4)
    resets, staggers = (of_part(jax.random.split(key, config.num_envs), part) for key in (reset_key, stagger_key))
    reset = env.reset
    if curriculum is not None:
        reset = functools.partial(cast(CurriculumEnvironment, env).reset, scale=jnp.float32(curriculum.start))
    return batched(env.randomize_episode_time, mesh)(batched(reset, mesh)(resets), staggers)
