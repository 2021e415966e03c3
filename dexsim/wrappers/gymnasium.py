"""Our environments as one Gymnasium vector environment, for trainers of other libraries (extra `gym`).

    env = GymVectorEnv(dexsim.make("grasp"), 64)
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

All environments step in one compiled call. A finished one restarts in the same step: `observation` is then the first
of the new episode, and `info["final_obs"]` has the last of the old one (Gymnasium's `SAME_STEP` mode).
"""

from typing import Any

import jax
import numpy as np

from dexsim.core.compilation import jit
from dexsim.core.errors import ConfigError
from dexsim.core.install import install_line
from dexsim.env.env import Env

try:
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(f"dexsim.wrappers.gymnasium needs gymnasium: {install_line('gym')}") from error


class GymVectorEnv(VectorEnv):
    """A batch of environments behind Gymnasium's vector interface; arrays are NumPy.

    Args:
      env: what `dexsim.make` returns.
      num_envs: environments side by side.
      observation_group: "actor" or "critic".

    Raises:
      ConfigError: no such group.
    """

    def __init__(self, env: Env, num_envs: int, observation_group: str = "actor"):
        if observation_group not in env.observation_layout:
            groups = ", ".join(env.observation_layout)
            raise ConfigError(f"no observation group {observation_group!r}: choose from {groups}")
        self.env, self.num_envs, self._group = env, num_envs, observation_group
        size = sum(field.size for field in env.observation_layout[observation_group])
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_fps": 1.0 / env.control_period}
        self._reset = jit(jax.vmap(env.reset), backend=env.backend)
        self._advance = jit(self._step_and_restart, backend=env.backend)
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Observations [num_envs, n] of new episodes, and an empty dictionary.

        `options` has no meaning here. Without a seed the random numbers go on.
        """
        del options
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**32)))
        self._state = self._reset(jax.random.split(key, self.num_envs))
        return self._observation(self._state), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control tick of all environments; `actions` [num_envs, A] are clipped to [-1, 1].

        Returns:
          observation [num_envs, n], reward, terminated, truncated [num_envs], and `info`: where an episode ended,
          `final_obs` [num_envs, n] and `final_info` (return and length) with the masks `_final_obs`, `_final_info`.

        Raises:
          ConfigError: before the first reset.
        """
        if self._state is None:
            raise ConfigError("reset the environment before its first step")
        self._state, last = self._advance(self._state, np.asarray(actions, np.float32))
        terminated, truncated = np.array(last.terminated), np.array(last.truncated)
        done, info = terminated | truncated, dict[str, Any]()
        if done.any():
            ends = {name: np.array(last.metrics[name]) for name in ("return", "length")}
            info = {"final_obs": self._observation(last), "_final_obs": done, "final_info": ends, "_final_info": done}
        return self._observation(self._state), np.array(last.reward), terminated, truncated, info

    def _step_and_restart(self, state: Any, action: jax.Array) -> tuple[Any, Any]:
        last = jax.vmap(self.env.step)(state, action)
        return jax.vmap(self.env.restart)(last, last.terminated | last.truncated), last

    def _observation(self, state: Any) -> np.ndarray:
        return np.array(state.obs[self._group])
