"""Checks every command that the emulated hand receives against limits, whatever the motors do with it.

Commands are compared with the true joint angles, not with the reported ones, which may be wrong (a fault).
"""

import dataclasses
from collections import Counter

import numpy as np

from dexsim.core.config import setting, validate
from dexsim_real.wire.frames import Mode


@dataclasses.dataclass(frozen=True, kw_only=True)
class LimitsConfig:
    """Limits of commands. The joint ranges come with the hand."""

    speed: float = setting(7.0, unit="rad/s", low=0.01, high=1000.0)
    """Largest rate of change of a commanded angle, the bridge's `--safety.speed`."""
    slack: float = setting(0.004, unit="s", low=0.0, high=1.0)
    """Time by which the interval between two commands may be shorter at the hand than at the bridge."""
    reach: float = setting(0.75, unit="rad", low=0.01, high=10.0)
    """Largest distance of a command from the true angle: the bridge's `--safety.reach` and the motion of a joint during
    an exchange."""
    start: float = setting(0.05, unit="rad", low=0.0, high=1.0)
    """Largest distance from the true angle of a command that turns the motors on."""
    torque_max: int = setting(400, unit="mA", low=0, high=32767)
    """Largest current limit in a command."""

    def __post_init__(self):
        validate(self)


class CommandCheck:
    """Counts commands outside the limits, by limit.

    Args:
      lower, upper: [12] rad, joint ranges.
      config: the other limits.
    """

    MAX_LISTED = 20  # commands outside the limits that are described in the report
    _ROUNDING = 1e-5  # rad, float32

    def __init__(self, lower: np.ndarray, upper: np.ndarray, config: LimitsConfig):
        self._lower, self._upper, self.config = np.asarray(lower), np.asarray(upper), config
        self.checked, self.fastest = 0, 0.0  # number; rad/s, with the slack
        self.wrong: Counter[str] = Counter()
        self.first: list[str] = []  # descriptions of the first ones
        self._last: tuple[float, np.ndarray, np.ndarray] | None = None

    def take(self, now: float, command: np.ndarray, angles: np.ndarray, since: float | None = None) -> list[str]:
        """Check joint commands; returns the names of the limits that they exceed.

        Args:
          now: s, time of reception.
          command: [12] `frames.JOINT_COMMAND`.
          angles: [12] rad, true angles at the last state that was sent.
          since: s, earliest possible time of arrival; None is `now`.
        """
        violations = self._find(now, now if since is None else since, command, angles)
        self.checked += 1
        self.wrong.update(violations)
        if violations and len(self.first) < self.MAX_LISTED:
            self.first.append(
                f"{now:.4f} {', '.join(violations)}: {np.round(command['position'], 4).tolist()}, "
                f"joints at {np.round(angles, 4).tolist()}"
            )
        return violations

    def _find(self, now: float, since: float, command: np.ndarray, angles: np.ndarray) -> list[str]:
        config, position = self.config, command["position"].astype(float)
        on = command["mode"] != Mode.PASSIVE
        before, self._last = self._last, None
        if not np.isin(command["mode"], list(Mode)).all():
            return ["mode"]
        if not np.isfinite(position).all():
            return ["not finite"]
        self._last = since, np.where(on, position, np.nan), on
        violations = []
        outside = (position < self._lower - self._ROUNDING) | (position > self._upper + self._ROUNDING)
        if np.any(outside & on):
            violations.append("range")
        if np.any(on & ((command["torque_max"] < 0) | (command["torque_max"] > config.torque_max))):
            violations.append("current limit")
        if np.any(on & (np.abs(position - angles) > config.reach)):
            violations.append("reach")
        # A hand that was off starts from the true angle; one that is on continues from the last command.
        fresh = on if before is None else on & ~before[2]
        if np.any(fresh & (np.abs(position - angles) > config.start)):
            violations.append("start")
        if before is not None:
            step = np.where(on & before[2], np.abs(position - before[1]), 0.0)
            speed = float(np.nanmax(step)) / (now - before[0] + config.slack)
            self.fastest = max(self.fastest, speed)
            if speed > config.speed:
                violations.append("speed")
        return violations

    def report(self) -> dict[str, object]:
        """Results; JSON-able."""
        return {
            "checked": self.checked,
            "outside_limits": sum(self.wrong.values()),
            "by_limit": dict(self.wrong),
            "fastest_rad_s": round(self.fastest, 3),
            "first": self.first,
        }
