"""Motors within the physics step: closed forms and the largest stable step."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.core.errors import ConfigError
from dexsim.env.motors import check_timestep
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


def test_the_default_step_is_stable_and_stiff_motors_are_refused_with_what_to_do(hand):
    ranges = Randomization()
    check_timestep(hand, PhysicsConfig(), ranges)
    with pytest.raises(ConfigError, match=r"motors drawn are unstable at joint \w+ .*: use at most 0.00\d* s"):
        check_timestep(hand, PhysicsConfig(), dataclasses.replace(ranges, stiffness=100.0))


@pytest.mark.parametrize("law", [lambda k, q, v: jnp.clip(pd(k, q, v), -0.4, 0.4), lambda k, q, v: 0.4 + 0.1 * v])
def test_a_motor_that_does_not_damp_keeps_its_torque(law):
    """A stalled one pushes with all it has; a positive slope, of a limit that falls with speed, adds no inertia."""
    torque, inertia = implicit(law, 0.01)(0, jnp.zeros(1), jnp.zeros(1))
    np.testing.assert_allclose((torque[0], inertia[0]), (0.4, 0.0), atol=1e-7)
