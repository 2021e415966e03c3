"""The log of a run on a hand, tick by tick, as the bridge measured it."""

from pathlib import Path

import numpy as np

from dexsim.core.errors import DexsimError
from dexsim.geometry import rotations
from dexsim.render.snapshot import Snapshot
from dexsim.view.source import Control, Frame, Slider, Values
from dexsim_real.replay.replay import replay


class Recording:
    """A replayed log. The object's shape is not in it: its estimated pose is shown as axes.

    Raises:
      LogError: not a log, or one that ends before the hand was ready.
      DexsimError: the policy never ran in it.
    """

    def __init__(self, path: Path, hand: str = ""):
        self._run, self._at = replay(path, hand), 0
        self.hand = self._run.hand
        if not self._run.ticks:
            raise DexsimError(f"{path}: the log has no tick of a policy to show")
        time = self._run.time
        self.period = float(time[-1] / max(len(time) - 1, 1)) or 0.03
        self.camera = "rotate" if self._run.report["task"] == "rotate" else "grasp"
        goals = np.array([tick["readings"]["goal_quat"] for tick in self._run.ticks])
        changed = np.abs(np.diff(goals, axis=0)).max(-1) > 1e-6
        self._turns = np.concatenate([[0], np.cumsum(changed)]) if changed.any() else None

    def controls(self) -> dict[str, Control]:
        """The time in the log, to go to."""
        return {"go to [s]": Slider(0.0, float(self._run.time[-1]), 0.01, 0.0)}

    def reset(self, values: Values) -> Frame:
        """Go to the time that the page names."""
        self._at = int(np.searchsorted(self._run.time, values["go to [s]"]))
        return self._frame()

    def step(self, values: Values) -> Frame:
        self._at += 1
        if self._at >= len(self._run.ticks):
            return self.reset(values)
        return self._frame()

    def _frame(self) -> Frame:
        self._at = min(self._at, len(self._run.ticks) - 1)
        measured, readings = self._run.measured[self._at], self._run.ticks[self._at]["readings"]
        return Frame(
            Snapshot(
                joint_position=measured.joint_position,
                object_position=np.asarray(readings["object_position"]),
                object_rotation=np.asarray(rotations.quat_to_matrix(readings["object_quat"])),
                primitive_size=np.zeros((0, 3)),
                primitive_position=np.zeros((0, 3)),
                primitive_rotation=np.zeros((0, 3, 3)),
                primitive_active=np.zeros(0, bool),
                taxel_force=measured.taxel_force,
                command=np.asarray(readings["command"]),
                target_force=np.float32(np.nan),
                finger_force=measured.finger_force,
                goal_rotation=None
                if self._turns is None
                else np.asarray(rotations.quat_to_matrix(readings["goal_quat"])),
                turns=None if self._turns is None else self._turns[self._at],
                seconds=self._run.time[self._at],
            ),
            (),
        )
