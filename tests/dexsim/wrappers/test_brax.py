"""The brax adapter, against the installed brax: its wrappers and its PPO."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import SHORT, TinyEnv

pytest.importorskip("brax")


from dexsim.wrappers.brax import BraxEnv, wrap


def keys(count):
    """Raw keys, as brax's trainers hand them out."""
    return jax.random.split(jax.random.PRNGKey(0), count)


def run(env, actions):
    """`[T, ...]` states of a wrapped environment under constant actions."""
    state, states = jax.jit(env.reset)(keys(actions.shape[0])), []
    step = jax.jit(env.step)
    for _ in range(14):
        state = step(state, actions)
        states.append(state)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


def test_rewards_are_ours_and_terminated_and_truncated_apart():
    # The first environment runs off the field, the second stays on it until the time limit.
    states = run(wrap(BraxEnv(TinyEnv(SHORT)), episode_length=100), jnp.array([[1.0], [0.0]]))
    x, target, _ = states.obs["critic"][:5, 1].T  # of an integrator that does not move
    np.testing.assert_allclose([x, states.reward[:5, 1]], [x[:1].repeat(5), 1 - np.abs(x - target)], rtol=1e-6)
    done, truncation = states.done.astype(bool), states.info["truncation"].astype(bool)
    ran_off, stayed = np.flatnonzero(done[:, 0]), np.flatnonzero(done[:, 1])
    assert len(ran_off) >= 2 and not truncation[:, 0].any()
    assert stayed.tolist() == [5, 11] and truncation[stayed, 1].all()
    np.testing.assert_array_equal(truncation & ~done, False)
    # The step count starts again with the episode, and so does the point, somewhere else each time.
    assert states.info["steps"][:7, 1].tolist() == [1, 2, 3, 4, 5, 6, 1]
    starts = states.obs["actor"][stayed, 1, 0]
    assert len(set(starts.tolist())) == 2 and (np.abs(starts) <= 1.0).all()


@pytest.mark.slow
def test_its_ppo_runs():
    from brax.training.agents.ppo import networks, train as ppo

    factory = functools.partial(networks.make_ppo_networks, policy_obs_key="actor", value_obs_key="critic")
    sizes = dict(num_timesteps=96, episode_length=8, num_envs=8, batch_size=4, num_minibatches=2, unroll_length=4)
    _, params, _ = ppo.train(
        BraxEnv(TinyEnv(SHORT)), wrap_env_fn=wrap, network_factory=factory, run_evals=False, **sizes
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
