"""A shipped policy whose network sees a memory of random weights, in place of its own: for what need not act well."""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.memory import init_memory, state_size
from dexsim_ppo.policy import load_policy

KINDS = ("history", "gru")


def remembering(kind, name="grasp"):
    policy = load_policy(name)
    first, *others = policy.params.layers
    size = policy.params.normalizer.mean.shape[0]
    keys = jax.random.split(jax.random.key(5), 3)
    memory = init_memory(keys[0], PPOConfig(memory=kind, memory_length=3, memory_size=16), size)
    if kind == "gru":
        memory = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(keys[1], x.shape), memory)
    extra = 0.1 * jax.random.normal(keys[2], (state_size(memory, size), first.kernel.shape[1]))
    first = dataclasses.replace(first, kernel=jnp.concatenate([first.kernel[:size], extra]))
    return dataclasses.replace(
        policy, params=dataclasses.replace(policy.params, layers=(first, *others), memory=memory)
    )
