"""Training that goes on from a finished policy, on objects, motors or sensors that have changed."""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.errors import ConfigError
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.ppo import TrainState
from dexsim_ppo.learner.running_stats import recover_stats
from dexsim_ppo.learner.types import Environment
from dexsim_ppo.policy import Policy, layout_to_list


def learner_settings(policy: Policy, config: PPOConfig) -> PPOConfig:
    """`config` with the policy's network, little noise, small steps, and some iterations for the critic alone.

    A policy's file holds neither its critic nor its noise. The first policy's noise would undo what it knows, a
    critic that has not settled would lead it astray, for its errors all point the same way, and the steps of a first
    training are too large for what little is left to gain.
    """
    return dataclasses.replace(
        config,
        actor_layers=tuple(layer.kernel.shape[1] for layer in policy.params.layers[:-1]),
        distribution=policy.params.squash,
        learning_rate=1e-5,
        learning_rate_min=1e-6,
        learning_rate_max=5e-4,
        kl_target=2e-4,
        initial_std=0.2,
        critic_first=100,
    )


def check_fit(policy: Policy, env: Environment, config: PPOConfig) -> None:
    """Whether a learner with this configuration can go on from the policy.

    Raises:
      ConfigError: the policy observes something else than the environment offers, or has another network.
    """
    theirs, mine = (layout_to_list(fields) for fields in (policy.observation_layout, env.observation_layout["actor"]))
    if theirs != mine:
        odd = [name for name, *_ in (*(f for f in theirs if f not in mine), *(f for f in mine if f not in theirs))]
        raise ConfigError(f"the policy does not observe what this configuration offers: {', '.join(odd) or 'order'}")
    layers = tuple(layer.kernel.shape[1] for layer in policy.params.layers)
    if layers != (*config.actor_layers, env.action_size) or policy.params.squash != config.distribution:
        raise ConfigError(
            f"the policy's network has layers {layers} and is {policy.params.squash!r}; leave "
            "ppo.actor_layers and ppo.distribution as they are"
        )


def start_from(policy: Policy, config: PPOConfig, state: TrainState) -> TrainState:
    """A fresh learner's state with the policy's actor and observation statistics, so that the network goes on seeing
    what it was trained with."""
    stats = recover_stats(policy.params.normalizer, std_floor=config.observation_std_floor)
    return dataclasses.replace(
        state,
        params=dataclasses.replace(state.params, actor=jax.tree.map(jnp.copy, policy.params.layers)),
        observation_stats=state.observation_stats | {"actor": stats},
    )
