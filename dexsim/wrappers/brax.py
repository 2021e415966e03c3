"""Our environments as brax environments, for brax's trainers and wrappers (extra `brax`).

    from brax.training.agents.ppo import networks, train as ppo
    env = BraxEnv(dexsim.make("grasp"))
    factory = functools.partial(networks.make_ppo_networks,
                                policy_obs_key="actor", value_obs_key="critic")
    ppo.train(env, wrap_env_fn=wrap, episode_length=env.episode_length,
              network_factory=factory, ...)

brax knows one `done`. Its convention, kept here: the environment reports `done` only where the task *terminated*, and
the time limit is a wrapper's, which marks those steps in `info["truncation"]`. With `wrap` the task's own time limit
does that. brax's standard wrappers work too, with their own limit (`episode_length`) and their own restart: every
environment returns to the one start state it was first given (random numbers move on).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.install import install_line
from dexsim.env.evaluation import evaluation_of
from dexsim.errors import ConfigError

try:
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper
except ImportError as error:
    raise ImportError(f"dexsim.wrappers.brax needs brax: {install_line('brax')}") from error


def _put_replicated(x: Any, devices: Sequence[jax.Device]) -> Any:
    """`x` with a leading axis over `devices`: JAX 0.10 took it out, brax 0.14 still calls it."""
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    return jax.tree.map(lambda leaf: jax.device_put(jnp.stack([jnp.asarray(leaf)] * len(devices)), sharding), x)


jax.device_put_replicated = _put_replicated

# brax sums each metric over the episode and keeps its own return and length.
_RUNNING_METRICS = ("return", "length")


class BraxEnv(Env):
    """A dexsim environment behind brax's interface.

    The brax state holds our state without its random key in `pipeline_state`, and in `info` the key, as raw data, and
    `time_limit` (1 where the task's time limit was reached and it did not terminate).
    The observation is a dictionary with an array for each group, chosen from by brax's `policy_obs_key` and
    `value_obs_key`.
    """

    def __init__(self, env: Any):
        self.env = env

    def reset(self, rng: jax.Array) -> State:
        """The start of an episode. `rng`: a raw key, as brax uses, or a typed one."""
        if not jnp.issubdtype(rng.dtype, jax.dtypes.prng_key):
            rng = jax.random.wrap_key_data(rng)
        return self._to_brax(self.env.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        """One control step. `action`: `[A]` in [-1, 1]."""
        return self._to_brax(self.env.step(self._to_dexsim(state), action), last=state)

    def restart(self, state: State, done: jax.Array) -> State:
        """Begin a new episode where `done`; reward, done and metrics stay the last step's."""
        after = self.env.restart(self._to_dexsim(state), done.astype(bool))
        info = {**state.info, "key": jax.random.key_data(after.key)}
        return state.replace(pipeline_state=dataclasses.replace(after, key=None), obs=dict(after.obs), info=info)

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        return {group: (sum(field.size for field in fields),) for group, fields in self.env.observation_layout.items()}

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return self.env.backend

    @property
    def episode_length(self) -> int:
        """Ticks of an evaluation episode."""
        return evaluation_of(self.env).evaluation_steps

    @property
    def dt(self) -> float:
        """One control tick, s."""
        return self.env.control_period

    def _to_brax(self, state: Any, last: State | None = None) -> State:
        # brax's wrappers keep entries of their own in `metrics` and `info`: they stay.
        carried, info = (last.metrics, last.info) if last is not None else ({}, {})
        terminated = state.terminated.astype(jnp.float32)
        time_limit = state.truncated.astype(jnp.float32) * (1 - terminated)
        own = {name: x.astype(jnp.float32) for name, x in state.metrics.items() if name not in _RUNNING_METRICS}
        return State(
            pipeline_state=dataclasses.replace(state, key=None),
            obs=dict(state.obs),
            reward=state.reward.astype(jnp.float32),
            done=terminated,
            metrics=carried | own,
            info={**info, "key": jax.random.key_data(state.key), "time_limit": time_limit},
        )

    def _to_dexsim(self, state: State) -> Any:
        """Our state. The key is `info`'s: brax's restart rewinds `pipeline_state`, and its trainer carries no typed
        keys."""
        return dataclasses.replace(state.pipeline_state, key=jax.random.wrap_key_data(state.info["key"]))


class Episodes(EpisodeWrapper):
    """brax's episode bookkeeping, which ends episodes at the task's own time limit as well, and starts new ones from
    the task's distribution of start states."""

    def step(self, state: State, action: jax.Array) -> State:
        steps = jnp.where(state.done, 0, state.info["steps"])
        state = state.replace(done=jnp.zeros_like(state.done), info={**state.info, "steps": steps})
        state = super().step(state, action)
        terminated = state.done * (1 - state.info["truncation"])
        truncation = jnp.maximum(state.info["truncation"], state.info["time_limit"] * (1 - terminated))
        done = jnp.maximum(state.done, truncation)
        state = state.replace(done=done, info={**state.info, "truncation": truncation, "episode_done": done})
        return jax.vmap(self.unwrapped.restart)(state, done)


def wrap(env: BraxEnv, episode_length: int, action_repeat: int = 1, randomization_fn: Any = None) -> Wrapper:
    """For the argument `wrap_env_fn` of brax's trainers: vmap, time limit, restart. The task's own time limit may come
    before `episode_length`, ticks.

    Raises:
      ConfigError: `randomization_fn` is given; our environments randomise themselves.
    """
    if randomization_fn is not None:
        raise ConfigError("randomization_fn: the task draws its own parameters; set its `randomization` config instead")
    return Episodes(VmapWrapper(env), episode_length, action_repeat)
