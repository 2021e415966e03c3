"""Faults of a training run: counted, shown, and kept in a file from which they can be replayed."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import DexsimError
from dexsim.registry import task_option
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.state import TrainState
from dexsim_ppo.training.runlog import RunFolder

DIVERGED_AFTER = 5  # calls in a row that skip more than half of their updates
COUNTED = ("nonfinite_rewards", "bounded_rewards")

# The step donates its state, so what a reproducer needs is copied before: one launch for all arrays.
keep: Callable[[TrainState], TrainState] = jax.jit(lambda state: jax.tree.map(jnp.copy, state))


class Faults:
    """What went wrong so far.

    Args:
      config: the learner's settings.
      folder: where reproducers go.
      task: the task's name.
      state: the state that training begins from.
      save: writes a state to a file, as a checkpoint.
    """

    def __init__(
        self,
        config: PPOConfig,
        folder: RunFolder,
        task: str,
        state: TrainState,
        save: Callable[[Path, TrainState], None],
    ):
        self._per_iteration = config.epochs * config.minibatches
        self._per_call = config.iterations_per_call * self._per_iteration
        self._folder, self._task, self._save = folder, task, save
        self._skipped, self._totals = int(state.skipped_updates), dict.fromkeys(COUNTED, 0.0)
        self._clean_until, self._bad_calls = int(state.iteration), 0
        self._clean = True
        self._file: Path | None = None

    def check(
        self, before: TrainState, metrics: dict[str, np.ndarray], iteration: int, note: Callable[[str], None]
    ) -> dict[str, float]:
        """Totals for the log and the display, after a call that ended at `iteration`.

        Args:
          before: a copy of the state before the call.
          metrics: of the call.
          note: shows a line to the user.

        Raises:
          DexsimError: most gradients of several calls in a row were not finite.
        """
        skipped = int(metrics["skipped_updates"][-1])
        lost, self._skipped = skipped - self._skipped, skipped
        if not lost:
            self._clean, self._clean_until = True, iteration
        elif self._clean:
            self._clean = False
            note(
                f"iteration {iteration}: {lost} of {self._per_call} updates skipped, their gradient is not finite"
                f"{self._write(before)}"
            )
        self._bad_calls = self._bad_calls + 1 if 2 * lost > self._per_call else 0
        if self._bad_calls >= DIVERGED_AFTER:
            raise DexsimError(
                f"training diverged: in each of the last {self._bad_calls} calls most gradients were not finite, the "
                f"first one after iteration {self._clean_until}; {self._from_before()}{self._how_to_replay()}"
            )
        for name in COUNTED:
            self._totals[name] += float(np.sum(metrics.get(name, 0.0)))
        return {
            "skipped_updates": float(skipped),
            "updates": float(iteration * self._per_iteration),
            **{f"total/{name}": value for name, value in self._totals.items()},
        }

    def _write(self, before: TrainState) -> str:
        """Write the first fault's reproducer; how to replay it."""
        if self._file is None:
            path = self._folder.path / f"reproduce-{int(before.iteration):08d}.msgpack"
            try:
                self._save(path, before)
            except OSError as error:  # A full disk is no reason to stop.
                return f"; {path} could not be written ({error.strerror})"
            self._file = path
        return self._how_to_replay()

    def _how_to_replay(self) -> str:
        if self._file is None:
            return ""
        return f"; replay: python -m dexsim_ppo.reproduce {self._file}{task_option(self._task)}"

    def _from_before(self) -> str:
        """Which checkpoints are from before the fault: later ones hold its state."""
        sound = [path for path in self._folder.existing_checkpoints() if int(path.stem) <= self._clean_until]
        return f"the newest checkpoint from before is {sound[-1]}" if sound else "no checkpoint is from before"
