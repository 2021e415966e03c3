"""What a recording of one fingertip against something firm looks like, of a motor of known truth.

Torques and speeds are the joint's. Motoring, the motor must give torque / efficiency; driven back, only torque *
back_efficiency holds it. On top comes the current that it draws without load, in the direction of motion.
"""

import dataclasses

import numpy as np

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


def press(motor, seed, *, lever, force_noise):
    """Press slowly, three times up and down, to 8 N at a lever m while the joint yields by 0.05 rad, 300 ripples/rad;
    steps of 1 mA."""
    rng, phase = np.random.default_rng(seed), np.arange(600) / 200 % 1.0
    share, way = 1.0 - np.abs(2.0 * phase - 1.0), np.where(phase < 0.5, 1.0, -1.0)  # up and down again
    force, loss = 8.0 * share, np.where(way > 0, 1.0 / motor.efficiency, motor.back_efficiency)
    ripple = 1.0 + motor.ripple * np.sin(300 * 0.05 * share + motor.ripple_phase)
    current = lever * force / (motor.torque_constant * ripple) * loss + motor.no_load_current * way
    current = np.round(current + motor.bias + motor.noise * rng.standard_normal(600), 3)
    return JointPress(np.maximum(force + force_noise * rng.standard_normal(600), 0.0), current)
