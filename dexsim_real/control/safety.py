"""Safety limits between a policy and the motors, each with one defined reaction.

`Safety` decides once a cycle which command is sent. It has no clock of its own: measurements and joint targets carry
their times, so any course of events can be tested.

| finding | reaction |
|---|---|
| joint target outside position, speed or reach limits | clip |
| joint target not finite; joint too fast; fingertip force too high; target or measurement too old | hold |
| current too high for too long; too hot; targets or measurements missing for long | relax |

Hold: the pose measured when the hold began, at the usual gains. Relax: motors off. After a hold or a reconnection the
commands start at the measured pose, slowly at first.
"""

import dataclasses
import enum
from collections import Counter
from collections.abc import Callable

import numpy as np

from dexsim.core.config import setting, validate
from dexsim.hand.kinematics import Hand
from dexsim_real.sensors.hand import HandMeasurement
from dexsim_real.wire.frames import Mode

_SILENT, _DEAD = "no measurement", "no target"  # reasons that turn the motors off when they last


class Reaction(enum.IntEnum):
    """Reaction of `Safety`, the mildest first."""

    NONE = 0
    CLIP = 1
    HOLD = 2
    RELAX = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Limits of the hand. Ages count from the time of the measurement or joint target."""

    margin: float = setting(0.0, unit="rad", low=0.0, high=0.5)
    """Distance of commands from the joints' end stops."""
    speed: float = setting(20.0, unit="rad/s", low=0.01, high=200.0)
    """Largest rate of change of a command. A policy that changes targets by 0.2 rad needs 0.2 rad within a cycle."""
    reach: float = setting(0.6, unit="rad", low=0.01, high=4.0)
    """Largest distance of a command from the measured angle."""
    joint_speed: float = setting(20.0, unit="rad/s", low=0.1, high=1000.0)
    """Measured joint speed above which the hand holds."""
    current: float = setting(1.8, unit="A", low=0.01, high=20.0)
    """Current of a joint above which the motors go off; the XHand reports 1.5 A when stalled at its usual limit."""
    current_seconds: float = setting(1.0, unit="s", low=0.0, high=60.0)
    """Time for which a joint may exceed `current`."""
    temperature: float = setting(70.0, unit="degC", low=20.0, high=150.0)
    """Temperature of a joint board or a fingertip above which the motors go off."""
    finger_force: float = setting(25.0, unit="N", low=0.1, high=1000.0)
    """Force of a fingertip (sum of its taxels) above which the hand holds."""
    total_force: float = setting(70.0, unit="N", low=0.1, high=1000.0)
    """Force of all fingertips above which the hand holds; it is rated for 80 N."""
    stale: float = setting(0.05, unit="s", low=0.001, high=10.0)
    """Age of the newest measurement above which the hand holds."""
    stale_object: float = setting(0.3, unit="s", low=0.01, high=10.0)
    """Age of the newest camera or IMU measurement above which the hand holds."""
    watchdog: float = setting(0.08, unit="s", low=0.001, high=10.0)
    """Age of the newest joint target above which the hand holds, at least two control ticks."""
    patience: float = setting(1.0, unit="s", low=0.0, high=60.0)
    """Duration of a hold for lack of joint targets or measurements, after which the motors go off."""
    slow_speed: float = setting(0.5, unit="rad/s", low=0.01, high=100.0)
    """Speed of commands right after the motors turn on or a hold ends; it then grows to `speed`."""
    ramp: float = setting(1.0, unit="s", low=0.0, high=60.0)
    """Time in which the speed of commands grows from `slow_speed` to `speed`."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True)
class HandSample:
    """One answered exchange, in SI units."""

    time: float  # s, monotonic clock, of reception
    sequence: int  # number of the exchange
    generation: int  # number of the connection
    measured: HandMeasurement
    velocity: np.ndarray  # [J] rad/s


@dataclasses.dataclass(frozen=True)
class SafetyDecision:
    """The command to send now, and why."""

    position: np.ndarray  # [J] rad
    mode: Mode
    reaction: Reaction
    reason: str


class Safety:
    """Decides which command is sent.

    Not thread-safe: one thread calls `decide`, `see` and `engage`. Another may call `set_target`, which replaces one
    tuple.

    Args:
      hand: joint limits.
      config: the other limits.
      note: called with one line whenever the reaction or its reason changes.
    """

    def __init__(self, hand: Hand, config: SafetyConfig, note: Callable[[str], None] = lambda text: None):
        self.config, self._note = config, note
        self._lower = hand.joint_lower.astype(np.float32) + config.margin
        self._upper = hand.joint_upper.astype(np.float32) - config.margin
        self.sample: HandSample | None = None
        self.engaged = False
        self.latched = ""  # why the motors are off permanently
        self.anchor = 0  # number of times that commands restarted from the measured pose
        self.counts: Counter[str] = Counter()  # cycles by reason
        self._target: tuple[float, np.ndarray, str] | None = None  # time s, joint target, reason to hold
        self._held: np.ndarray | None = None
        self._since = 0.0  # s, when the current reason to hold began
        self._commanded: np.ndarray | None = None
        self._time = self._ramp_start = 0.0
        self._overcurrent_since: float | None = None  # s
        self.last = (Reaction.NONE, "")  # reaction and reason of the newest decision

    def see(self, sample: HandSample) -> None:
        """Update with a measurement; one that is not finite is ignored."""
        if not sample.measured.finite():
            self.counts["not finite: measurement"] += 1
            return
        if self.sample is not None and sample.generation != self.sample.generation:
            # The hand was disconnected with its motors off: its pose may have changed.
            self._commanded = None
        self.sample = sample
        high = bool(np.any(sample.measured.current > self.config.current))
        since = self._overcurrent_since
        self._overcurrent_since = (sample.time if since is None else since) if high else None

    def set_target(self, position: np.ndarray, time: float, hold_reason: str = "") -> None:
        """Set the requested joint targets.

        Args:
          position: [J] rad.
          time: s of the request.
          hold_reason: why the hand should hold instead of moving there; empty to move.
        """
        self._target = time, np.array(position, np.float32), hold_reason

    def engage(self) -> None:
        """Turn the motors on at the measured pose. No effect once latched."""
        self.engaged, self._commanded, self._held, self._target = True, None, None, None

    def relax(self, reason: str) -> None:
        """Turn the motors off permanently."""
        self.latched = self.latched or reason

    def decide(self, now: float) -> SafetyDecision:
        """The command for this cycle."""
        if not self.engaged or self.latched or self.sample is None:
            return self._finish(now, Reaction.RELAX, self.latched or "not engaged", self._rest())
        sample, config = self.sample, self.config
        fatal = self._fatal(now, sample)
        if fatal:
            self.relax(fatal)
            return self._finish(now, Reaction.RELAX, fatal, self._rest())
        reason = self._reason_to_hold(now, sample)
        # A hand that was silent may have turned its motors off: its pose may have changed.
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
                # Without measurements the pose is unknown: restart from the next measured one.
                self._commanded = None
                return self._finish(now, Reaction.RELAX, reason, self._held)
            self._commanded = self._held
            return self._finish(now, Reaction.HOLD, reason, self._held)
        if self._held is not None:
            self._start(now, sample)
        return self._follow(now, sample)

    # --- pieces -----------------------------------------------------------------------------

    def _fatal(self, now: float, sample: HandSample) -> str:
        config = self.config
        if np.any(sample.measured.temperature > config.temperature):
            return f"too hot: {sample.measured.temperature.max():.0f} degC"
        if self._overcurrent_since is not None and sample.time - self._overcurrent_since > config.current_seconds:
            current = sample.measured.current
            return f"current too high: {current.max():.2f} A in joint {current.argmax()}"
        return ""

    def _reason_to_hold(self, now: float, sample: HandSample) -> str:
        config, force = self.config, sample.measured.finger_force
        if now - sample.time > config.stale:
            return _SILENT
        if np.any(np.abs(sample.velocity) > config.joint_speed):
            return "a joint is too fast"
        if force.max() > config.finger_force or force.sum() > config.total_force:
            return "the fingertip force is too high"
        if self._target is not None and not np.isfinite(self._target[1]).all():
            return "target is not finite"
        # Before the first target the start pose is the target.
        if self._target is not None and now - self._target[0] > config.watchdog:
            return _DEAD
        return self._target[2] if self._target is not None else ""

    def _start(self, now: float, sample: HandSample) -> None:
        self._commanded, self._held = self._inside(sample.measured.joint_position), None
        self._ramp_start = self._time = now
        self.anchor += 1

    def _follow(self, now: float, sample: HandSample) -> SafetyDecision:
        config = self.config
        assert self._commanded is not None, "`_start` comes first"
        if self._target is None:
            return self._finish(now, Reaction.NONE, "", self._commanded)
        target = self._target[1]
        grown = min((now - self._ramp_start) / config.ramp, 1.0) if config.ramp > 0 else 1.0
        speed = config.slow_speed + grown * (config.speed - config.slow_speed)
        step = np.float32(speed * max(now - self._time, 0.0))
        measured = sample.measured.joint_position
        position = np.clip(target, self._commanded - step, self._commanded + step)
        position = np.clip(position, measured - config.reach, measured + config.reach)
        position = self._inside(position)
        clipped = np.abs(position - target) > 1e-5
        self._commanded = position
        if not clipped.any():
            return self._finish(now, Reaction.NONE, "", position)
        ramping = " (ramp)" if grown < 1 else ""
        return self._finish(now, Reaction.CLIP, f"target beyond a limit{ramping}", position)

    def _inside(self, position: np.ndarray) -> np.ndarray:
        return np.clip(position, self._lower, self._upper).astype(np.float32)

    def _rest(self) -> np.ndarray:
        if self.sample is None:
            return np.zeros_like(self._lower)
        return self._inside(self.sample.measured.joint_position)

    def _finish(self, now: float, reaction: Reaction, reason: str, position: np.ndarray) -> SafetyDecision:
        self._time = now
        self.counts[reason] += bool(reason)
        if (reaction, reason) != self.last:
            self._note(f"{reaction.name.lower()}: {reason}" if reason else "in command")
            self.last = (reaction, reason)
        mode = Mode.PASSIVE if reaction == Reaction.RELAX else Mode.POSITION
        return SafetyDecision(position, mode, reaction, reason)
