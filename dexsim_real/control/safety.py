"""Safety limits between a policy and the motors, each with one defined reaction (the table in docs/hardware.md).

`Safety` decides once a cycle which command is sent. It has no clock of its own: measurements and joint targets carry
their times, so any course of events can be tested.

Hold: the last command that the hand confirmed, at the usual gains; when the force is too high, slowly toward the
measured pose, but never far from where it was as the hold began. A hold ends after some seconds with the motors off.
Relax: motors off. The motors come on at the measured pose, with stiffness and speed that grow from zero. Then each
command differs from the one before by at most the speed limit times the time between them, whatever was measured or
requested: this limit applies last. After a hold or a reconnection commands are slow at first.
"""

import dataclasses
import enum
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dexsim.hand.description import Hand
from dexsim_real.control.alarms import Alarms, Lasting, joint_labels
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.pose_check import UNKNOWN, PoseCheck
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandMeasurement
from dexsim_real.wire.frames import Mode

_SILENT, _DEAD = "no measurement", "no target"  # reasons that turn the motors off when they last
_FORCE = "the fingertip force is too high"
_GAP = 0.03  # s, longest interval between two commands that counts for the speed limit
_SOFT = 0.5  # s, in which stiffness grows when the motors come on: a joint whose pose was wrong creeps there
_LONGEST = 5.0  # s of holding after which the motors go off: a policy that is held does not let go of what it squeezes
_RECOVERY = 0.25  # s of holding that are forgiven per s without: short holds may take a fifth of the time for ever
_EASE = 0.1  # rad, 1 cm at a fingertip: farther, easing after a joint that reads too high would lead it to its stop
_SAME = 0.5  # s, holds for force with less time between them are one: each alone could ease by as much again


class Reaction(enum.IntEnum):
    """Reaction of `Safety`, the mildest first."""

    NONE = 0
    CLIP = 1
    HOLD = 2
    RELAX = 3


@dataclasses.dataclass(frozen=True)
class HandSample:
    """One answered exchange, in SI units."""

    time: float  # s, monotonic clock, of reception
    sequence: int  # number of the exchange
    generation: int  # number of the connection
    measured: HandMeasurement
    velocity: np.ndarray  # [J] rad/s
    state: np.ndarray  # that it was measured from: `frames.STATE_BLOCK` or `frames.driver_block`


@dataclasses.dataclass(frozen=True)
class SafetyDecision:
    """The command to send now, and why."""

    position: np.ndarray  # [J] rad
    mode: Mode
    reaction: Reaction
    reason: str
    stiffness: float  # share of the gain kp


class TargetRequest(NamedTuple):
    """What `Safety.set_target` was told last."""

    time: float  # s
    position: np.ndarray  # [J] rad
    hold_reason: str
    since: float  # s, of the first of the requests to hold that have come without a break


class Safety:
    """Decides which command is sent.

    Not thread-safe: one thread calls `decide`, `update`, `engage` and `alarms.refuse`. Another may call `set_target`,
    which replaces one tuple. `note` is called with one line whenever the reaction or its reason changes.
    """

    def __init__(self, hand: Hand, config: SafetyConfig, note: Callable[[str], None] = lambda text: None):
        self.config, self._note = config, note
        self._stops = hand.joint_lower.astype(np.float32), hand.joint_upper.astype(np.float32)
        if not np.max(np.abs(self._stops)) <= 2 * np.pi:
            raise HandError(f"{hand.name}: a joint's limits are beyond a turn; check the hand's model")
        # At most half of a joint's range: beyond that the limits would change sides.
        margin = np.minimum(np.float32(config.margin), (self._stops[1] - self._stops[0]) / 2)
        # rad/s. A joint that follows a ramp is up to 3 % faster than the ramp for a moment.
        self._slow = min(0.95 * config.slow_speed, config.speed)
        self._lower, self._upper = self._stops[0] + margin, self._stops[1] - margin
        self.sample: HandSample | None = None  # the newest plausible one
        self.problem = ""  # why the newest measurement does not count
        self.engaged = False
        self.latched = ""  # why the motors are off permanently
        self.anchor = 0  # number of times that commands restarted, after a hold or with the motors off before
        self.counts: Counter[str] = Counter()  # cycles by reason
        self._target: TargetRequest | None = None
        self._pose = PoseCheck(hand)
        self.alarms = Alarms(hand, config)
        self._joints = joint_labels(hand)
        self._generation: int | None = None
        self._wrong = Lasting()  # measurements that were wrong
        self._holding = False
        self._held = 0.0  # s, balance of `_LONGEST` and `_RECOVERY`; a restart after a silence forgives nothing
        self._eased: tuple[float, np.ndarray] | None = None  # last hold for force: s, its end; [J] rad, pose before it
        self._on = 0.0  # s, when the motors came on
        self._commanded: np.ndarray | None = None  # last command with the motors on
        self._confirmed: np.ndarray | None = None  # last one that the hand answered
        self._time = self._ramp_start = 0.0
        self.last = (Reaction.NONE, "")  # reaction and reason of the newest decision

    @property
    def commanded(self) -> np.ndarray:
        """Where commands continue [J] rad: the last one, or the measured pose with the motors off."""
        return self._rest() if self._commanded is None else self._commanded

    def update(self, sample: HandSample) -> None:
        """Update with a measurement. One that is not plausible does not count as one."""
        if self._generation not in (None, sample.generation):
            # The hand was disconnected with its motors off: its pose may have changed. A wrong reading remains wrong.
            self._commanded = self._confirmed = None
            if not self.problem:
                self._pose.release()
        self._generation, self._confirmed = sample.generation, self._commanded
        measured = sample.measured
        numbers = measured.joint_position, measured.joint_torque, measured.taxel_force
        self.problem = "not finite"
        if all(np.isfinite(part).all() for part in numbers):
            self.problem = self._pose.judge(sample.time, measured.joint_position, self._commanded)
        if self.problem:
            self.counts["implausible: measurement"] += 1
            self._wrong.update(sample.time, True)
            return
        self.sample = sample
        self._wrong.update(sample.time, False)
        self.alarms.update(sample.time, measured, self._commanded)

    def set_target(self, position: np.ndarray, time: float, hold_reason: str = "") -> None:
        """Request joint targets [J] rad at a time in s.

        `hold_reason` is why the hand should hold instead of moving there, and the motors go off when it lasts.
        """
        before = self._target
        since = before.since if before is not None and before.hold_reason else time
        self._target = TargetRequest(time, np.array(position, np.float32), hold_reason, since)

    def engage(self) -> None:
        """Turn the motors on at the measured pose. No effect once latched."""
        self.engaged, self._commanded, self._confirmed, self._target = True, None, None, None

    def relax(self, reason: str) -> None:
        """Turn the motors off permanently."""
        self.latched = self.latched or reason

    def decide(self, now: float) -> SafetyDecision:
        """The command for this cycle."""
        if not self.engaged or self.latched or self.sample is None:
            return self._finish(now, Reaction.RELAX, self.latched or "not engaged", self._rest())
        sample, fatal = self.sample, self.alarms.fatal
        if self.problem and self._wrong.seconds > self.config.patience:
            fatal = f"implausible measurements for {self.config.patience:g} s: {self.problem}"
        if fatal:
            self.relax(fatal)
            return self._finish(now, Reaction.RELAX, fatal, self._rest())
        if self._commanded is None:
            silent = now - sample.time > self.config.stale  # The hand may have been moved since.
            pose = self._pose.at_rest
            if silent or self.problem or self.alarms.hold or pose is None:
                why = self.problem or (self._silence() if silent else self.alarms.hold or UNKNOWN)
                return self._finish(now, Reaction.RELAX, why, self._rest())
            self._start(now, pose)
        request = self._target  # Read once: another thread may replace it meanwhile.
        if lasted := self._lasted(now, sample, request):
            if not lasted.startswith(_SILENT):  # One silence does not end a run.
                self.relax(f"{lasted} for {self.config.patience:g} s")
            return self._turn_off(now, lasted)
        reason, since = self._reason_to_hold(now, sample, request), max(now - self._time, 0.0)
        self._held = self._held + since if reason else max(self._held - _RECOVERY * since, 0.0)
        if self._held > _LONGEST:
            self.relax(f"{reason} for {_LONGEST:g} s")
            return self._turn_off(now, reason)
        if reason:
            return self._hold(now, reason)
        if self._holding:
            self._restart(now)
        return self._follow(now, sample, self.commanded if request is None else request.position)

    def _silence(self) -> str:
        return f"{_SILENT}: {self.alarms.refused}" if self.alarms.refused else _SILENT

    def _lasted(self, now: float, sample: HandSample, request: TargetRequest | None) -> str:
        """What has lasted for longer than `patience`, whatever else the hand held for meanwhile; empty for nothing."""
        patience, silent = self.config.patience, now - sample.time - self.config.stale
        if silent > 0:
            return self._silence() if silent > patience else ""
        if request is None:
            return ""
        if now - max(request.time + self.config.watchdog, self._on) > patience:
            return _DEAD
        return request.hold_reason if now - max(request.since, self._on) > patience else ""

    def _reason_to_hold(self, now: float, sample: HandSample, request: TargetRequest | None) -> str:
        config, force = self.config, sample.measured.finger_force
        if now - sample.time > config.stale:
            return self._silence()
        if self.alarms.hold:
            return self.alarms.hold
        speed = np.abs(sample.velocity)
        if np.any(speed > config.joint_speed):
            return f"too fast: {self._joints[int(speed.argmax())]}"
        if force.max() > config.finger_force or force.sum() > config.total_force:
            return _FORCE
        if request is None:  # Before the first target the start pose is the target.
            return ""
        if not np.isfinite(request.position).all():
            return "target is not finite"
        return _DEAD if now - request.time > config.watchdog else request.hold_reason

    def _start(self, now: float, pose: np.ndarray) -> None:
        """Turn the motors on at the measured pose [J] rad."""
        # Between the end stops, not within the margin: enabling must not move the hand.
        self._commanded = self._confirmed = np.clip(pose, *self._stops).astype(np.float32)
        self._time = self._on = now
        self._eased = None
        self._restart(now)

    def _restart(self, now: float) -> None:
        """Continue from the last command, slowly at first; a hold does not shorten the start of the motors."""
        self._holding, self._ramp_start = False, max(now, self._on + _SOFT)
        self.anchor += 1

    def _turn_off(self, now: float, reason: str) -> SafetyDecision:
        # With the motors off the pose may change: restart from the next one that is known.
        if not self.problem:
            self._pose.release()
        self._commanded = self._confirmed = None
        return self._finish(now, Reaction.RELAX, reason, self._rest())

    def _hold(self, now: float, reason: str) -> SafetyDecision:
        config = self.config
        self._holding = True
        if reason == _FORCE:  # Staying there would keep the force.
            pose = self._pose.newest
            pose = self.commanded if pose is None else pose
            before = pose if self._eased is None or now - self._eased[0] > _SAME else self._eased[1]
            self._eased = now, before
            goal = np.clip(pose, before - _EASE, before + _EASE)
            position = self._toward(now, self._inside(goal), self._slow)
        else:
            position = self._toward(now, self.commanded if self._confirmed is None else self._confirmed, config.speed)
        return self._finish(now, Reaction.HOLD, reason, position)

    def _follow(self, now: float, sample: HandSample, target: np.ndarray) -> SafetyDecision:
        config, measured = self.config, sample.measured.joint_position
        # Not below 0, should a clock go back: the speed would become negative.
        grown = min(max((now - self._ramp_start) / config.ramp, 0.0), 1.0)
        # Reach ends a motion away from the measured pose and starts none: that pose may be wrong.
        near = (
            np.minimum(measured - config.reach, self.commanded),
            np.maximum(measured + config.reach, self.commanded),
        )
        # A command that moved ahead of soft motors would stick by friction, then catch up faster than itself.
        speed = self._slow + grown * (config.speed - self._slow) if self._soft(now) >= 1 else 0.0
        position = self._toward(now, self._inside(np.clip(target, *near)), speed)
        # Policies rest joints at their stops: the margin alone is no event.
        clipped = np.abs(position - self._inside(target)), np.abs(target - np.clip(target, *self._stops))
        if np.maximum(*clipped).max() <= 1e-5:
            return self._finish(now, Reaction.NONE, "", position)
        ramping = " (ramp)" if grown < 1 else ""
        return self._finish(now, Reaction.CLIP, f"target beyond a limit{ramping}", position)

    def _toward(self, now: float, goal: np.ndarray, speed: float) -> np.ndarray:
        """The next command on the way to a goal [J] rad between the end stops: the last limit, after every rule."""
        step = np.float32(speed * min(max(now - self._time, 0.0), _GAP))
        return np.clip(goal, self.commanded - step, self.commanded + step).astype(np.float32)

    def _soft(self, now: float) -> float:
        """Share of the stiffness after the motors came on."""
        return min(max((now - self._on) / _SOFT, 0.0), 1.0)

    def _inside(self, position: np.ndarray) -> np.ndarray:
        return np.clip(position, self._lower, self._upper).astype(np.float32)

    def _rest(self) -> np.ndarray:
        if self.sample is None:
            return np.zeros_like(self._lower)
        return self._inside(self.sample.measured.joint_position)

    def _finish(self, now: float, reaction: Reaction, reason: str, position: np.ndarray) -> SafetyDecision:
        self._time = now
        if reaction != Reaction.RELAX:
            self._commanded = position
            self._pose.follow(position)
        self.counts[reason] += bool(reason)
        if (reaction, reason) != self.last:
            self._note(f"{reaction.name.lower()}: {reason}" if reason else "in command")
            self.last = (reaction, reason)
        mode = Mode.PASSIVE if reaction == Reaction.RELAX else Mode.POSITION
        return SafetyDecision(position, mode, reaction, reason, self._soft(now))
