"""Angles between orientations against SciPy."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from dexsim.geometry.rotations import quat_angle


def test_angle_between_orientations():
    """From 10 urad to almost half a turn; a quaternion and its negative are one orientation."""
    angle, rng = np.geomspace(1e-5, np.pi - 1e-3, 60), np.random.default_rng(0)
    axis = rng.normal(size=(60, 3))
    start = Rotation.random(60, random_state=0)
    turned = Rotation.from_rotvec(axis * (angle / np.linalg.norm(axis, axis=1))[:, None]) * start
    first, second = (np.roll(one.as_quat(), 1, axis=1).astype(np.float32) for one in (start, turned))
    for sign in (1, -1):
        # Unit quaternions in float32 are good for about 1e-7.
        np.testing.assert_allclose(quat_angle(first, sign * second), angle, atol=1e-6, rtol=1e-5)


def test_angle_has_a_finite_gradient_at_zero():
    quat = np.float32([0.5, -0.5, 0.1, 0.7])
    assert np.all(np.isfinite(jax.grad(quat_angle)(quat / np.linalg.norm(quat), quat / np.linalg.norm(quat))))
