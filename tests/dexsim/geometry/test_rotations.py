"""Rotations against C MuJoCo, NumPy and hand-made cases."""

import jax
import numpy as np
import pytest
from hypothesis import given, strategies as st

from dexsim.geometry import rotations

RNG = np.random.default_rng(0)
QUATS = RNG.normal(size=(64, 4))
QUATS /= np.linalg.norm(QUATS, axis=1, keepdims=True)
AXES = RNG.normal(size=(64, 3))
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)


def f32(x):
    return np.asarray(x, np.float32)


@jax.jit
def turned_angle(start, axis, angle):
    """Angle between `start` and `start` turned."""
    return rotations.quat_angle(start, rotations.quat_multiply(rotations.axis_angle_to_quat(axis, angle), start))


@given(st.floats(1e-5, np.pi - 1e-3), st.integers(0, 63), st.integers(0, 63))
def test_angle_between_orientations(angle, at, about):
    # Unit quaternions in float32 are good for about 1e-7, so an angle of 1e-5 for a few percent.
    assert float(turned_angle(f32(QUATS[at]), f32(AXES[about]), f32(angle))) == pytest.approx(angle, abs=1e-6, rel=1e-5)


def test_a_quaternion_and_its_negative_are_one_orientation():
    assert float(np.max(rotations.quat_angle(f32(QUATS), -f32(QUATS)))) < 1e-6


def test_angle_has_a_finite_gradient_at_zero():
    quat = f32(QUATS[0])
    assert float(rotations.quat_angle(quat, quat)) < 1e-6
    assert np.all(np.isfinite(jax.grad(rotations.quat_angle)(quat, quat)))
