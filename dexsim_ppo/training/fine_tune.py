"""Fine-tuning: training that starts from a policy, on changed objects, motors or sensors."""

import dataclasses

import jax
import numpy as np

from dexsim.core.errors import ConfigError
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.networks import carry_size
from dexsim_ppo.learner.running_stats import recover_stats
from dexsim_ppo.learner.types import TrainState
from dexsim_ppo.policy import Policy


def fine_tuning_config(policy: Policy, config: PPOConfig) -> PPOConfig:
    """`config` with the policy's network and normaliser, little noise, small steps, and the critic alone at first.

    A policy file holds neither critic nor noise. The noise and step size of training from scratch would make the
    policy forget. So would a fresh critic, whose errors are correlated: it trains alone first.
    """
    units = carry_size(policy.params.memory)
    normalizer, floor = policy.params.normalizer, config.observation_std_floor
    running = np.concatenate([np.full(entry.size, entry.scale is None) for entry in policy.observation_layout])
    smallest = float(np.min(np.asarray(normalizer.std)[running], initial=floor))
    if smallest < 0.999 * floor:  # Beyond rounding: a higher floor than that of its training would raise deviations.
        floor = smallest
    return dataclasses.replace(
        config,
        memory="gru" if units else "none",
        memory_size=units or config.memory_size,
        actor_layers=tuple(layer.kernel.shape[1] for layer in policy.params.layers[:-1]),
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


def check_network(policy: Policy, config: PPOConfig) -> None:
    """Raises ConfigError: the policy's network is not that of a learner with this configuration."""
    network = fine_tuning_config(policy, config)
    for name in ("memory", "memory_size", "actor_layers"):
        if getattr(config, name) != getattr(network, name):
            raise ConfigError(f"PPOConfig.{name} = {getattr(config, name)}: the policy has {getattr(network, name)}")


def initialize_from(policy: Policy, config: PPOConfig, state: TrainState) -> TrainState:
    """A fresh learner's state with the policy's actor and observation statistics: the actor's inputs keep the
    normalisation that it was trained with."""
    with jax.ensure_compile_time_eval():
        stats = recover_stats(policy.params.normalizer, std_floor=config.observation_std_floor)
    actor, memory = policy.params.layers, policy.params.memory
    return dataclasses.replace(
        state,
        params=dataclasses.replace(state.params, actor=actor, memory=memory),
        average=(actor, memory),
        observation_stats=state.observation_stats | {"actor": stats},
    )
