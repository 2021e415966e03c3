"""Turns the motors off and waits until the hand confirms it, over a lost cable too."""

import time

import numpy as np

from dexsim_real.wire.link import HandPort

UNCONFIRMED = "the hand did not confirm that its motors are off"
PATIENCE = 5.0  # s for which a hand that was on and does not answer is told to turn its motors off
_BRIEF = 0.3  # s, the same for a hand that was off already


def turn_off(port: HandPort, command: np.ndarray, seconds: float) -> bool:
    """Send a command until the hand answers it; a port that fails is opened again.

    Args:
      port: connected, or lost.
      command: `frames.COMMAND_BLOCK` with all motors off.
      seconds: s after which to give up.

    Returns:
      Whether the hand has confirmed it.
    """
    until = time.monotonic() + seconds
    while port.exchange(command) is None:
        if time.monotonic() > until:
            return False
    return True


def patience(driven: bool) -> float:
    """Time s to try: long for a hand whose motors may be on."""
    return PATIENCE if driven else _BRIEF
