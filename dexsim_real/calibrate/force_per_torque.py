"""Force of a fingertip over the torque of its finger's root joint, as a run reads that torque, from the presses."""

from collections.abc import Mapping

import numpy as np

from dexsim.calibration.joint import JointPress, fit_joint
from dexsim.calibration.maps import Calibration, joint_torque
from dexsim.hand.kinematics import Hand


def fit_force_per_torque(
    hand: Hand, calibration: Calibration, real: Mapping[str, JointPress], sim: Mapping[str, JointPress]
) -> np.ndarray:
    """Force over torque [3, F] N/Nm and its 95 % interval: value, low, high; 0 where nothing pressed.

    A run does not know whether a finger closes or opens: the value is half way between the lines of both directions,
    and the interval reaches to them, and by what the presses and the lever arm leave open beyond. What weight and
    friction add to the torque is in the lines' offsets.

    Args:
      hand: the hand.
      calibration: of the same presses.
      real, sim: by joint name, force against current (A) and against torque (Nm).
    """
    ratio = np.zeros((3, hand.num_fingers))
    for finger, joint in enumerate(hand.root_joint):
        name = hand.joint_names[joint]
        if name not in real:
            continue
        press = real[name]
        current = np.zeros((len(press.value), hand.num_joints), np.float32)
        current[:, joint] = press.value
        torque = np.asarray(joint_torque(calibration, current), float)[:, joint]
        read = JointPress(press.force, torque, press.direction, press.press, sim[name].gain_error)
        both = fit_joint(read, "Nm", where=f"{name} in a run")
        lines = [line for line in (both.loading, both.unloading) if line is not None]
        gain = np.abs([line.gain for line in lines])
        known = max(np.ptp(line.gain_interval) / 2 for line in lines)
        middle, half = gain.mean(), float(np.hypot(known, np.ptp(gain) / 2))
        if half < middle:
            ratio[:, finger] = 1.0 / np.array([middle, middle + half, middle - half])
    return ratio
