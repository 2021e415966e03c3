"""Environments from elsewhere: what the learner makes of five members, and what is an error."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reach_env import MAX_STEPS, Reach
from tiny_env import SMALL

from dexsim import registry
from dexsim.errors import ConfigError
from dexsim_ppo import evaluate as evaluate_command
from dexsim_ppo import evaluate_policy, load_policy, make_train, train_policy
from dexsim_ppo.learner.adapter import adapt


@pytest.fixture(autouse=True)
def own_tasks(monkeypatch):
    monkeypatch.setattr(registry, "TASKS", dict(registry.TASKS))
    monkeypatch.setattr(registry, "_MODULES", dict(registry._MODULES))


def play(env, actions, key=0):
    """All states of one episode, the first included."""
    states = [jax.jit(env.reset)(jax.random.key(key))]
    step = jax.jit(env.step)
    for action in actions:
        states.append(step(states[-1], jnp.full(1, action, jnp.float32)))
    return states


def test_steps_are_those_of_the_environment_with_return_and_length():
    env = adapt(Reach(), "reach")
    states = play(env, [0.5, -1.0, 0.0])
    begun = float(states[0].inner["x"])
    x = begun + 0.25 * np.cumsum([0.5, -1.0, 0.0])
    np.testing.assert_allclose([s.obs["actor"][0] for s in states[1:]], x, rtol=1e-6)
    np.testing.assert_allclose([s.reward for s in states[1:]], 1 - np.abs(x), rtol=1e-6)
    np.testing.assert_allclose([s.metrics["return"] for s in states[1:]], np.cumsum(1 - np.abs(x)), rtol=1e-6)
    np.testing.assert_allclose([s.metrics["distance"] for s in states], np.abs([begun, *x]), rtol=1e-6)
    assert [float(s.metrics["length"]) for s in states] == [0, 1, 2, 3]
    assert not any(s.terminated or s.truncated for s in states)


def test_the_time_limit_truncates_and_a_terminal_state_terminates():
    env = adapt(Reach(), "reach")
    states = play(env, [0.0] * MAX_STEPS)
    assert [bool(s.truncated) for s in states] == [False] * MAX_STEPS + [True]
    assert not states[-1].terminated
    away = play(env, [np.sign(states[0].inner["x"])] * MAX_STEPS)
    first = next(i for i, s in enumerate(away) if s.terminated)
    assert abs(away[first].inner["x"]) > 2 >= abs(away[first - 1].inner["x"])
    # In the last step of an episode, what terminates it is no time limit.
    late = dataclasses.replace(away[first - 1], clock=jnp.int32(MAX_STEPS - 1))
    ended = env.step(late, jnp.sign(late.inner["x"])[None])
    assert ended.terminated and not ended.truncated


def test_restart_is_a_new_episode_where_asked():
    env = adapt(Reach(), "reach")
    state = play(env, [0.3, 0.3])[-1]
    same, fresh = (jax.jit(env.restart)(state, jnp.bool_(done)) for done in (False, True))
    assert same.inner["x"] == state.inner["x"] != fresh.inner["x"]
    assert fresh.clock == 0 and fresh.metrics["length"] == 0 and same.clock == 2
    assert jax.jit(env.restart)(same, jnp.bool_(True)).inner["x"] != fresh.inner["x"], "keys advance either way"


def test_make_train_adapts_and_leaves_complete_environments_alone():
    training = make_train(Reach(), SMALL)
    state, metrics = training.step(training.init(jax.random.key(0)))
    assert int(state.iteration) == 1 and np.isfinite(metrics["step/distance"]).all()
    env = adapt(Reach(), "reach")
    assert adapt(env, "other") is env and adapt(Reach()).name == "Reach"
    with pytest.raises(ConfigError, match="a dict has no observation_size, action_size, max_steps, reset, step"):
        adapt({}, "nothing")


@pytest.mark.slow
def test_training_by_name_is_reported_saved_resumed_and_evaluated(tmp_path, capsys):
    config = dataclasses.replace(SMALL, num_envs=16)
    sizes = {"evaluation_chunk": 16, "evaluation_episodes": 16}
    run = train_policy("reach_env:reach", ppo=config, steps=16 * 8 * 4, run_dir=tmp_path / "run", seed=1, **sizes)
    assert run.policy.task == run.report["task"] == "reach" and run.policy.control_rate == 10.0
    assert run.report["trained"]["steps"] == MAX_STEPS and not (tmp_path / "run" / "policy.mp4").exists()
    # Doing nothing leaves the point where it begins: half a metre off in the mean over its range.
    idle = run.report["do_nothing"]
    assert idle["held"]["value"] == 1.0 and 0.2 < idle["task"]["headline"]["distance"] < 0.8
    assert idle["return"]["value"] == pytest.approx(MAX_STEPS * (1 - idle["task"]["headline"]["distance"]), rel=1e-4)
    longer = train_policy("reach_env:reach", resume=tmp_path / "run", steps=16 * 8 * 8)
    assert longer.policy.training["iteration"] == 8
    report = evaluate_policy(load_policy(tmp_path / "run" / "last.msgpack"), episodes=16, chunk=16, seed=3)
    code = evaluate_command.main(
        [str(tmp_path / "run" / "last.msgpack"), "--task", "reach_env:reach", "--episodes", "16", "--chunk", "16"]
        + ["--seed", "3", "--output", str(tmp_path / "report.json")]
    )
    assert code == 0 and f"{report['return']['value']:.4g}" in capsys.readouterr().out
