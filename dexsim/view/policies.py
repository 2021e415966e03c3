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
        self._loaded: dict[str, tuple[float, Policy | None]] = {}
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
        if name not in self._loaded or self._loaded[name][0] != time:
            self._loaded[name] = time, self._load(name)
        return self._loaded[name][1]

    def _load(self, name: str) -> Policy | None:
        try:
            policy = load_policy(name)
        except (CheckpointError, OSError):
            return self._loaded.get(name, (0.0, None))[1]
        return policy if policy.observation_layout == self._layout else None


def _changed(path: Path) -> float:
    """When a file was last written, s; 0 if it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
