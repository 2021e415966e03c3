"""What the emulated hand thinks of its orders: every one is held against limits, whatever the motors do with it."""

import dataclasses
from collections import Counter, deque

import numpy as np

from dexsim.core.config import setting, validate
from dexsim_real.wire.frames import Mode


@dataclasses.dataclass(frozen=True, kw_only=True)
class LimitsConfig:
    """What no command may exceed. The joints' own ranges come with the hand."""

    speed: float = setting(20.0, unit="rad/s", low=0.01, high=1000.0)
    """Fastest change of a commanded angle: the bridge's own `--safety.speed`. A joint may always be told to stop
    where it is or has been in the last `recent` seconds."""
    recent: float = setting(0.15, unit="s", low=0.0, high=10.0)
    """How old the news of a joint may be by which the bridge stops it."""
    slack: float = setting(0.004, unit="s", low=0.0, high=1.0)
    """Time by which two commands may have come closer together than they were decided."""
    reach: float = setting(0.75, unit="rad", low=0.01, high=10.0)
    """Largest distance of a command from the angle that the hand reported last; the bridge's own
    `--safety.reach`, and what a joint moves in an exchange."""
    start: float = setting(0.05, unit="rad", low=0.0, high=1.0)
    """Distance from the reported angle of the command that turns the motors on."""
    torque_max: int = setting(400, unit="mA", low=0, high=32767)
    """Largest current limit."""

    def __post_init__(self):
        validate(self)


class CommandCheck:
    """Counts commands outside limits, by what is wrong with them.

    Args:
      lower: [12] rad, ends of the joints' ranges.
      upper: [12] rad.
    """

    WORDS = 20  # commands that are described in words
    _ROUNDING = 1e-5  # rad, float32

    def __init__(self, lower: np.ndarray, upper: np.ndarray, config: LimitsConfig):
        self._lower, self._upper, self.config = np.asarray(lower), np.asarray(upper), config
        self.checked, self.fastest = 0, 0.0  # rad/s, after allowing for the slack
        self.wrong: Counter[str] = Counter()
        self.first: list[str] = []  # the first few, in words
        self._last: tuple[float, np.ndarray, np.ndarray] | None = None
        self._shown: deque[tuple[float, np.ndarray]] = deque()  # what was reported lately

    def take(self, now: float, command: np.ndarray, reported: np.ndarray, since: float | None = None) -> list[str]:
        """What is wrong with joint commands [12] (`frames.JOINT_COMMAND`) received at `now` s.

        Args:
          reported: [12] rad, angles of the last state that was sent.
          since: s, the earliest time at which it may have come, where that is not `now`.
        """
        found = self._find(now, now if since is None else since, command, reported)
        self.checked += 1
        self.wrong.update(found)
        if found and len(self.first) < self.WORDS:
            self.first.append(
                f"{now:.4f} {', '.join(found)}: {np.round(command['position'], 4).tolist()}, "
                f"reported {np.round(reported, 4).tolist()}"
            )
        return found

    def _find(self, now: float, since: float, command: np.ndarray, reported: np.ndarray) -> list[str]:
        config, position = self.config, command["position"].astype(float)
        self._shown.append((now, reported))
        while self._shown[0][0] < now - config.recent:
            self._shown.popleft()
        on = command["mode"] != Mode.PASSIVE
        before, self._last = self._last, None
        if not np.isin(command["mode"], list(Mode)).all():
            return ["mode"]
        if not np.isfinite(position).all():
            return ["not finite"]
        self._last = since, np.where(on, position, np.nan), on
        found = []
        outside = (position < self._lower - self._ROUNDING) | (position > self._upper + self._ROUNDING)
        if np.any(outside & on):
            found.append("range")
        if np.any(on & ((command["torque_max"] < 0) | (command["torque_max"] > config.torque_max))):
            found.append("current limit")
        if np.any(on & (np.abs(position - reported) > config.reach)):
            found.append("reach")
        # A hand that was off is taken over where it is; one that is on is moved on from the last command.
        fresh = on if before is None else on & ~before[2]
        if np.any(fresh & (np.abs(position - reported) > config.start)):
            found.append("start")
        if before is not None:
            step = np.where(on & before[2] & ~self._stops(position), np.abs(position - before[1]), 0.0)
            speed = float(np.nanmax(step)) / (now - before[0] + config.slack)
            self.fastest = max(self.fastest, speed)
            if speed > config.speed:
                found.append("speed")
        return found

    def _stops(self, position: np.ndarray) -> np.ndarray:
        """Which joints [12] are told to be where they lately were."""
        shown = np.stack([angles for _, angles in self._shown])
        near = self.config.start
        return (position >= shown.min(0) - near) & (position <= shown.max(0) + near)

    def report(self) -> dict[str, object]:
        """Counts for the summary."""
        return {
            "checked": self.checked,
            "outside_limits": sum(self.wrong.values()),
            "by_limit": dict(self.wrong),
            "fastest_rad_s": round(self.fastest, 3),
            "first": self.first,
        }
