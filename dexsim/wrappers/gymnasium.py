"""Our environments behind Gymnasium's interfaces, for trainers of other libraries (extra `gym`).

    env = GymVectorEnv(dexsim.make("grasp"), 64)
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

All environments step in one compiled call. `GymEnv` is a single one.
"""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from dexsim.core.compilation import jit
from dexsim.core.install import install_line
from dexsim.env.env import Env
from dexsim.env.evaluation import take_snapshot
from dexsim.errors import ConfigError
from dexsim.render.render import render_frame

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(f"dexsim.wrappers.gymnasium needs gymnasium: {install_line('gym')}") from error


class GymVectorEnv(VectorEnv):
    """A batch of environments behind Gymnasium's vector interface; arrays are NumPy.

    Args:
      autoreset_mode: when a finished environment restarts. `SAME_STEP`: at once; `observation` is then the first of the
        new episode, and `info["final_obs"]` has the last of the old one. `NEXT_STEP`: in the step after, which ignores
        its action and earns nothing; Gymnasium's wrappers, such as `NormalizeObservation`, need this mode.
      render_mode: "rgb_array" for pictures by `render`; None for none.

    Raises:
      ConfigError: another autoreset mode.
    """

    def __init__(
        self,
        env: Env,
        num_envs: int,
        *,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
    ):
        if autoreset_mode not in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP):
            raise ConfigError(f"{autoreset_mode}: choose AutoresetMode.SAME_STEP or NEXT_STEP")
        self.env, self.num_envs, self.render_mode = env, num_envs, render_mode
        size = sum(field.size for field in env.observation_layout["actor"])
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {
            "autoreset_mode": autoreset_mode,
            "render_modes": ["rgb_array"],
            "render_fps": 1.0 / env.control_period,
        }
        self._same_step = autoreset_mode == AutoresetMode.SAME_STEP
        self._reset = jit(jax.vmap(lambda seed: env.reset(jax.random.key(seed))), backend=env.backend)
        self._advance = jit(self._step_and_restart, backend=env.backend)
        self._snapshot = jit(jax.vmap(functools.partial(take_snapshot, env)), backend=env.backend)
        self._state: Any = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Observations [num_envs, n] of new episodes, and an empty dictionary.

        `seed` is of each environment, or of the first, and one more for each that follows; without one the random
        numbers go on. `options` has no meaning here.
        """
        if seed is None:
            seeds = self.np_random.integers(2**32, size=self.num_envs)
        else:
            seeds = seed + np.arange(self.num_envs) if np.ndim(seed) == 0 else np.array(seed)
            super().reset(seed=int(seeds[0]))
        self._state = self._reset((seeds % 2**32).astype(np.uint32))
        return np.array(self._state.obs["actor"]), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control tick of all environments; `actions` [num_envs, A] are clipped to [-1, 1].

        Returns:
          observation [num_envs, n], reward, terminated, truncated [num_envs], and `info`: empty, but in the mode
          `SAME_STEP`, where an episode ended, `final_obs` [num_envs, n] and `final_info` (return and length) with the
          masks `_final_obs`, `_final_info`.
        """
        self._state, last = self._advance(self._state, np.asarray(actions, np.float32))
        reported, info = (last if self._same_step else self._state), dict[str, Any]()
        terminated, truncated = np.array(reported.terminated), np.array(reported.truncated)
        done = terminated | truncated
        if self._same_step and done.any():
            ends, final = {name: np.array(last.metrics[name]) for name in ("return", "length")}, last.obs["actor"]
            info = {"final_obs": np.array(final), "_final_obs": done, "final_info": ends, "_final_info": done}
        return np.array(self._state.obs["actor"]), np.array(reported.reward), terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Pictures, uint8 [480, 640, 3] each: hand and object, and the forces of the taxels."""
        if self.render_mode is None:
            return None
        snapshots = jax.device_get(self._snapshot(self._state))
        env = self.env
        return tuple(
            render_frame(env.hand, env.primitive_kinds, snapshots.map(lambda x, i=i: x[i]), camera=env.name)
            for i in range(self.num_envs)
        )

    def _step_and_restart(self, state: Any, action: jax.Array) -> tuple[Any, Any]:
        last = jax.vmap(self.env.step)(state, action)
        ended = last if self._same_step else state
        return jax.vmap(self.env.restart)(last, ended.terminated | ended.truncated), last


class GymEnv(gymnasium.Env):
    """A single environment; arguments as of `GymVectorEnv`."""

    def __init__(self, env: Env, *, render_mode: str | None = None):
        self._batch = GymVectorEnv(env, 1, autoreset_mode=AutoresetMode.NEXT_STEP, render_mode=render_mode)
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space
        self.metadata, self.render_mode = self._batch.metadata, render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """The observation [n] of a new episode, and an empty dictionary."""
        super().reset(seed=seed)
        first = int(self.np_random.integers(2**32)) if seed is None else seed
        observation, info = self._batch.reset(seed=first)
        return observation[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control tick; `action` [A] is clipped to [-1, 1]."""
        observation, reward, terminated, truncated, info = self._batch.step(np.asarray(action)[None])
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray | None:
        """A picture, uint8 [480, 640, 3]."""
        pictures = self._batch.render()
        return pictures[0] if pictures else None
