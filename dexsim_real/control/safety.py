"""What stands between a policy and the motors: limits, each with one defined reaction.

`Safety` is asked once a cycle for the command to send. It sees measurements and wishes with their
times, knows no clock of its own, and so can be tested against any course of events.

| found | reaction |
|---|---|
| wish outside position, step or reach limits | clip |
| wish not finite; joint too fast; fingertips press too hard; wish or measurement too old | hold |
| current too high for too long; too hot; wishes or measurements missing for long | relax |

Hold: the pose measured when the hold began, at the usual gains. Relax: motors off. After a hold or a
reconnection commands start at the measured pose and may move slowly at first, then faster.
"""

import dataclasses
import enum
from collections import Counter
from collections.abc import Callable

import numpy as np

from dexsim.core.config import setting, validate
from dexsim.hand.kinematics import Hand
from dexsim_real.sensors.hand import Measured
from dexsim_real.wire.frames import Mode

_SILENT, _DEAD = "no measurement", "no wish"  # reasons that end in motors off when they last


class Reaction(enum.IntEnum):
    """What was done to a wish, the harshest last."""

    NONE = 0
    CLIP = 1
    HOLD = 2
    RELAX = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Limits of the hand; times count from the measurement or wish concerned."""

    margin: float = setting(0.0, unit="rad", low=0.0, high=0.5)
    """Distance that commands keep from the joints' ends."""
    speed: float = setting(20.0, unit="rad/s", low=0.01, high=200.0)
    """Fastest change of a command; a policy that moves targets by 0.2 rad at once needs 0.2 rad in a cycle."""
    reach: float = setting(0.6, unit="rad", low=0.01, high=4.0)
    """Largest distance of a command from the measured angle."""
    joint_speed: float = setting(20.0, unit="rad/s", low=0.1, high=1000.0)
    """Measured speed that no sound hand reaches."""
    current: float = setting(1.8, unit="A", low=0.01, high=20.0)
    """Current of one joint; the XHand reports 1.5 A when stalled at its usual limit."""
    current_seconds: float = setting(1.0, unit="s", low=0.0, high=60.0)
    """Time for which it may last."""
    temperature: float = setting(70.0, unit="degC", low=20.0, high=150.0)
    """Of a joint board or a fingertip."""
    finger_force: float = setting(25.0, unit="N", low=0.1, high=1000.0)
    """Sum of one fingertip's taxels."""
    total_force: float = setting(70.0, unit="N", low=0.1, high=1000.0)
    """Sum of all taxels; the hand is rated for 80 N."""
    stale: float = setting(0.05, unit="s", low=0.001, high=10.0)
    """Age at which a measurement of the hand is too old to act on."""
    stale_object: float = setting(0.3, unit="s", low=0.01, high=10.0)
    """The same for camera and IMU."""
    watchdog: float = setting(0.08, unit="s", low=0.001, high=10.0)
    """Age at which a wish is too old: the policy is dead. At least two control ticks."""
    patience: float = setting(1.0, unit="s", low=0.0, high=60.0)
    """Hold for this long for lack of wishes or measurements, then relax."""
    slow_speed: float = setting(0.5, unit="rad/s", low=0.01, high=100.0)
    """Speed of commands right after the motors turn on or a hold ends; it then grows to `speed`."""
    ramp: float = setting(1.0, unit="s", low=0.0, high=60.0)
    """Time in which the speed of commands grows from `slow_speed` to `speed`."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True)
class Sample:
    """One answered exchange, in SI units."""

    time: float  # s, monotonic, when it was received
    sequence: int  # of the exchange
    generation: int  # of the connection
    measured: Measured
    velocity: np.ndarray  # [J] rad/s


@dataclasses.dataclass(frozen=True)
class Decision:
    """What to send now."""

    position: np.ndarray  # [J] rad
    mode: Mode
    reaction: Reaction
    reason: str


class Safety:
    """Decides what is sent. Not thread-safe: `decide`, `see` and `engage` belong to one thread;
    `wish` may come from another, since it replaces one tuple.

    Args:
      note: called with one line whenever the reaction or its reason changes.
    """

    def __init__(self, hand: Hand, config: SafetyConfig, note: Callable[[str], None] = lambda text: None):
        self.config, self._note = config, note
        self._lower = hand.joint_lower.astype(np.float32) + config.margin
        self._upper = hand.joint_upper.astype(np.float32) - config.margin
        self.sample: Sample | None = None
        self.engaged = False
        self.latched = ""  # why the motors are off for good
        self.anchor = 0  # grows when commands start anew from the measured pose
        self.counts: Counter[str] = Counter()  # cycles by reason
        self._wish: tuple[float, np.ndarray, str] | None = None
        self._held: np.ndarray | None = None
        self._since = 0.0  # when its reason came up
        self._commanded: np.ndarray | None = None
        self._time = self._ramp_start = 0.0
        self._hot_current: float | None = None  # since when a current is too high
        self.last = (Reaction.NONE, "")  # reaction and reason of the newest decision

    def see(self, sample: Sample) -> None:
        """Take in a measurement; one with numbers that are not finite is no measurement."""
        if not sample.measured.finite():
            self.counts["not finite: measurement"] += 1
            return
        if self.sample is not None and sample.generation != self.sample.generation:
            # The hand was away, and its motors are off: its pose may be another.
            self._commanded = None
        self.sample = sample
        high = bool(np.any(sample.measured.current > self.config.current))
        self._hot_current = (self._hot_current if self._hot_current is not None else sample.time) if high else None

    def wish(self, position: np.ndarray, time: float, trouble: str = "") -> None:
        """Where the policy wants the joints [J] rad, when it said so, and why not to heed it."""
        self._wish = time, np.array(position, np.float32), trouble

    def engage(self) -> None:
        """Turn the motors on, at the pose measured last; does nothing once latched."""
        self.engaged, self._commanded, self._held, self._wish = True, None, None, None

    def relax(self, reason: str) -> None:
        """Turn the motors off for good."""
        self.latched = self.latched or reason

    def decide(self, now: float) -> Decision:
        """The command for this cycle."""
        if not self.engaged or self.latched or self.sample is None:
            return self._finish(now, Reaction.RELAX, self.latched or "not engaged", self._rest())
        sample, config = self.sample, self.config
        fatal = self._fatal(now, sample)
        if fatal:
            self.relax(fatal)
            return self._finish(now, Reaction.RELAX, fatal, self._rest())
        reason = self._reason_to_hold(now, sample)
        # A hand that was silent may have turned its motors off: its pose may be another.
        back = self.last[1] == _SILENT and reason != _SILENT
        if self._commanded is None or back:
            self._start(now, sample)
        if reason:
            if self._held is None:
                self._held = self._inside(sample.measured.joint_position)
            if reason != self.last[1]:
                self._since = now
            if reason in (_SILENT, _DEAD) and now - self._since > config.patience:
                if reason == _DEAD:
                    self.relax(f"{reason} for {config.patience:g} s")
                # Without news of the hand its pose is unknown: start from the measured one again.
                self._commanded = None
                return self._finish(now, Reaction.RELAX, reason, self._held)
            self._commanded = self._held
            return self._finish(now, Reaction.HOLD, reason, self._held)
        if self._held is not None:
            self._start(now, sample)
        return self._follow(now, sample)

    # --- pieces -----------------------------------------------------------------------------

    def _fatal(self, now: float, sample: Sample) -> str:
        config = self.config
        if np.any(sample.measured.temperature > config.temperature):
            return f"too hot: {sample.measured.temperature.max():.0f} degC"
        if self._hot_current is not None and sample.time - self._hot_current > config.current_seconds:
            current = sample.measured.current
            return f"current too high: {current.max():.2f} A in joint {current.argmax()}"
        return ""

    def _reason_to_hold(self, now: float, sample: Sample) -> str:
        config, force = self.config, sample.measured.finger_force
        if now - sample.time > config.stale:
            return _SILENT
        if np.any(np.abs(sample.velocity) > config.joint_speed):
            return "a joint is too fast"
        if force.max() > config.finger_force or force.sum() > config.total_force:
            return "a fingertip presses too hard"
        if self._wish is not None and not np.isfinite(self._wish[1]).all():
            return "wish is not finite"
        # Before the first wish the start pose is the wish.
        if self._wish is not None and now - self._wish[0] > config.watchdog:
            return _DEAD
        return self._wish[2] if self._wish is not None else ""

    def _start(self, now: float, sample: Sample) -> None:
        self._commanded, self._held = self._inside(sample.measured.joint_position), None
        self._ramp_start = self._time = now
        self.anchor += 1

    def _follow(self, now: float, sample: Sample) -> Decision:
        config = self.config
        if self._wish is None:
            return self._finish(now, Reaction.NONE, "", self._commanded)
        wanted = self._wish[1]
        grown = min((now - self._ramp_start) / config.ramp, 1.0) if config.ramp > 0 else 1.0
        speed = config.slow_speed + grown * (config.speed - config.slow_speed)
        step = np.float32(speed * max(now - self._time, 0.0))
        measured = sample.measured.joint_position
        position = np.clip(wanted, self._commanded - step, self._commanded + step)
        position = np.clip(position, measured - config.reach, measured + config.reach)
        position = self._inside(position)
        clipped = np.abs(position - wanted) > 1e-5
        self._commanded = position
        if not clipped.any():
            return self._finish(now, Reaction.NONE, "", position)
        ramping = " (ramp)" if grown < 1 else ""
        return self._finish(now, Reaction.CLIP, f"wish beyond a limit{ramping}", position)

    def _inside(self, position: np.ndarray) -> np.ndarray:
        return np.clip(position, self._lower, self._upper).astype(np.float32)

    def _rest(self) -> np.ndarray:
        if self.sample is None:
            return np.zeros_like(self._lower)
        return self._inside(self.sample.measured.joint_position)

    def _finish(self, now: float, reaction: Reaction, reason: str, position: np.ndarray) -> Decision:
        self._time = now
        self.counts[reason] += bool(reason)
        if (reaction, reason) != self.last:
            self._note(f"{reaction.name.lower()}: {reason}" if reason else "in command")
            self.last = (reaction, reason)
        mode = Mode.PASSIVE if reaction == Reaction.RELAX else Mode.POSITION
        return Decision(position, mode, reaction, reason)
