"""The motor current of the simulated hand, against its equations written down for each quadrant."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.actuator.current import Motor, motor_current, read_current

MOTOR = Motor(torque_constant=0.5, efficiency=0.8, back_efficiency=0.6, no_load_current=0.03)


@pytest.mark.parametrize(
    ("torque", "velocity", "current"),
    [
        (0.2, 1.0, 0.2 / 0.5 / 0.8 + 0.03),  # motoring forwards
        (-0.2, -1.0, -0.2 / 0.5 / 0.8 - 0.03),  # motoring backwards
        (0.2, -1.0, 0.2 / 0.5 * 0.6 - 0.03),  # driven back
        (-0.2, 1.0, -0.2 / 0.5 * 0.6 + 0.03),
        (0.2, 0.0, 0.4),
        (0.0, 2.0, 0.03),
        (0.0, 0.0, 0.0),
    ],
)
def test_the_four_quadrants(torque, velocity, current):
    assert float(motor_current(MOTOR, torque, velocity)) == pytest.approx(current, abs=1e-6)


def test_ripple_goes_round_with_the_joint():
    motor = Motor(torque_constant=0.5, ripple=0.1, ripple_count=20.0, ripple_phase=0.3)
    position = jnp.linspace(0, 2 * jnp.pi, 1001)
    constant = 0.2 / np.asarray(motor_current(motor, 0.2, 0.0, position), float)
    np.testing.assert_allclose(constant, 0.5 * (1 + 0.1 * np.sin(20 * np.asarray(position) + 0.3)), rtol=1e-4)


def test_the_reading_has_bias_noise_steps_and_an_end():
    motor = Motor(torque_constant=0.5, bias=0.1, noise=0.02)
    reading = np.asarray(read_current(jax.random.key(0), motor, jnp.zeros(20_000)))
    assert reading.mean() == pytest.approx(0.1, abs=1e-3) and reading.std() == pytest.approx(0.02, rel=0.03)
    steps = Motor(torque_constant=0.5, noise=0.02, resolution=0.005, limit=0.03)
    reading = np.asarray(read_current(jax.random.key(0), steps, jnp.zeros(20_000)), float)
    np.testing.assert_allclose(reading / 0.005, np.round(reading / 0.005), atol=1e-3)
    assert np.abs(reading).max() == pytest.approx(0.03)
    quiet = Motor(torque_constant=0.5)
    assert float(read_current(jax.random.key(0), quiet, jnp.float32(0.123))) == pytest.approx(0.123, rel=1e-6)
