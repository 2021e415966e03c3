"""Whether measured joint angles can be true: a wrong reading counts as no measurement.

An angle is wrong outside the joint's limits, or farther from the last plausible angle than the joint can have moved.
With the motors on, a joint moves between its last angle and its commands, so a wrong angle stays wrong however long it
lasts. With the motors off anything may move a joint: the pose is the median of several readings, and only known while
they agree.
"""

from collections import deque

import numpy as np

from dexsim.hand.description import Hand

UNKNOWN = "the pose is not known: the last readings disagree, or are too few"
_BEYOND = 0.1  # rad beyond a joint's limits up to which an angle is plausible
_AGREEING = 10  # newest readings of a pose; fewer than half of them may be wrong by as much as they may differ
_DEVIATION = 0.05  # rad, largest distance of these readings from their median
_STILL = 0.01  # rad, largest motion of their median from the older half of them to the newer: no drift is a pose
_NOW = 5  # newest readings whose median is the pose of a hand that moves
_FASTER = 1.25  # largest joint speed, relative to the no-load speed of the model
_JUMP = 0.1  # rad, change that is always possible: noise, gear play, a push
_GAP = 0.03  # s, longest motion that an interval between two readings explains


class PoseCheck:
    """Judges measured joint angles, in the order in which they arrive."""

    def __init__(self, hand: Hand):
        self._names = hand.joint_names
        self._lower, self._upper = hand.joint_lower - _BEYOND, hand.joint_upper + _BEYOND
        self._speed = _FASTER * hand.speed_limit
        self._time = self._known_time = 0.0  # s, of the last reading and of the last plausible one
        self._last: np.ndarray | None = None  # [J] rad, last plausible angles
        self._low: np.ndarray | None = None  # [J] rad, the commands since then; None with the motors off
        self._high: np.ndarray | None = None
        self._recent: deque[np.ndarray] = deque(maxlen=_AGREEING)  # [J] rad, newest plausible angles

    @property
    def at_rest(self) -> np.ndarray | None:
        """[J] rad, where motors that are off may come on: median of the last readings; None unless they agree and stand
        still."""
        if len(self._recent) < _AGREEING:
            return None
        readings = np.array(self._recent)
        median, older, newer = (np.median(part, axis=0) for part in (readings, readings[:_NOW], readings[_NOW:]))
        deviation, moved = np.abs(readings - median).max(), np.abs(newer - older).max()
        return median if deviation <= _DEVIATION and moved <= _STILL else None

    @property
    def newest(self) -> np.ndarray | None:
        """[J] rad, where the hand is, whether it moves or not; no single wrong reading counts. None right after one."""
        return np.asarray(np.median(list(self._recent)[-_NOW:], axis=0)) if self._recent else None

    def follow(self, command: np.ndarray) -> None:
        """The motors move toward these joint angles [J] rad from now on."""
        if self._low is None and self._recent:
            self._last = self.newest
        self._low = command if self._low is None else np.minimum(self._low, command)
        self._high = command if self._high is None else np.maximum(self._high, command)

    def release(self) -> None:
        """The motors are off, or were off unseen: forget the pose."""
        self._last = self._low = self._high = None
        self._recent.clear()

    def judge(self, time: float, position: np.ndarray, command: np.ndarray | None) -> str:
        """Why a finite reading [J] rad at a time in s is wrong; empty for a plausible one.

        `command` [J] rad is to which the motors move now; None if they are off.
        """
        gap, self._time = max(time - self._time, 0.0), time
        outside = (position < self._lower) | (position > self._upper)
        if outside.any():
            self._recent.clear()
            return f"{self._say(position, outside)}, outside its limits"
        last, low, high = self._last, self._low, self._high
        if last is not None and low is not None and high is not None:
            room = _JUMP + self._speed * min(gap, _GAP)
            jumped = (position < np.minimum(last, low) - room) | (position > np.maximum(last, high) + room)
            jumped |= np.abs(position - last) > _JUMP + self._speed * (time - self._known_time)
            if jumped.any():
                return f"{self._say(position, jumped)}, too far from {last[jumped.argmax()]:.2f} rad before"
            if command is None:  # The motors went off unseen: others must agree with this reading.
                self._recent.clear()
        self._last, self._known_time = position, time
        self._low = self._high = command
        self._recent.append(position)
        return ""

    def _say(self, position: np.ndarray, wrong: np.ndarray) -> str:
        joint = int(wrong.argmax())
        return f"joint {self._names[joint]} reads {position[joint]:.3g} rad"
