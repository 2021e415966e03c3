"""The vector environment of Stable-Baselines3: its conventions at an episode's end, under its monitor."""

import numpy as np
import pytest
from tiny_env import SHORT, TinyEnv


@pytest.fixture(autouse=True)
def sb3():
    """Loads torch, for seconds."""
    pytest.importorskip("stable_baselines3")


def test_an_end_has_its_last_observation_and_tells_a_time_limit_from_a_termination():
    from stable_baselines3.common.vec_env import VecMonitor

    from dexsim.wrappers.sb3 import SB3VecEnv

    # The first environment runs off the field, the second stays on it until the time limit.
    env = VecMonitor(SB3VecEnv(TinyEnv(SHORT), 2))
    env.seed(5)
    first = env.reset()
    env.seed(5)
    np.testing.assert_array_equal(first, env.reset())
    assert np.any(first != env.reset())
    limits = {0: set(), 1: set()}
    for _ in range(6):
        seen, _, done, infos = env.step(np.array([[1.0], [0.0]]))
        for i in np.flatnonzero(done):
            limits[i].add(infos[i]["TimeLimit.truncated"])
            assert np.any(infos[i]["terminal_observation"] != seen[i]) and infos[i]["episode"]["l"] <= 6
    assert limits == {0: {False}, 1: {True}}
