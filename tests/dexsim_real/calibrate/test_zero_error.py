"""Taxels that read something at zero force: the gauge shows it, and the presses' forces are free of it."""

import numpy as np
import pytest
from calibrating import arguments

from dexsim_real.calibrate.force_scale import force_scale
from dexsim_real.calibrate.read import PressSession, Recording

GAIN, ZERO = 8.0, 20.0  # counts per newton, counts at zero force


def pressed(forces: np.ndarray, hand) -> Recording:
    """A press of the index finger whose middle taxels read GAIN F + ZERO."""
    press = Recording(name="index pad", finger=1, joints=(4,), rate=83.0)
    for level, force in enumerate(forces):
        for sample in range(5):
            counts = np.zeros(hand.num_taxels)
            counts[[54, 55, 56, 64, 65, 66]] = (GAIN * force + ZERO) / 6
            press.phase.append(f"level {level}")
            press.time.append(level + 0.1 * sample)
            press.counts.append(counts)
            press.shown.append(float(counts.sum()))
            press.position.append(np.zeros(12))
        press.gauge[f"level {level}"] = float(force)
    return press


def test_a_zero_error_is_taken_from_the_force(hand, tmp_path):
    forces = np.linspace(0.5, 8.0, 12)
    options = arguments(tmp_path)
    session = PressSession(options.hardware, options.check, "serial", "right", 83.0, {}, np.empty(0))
    gain, offset = force_scale(session, hand, [pressed(forces, hand)]).newtons["index pad"]
    for force in (1.0, 5.0):
        assert gain * (GAIN * force + ZERO) + offset == pytest.approx(force, rel=0.01)
