"""A number that is shown once, at an episode's first step, and is to be given as the action until its end.

What is remembered is all that helps: without memory the best action of every later step is 0, at a mean error of 0.5.
"""

import jax
import jax.numpy as jnp

from dexsim_ppo.learner.config import PPOConfig

MAX_STEPS = 6
# Rollouts are shorter than episodes: what a GRU remembers crosses them.
CONFIG = PPOConfig(
    num_envs=64,
    rollout_length=4,
    minibatches=4,
    epochs=4,
    actor_layers=(32,),
    critic_layers=(32,),
    discount=0.0,
    kl_target=0.02,
    learning_rate=2e-3,
    learning_rate_max=1e-2,
    memory_size=16,
    iterations_per_call=10,
)


class Recall:
    observation_size, action_size, max_steps = 2, 1, MAX_STEPS
    control_period = 0.1

    def reset(self, key):
        state = {"number": jax.random.uniform(key, (), minval=-1.0), "error": jnp.float32(0)}
        return jnp.stack([state["number"], jnp.float32(1)]), state

    def step(self, key, state, action):
        state = state | {"error": jnp.abs(action[0] - state["number"])}
        return jnp.zeros(2), state, -state["error"], jnp.bool_(False)

    def metrics(self, state):
        return {"error": state["error"]}
