"""A trained policy: loads from one file, needs no simulator, runs anywhere JAX does.

`act(params, obs)` is the pure function, for use under `jit`, `vmap` and `scan`. `Policy` is what a file
holds: those parameters together with the task, the observation's layout and the control rate.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core import cli
from dexsim.core.assets import asset_path
from dexsim.core.config import from_dict, to_dict
from dexsim.core.errors import AssetError, CheckpointError, ConfigError
from dexsim.core.pytree import pytree_dataclass, static
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.networks import MLP, Layer, apply_mlp
from dexsim_ppo.learner.running_stats import Normalizer, make_normalizer, normalize
from dexsim_ppo.learner.types import Environment, Field, Fields, layout_size
from dexsim_ppo.retired import migrate_config


@pytree_dataclass
class PolicyParams:
    """What `act` needs."""

    layers: MLP
    normalizer: Normalizer
    squash: str = static(default="gaussian")
    """`"gaussian"`: actions are clipped to [-1, 1]; `"tanh"`: squashed."""


def act(params: PolicyParams, obs: jax.Array) -> jax.Array:
    """The policy's mode: actor observation `[..., n]`, SI units, to action `[..., A]` in [-1, 1]."""
    mean = apply_mlp(params.layers, normalize(params.normalizer, obs))
    return jnp.tanh(mean) if params.squash == "tanh" else jnp.clip(mean, -1.0, 1.0)


_act = jax.jit(act)


@dataclass(frozen=True, kw_only=True)
class Policy:
    """A deterministic policy and what one must know to use it."""

    task: str
    env_config: dict[str, Any]
    """The task's configuration, as `dexsim.core.config.to_dict` gives it."""
    observation_layout: tuple[Field, ...]
    """Fields of the actor's observation."""
    params: PolicyParams
    control_rate: float
    """Actions per second, Hz."""
    training: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Where it comes from: seed, steps, learner settings."""

    def __call__(self, obs: jax.Array) -> jax.Array:
        """Action `[..., A]` for an actor observation `[..., n]`."""
        return _act(self.params, obs)

    def blind(self, *names: str) -> "Policy":
        """This policy without some of its readings, which it takes for their mean in training from then on.

        Tells what a policy relies on. It is not what a policy trained without them would do.

        Raises:
          ConfigError: it has no such reading.
        """
        fields = sorted(field.name for field in self.observation_layout)
        if unknown := sorted(set(names) - set(fields)):
            raise ConfigError(f"the policy does not observe {', '.join(unknown)}; it observes {', '.join(fields)}")
        kept = np.concatenate([np.full(field.size, field.name not in names) for field in self.observation_layout])
        first, *others = self.params.layers
        first = dataclasses.replace(first, kernel=jnp.where(kept[:, None], first.kernel, 0.0))
        return dataclasses.replace(self, params=dataclasses.replace(self.params, layers=(first, *others)))

    def save(self, path: str | Path) -> None:
        """Write to a file, whole or not at all."""
        content = {
            "env_config": self.env_config,
            "control_rate": self.control_rate,
            "observation_layout": layout_to_list(self.observation_layout),
            "squash": self.params.squash,
            "clip": self.params.normalizer.clip,
            "layers": len(self.params.layers),
            "training": self.training,
        }
        checkpoint.save(path, kind="policy", task=self.task, content=content, tree=self.params)

    @classmethod
    def load(cls, path: str | Path, *, task: str | None = None) -> "Policy":
        """Read a file.

        Args:
          task: refuse a policy of another task; None takes any.

        Raises:
          CheckpointError: see `dexsim_ppo.checkpoint.load`; or the parts do not fit together.
        """
        file = checkpoint.load(path, kind="policy", task=task)
        try:
            return cls._from_file(file)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise CheckpointError(f"{path}: is not a sound policy ({error!r})") from None

    @classmethod
    def from_training(
        cls, env: Environment, config: Any, state: Any, training: dict[str, Any] | None = None
    ) -> "Policy":
        """The policy that a learner's state stands for.

        Args:
          config: the `PPOConfig` that it is trained with.
          state: a `TrainState`; its arrays are copied, so the state may be donated afterwards.
          training: what to remember of its origin.
        """
        fields = env.observation_layout["actor"]
        normalizer = make_normalizer(
            state.observation_stats["actor"],
            fields,
            std_floor=config.observation_std_floor,
            clip=config.observation_clip,
        )
        params = PolicyParams(state.params.actor, normalizer, config.distribution)
        return cls(
            task=env.name,
            env_config=to_dict(env.config),
            observation_layout=tuple(Field(f.name, f.size, f.scale) for f in fields),
            params=jax.tree.map(jnp.copy, params),
            control_rate=1.0 / env.control_period,
            training=training or {},
        )

    @classmethod
    def _from_file(cls, file: checkpoint.Checkpoint) -> "Policy":
        content, leaves = file.content, file.leaves
        layout = tuple(Field(*field) for field in content["observation_layout"])
        layers = tuple(
            Layer(leaves[f".layers[{i}].kernel"], leaves[f".layers[{i}].bias"]) for i in range(content["layers"])
        )
        normalizer = Normalizer(leaves[".normalizer.mean"], leaves[".normalizer.std"], content["clip"])
        sizes = [layout_size(layout), *(layer.kernel.shape[1] for layer in layers)]
        shapes = [(layer.kernel.shape, layer.bias.shape) for layer in layers]
        wanted = [((n, m), (m,)) for n, m in zip(sizes[:-1], sizes[1:], strict=True)]
        if (
            len(leaves) != 2 * len(layers) + 2
            or shapes != wanted
            or not normalizer.mean.shape == normalizer.std.shape == (sizes[0],)
        ):
            raise ValueError(f"layer shapes {shapes} for {sizes[0]} observations")
        params = PolicyParams(layers, normalizer, content["squash"])
        return cls(
            task=file.task,
            env_config=migrate_config(content["env_config"], file.path),
            observation_layout=layout,
            params=jax.tree.map(jnp.asarray, params),
            control_rate=content["control_rate"],
            training=content["training"],
        )


def layout_to_list(fields: Fields) -> list[list[Any]]:
    """Fields as plain lists, `[name, size, scale]`."""
    return [[field.name, field.size, field.scale] for field in fields]


def load_policy(name: str, *, task: str | None = None) -> Policy:
    """A policy from a file, or a shipped one by its name; of that task, if one is given."""
    if Path(name).exists() or "/" in name or name.endswith(".msgpack"):
        return Policy.load(name, task=task)
    try:
        return Policy.load(asset_path(f"policies/{name}.msgpack"), task=task)
    except AssetError:
        raise CheckpointError(f"{name}: no such file, and no shipped policy has that name") from None


def make_env(policy: Policy, *, backend: str, num_envs: int) -> Environment:
    """The environment that a policy was trained in."""
    import dexsim

    entry = cli.find_task(policy.task)
    env = dexsim.make(policy.task, from_dict(entry.config_class, policy.env_config), backend=backend, num_envs=num_envs)
    if layout_to_list(env.observation_layout["actor"]) != layout_to_list(policy.observation_layout):
        raise CheckpointError(
            f"the policy observes {layout_to_list(policy.observation_layout)}, and "
            f"{env.name} gives {layout_to_list(env.observation_layout['actor'])}"
        )
    return env
