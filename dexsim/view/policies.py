"""The policies that a view can choose from: shipped ones and those of runs, read again when a training has saved."""

from pathlib import Path

from dexsim.core.assets import asset_path
from dexsim.core.errors import CheckpointError
from dexsim.env.env import Env
from dexsim_ppo.policy import Policy, load_policy

NONE = "none"
"""The choice of no policy: actions are zero."""
_NEWEST = 20  # files of runs that are listed


class PolicyShelf:
    """Policies that fit an environment, by the name of a shipped one or the path of a file.

    Args:
      env: the environment whose observation they must take.
      first: the policy that the view begins with; `NONE` for none.
      runs: folder of the trainings.
    """

    def __init__(self, env: Env, first: str, runs: Path = Path("runs")):
        self._layout = tuple(env.observation_layout["actor"])
        self._runs = runs
        self._kept: dict[str, tuple[float, Policy | None]] = {}
        self._first = first
        self._shipped = [path.stem for path in sorted(asset_path("policies/grasp.msgpack").parent.glob("*.msgpack"))]

    def names(self) -> tuple[str, ...]:
        """What can be chosen now: the first policy, then shipped ones, then the newest files of runs."""
        files = [path for name in ("best", "last") for path in self._runs.glob(f"*/{name}.msgpack")]
        newest = sorted(files, key=_changed, reverse=True)[:_NEWEST]
        listed = dict.fromkeys([self._first, *self._shipped, *map(str, newest), NONE])
        return tuple(name for name in listed if name == NONE or self.get(name) is not None)

    def get(self, name: str) -> Policy | None:
        """The policy of this name as its file is now; None where it is unsound, does not fit, or is `NONE`.

        A file that a training is about to replace keeps its last sound policy.
        """
        if name == NONE:
            return None
        time = 0.0 if name in self._shipped else _changed(Path(name))
        kept = self._kept.get(name)
        if kept is None or kept[0] != time:
            try:
                policy: Policy | None = load_policy(name)
            except (CheckpointError, OSError):
                policy = kept[1] if kept else None
            if policy is not None and policy.observation_layout != self._layout:
                policy = None
            kept = self._kept[name] = time, policy
        return kept[1]


def _changed(path: Path) -> float:
    """When a file was last written, s; 0 if it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
