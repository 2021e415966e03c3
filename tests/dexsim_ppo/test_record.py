"""Recorded episodes: readings and the targets that followed, to the end of each."""

import jax
import numpy as np
import pytest

import dexsim
from dexsim.core.compilation import jit
from dexsim.env.evaluation import evaluation_of
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo import load_policy, record


@pytest.mark.slow
def test_readings_and_targets_are_those_of_the_episodes():
    env, policy = dexsim.make("grasp", GraspConfig(pool_size=80), backend="c"), load_policy("grasp")
    found, shown = record.record(policy, env, episodes=3, seconds=0.3, seed=0)
    assert [len(one.time) for one in found] == [10, 10, 10]
    for one, snapshots in zip(found, shown, strict=True):
        np.testing.assert_allclose(snapshots.taxel_force, one.taxel_force)
        assert snapshots.primitive_active.shape == (10, len(env.primitive_kinds))
    protocol, memory = evaluation_of(env), policy.initial_carry(3)
    state = jit(protocol.evaluation_starts, once=True)(protocol.evaluation_plan(3, 0))
    step = jit(jax.vmap(env.step), once=True)
    for tick in range(10):
        for i, one in enumerate(found):
            for name in ("joint_position", "taxel_force", "command"):
                wanted = np.asarray(getattr(state.readings, name))[i]
                np.testing.assert_allclose(getattr(one, name)[tick], wanted, atol=2e-3)
        memory, action = policy.act(memory, state.obs["actor"])
        state = step(state, action)
        np.testing.assert_allclose([one.target[tick] for one in found], state.joint_target, atol=2e-3)
