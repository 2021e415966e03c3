"""Turns the motors off and waits until the hand confirms it, over a lost cable too."""

import time

import numpy as np

from dexsim_real.wire.link import HandPort, Reply

UNCONFIRMED = "the hand did not confirm that its motors are off"
PATIENCE = 5.0  # s for which a hand whose motors may be on and that does not answer is told to turn them off
BRIEF = 0.3  # s, the same for a hand that was off already
_PAUSE = 0.01  # s after an error of the port


def turn_off(port: HandPort, command: np.ndarray, seconds: float) -> bool:
    """Send a command with all motors off until the hand answers it; a port that fails is asked again.

    Gives up after so many `seconds`; returns whether the hand has confirmed it.
    """
    until = time.monotonic() + seconds
    while True:
        try:
            if isinstance(port.exchange(command), Reply):
                return True
        except (Exception, SystemExit):  # Of a driver from elsewhere, which may work again.
            time.sleep(_PAUSE)
        if time.monotonic() > until:
            return False
