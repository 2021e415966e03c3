"""Our environments as a vector environment of Stable-Baselines3 (extra `sb3`).

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
PPO("MlpPolicy", VecMonitor(SB3VecEnv(dexsim.make("grasp"), 64))).learn(1_000_000)
"""

from typing import Any

import numpy as np

from dexsim.core.install import install_line
from dexsim.env.env import Env
from dexsim.wrappers.gymnasium import GymVectorEnv

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError(f"dexsim.wrappers.sb3 needs stable-baselines3: {install_line('sb3')}") from error


class SB3VecEnv(VecEnv):
    """A batch of environments, stepped in one compiled call; arguments as of `GymVectorEnv`.

    They have no attributes of their own: `get_attr` and `env_method` answer for the whole batch.
    """

    def __init__(self, env: Env, num_envs: int, *, render_mode: str | None = None):
        self._batch = GymVectorEnv(env, num_envs, render_mode=render_mode)
        super().__init__(num_envs, self._batch.single_observation_space, self._batch.single_action_space)
        self._actions = np.zeros(0)

    def reset(self) -> np.ndarray:
        """Observations [num_envs, n] of new episodes."""
        seeds = None if self._seeds[0] is None else self._seeds
        self._reset_seeds()
        return self._batch.reset(seed=seeds)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Keep `actions` [num_envs, A] for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observation, reward, done and infos; an info of an episode's end has `terminal_observation` and
        `TimeLimit.truncated`."""
        observation, reward, terminated, truncated, info = self._batch.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(terminated | truncated):
            infos[i]["terminal_observation"] = info["final_obs"][i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return observation, reward, terminated | truncated, infos

    def get_images(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each environment."""
        return self._batch.render()

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self._batch, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self._batch, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [getattr(self._batch, method_name)(*args, **kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
