"""Whether measured joint angles can be true: a wrong reading counts as no measurement.

An angle is wrong outside the joint's limits, or farther from the last plausible angle than the joint can have moved.
With the motors on, a joint moves between its last angle and its commands, so a wrong angle stays wrong however long it
lasts. With the motors off anything may move a joint, so several readings must agree before the pose is known.
"""

import numpy as np

from dexsim.hand.kinematics import Hand

UNKNOWN = "the pose is not known yet"
_AGREEING = 3  # readings that must agree before the pose is known
_FASTER = 1.25  # largest joint speed, relative to the no-load speed of the model
_JUMP = 0.1  # rad, change that is always possible: noise, gear play, a push
_GAP = 0.03  # s, longest motion that an interval between two readings explains


class PoseCheck:
    """Judges measured joint angles, in the order in which they arrive.

    Args:
      hand: limits, speeds and names of the joints.
      beyond: rad outside the limits up to which an angle is plausible.
    """

    def __init__(self, hand: Hand, beyond: float):
        self._names = hand.joint_names
        self._lower, self._upper = hand.joint_lower - beyond, hand.joint_upper + beyond
        self._speed = _FASTER * hand.speed_limit
        self._time = self._known_time = 0.0  # s, of the last reading and of the last plausible one
        self._last: np.ndarray | None = None  # [J] rad, last plausible angles
        self._low: np.ndarray | None = None  # [J] rad, the commands since then; None with the motors off
        self._high: np.ndarray | None = None
        self._agreeing = 0

    @property
    def known(self) -> bool:
        """Whether the pose is known."""
        return self._low is not None or self._agreeing >= _AGREEING

    def follow(self, command: np.ndarray) -> None:
        """The motors move toward these joint angles [J] rad from now on."""
        self._low = command if self._low is None else np.minimum(self._low, command)
        self._high = command if self._high is None else np.maximum(self._high, command)

    def release(self) -> None:
        """The motors are off, or were off unseen: forget the pose."""
        self._last = self._low = self._high = None
        self._agreeing = 0

    def judge(self, time: float, position: np.ndarray, command: np.ndarray | None) -> str:
        """Why a reading is wrong, or cannot be trusted yet; empty for a plausible one.

        Args:
          time: s of the reading.
          position: [J] rad, finite.
          command: [J] rad, to which the motors move now; None if they are off.
        """
        gap, self._time = max(time - self._time, 0.0), time
        outside = (position < self._lower) | (position > self._upper)
        if outside.any():
            self._agreeing = 0
            return f"{self._say(position, outside)}, outside its limits"
        room = _JUMP + self._speed * min(gap, _GAP)
        last, low, high = self._last, self._low, self._high
        if last is None or low is None or high is None:
            agrees = last is not None and bool(np.all(np.abs(position - last) <= room))
            self._agreeing = self._agreeing + 1 if agrees else 1
            self._last, self._known_time = position, time
            return "" if self.known else UNKNOWN
        jumped = (position < np.minimum(last, low) - room) | (position > np.maximum(last, high) + room)
        jumped |= np.abs(position - last) > _JUMP + self._speed * (time - self._known_time)
        if jumped.any():
            return f"{self._say(position, jumped)}, too far from {last[jumped.argmax()]:.2f} rad before"
        self._last, self._known_time = position, time
        self._low = self._high = command
        if command is None:  # The motors went off unseen: others must agree with this reading.
            self._agreeing = 1
        return "" if self.known else UNKNOWN

    def _say(self, position: np.ndarray, wrong: np.ndarray) -> str:
        joint = int(wrong.argmax())
        return f"joint {self._names[joint]} reads {position[joint]:.3g} rad"
