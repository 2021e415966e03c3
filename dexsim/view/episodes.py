"""Recorded episodes, tick by tick: nothing is simulated."""

from dexsim.datasets.episodes import Episodes
from dexsim.render.render import CAMERAS
from dexsim.view.source import Control, Frame, Values


class RecordedEpisodes:
    """Episodes of a file one after another; each reset is the next one."""

    def __init__(self, episodes: Episodes):
        self._episodes, self.hand, self.period = episodes, episodes.hand, episodes.period
        self.camera = episodes.task if episodes.task in CAMERAS else "grasp"
        self._number, self._tick = -1, 0

    def controls(self) -> dict[str, Control]:
        """None: what was recorded cannot be changed."""
        return {}

    def reset(self, values: Values) -> Frame:
        self._number, self._tick = (self._number + 1) % len(self._episodes.snapshots), 0
        return self._frame()

    def step(self, values: Values) -> Frame:
        self._tick += 1
        if self._tick == len(self._episodes.snapshots[self._number].joint_position):
            return self.reset(values)
        return self._frame()

    def _frame(self) -> Frame:
        snapshot = self._episodes.snapshots[self._number].map(lambda x: x[self._tick])
        note = f"recorded episode {self._number + 1} of {len(self._episodes.snapshots)}"
        return Frame(snapshot, self._episodes.kinds, note)
