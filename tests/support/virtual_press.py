"""What a recording of one fingertip against something firm looks like, of a motor of known truth."""

import jax
import numpy as np
from scipy.signal import lfilter

from dexsim.actuator.current import motor_current, read_current
from dexsim.calibration.joint import JointPress


def triangle(presses, samples):
    """Number [T] of the press, share [T] of the peak force, and way [T]: 1 up, -1 down."""
    phase = np.arange(samples) / samples * presses
    return phase.astype(int), 1.0 - np.abs(2.0 * (phase % 1.0) - 1.0), np.where(phase % 1.0 < 0.5, 1.0, -1.0)


def press(motor, key, *, lever, peak=8.0, cycles=3, samples=600, travel=0.05, force_noise=0.0, force_limit=np.inf):
    """Press slowly, up and down, to `peak` N at a lever m while the joint yields by `travel` rad."""
    _, share, way = triangle(cycles, samples)
    force = peak * share
    current_key, force_key = jax.random.split(key)
    current = read_current(
        current_key, motor, motor_current(motor, lever * force, way * np.sign(lever), travel * share * np.sign(lever))
    )
    reading = force + force_noise * np.asarray(jax.random.normal(force_key, force.shape))
    return JointPress(np.clip(reading, 0.0, force_limit), np.asarray(current, float))


def varied_presses(
    rng,
    *,
    gain=0.05,
    offset=0.02,
    friction=0.0,
    spread=0.02,
    shift=0.005,
    noise=0.004,
    correlation=0.9,
    presses=4,
    samples=800,
    peak=8.0,
):
    """Force [T] N and value [T]; gain and offset vary from press to press (by a share, and by a value), AR(1) noise."""
    number, share, way = triangle(presses, samples)
    force = peak * share
    slope = gain * (1.0 + spread * rng.standard_normal(presses))[number]
    zero = offset + shift * rng.standard_normal(presses)[number]
    fresh = noise * np.sqrt(1.0 - correlation**2) * rng.standard_normal(samples)
    fresh[0] = noise * rng.standard_normal()
    return force, slope * force + zero + friction * way + lfilter([1.0], [1.0, -correlation], fresh)
