"""The brax adapter, against the installed brax: its wrappers and its PPO."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simple_physics import SimplePhysics

import dexsim
from dexsim.core.errors import ConfigError
from dexsim.tasks.grasp.config import GraspConfig

pytest.importorskip("brax")

from brax.envs.wrappers import training

from dexsim.wrappers.brax import BraxEnv, wrap


class Field(NamedTuple):
    name: str
    size: int
    scale: float | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PointState:
    obs: dict
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    metrics: dict
    key: jax.Array
    position: jax.Array
    clock: jax.Array


class PointEnv:
    """A point on a line that terminates when it leaves (-1, 1) and is truncated after 6 ticks."""

    action_size, name, backend, evaluation_steps = 1, "point", "mjx", 6
    observation_layout = {"actor": (Field("position", 1),), "critic": (Field("position", 1), Field("clock", 1))}

    def reset(self, key):
        key, draw = jax.random.split(key)
        position = jax.random.uniform(draw, minval=-0.4, maxval=0.4)
        return self._state(key, position, jnp.zeros((), jnp.int32))

    def step(self, state, action):
        position = state.position + 0.3 * jnp.clip(action[0], -1, 1)
        return self._state(state.key, position, state.clock + 1)

    def restart(self, state, done):
        begun = self.reset(state.key)
        return jax.tree.map(lambda new, old: jnp.where(done, new, old), begun, state)

    def _state(self, key, position, clock):
        reward = -(position**2)
        return PointState(
            obs={"actor": position[None], "critic": jnp.stack([position, clock / 6.0])},
            reward=reward,
            terminated=jnp.abs(position) > 1,
            truncated=clock >= 6,
            metrics={"reward/centre": reward, "success": jnp.abs(position) < 0.1, "return": reward, "length": clock},
            key=key,
            position=position,
            clock=clock,
        )


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


def test_sizes_and_groups():
    env = BraxEnv(PointEnv())
    assert env.observation_size == {"actor": (1,), "critic": (2,)}
    assert (env.action_size, env.backend, env.episode_length) == (1, "mjx", 6)
    state = env.reset(jax.random.PRNGKey(0))
    assert {group: obs.shape for group, obs in state.obs.items()} == env.observation_size
    assert set(state.metrics) == {"reward/centre", "success"}
    actor = BraxEnv(PointEnv(), "actor")
    assert actor.observation_size == 1 and actor.reset(jax.random.PRNGKey(0)).obs.shape == (1,)
    with pytest.raises(ConfigError, match="actor, critic"):
        BraxEnv(PointEnv(), "camera")


def test_step_is_ours():
    ours, env = PointEnv(), BraxEnv(PointEnv())
    state, want = env.reset(jax.random.PRNGKey(3)), ours.reset(jax.random.key(3))
    for _ in range(4):
        state, want = env.step(state, jnp.ones(1)), ours.step(want, jnp.ones(1))
    np.testing.assert_array_equal(state.obs["critic"], want.obs["critic"])
    np.testing.assert_array_equal(state.reward, want.reward)


def test_terminated_and_truncated_apart():
    # The first environment runs off the field, the second stays on it until the time limit.
    states = run(wrap(BraxEnv(PointEnv()), episode_length=100), jnp.array([[1.0], [0.0]]))
    done, truncation = states.done.astype(bool), states.info["truncation"].astype(bool)
    ran_off, stayed = np.flatnonzero(done[:, 0]), np.flatnonzero(done[:, 1])
    assert len(ran_off) >= 2 and not truncation[:, 0].any()
    assert stayed.tolist() == [5, 11] and truncation[stayed, 1].all()
    np.testing.assert_array_equal(truncation & ~done, False)
    # The step count starts again with the episode, and so does the point, somewhere else each time.
    assert states.info["steps"][:7, 1].tolist() == [1, 2, 3, 4, 5, 6, 1]
    starts = states.obs["actor"][stayed, 1, 0]
    assert len(set(starts.tolist())) == 2 and (np.abs(starts) <= 0.4).all()


def test_termination_wins_over_truncation():
    class Both(PointEnv):
        def _state(self, key, position, clock):
            state = super()._state(key, position, clock)
            return dataclasses.replace(state, terminated=state.truncated)

    states = run(wrap(BraxEnv(Both()), episode_length=100), jnp.zeros((2, 1)))
    assert states.done[5].all() and not states.info["truncation"].any()


def test_standard_wrappers():
    env = training.wrap(BraxEnv(PointEnv()), episode_length=6)
    states = run(env, jnp.array([[1.0], [0.0]]))
    stayed = np.flatnonzero(states.done[:, 1])
    assert stayed.tolist() == [5, 11] and states.info["truncation"][stayed, 1].all()
    # Each environment goes back to its own first state, as brax does it.
    assert len(set(states.obs["actor"][stayed, 1, 0].tolist())) == 1


def train(env, num_timesteps, **options):
    """brax's PPO at toy size; returns the metrics of each evaluation and the parameters."""
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo

    history = []
    factory = functools.partial(
        networks.make_ppo_networks,
        policy_obs_key="actor",
        value_obs_key="critic",
        policy_hidden_layer_sizes=(16,),
        value_hidden_layer_sizes=(16,),
    )
    _, params, _ = ppo.train(
        env,
        num_timesteps=num_timesteps,
        wrap_env_fn=wrap,
        normalize_observations=True,
        num_updates_per_batch=2,
        network_factory=factory,
        num_evals=2,
        progress_fn=lambda step, metrics: history.append(metrics),
        **options,
    )
    return history, params


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["simple", "c"])
def test_ppo_runs_on_grasp(physics, monkeypatch):
    """The task itself under brax's wrappers and learner. Its evaluations compile the task once more: the point's do."""
    if physics == "simple":
        monkeypatch.setattr("dexsim.env.env.Physics", SimplePhysics)
    env = dexsim.make("grasp", GraspConfig(pool_size=20), backend="c")
    history, params = train(
        BraxEnv(env),
        num_timesteps=3 * 8 * 4,
        episode_length=8,
        num_envs=8,
        batch_size=4,
        num_minibatches=2,
        unroll_length=4,
        run_evals=False,
        discounting=0.97,
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
    assert np.isfinite(history[-1]["training/total_loss"])
