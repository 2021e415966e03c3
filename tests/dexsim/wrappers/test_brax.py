"""The brax adapter, against the installed brax's wrappers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import TinyConfig, TinyEnv

pytest.importorskip("brax")


from dexsim.wrappers.brax import BraxEnv, wrap


def tiny():
    """A point that is off the field after three ticks of full action; its time limit is 6 ticks."""
    return TinyEnv(TinyConfig(horizon=6, gain=1.0, wall=1.5))


def test_step_is_ours():
    ours, env = tiny(), BraxEnv(tiny())
    state, want = env.reset(jax.random.PRNGKey(3)), ours.reset(jax.random.key(3))
    for _ in range(4):
        state, want = env.step(state, 0.1 * jnp.ones(1)), ours.step(want, 0.1 * jnp.ones(1))
    np.testing.assert_array_equal(state.obs["critic"], want.obs["critic"])
    np.testing.assert_array_equal(state.reward, want.reward)
    assert env.observation_size == {"actor": (3,), "critic": (3,)} and env.action_size == 1
    assert (env.episode_length, env.dt) == (32, 0.1)


def test_terminated_and_truncated_apart():
    # The first environment runs off the field, the second stays on it until the time limit.
    env, states = wrap(BraxEnv(tiny()), episode_length=100), []
    state, step = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2)), jax.jit(env.step)
    for _ in range(14):
        state = step(state, jnp.array([[1.0], [0.0]]))
        states.append(state)
    states = jax.tree.map(lambda *leaves: np.stack(leaves), *states)
    done, truncation = states.done.astype(bool), states.info["truncation"].astype(bool)
    ran_off, stayed = np.flatnonzero(done[:, 0]), np.flatnonzero(done[:, 1])
    assert len(ran_off) >= 2 and not truncation[:, 0].any()
    assert stayed.tolist() == [5, 11] and truncation[stayed, 1].all()
    np.testing.assert_array_equal(truncation & ~done, False)
    # The step count starts again with the episode, and so does the point, somewhere else each time.
    assert states.info["steps"][:7, 1].tolist() == [1, 2, 3, 4, 5, 6, 1]
    starts = states.obs["actor"][stayed, 1, 0]
    assert len(set(starts.tolist())) == 2 and (np.abs(starts) <= 1.0).all()
