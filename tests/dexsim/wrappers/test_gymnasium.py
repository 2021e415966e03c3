"""The Gymnasium environments: the same episodes as ours, with Gymnasium's conventions at their ends."""

import jax
import numpy as np
import pytest
from tiny_env import SHORT, TinyEnv

pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from dexsim.wrappers.gymnasium import GymEnv, GymVectorEnv

NEXT_STEP = {"autoreset_mode": AutoresetMode.NEXT_STEP}


def test_it_steps_as_the_environment_does_and_restarts_in_the_same_step():
    """Where an episode has ended its last observation is kept, and what is seen is that of a new one."""
    ours, env = TinyEnv(), GymVectorEnv(TinyEnv(), 4)
    seen, info = env.reset(seed=3)
    assert info == {} and env.observation_space.contains(seen) and seen.dtype == np.float32
    np.testing.assert_array_equal(
        seen, jax.vmap(lambda seed: ours.reset(jax.random.key(seed)))(np.arange(3, 7)).obs["actor"]
    )
    env.action_space.seed(0)
    step, done = jax.jit(jax.vmap(ours.step)), np.zeros(4, bool)
    while not done.any():
        assert info == {}
        action = env.action_space.sample()
        last = step(env._state, action)
        seen, reward, terminated, truncated, info = env.step(action)
        np.testing.assert_allclose(reward, last.reward, rtol=1e-6)
        np.testing.assert_array_equal([terminated, truncated], [last.terminated, last.truncated])
        done = terminated | truncated
        np.testing.assert_allclose(seen[~done], last.obs["actor"][~done], rtol=1e-6)
    np.testing.assert_array_equal(info["_final_obs"], done)
    np.testing.assert_allclose(info["final_obs"][done], last.obs["actor"][done], rtol=1e-6)
    assert np.any(seen[done] != info["final_obs"][done])
    np.testing.assert_allclose(env._state.metrics["length"][done], 0)
    np.testing.assert_allclose(info["final_info"]["return"][done], last.metrics["return"][done], rtol=1e-6)


def test_a_finished_episode_restarts_in_the_next_step_as_gymnasiums_own_vector_environment_has_it():
    """Against `SyncVectorEnv` of single environments: the same ends, rewards and, up to the first restart, states."""
    from gymnasium.vector import SyncVectorEnv

    ours = GymVectorEnv(TinyEnv(SHORT), 2, **NEXT_STEP)
    theirs = SyncVectorEnv([lambda: GymEnv(TinyEnv(SHORT))] * 2)
    assert theirs.metadata["autoreset_mode"] == ours.metadata["autoreset_mode"]
    (seen, _), (expected, _) = ours.reset(seed=7), theirs.reset(seed=7)
    np.testing.assert_allclose(seen, expected, rtol=1e-6)
    action, ended = np.zeros((2, 1), np.float32), []
    for _ in range(16):
        (seen, reward, terminated, truncated, info), other = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal([terminated, truncated], other[2:4])
        if not ended:
            np.testing.assert_allclose(seen, other[0], rtol=1e-6)
        if ended and ended[-1]:
            assert (reward == 0).all() and (other[1] == 0).all()
            np.testing.assert_allclose(np.asarray(ours._state.metrics["length"]), 0)
        assert info == {}
        ended.append(bool(truncated.all()))
    assert np.flatnonzero(ended).tolist() == [5, 12], "six steps, and one that restarts"


def test_seeds_repeat_are_each_environments_own_and_without_one_the_numbers_go_on():
    env = GymVectorEnv(TinyEnv(), 3)
    first = env.reset(seed=5)[0]
    np.testing.assert_array_equal(first, env.reset(seed=[5, 6, 7])[0])
    np.testing.assert_array_equal(first[[2, 0, 1]], env.reset(seed=(7, 5, 6))[0])
    after = env.reset(seed=[5, 6, 7])[0], env.reset()[0]
    assert np.any(after[1] != after[0])
    single = GymEnv(TinyEnv())
    np.testing.assert_array_equal(single.reset(seed=5)[0], first[0])


def test_gymnasiums_checker_accepts_a_single_environment():
    with pytest.warns(UserWarning, match="infinity|spec"):  # of the bounds of an observation in SI units
        check_env(GymEnv(TinyEnv()))


def test_a_batch_is_drawn_as_one_picture_each(grasp_env, grasp_rollout):
    env = GymVectorEnv(grasp_env, 2, render_mode="rgb_array")
    env._state = jax.jit(lambda state: jax.tree.map(lambda x: x[:2], state))(grasp_rollout.reset(jax.random.key(0)))
    first, second = env.render()
    assert first.shape == second.shape == (480, 640, 3) and first.dtype == np.uint8 and np.any(first != second)
    single = GymEnv(grasp_env)
    assert single.render() is None
    single._batch = env
    np.testing.assert_array_equal(single.render(), first)
