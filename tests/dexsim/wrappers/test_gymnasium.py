"""The Gymnasium vector environment: the same episodes as ours, with its conventions at their ends."""

import jax
import numpy as np
import pytest
from tiny_env import TinyEnv

pytest.importorskip("gymnasium")
from dexsim.wrappers.gymnasium import GymVectorEnv


def test_it_steps_as_the_environment_does():
    ours, env = TinyEnv(), GymVectorEnv(TinyEnv(), 4)
    seen, info = env.reset(seed=3)
    assert info == {} and env.observation_space.contains(seen) and seen.dtype == np.float32
    key = jax.random.key(int(np.random.default_rng(3).integers(2**32)))
    state = jax.vmap(ours.reset)(jax.random.split(key, 4))
    np.testing.assert_array_equal(seen, state.obs["actor"])
    env.action_space.seed(0)
    for _ in range(5):
        action = env.action_space.sample()
        state = jax.vmap(ours.step)(state, action)
        seen, reward, terminated, truncated, info = env.step(action)
        np.testing.assert_allclose(seen, state.obs["actor"], rtol=1e-6)
        np.testing.assert_allclose(reward, state.reward, rtol=1e-6)
        assert not (terminated | truncated).any() and info == {}


def test_a_finished_episode_restarts_in_the_same_step_and_leaves_its_last_observation():
    ours, env = TinyEnv(), GymVectorEnv(TinyEnv(), 3)
    env.reset(seed=0)
    before = env._state
    for _ in range(200):
        action = np.zeros(env.action_space.shape, np.float32)
        state = jax.vmap(ours.step)(before, action)
        seen, _, terminated, truncated, info = env.step(action)
        before = env._state
        if (terminated | truncated).any():
            break
    done = terminated | truncated
    np.testing.assert_array_equal(info["_final_obs"], done)
    np.testing.assert_allclose(info["final_obs"][done], np.asarray(state.obs["actor"])[done], rtol=1e-6)
    assert np.any(seen[done] != info["final_obs"][done]), "the observation is that of a new episode"
    np.testing.assert_allclose(np.asarray(env._state.metrics["length"])[done], 0)
    np.testing.assert_allclose(info["final_info"]["return"][done], np.asarray(state.metrics["return"])[done], rtol=1e-6)


def test_seeds_repeat_and_without_one_the_numbers_go_on():
    env = GymVectorEnv(TinyEnv(), 4)
    first, again = env.reset(seed=5)[0], env.reset(seed=5)[0]
    np.testing.assert_array_equal(first, again)
    assert np.any(env.reset()[0] != first)
