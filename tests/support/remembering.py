"""A shipped policy whose network sees a memory of random weights, in place of its own: for what need not act well."""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim_ppo.learner.networks import carry_size, init_gru
from dexsim_ppo.policy import load_policy


def remembering(name="grasp"):
    policy = load_policy(name)
    first, *others = policy.params.layers
    size = policy.params.normalizer.mean.shape[0]
    keys = jax.random.split(jax.random.key(5), 3)
    memory = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(keys[1], x.shape), init_gru(keys[0], size, 16))
    extra = 0.1 * jax.random.normal(keys[2], (carry_size(memory), first.kernel.shape[1]))
    first = dataclasses.replace(first, kernel=jnp.concatenate([first.kernel[:size], extra]))
    return dataclasses.replace(
        policy, params=dataclasses.replace(policy.params, layers=(first, *others), memory=memory)
    )
