"""Whether a run did what it was started for: a hand that was gone or held, or lost records, are no success."""

import numpy as np

from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.core.log import LogWriter

_BLIND = 0.1  # share of the time without a measurement that a run may have, such as a cable that was out for a moment
_HELD = 0.5  # share of the time in which `Safety` may have held the hand


class Outcome:
    """Counts what goes wrong while the policy runs.

    Args:
      began: s, monotonic clock.
    """

    def __init__(self, began: float = 0.0):
        self._last = began
        self._total = self._blind = self._held = 0.0  # s
        self._actions = self._wrong = 0
        self._reason = self._silence = ""  # of the newest hold, and of the newest refusal

    def add(self, now: float, target: np.ndarray | None, safety: Safety) -> None:
        """Count the time since the last call.

        Args:
          now: s.
          target: [J] rad that the policy gave; None when no measurement was young enough.
          safety: its newest decision counts, unless the motors are off on purpose.
        """
        step, self._last = now - self._last, now
        self._total += step
        if target is None:
            self._blind += step
            self._silence = safety.refused or self._silence
        else:
            self._actions += 1
            self._wrong += not np.isfinite(target).all()
        reaction, reason = safety.last
        if safety.engaged and reaction >= Reaction.HOLD:
            self._held += step
            self._reason = reason

    def missing(self, log: LogWriter) -> list[str]:
        """What the run lacks, one line each; empty for a whole run. `log` should be closed."""
        lines = []
        if self._blind > _BLIND * self._total:
            why = f" ({self._silence})" if self._silence else ""
            lines.append(f"no measurement for {self._share(self._blind)} of the run{why}")
        if self._wrong:
            lines.append(f"{self._wrong} of {self._actions} actions of the policy were not finite")
        if self._held > _HELD * self._total:
            lines.append(f"the hand was held for {self._share(self._held)} of the run, last because: {self._reason}")
        if log.dropped or log.failure:
            lines.append(f"{log.dropped} log records are lost ({log.failure or 'the disk is too slow'})")
        return lines

    def _share(self, seconds: float) -> str:
        return f"{100 * seconds / self._total:.0f} %"
