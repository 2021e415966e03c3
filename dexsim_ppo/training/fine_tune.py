"""Fine-tuning: training that starts from a policy, on changed objects, motors or sensors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import ConfigError
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.running_stats import recover_stats
from dexsim_ppo.learner.state import TrainState
from dexsim_ppo.learner.types import Environment
from dexsim_ppo.policy import Policy, layout_to_list
from dexsim_ppo.policy_file import memory_to_list


def fine_tuning_config(policy: Policy, config: PPOConfig) -> PPOConfig:
    """`config` with the policy's network and normaliser, little noise, small steps, and the critic alone at first.

    A policy file holds neither critic nor noise. The noise and step size of training from scratch would make the
    policy forget. So would a fresh critic, whose errors are correlated: it trains alone first.
    """
    kind, size = memory_to_list(policy.params.memory) or ["none", 0]
    sizes = {"history": {"memory_length": size + 1}, "gru": {"memory_size": size}}.get(kind, {})
    normalizer, floor = policy.params.normalizer, config.observation_std_floor
    running = np.concatenate([np.full(field.size, field.scale is None) for field in policy.observation_layout])
    smallest = float(np.min(np.asarray(normalizer.std)[running], initial=floor))
    if smallest < 0.999 * floor:  # Beyond rounding: a higher floor than that of its training would raise deviations.
        floor = smallest
    return dataclasses.replace(
        config,
        memory=kind,
        **sizes,
        actor_layers=tuple(layer.kernel.shape[1] for layer in policy.params.layers[:-1]),
        distribution=policy.params.squash,
        observation_clip=normalizer.clip,
        observation_std_floor=floor,
        learning_rate=1e-5,
        learning_rate_min=1e-6,
        learning_rate_max=5e-4,
        kl_target=2e-4,
        kl_halving=0,
        initial_std=0.2,
        critic_first=100,
    )


def check_fit(policy: Policy, env: Environment, config: PPOConfig) -> None:
    """Check that a learner with this configuration can start from the policy.

    Raises:
      ConfigError: the policy's observation is not the environment's, or its network is not the configuration's.
    """
    theirs, mine = (layout_to_list(fields) for fields in (policy.observation_layout, env.observation_layout["actor"]))
    if theirs != mine:
        odd = [name for name, *_ in (*(f for f in theirs if f not in mine), *(f for f in mine if f not in theirs))]
        raise ConfigError(f"observations of policy and environment differ: {', '.join(odd) or 'their order'}")
    remembers = memory_to_list(policy.params.memory)
    wanted = {"history": ["history", config.memory_length - 1], "gru": ["gru", config.memory_size]}.get(config.memory)
    if remembers != wanted:
        raise ConfigError("the policy has another memory: do not set --ppo.memory or its size")
    layers = tuple(layer.kernel.shape[1] for layer in policy.params.layers)
    if layers != (*config.actor_layers, env.action_size) or policy.params.squash != config.distribution:
        raise ConfigError(
            f"the policy's network has layers {layers} and is {policy.params.squash!r}: do not set "
            "--ppo.actor-layers or --ppo.distribution"
        )


def initialize_from(policy: Policy, config: PPOConfig, state: TrainState) -> TrainState:
    """A fresh learner's state with the policy's actor and observation statistics: the actor's inputs keep the
    normalisation that it was trained with."""
    stats = recover_stats(policy.params.normalizer, std_floor=config.observation_std_floor)
    actor, memory = jax.tree.map(jnp.copy, (policy.params.layers, policy.params.memory))
    return dataclasses.replace(
        state,
        params=dataclasses.replace(state.params, actor=actor, memory=memory),
        observation_stats=state.observation_stats | {"actor": stats},
    )
