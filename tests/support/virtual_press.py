"""What a recording of one fingertip against something firm looks like, of a motor of known truth.

Torques and speeds are the joint's. Motoring, the motor must give torque / efficiency; driven back, only torque *
back_efficiency holds it. On top comes the current that it draws without load, in the direction of motion.
"""

import dataclasses

import numpy as np
from scipy.signal import lfilter

from dexsim.calibration.fit import JointPress


@dataclasses.dataclass(frozen=True)
class Motor:
    """Nm/A, shares and A; the reading is off by `bias` and has `noise`."""

    torque_constant: float
    efficiency: float = 1.0
    back_efficiency: float = 1.0
    no_load_current: float = 0.0
    ripple: float = 0.0
    ripple_phase: float = 0.0
    bias: float = 0.0
    noise: float = 0.0


def triangle(presses, samples):
    """Number [T] of the press, share [T] of the peak force, and way [T]: 1 up, -1 down."""
    phase = np.arange(samples) / samples * presses
    return phase.astype(int), 1.0 - np.abs(2.0 * (phase % 1.0) - 1.0), np.where(phase % 1.0 < 0.5, 1.0, -1.0)


def press(motor, seed, *, lever, force_noise):
    """Press slowly, three times up and down, to 8 N at a lever m while the joint yields by 0.05 rad, 300 ripples/rad;
    steps of 1 mA."""
    rng, (_, share, way) = np.random.default_rng(seed), triangle(3, 600)
    force, loss = 8.0 * share, np.where(way > 0, 1.0 / motor.efficiency, motor.back_efficiency)
    ripple = 1.0 + motor.ripple * np.sin(300 * 0.05 * share + motor.ripple_phase)
    current = lever * force / (motor.torque_constant * ripple) * loss + motor.no_load_current * way
    current = np.round(current + motor.bias + motor.noise * rng.standard_normal(600), 3)
    return JointPress(np.maximum(force + force_noise * rng.standard_normal(600), 0.0), current)


def varied_presses(rng, presses=4, samples=800):
    """Force [T] N and value [T] = 0.05 F + 0.02; gain and offset vary from press to press, AR(1) noise."""
    number, share, _ = triangle(presses, samples)
    slope = 0.05 * (1.0 + 0.02 * rng.standard_normal(presses))[number]
    zero = 0.02 + 0.005 * rng.standard_normal(presses)[number]
    fresh = 0.004 * np.sqrt(1.0 - 0.9**2) * rng.standard_normal(samples)
    fresh[0] = 0.004 * rng.standard_normal()
    return 8.0 * share, slope * 8.0 * share + zero + lfilter([1.0], [1.0, -0.9], fresh)
