"""Environments from elsewhere: what the learner makes of five members, and what is an error."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.errors import ConfigError
from dexsim_ppo.learner.adapter import adapt

MAX_STEPS = 8


class Reach:
    """A point that is to reach the origin."""

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


ENV = adapt(Reach(), "reach")
reset, step, restart = (jax.jit(function) for function in (ENV.reset, ENV.step, ENV.restart))


def play(actions):
    """All states of one episode, the first included."""
    states = [reset(jax.random.key(0))]
    for action in actions:
        states.append(step(states[-1], jnp.full(1, action, jnp.float32)))
    return states


def test_steps_are_those_of_the_environment_with_return_and_length():
    states = play([0.5, -1.0, 0.0])
    begun = float(states[0].inner["x"])
    x = begun + 0.25 * np.cumsum([0.5, -1.0, 0.0])
    np.testing.assert_allclose([s.obs["actor"][0] for s in states[1:]], x, rtol=1e-6)
    np.testing.assert_allclose([s.reward for s in states[1:]], 1 - np.abs(x), rtol=1e-6)
    np.testing.assert_allclose([s.metrics["return"] for s in states[1:]], np.cumsum(1 - np.abs(x)), rtol=1e-6)
    np.testing.assert_allclose([s.metrics["distance"] for s in states], np.abs([begun, *x]), rtol=1e-6)
    assert [float(s.metrics["length"]) for s in states] == [0, 1, 2, 3]
    assert not any(s.terminated or s.truncated for s in states)


def test_the_time_limit_truncates_and_a_terminal_state_terminates():
    states = play([0.0] * MAX_STEPS)
    assert [bool(s.truncated) for s in states] == [False] * MAX_STEPS + [True]
    assert not states[-1].terminated
    away = play([np.sign(states[0].inner["x"])] * MAX_STEPS)
    first = next(i for i, s in enumerate(away) if s.terminated)
    assert abs(away[first].inner["x"]) > 2 >= abs(away[first - 1].inner["x"])
    # In the last step of an episode, what terminates it is no time limit.
    late = dataclasses.replace(away[first - 1], clock=jnp.int32(MAX_STEPS - 1))
    ended = step(late, jnp.sign(late.inner["x"])[None])
    assert ended.terminated and not ended.truncated


def test_restart_is_a_new_episode_where_asked():
    state = play([0.3, 0.3])[-1]
    same, fresh = (restart(state, jnp.bool_(done)) for done in (False, True))
    assert same.inner["x"] == state.inner["x"] != fresh.inner["x"]
    assert fresh.clock == 0 and fresh.metrics["length"] == 0 and same.clock == 2
    assert restart(same, jnp.bool_(True)).inner["x"] != fresh.inner["x"], "keys advance either way"


def test_a_report_has_the_means_of_its_own_metrics_over_the_steps_that_episodes_lived():
    metrics = {"distance": np.array([[1.0, 3.0], [5.0, 99.0]]), "return": np.ones((2, 2)), "length": np.ones((2, 2))}
    assert ENV.summarize(metrics, np.array([[True, True], [True, False]])) == {"headline": {"distance": 3.0}}


def test_complete_environments_are_left_alone():
    """That `make_train` adapts is shown by `docs/any_environment.md`, whose example runs."""
    assert adapt(ENV, "other") is ENV and adapt(Reach()).name == "Reach"
    with pytest.raises(ConfigError, match="a dict has no observation_size, action_size, max_steps, reset, step"):
        adapt({}, "nothing")
