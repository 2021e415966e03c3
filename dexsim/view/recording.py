"""Recorded episodes, tick by tick: of an .npz, or the log of a run on a hand as the bridge measured it."""

import operator
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.datasets.episodes import Episodes
from dexsim.errors import DexsimError
from dexsim.render.snapshot import Snapshot
from dexsim.view.scene import Frame


class Recording:
    """Episodes one after another, from the time on that the page names; nothing is simulated.

    Of a log the object's shape is not known: its estimated pose is shown as axes.
    """

    def __init__(self, episodes: Episodes):
        self._episodes, self.hand, self.period = episodes.snapshots, episodes.hand, episodes.period
        self.task, self._kinds, self._number = episodes.task, episodes.kinds, -1

    def add_controls(self, gui: Any) -> None:
        """The time at which episodes begin."""
        longest = max(len(episode.joint_position) for episode in self._episodes) * self.period
        self._begin = gui.add_slider("go to [s]", min=0.0, max=longest, step=0.01, initial_value=0.0)

    def episode(self) -> Iterator[Frame]:
        self._number = (self._number + 1) % len(self._episodes)
        episode = self._episodes[self._number]
        note, length = f"recorded episode {self._number + 1} of {len(self._episodes)}", len(episode.seconds)
        for tick in range(min(int(np.searchsorted(episode.seconds, self._begin.value)), length - 1), length):
            yield Frame(episode.map(operator.itemgetter(tick)), self._kinds, note)


def read_log(path: Path, hand: str = "") -> Episodes:
    """A replayed log as one episode.

    Raises:
      LogError: not a log, or one that ends before the hand was ready.
      DexsimError: the policy never ran in it.
    """
    from dexsim.geometry import rotations
    from dexsim_real.replay import Replay

    run = Replay(path, hand)
    if not run.ticks:
        raise DexsimError(f"{path}: the log has no tick of a policy to show")
    count, measured = len(run.ticks), run.measured[: len(run.ticks)]
    readings = {
        name: np.stack([tick["readings"][name] for tick in run.ticks])
        for name in ("object_position", "object_quat", "goal_quat", "command")
    }
    goals = readings["goal_quat"]
    turns = np.cumsum(np.abs(np.diff(goals, axis=0, prepend=goals[:1])).max(-1) > 1e-6)
    turned = bool(turns[-1])  # a task without goals has the same one in all ticks
    snapshot = Snapshot(
        joint_position=np.stack([now.joint_position for now in measured]),
        object_position=readings["object_position"],
        object_rotation=np.asarray(rotations.quat_to_matrix(readings["object_quat"])),
        primitive_size=np.zeros((count, 0, 3)),
        primitive_position=np.zeros((count, 0, 3)),
        primitive_rotation=np.zeros((count, 0, 3, 3)),
        primitive_active=np.zeros((count, 0), bool),
        taxel_force=np.stack([now.taxel_force for now in measured]),
        command=readings["command"],
        target_force=np.full(count, np.nan, np.float32),
        finger_force=np.stack([now.finger_force for now in measured]),
        goal_rotation=np.asarray(rotations.quat_to_matrix(goals)) if turned else None,
        turns=turns if turned else None,
        seconds=np.asarray(run.time),
    )
    period = float(run.time[-1] / max(count - 1, 1)) or 0.03
    return Episodes(task=run.report["task"], hand=run.hand, period=period, kinds=(), snapshots=[snapshot])
