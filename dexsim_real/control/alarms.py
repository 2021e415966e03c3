"""What the answers say about the hand's own state: heat, current, error bits, control mode, motion, refusals.

docs/hardware.md says which of them hold the hand, and which turn its motors off. The meaning of the error bits is not
public, so every bit counts unless it is listed as harmless. Each finding is one line that names joint and finger.
"""

import numpy as np
import numpy.typing as npt

from dexsim.hand.description import Hand
from dexsim.hand.kinematics import finger_bodies
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.sensors.hand import HandMeasurement
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import Refusal

_BOARDS = ("palm", "joint", "tip")
_STILL = 0.05  # rad, motion below which a joint with high current is stalled
_FAR, _IDLE = 0.3, 0.15  # rad, A: so far from its command a joint draws 0.8 A, even at a fifth of the stiffness 0.16 A
_BOTH = 0.15  # rad, to either side of an angle that does not change: a sound joint turned a cube with 0.04
_MOVED = 0.2  # rad, motion of a command that changes some joint's angle
_UNNOTICED = 0.3  # s for which a joint may seem not to follow: commands and answers take time
_BREAK = 0.1  # s without a finding after which it is over
_FORGIVEN = 0.25  # serious refusals that one other answer makes up for


def finger_joints(hand: Hand, finger: int) -> list[int]:
    """Joint indices of a finger from the palm to its tip, each once: a motor may move two hinges."""
    joints = [int(hand.body_joint[body]) for body in reversed(finger_bodies(hand, finger))]
    return list(dict.fromkeys(joint for joint in joints if joint >= 0))


def joint_labels(hand: Hand) -> tuple[str, ...]:
    """Names of the joints for messages, with their fingers."""
    fingers = {joint: name for i, name in enumerate(hand.finger_names) for joint in finger_joints(hand, i)}
    return tuple(f"joint {name} ({fingers[joint]})" for joint, name in enumerate(hand.joint_names))


class Lasting:
    """How long each of some findings has lasted: the time between two answers with it, less that before one without.

    So a single wrong answer neither makes a finding nor ends one; after a longer break it begins anew.
    """

    def __init__(self) -> None:
        self.seconds: np.ndarray = np.zeros(())
        self._time, self._active, self._seen = 0.0, np.zeros((), bool), np.zeros(())

    def update(self, time: float, active: npt.ArrayLike) -> np.ndarray:
        """Seconds of each finding, by an answer at a time in s; -1 for one that is not `active` in it."""
        active = np.asarray(active)
        if not (active.any() or self.seconds.any()):  # Nearly always: the rest takes a hundred times as long.
            self._time, self._active = time, active
            return np.full(active.shape, -1.0)
        gap, before = time - self._time, self._active
        self._seen = np.where(active, time, self._seen)  # s, last answer with it
        less = np.where(time - self._seen > _BREAK, 0.0, np.maximum(self.seconds - gap, 0.0))
        self.seconds = np.where(active, self.seconds + gap * before, less)
        self._time, self._active = time, active
        return np.where(active, self.seconds, -1.0)


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
        self._hot, self._current, self._stalled = Lasting(), Lasting(), Lasting()
        self._error, self._off, self._away, self._frozen, self._lost = (Lasting() for _ in range(5))
        self._changed: tuple[np.ndarray, np.ndarray] | None = None  # [J] rad, angles as they changed last, command then
        self._before: tuple[np.ndarray, np.ndarray] | None = None  # [J] rad, last command and angles with the motors on
        self._led = np.zeros(hand.num_joints)  # [J] rad, how far the commands have led ahead of the angles
        self._ahead = np.zeros((2, hand.num_joints))  # [J] rad, farthest commands before and beyond an unchanged angle
        self._reports_mode = False  # whether the hand has ever reported that its motors are on
        self._stood: np.ndarray = np.zeros(hand.num_joints)  # [J] rad, where a joint with a high current was at first
        self._serious = 0.0  # serious refusals, less the forgiven ones

    def update(self, time: float, measured: HandMeasurement, command: np.ndarray | None) -> None:
        """Judge an answer at a time in s to a command [J] rad; None with the motors off."""
        self.refused, self._serious = "", max(self._serious - _FORGIVEN, 0.0)
        waiting = (
            self._errors(time, measured),
            self._switched_off(time, measured, command is not None),
            self._deaf(time, measured, command),
        )
        findings = (
            (*self._heat(time, measured), 0.0),
            (*self._overcurrent(time, measured), self.config.current_seconds),
            (*self._stall(time, measured), self.config.stall_seconds),
            *((*finding, self.config.alarm_seconds) for finding in waiting),
        )
        self.fatal = next((text for text, lasts, limit in findings if lasts > limit), "")
        self.hold = next((text for text, _ in waiting if text), "")

    def refuse(self, refusal: Refusal) -> None:
        """Judge an answer in which the hand refuses the command."""
        self.refused = refusal.text
        self._serious = self._serious + 1 if refusal.serious else max(self._serious - _FORGIVEN, 0.0)
        if self._serious >= 2:
            self.fatal = refusal.text

    # --- findings, each with the seconds for which it has lasted; negative without one --------------------

    def _heat(self, time: float, measured: HandMeasurement) -> tuple[str, np.ndarray]:
        hottest = int(measured.temperature.argmax())
        degrees = measured.temperature[hottest]
        lasts = self._hot.update(time, degrees > self.config.temperature)
        return f"too hot: {self._parts[hottest]}, {degrees:.0f} degC", lasts

    def _overcurrent(self, time: float, measured: HandMeasurement) -> tuple[str, np.ndarray]:
        joint = int(measured.current.argmax())
        lasts = self._current.update(time, measured.current[joint] > self.config.current)
        return f"current too high: {measured.current[joint]:.2f} A in {self._joints[joint]}", lasts

    def _stall(self, time: float, measured: HandMeasurement) -> tuple[str, np.ndarray]:
        position = measured.joint_position
        # A current that is not measured (NaN) is above nothing.
        still = (measured.current > self.config.stall_current) & (np.abs(position - self._stood) <= _STILL)
        lasts = self._stalled.update(time, still)
        self._stood = np.where(self._stalled.seconds > 0, self._stood, position)
        joint = int(lasts.argmax())
        return f"stalled: {self._joints[joint]} draws {measured.current[joint]:.2f} A without moving", lasts[joint]

    def _errors(self, time: float, measured: HandMeasurement) -> tuple[str, np.ndarray]:
        bits = measured.errors & ~self._harmless
        lasts = self._error.update(time, bits.any())
        if lasts < 0:
            return "", lasts
        joint, board = np.unravel_index(int((bits != 0).argmax()), bits.shape)
        return f"error bits 0x{bits[joint, board]:04x} of the {_BOARDS[board]} board, {self._joints[joint]}", lasts

    def _switched_off(self, time: float, measured: HandMeasurement, on: bool) -> tuple[str, np.ndarray]:
        """Whether motors are off that were commanded to be on. Old firmware may not report the mode at all."""
        off = measured.mode != Mode.POSITION
        self._reports_mode |= on and not off.all()
        lasts = self._off.update(time, on and self._reports_mode and off.any())
        if lasts <= 0:
            return "", lasts
        joint = int(off.argmax())
        which = "all joints report" if off.all() else f"{self._joints[joint]} reports"
        return f"the hand switched itself off: {which} mode {measured.mode[joint]}", lasts

    def _deaf(self, time: float, measured: HandMeasurement, command: np.ndarray | None) -> tuple[str, np.ndarray]:
        """Angles that do not follow the commands: frozen, of another joint, or of motors without power."""
        text, position = "", measured.joint_position
        goal = position if command is None else command
        if command is None or self._changed is None or np.any(position != self._changed[0]):
            self._changed = position, goal
        if self._frozen.update(time, np.abs(goal - self._changed[1]).max() > _MOVED) > _UNNOTICED:
            text = "no joint angle changes while the commands move"
        ahead, before = goal - position, self._before
        error, moved = np.abs(ahead), before is None or position != before[1]
        # A joint that draws current may press on something, as far as its commands lead. Beyond that it was taken.
        led = error if before is None else self._led + np.abs(goal - before[1]) - np.abs(np.subtract(*before))
        self._led, self._before = np.clip(led, 0.0, error), None if command is None else (command, position)
        lost = (measured.current < _IDLE) | (error - self._led > _FAR)
        # Nothing to press on keeps an angle from changing both ways: its encoder is stuck.
        self._ahead = np.where(moved, ahead, [np.minimum(self._ahead[0], ahead), np.maximum(self._ahead[1], ahead)])
        stuck = np.minimum(-self._ahead[0], self._ahead[1]) > _BOTH
        lasts = self._away.update(time, (error > _FAR) & lost | stuck)
        joint = int(lasts.argmax())
        if not text and lasts[joint] > _UNNOTICED:
            text = (
                f"{self._joints[joint]} does not follow its command: "
                f"at {position[joint]:.2f} rad, commanded to {goal[joint]:.2f} rad"
            )
        return text, self._lost.update(time, bool(text))
