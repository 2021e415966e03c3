"""Motors within the physics step: closed forms and the largest stable step."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dexsim.env.motors import check_timestep
from dexsim.errors import ConfigError
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.law import implicit
from dexsim.randomization import Randomization

STIFFNESS, DAMPING, INERTIA = 3.0, 0.1, 1e-3  # Nm/rad, Nm s/rad, kg m^2


def pd(substep, position, velocity):
    return STIFFNESS * (0.5 - position) - DAMPING * velocity


@pytest.mark.parametrize("step", [0.001, 0.01, 0.1])
def test_damping_acts_at_the_mean_speed_of_the_step(step):
    """v' = v + h/I tau(q, (v + v') / 2) has one solution for a linear law."""
    q, v = jnp.array([0.1, -0.4]), jnp.array([3.0, -20.0])
    torque, inertia = implicit(pd, step)(0, q, v)
    after = v + step * torque / (INERTIA + inertia)
    np.testing.assert_allclose(INERTIA * (after - v), step * pd(0, q, (v + after) / 2), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_step_that_is_advised_for_stiff_motors_is_the_largest_that_is_stable(hand, scale):
    """By the growth of a free swing over many steps of all joints, with the stiffest motors that are drawn."""
    check_timestep(hand, PhysicsConfig(), Randomization())
    ranges = Randomization(
        stiffness=20.0, scale=scale, stiffness_factor=(0.5, 1.5), ripple=(0.0, 0.1), efficiency=(0.9, 1.2)
    )
    with pytest.raises(ConfigError, match=r"motors drawn are unstable at joint \w+ .*: use at most 0.00\d* s") as error:
        check_timestep(hand, PhysicsConfig(), ranges)
    advised = float(str(error.value).rpartition("use at most ")[2].partition(" s")[0])
    check_timestep(hand, PhysicsConfig(timestep=advised), ranges)
    with pytest.raises(ConfigError, match="must be below 4"):
        check_timestep(hand, PhysicsConfig(timestep=1.02 * advised), ranges)

    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = model.jnt_range.mean(1)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    spring = np.zeros(model.nv)
    for name, gain in zip(hand.joint_names, hand.gain, strict=True):
        spring[model.joint(name).dofadr[0]] = 20.0 * (1 + scale * 0.5) * (1 + scale * 0.1) * (1 + scale * 0.2) * gain
    for step, stable in ((0.98 * advised, True), (1.04 * advised, False)):
        q, v = np.full(model.nv, 1e-3), np.zeros(model.nv)
        for _ in range(200):
            v = v - step * np.linalg.solve(mass, spring * q + model.dof_damping * v)
            q = q + step * v
        assert (np.abs(q).max() < 1.0) == stable


@pytest.mark.parametrize("law", [lambda k, q, v: jnp.clip(pd(k, q, v), -0.4, 0.4), lambda k, q, v: 0.4 + 0.1 * v])
def test_a_motor_that_does_not_damp_keeps_its_torque(law):
    """A stalled one pushes with all it has; a positive slope, of a limit that falls with speed, adds no inertia."""
    torque, inertia = implicit(law, 0.01)(0, jnp.zeros(1), jnp.zeros(1))
    np.testing.assert_allclose((torque[0], inertia[0]), (0.4, 0.0), atol=1e-7)
