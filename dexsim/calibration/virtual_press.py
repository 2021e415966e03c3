"""A virtual press: what a recording of one fingertip against something firm looks like."""

import jax
import numpy as np
from scipy.signal import lfilter

from dexsim.actuator.current import Motor, motor_current, read_current
from dexsim.calibration.joint import JointPress


def press(
    motor: Motor,
    key: jax.Array,
    *,
    lever: float,
    peak: float = 8.0,
    cycles: int = 3,
    samples: int = 600,
    travel: float = 0.05,
    force_noise: float = 0.0,
    force_resolution: float = 0.0,
    force_limit: float = np.inf,
) -> JointPress:
    """Press one joint's fingertip slowly, up and down: what a recording of the hand looks like.

    Args:
      motor: scalars.
      key: of the noise.
      lever: m, joint torque per fingertip force; negative where the joint presses by turning back.
      peak: N, largest force of the triangle wave.
      cycles, samples: presses in the recording, samples in all.
      travel: rad that the joint yields from no force to the peak (the ripple passes by).
      force_noise, force_resolution, force_limit: N, of the tactile reading.
    """
    phase = np.arange(samples) / samples * cycles % 1.0
    share = 1.0 - np.abs(2.0 * phase - 1.0)
    force, way = peak * share, np.where(phase < 0.5, 1.0, -1.0)
    current_key, force_key = jax.random.split(key)
    current = read_current(
        current_key, motor, motor_current(motor, lever * force, way * np.sign(lever), travel * share * np.sign(lever))
    )
    reading = force + force_noise * np.asarray(jax.random.normal(force_key, force.shape))
    if force_resolution > 0:
        reading = np.round(reading / force_resolution) * force_resolution
    return JointPress(np.clip(reading, 0.0, force_limit), np.asarray(current, float))


def varied_presses(
    rng: np.random.Generator,
    *,
    gain: float = 0.05,
    offset: float = 0.02,
    friction: float = 0.0,
    spread: float = 0.02,
    shift: float = 0.005,
    noise: float = 0.004,
    correlation: float = 0.9,
    presses: int = 4,
    samples: int = 800,
    peak: float = 8.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Presses that differ, with noise that does not forget: force [T] N, value [T].

    Args:
      rng: random numbers.
      gain, offset: of the line, on average over presses.
      friction: added while loading, subtracted while unloading.
      spread: standard deviation of the gain from press to press, as a share of it.
      shift: standard deviation of the offset from press to press.
      noise: standard deviation of each sample.
      correlation: of neighbouring samples' noise.
      presses, samples: number of presses, and samples in all.
      peak: N, largest force of the triangle wave.
    """
    phase = np.arange(samples) / samples * presses
    number, share = phase.astype(int), 1.0 - np.abs(2.0 * (phase % 1.0) - 1.0)
    force, way = peak * share, np.where(phase % 1.0 < 0.5, 1.0, -1.0)
    slope = gain * (1.0 + spread * rng.standard_normal(presses))[number]
    zero = offset + shift * rng.standard_normal(presses)[number]
    fresh = noise * np.sqrt(1.0 - correlation**2) * rng.standard_normal(samples)
    fresh[0] = noise * rng.standard_normal()
    return force, slope * force + zero + friction * way + lfilter([1.0], [1.0, -correlation], fresh)
