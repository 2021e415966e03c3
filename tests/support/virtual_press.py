"""What a recording of one fingertip against something firm looks like, of a motor of known truth."""

import jax
import numpy as np
from scipy.signal import lfilter

from dexsim.actuator.current import motor_current, read_current
from dexsim.calibration.fit import JointPress


def triangle(presses, samples):
    """Number [T] of the press, share [T] of the peak force, and way [T]: 1 up, -1 down."""
    phase = np.arange(samples) / samples * presses
    return phase.astype(int), 1.0 - np.abs(2.0 * (phase % 1.0) - 1.0), np.where(phase % 1.0 < 0.5, 1.0, -1.0)


def press(motor, key, *, lever, force_noise):
    """Press slowly, three times up and down, to 8 N at a lever m while the joint yields by 0.05 rad."""
    _, share, way = triangle(3, 600)
    force, side = 8.0 * share, np.sign(lever)
    current_key, force_key = jax.random.split(key)
    current = read_current(current_key, motor, motor_current(motor, lever * force, way * side, 0.05 * share * side))
    reading = force + force_noise * np.asarray(jax.random.normal(force_key, force.shape))
    return JointPress(np.maximum(reading, 0.0), np.asarray(current, float))


def varied_presses(rng, presses=4, samples=800):
    """Force [T] N and value [T] = 0.05 F + 0.02; gain and offset vary from press to press, AR(1) noise."""
    number, share, _ = triangle(presses, samples)
    slope = 0.05 * (1.0 + 0.02 * rng.standard_normal(presses))[number]
    zero = 0.02 + 0.005 * rng.standard_normal(presses)[number]
    fresh = 0.004 * np.sqrt(1.0 - 0.9**2) * rng.standard_normal(samples)
    fresh[0] = 0.004 * rng.standard_normal()
    return 8.0 * share, slope * 8.0 * share + zero + lfilter([1.0], [1.0, -0.9], fresh)
