"""What the answers say about the hand's own state: heat, current, error bits, control mode, motion, refusals.

docs/hardware.md says which of them hold the hand, and which turn its motors off. The meaning of the error bits is not
public, so every bit counts unless it is listed as harmless. Each finding is one line that names joint and finger.
"""

import numpy as np

from dexsim.hand.description import Hand
from dexsim.hand.kinematics import finger_bodies
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.sensors.hand import HandMeasurement
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import Refusal

_BOARDS = ("palm", "joint", "tip")
_STILL = 0.05  # rad, motion below which a joint with high current is stalled
_FAR, _IDLE = 0.3, 0.15  # rad, A: so far from its command a joint draws 0.8 A, even at a fifth of the stiffness 0.16 A
_MOVED = 0.2  # rad, motion of a command that changes some joint's angle
_UNNOTICED = 0.3  # s for which a joint may seem not to follow: commands and answers take time


def finger_joints(hand: Hand, finger: int) -> list[int]:
    """Joint indices of a finger from the palm to its tip, each once: a motor may move two hinges."""
    joints = [int(hand.body_joint[body]) for body in reversed(finger_bodies(hand, finger))]
    return list(dict.fromkeys(joint for joint in joints if joint >= 0))


def joint_labels(hand: Hand) -> tuple[str, ...]:
    """Names of the joints for messages, with their fingers."""
    fingers = {joint: name for i, name in enumerate(hand.finger_names) for joint in finger_joints(hand, i)}
    return tuple(f"joint {name} ({fingers[joint]})" for joint, name in enumerate(hand.joint_names))


class _Timer:
    """How long a finding has lasted without a break."""

    def __init__(self) -> None:
        self._since: float | None = None

    def lasts(self, time: float, active: bool) -> float:
        """Seconds from the first answer with this finding to this one; -1 without it."""
        self._since = (time if self._since is None else self._since) if active else None
        return -1.0 if self._since is None else time - self._since


class Alarms:
    """Judges the answers of the hand in the order in which they arrive."""

    def __init__(self, hand: Hand, config: SafetyConfig):
        self.config = config
        self.fatal = ""  # why the motors must go off
        self.hold = ""  # why the hand must not be moved now
        self.refused = ""  # what the hand said when it refused a command, until it answers one again
        self._joints = joint_labels(hand)
        self._parts = (*self._joints, *(f"fingertip of the {name}" for name in hand.finger_names), "palm board")
        self._harmless = np.array(config.ignored_errors, np.uint16)
        self._hot, self._current, self._error, self._off = _Timer(), _Timer(), _Timer(), _Timer()
        self._follows, self._lost = np.full(hand.num_joints, np.inf), _Timer()  # [J] s, when a joint last followed
        self._frozen = _Timer()
        self._changed: tuple[np.ndarray, np.ndarray] | None = None  # [J] rad, angles as they changed last, command then
        self._reports_mode = False  # whether the hand has ever reported that its motors are on
        self._moved_at: np.ndarray | None = None  # [J] s, since when a joint neither moved nor had a low current
        self._stood: np.ndarray = np.zeros(hand.num_joints)  # [J] rad, its angle then
        self._serious = 0  # serious refusals in a row

    def update(self, time: float, measured: HandMeasurement, command: np.ndarray | None) -> None:
        """Judge an answer at a time in s to a command [J] rad; None with the motors off."""
        self.refused, self._serious = "", 0
        sudden = (self._heat(time, measured), self._overcurrent(time, measured), self._stall(time, measured))
        waiting = (
            self._errors(time, measured),
            self._switched_off(time, measured, command is not None),
            self._deaf(time, measured, command),
        )
        limit = self.config.alarm_seconds
        self.fatal = next(filter(None, sudden), "") or next((text for text, lasts in waiting if lasts > limit), "")
        self.hold = next((text for text, lasts in waiting if text), "")

    def refuse(self, refusal: Refusal) -> None:
        """Judge an answer in which the hand refuses the command."""
        self.refused = refusal.text
        self._serious = self._serious + 1 if refusal.serious else 0
        if self._serious > 1:
            self.fatal = refusal.text

    # --- findings -------------------------------------------------------------------------------

    def _heat(self, time: float, measured: HandMeasurement) -> str:
        hottest = int(measured.temperature.argmax())
        degrees = measured.temperature[hottest]
        if self._hot.lasts(time, bool(degrees > self.config.temperature)) <= 0:
            return ""
        return f"too hot: {self._parts[hottest]}, {degrees:.0f} degC"

    def _overcurrent(self, time: float, measured: HandMeasurement) -> str:
        joint = int(measured.current.argmax())
        lasts = self._current.lasts(time, bool(measured.current[joint] > self.config.current))
        if lasts <= self.config.current_seconds:
            return ""
        return f"current too high: {measured.current[joint]:.2f} A in {self._joints[joint]}"

    def _stall(self, time: float, measured: HandMeasurement) -> str:
        position = measured.joint_position
        # A current that is not measured (NaN) is above nothing.
        fine = ~(measured.current > self.config.stall_current) | (np.abs(position - self._stood) > _STILL)
        since = np.full(len(position), time) if self._moved_at is None else np.where(fine, time, self._moved_at)
        self._moved_at, self._stood = since, np.where(since == time, position, self._stood)
        joint = int(since.argmin())
        if time - since[joint] <= self.config.stall_seconds:
            return ""
        return f"stalled: {self._joints[joint]} draws {measured.current[joint]:.2f} A without moving"

    def _errors(self, time: float, measured: HandMeasurement) -> tuple[str, float]:
        bits = measured.errors & ~self._harmless
        lasts = self._error.lasts(time, bool(bits.any()))
        if lasts < 0:
            return "", lasts
        joint, board = np.unravel_index(int((bits != 0).argmax()), bits.shape)
        return f"error bits 0x{bits[joint, board]:04x} of the {_BOARDS[board]} board, {self._joints[joint]}", lasts

    def _switched_off(self, time: float, measured: HandMeasurement, on: bool) -> tuple[str, float]:
        """Whether motors are off that were commanded to be on. Old firmware may not report the mode at all."""
        off = measured.mode != Mode.POSITION
        self._reports_mode |= on and not off.all()
        lasts = self._off.lasts(time, bool(on and self._reports_mode and off.any()))
        if lasts <= 0:
            return "", lasts
        joint = int(off.argmax())
        which = "all joints report" if off.all() else f"{self._joints[joint]} reports"
        return f"the hand switched itself off: {which} mode {measured.mode[joint]}", lasts

    def _deaf(self, time: float, measured: HandMeasurement, command: np.ndarray | None) -> tuple[str, float]:
        """Angles that do not follow the commands: frozen, of another joint, or of motors without power."""
        text, position = "", measured.joint_position
        goal = position if command is None else command
        if command is None or self._changed is None or np.any(position != self._changed[0]):
            self._changed = position, goal
        moved = bool(np.abs(goal - self._changed[1]).max() > _MOVED)
        if self._frozen.lasts(time, moved) > _UNNOTICED:
            text = "no joint angle changes while the commands move"
        away = (np.abs(goal - position) > _FAR) & (measured.current < _IDLE)
        self._follows = np.where(away, self._follows, time)
        joint = int(self._follows.argmin())
        if not text and time - self._follows[joint] > _UNNOTICED:
            text = (
                f"{self._joints[joint]} does not follow its command: "
                f"at {position[joint]:.2f} rad, commanded to {goal[joint]:.2f} rad"
            )
        return text, self._lost.lasts(time, bool(text))
