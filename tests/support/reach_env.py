"""A point that is to reach the origin, with the five members that `dexsim_ppo.learner.adapter` asks for."""

import jax
import jax.numpy as jnp

MAX_STEPS = 8


class Reach:
    observation_size, action_size, max_steps = 2, 1, MAX_STEPS
    control_period = 0.1

    def reset(self, key):
        x = jax.random.uniform(key, (), minval=-1.0, maxval=1.0)
        state = {"x": x, "steps": jnp.int32(0)}
        return self._seen(state), state

    def step(self, key, state, action):
        state = {"x": state["x"] + 0.25 * action[0], "steps": state["steps"] + 1}
        return self._seen(state), state, 1.0 - jnp.abs(state["x"]), jnp.abs(state["x"]) > 2.0

    def metrics(self, state):
        return {"distance": jnp.abs(state["x"])}

    def _seen(self, state):
        return jnp.stack([state["x"], jnp.float32(1.0)])


def reach():
    return Reach()
