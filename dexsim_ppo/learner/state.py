"""All that training carries from one iteration to the next, and how it begins."""

import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dexsim.core.layout import layout_size
from dexsim.core.pytree import pytree_dataclass
from dexsim_ppo.learner import adam
from dexsim_ppo.learner.adam import AdamState
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.curriculum import CurriculumConfig
from dexsim_ppo.learner.networks import Params, carry_size, init_gru, init_params, zero_carry
from dexsim_ppo.learner.running_stats import RunningStats, init_stats
from dexsim_ppo.learner.sharding import batched
from dexsim_ppo.learner.types import Environment


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
    carry: jax.Array | None = None  # [B, m] of the policy's memory


def init_state(
    env: Environment, config: PPOConfig, key: jax.Array, curriculum: CurriculumConfig | None, mesh: Mesh | None
) -> TrainState:
    """A fresh learner, and freshly reset environments [B, ...] with staggered clocks."""
    params_key, reset_key, stagger_key, key = jax.random.split(key, 4)
    sizes = {group: layout_size(layout) for group, layout in env.observation_layout.items()}
    memory = None
    if config.memory == "gru":
        memory = init_gru(jax.random.fold_in(params_key, 1), sizes["actor"], config.memory_size)
    actor = (sizes["actor"] + carry_size(memory), *config.actor_layers, env.action_size)
    critic = (sizes["critic"] + carry_size(memory), *config.critic_layers, 1)
    params = init_params(params_key, actor, critic, config.initial_std, memory)
    resets, staggers = (jax.random.split(key, config.num_envs) for key in (reset_key, stagger_key))
    scale = None if curriculum is None else jnp.float32(curriculum.start)
    reset = env.reset if scale is None else functools.partial(cast(Any, env).reset, scale=scale)
    return TrainState(
        params=params,
        adam=adam.init(params),
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
