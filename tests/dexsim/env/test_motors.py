"""The time step at which explicit motors are stable, against a joint that is simulated."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dexsim.actuator.drive import delayed_target
from dexsim.env.motors import JointCommand, Motors, check_timestep
from dexsim.errors import ConfigError
from dexsim.hand.kinematics import hinge_angles
from dexsim.hand.mjcf import read_mjcf
from dexsim.physics.config import PhysicsConfig
from dexsim.randomization import Randomization

NOMINAL = Randomization(scale=0.0)


def accepts(hand, step, ranges):
    try:
        check_timestep(hand, PhysicsConfig(timestep=step), ranges)
    except ConfigError:
        return False
    return True


@pytest.mark.parametrize("damping", [0.0, 0.001, 0.003])
def test_the_bound_is_where_one_joint_begins_to_chatter(damping):
    """a + 2 b < 4 of a joint that is stepped as engines do: bounded below, growing above."""
    inertia, stiffness = 1e-3, 2.0

    def grows(step):
        q, v = 0.01, 0.0
        for _ in range(20_000):
            v += step / inertia * (-stiffness * q - damping * v)
            q += step * v
            if abs(q) > 1.0:
                return True
        return False

    # h^2 k + 2 h d = 4 I
    bound = (-damping + np.sqrt(damping**2 + 4 * stiffness * inertia)) / stiffness
    assert not grows(0.995 * bound) and grows(1.005 * bound)


def chatters(hand, step, stiffness, damping):
    """Whether C MuJoCo's hand, alone and without gravity, moves more after 5 s under PD than at the start."""
    spec = read_mjcf(hand)
    spec.option = mujoco.MjSpec().option
    spec.option.timestep, spec.option.gravity = step, [0, 0, 0]
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    middle = np.asarray(hinge_angles(hand, (hand.joint_lower + hand.joint_upper) / 2))
    data.qpos[:] = middle + 1e-4 * rng.normal(size=model.nq)
    for _ in range(round(5.0 / step)):
        data.qfrc_applied[:] = stiffness * (middle - data.qpos) - damping * data.qvel
        mujoco.mj_step(model, data)
        if np.abs(data.qpos - middle).max() > 0.01:
            return True
    return False


@pytest.mark.parametrize("step", [0.006, 0.0072, 0.0082, 0.010])
def test_it_refuses_the_steps_at_which_the_hand_chatters(hand, step):
    assert accepts(hand, step, NOMINAL) == (not chatters(hand, step, NOMINAL.stiffness, NOMINAL.damping))


def test_targets_arrive_after_their_latency_up_to_two_ticks():
    """Targets 0, 1, 2, ... of successive ticks: at sub-step n acts the newest that is at least `latency` old."""
    substeps, targets = 6, jnp.arange(8.0)
    motors = object.__new__(Motors)
    motors._substeps = substeps
    latency = jnp.arange(2 * substeps + 1)
    for tick in range(2, 6):
        target, previous, earlier = (jnp.full(len(latency), targets[tick - k]) for k in range(3))
        command = JointCommand(target, target, previous, jnp.bool_(True), earlier)
        delay = motors._delay(SimpleNamespace(latency=latency), command)
        for substep in range(substeps):
            expected = (tick * substeps + substep - np.asarray(latency)) // substeps
            np.testing.assert_array_equal(delayed_target(jnp.int32(substep), *delay), expected)


def test_the_default_is_stable_and_coarser_steps_are_refused_with_what_to_do(hand):
    ranges = Randomization()
    check_timestep(hand, PhysicsConfig(), ranges)
    for step in (0.008, 0.010):
        with pytest.raises(ConfigError, match=r"unstable at joint \w+: use at most 0.006\d* s"):
            check_timestep(hand, PhysicsConfig(timestep=step), ranges)
    soft = dataclasses.replace(ranges, stiffness=1.0, damping=0.02)
    check_timestep(hand, PhysicsConfig(timestep=0.010), soft)
