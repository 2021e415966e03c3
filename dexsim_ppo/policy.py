"""A trained policy: loads from one file, needs no simulator, runs anywhere JAX does.

    policy = load_policy("grasp")        # a shipped one by name, or a file
    action = policy(observation)

`act(params, obs)` is the pure function, for use under `jit`, `vmap` and `scan`. `Policy` is what a file
holds: those parameters together with the task, the observation's layout and the control rate.
"""

import dataclasses
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.assets import asset_path
from dexsim.core.config import from_dict, to_dict
from dexsim.core.errors import AssetError, CheckpointError, ConfigError, OtherEnvWarning
from dexsim.core.pytree import Array, pytree_dataclass, static
from dexsim.hand.source import check_record, check_same, record_of, recorded_hand
from dexsim.task_spec import TaskSpec
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.adapter import adapt
from dexsim_ppo.learner.networks import MLP, Layer, apply_mlp
from dexsim_ppo.learner.running_stats import Normalizer, make_normalizer, normalize
from dexsim_ppo.learner.types import Environment, Field, Fields, layout_size
from dexsim_ppo.retired import migrate_config, old_spec

if TYPE_CHECKING:
    from dexsim.env.env import Env
    from dexsim.hand.kinematics import Hand


@pytree_dataclass
class PolicyParams:
    """What `act` needs."""

    layers: MLP
    normalizer: Normalizer
    squash: Literal["gaussian", "tanh"] = static(default="gaussian")
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
    """Configuration of the environment that it was trained in, as `dexsim.core.config.to_dict` gives it."""
    observation_layout: tuple[Field, ...]
    """Fields of the actor's observation."""
    params: PolicyParams
    control_rate: float
    """Actions per second, Hz."""
    training: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Where it comes from: seed, steps, learner settings."""
    spec: TaskSpec | None = None
    """What a host must know of the task; None for an environment that is not of this library."""
    hand: dict[str, Any] | None = None
    """Which hand it was trained on (`dexsim.hand.source`); None for the shipped default one."""

    def __call__(self, obs: Array) -> jax.Array:
        """Action `[..., A]` for an actor observation `[..., n]`."""
        return _act(self.params, obs)

    def ablate(self, *names: str) -> "Policy":
        """This policy with some observation fields replaced by their mean in training.

        Shows what the policy relies on. A policy that was trained without those fields may do better.

        Raises:
          ConfigError: it observes no such field.
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
            "spec": self.spec and to_dict(self.spec),
            "hand": self.hand,
        }
        checkpoint.save(path, kind="policy", task=self.task, content=content, tree=self.params)

    @classmethod
    def load(cls, name: str | Path, *, task: str | None = None) -> "Policy":
        """Read a file, or a shipped policy by its name (`Policy.load("grasp")`).

        Args:
          name: path of a file, or the name of a shipped policy.
          task: refuse a policy of another task; None takes any.

        Raises:
          CheckpointError: there is no such policy; see `dexsim_ppo.checkpoint.load`; or the parts do not fit together.
        """
        path = _find(name)
        file = checkpoint.load(path, kind="policy", task=task)
        try:
            return cls._from_file(file)
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError, ConfigError) as error:
            text = " ".join(repr(error).split())
            raise CheckpointError(f"{path}: is not a sound policy ({text:.300})") from None

    def find_hand(self, given: str | Path | None = None) -> "Hand | None":
        """The hand that the policy was trained on, or the file that is `given`; None for the default one.

        Raises:
          ConfigError: that hand is not here, its files have changed, or the given one has other joints, fingers or
            taxels.
        """
        return recorded_hand(self.hand, given, f"the policy of {self.task!r}")

    def check_hand(self, hand: "Hand") -> None:
        """Raises ConfigError: the policy was trained on another hand than this one."""
        check_same(self.hand, hand, f"the policy of {self.task!r}")

    def make_env(self, *, num_envs: int = 1, backend: str = "auto", hand: "Hand | None" = None, seed: int = 0) -> "Env":
        """The environment that the policy was trained in; arguments as in `dexsim.make`.

        Raises:
          ConfigError: its task is not registered.
          CheckpointError: today's task gives another observation, or the policy's mesh is outside of this folder.
        """
        self.check_mesh()
        return self.build_env(num_envs=num_envs, backend=backend, hand=hand, seed=seed)

    def check_mesh(self) -> None:
        """Refuse an object mesh that the policy's file names outside of the current folder.

        A policy may come from anywhere; which files of this computer are opened is for its user to say.

        Raises:
          CheckpointError: the mesh is elsewhere.
        """
        objects = self.env_config.get("objects")
        mesh = str(objects.get("mesh") or "") if isinstance(objects, dict) else ""
        if mesh and not Path(mesh).expanduser().resolve().is_relative_to(Path.cwd().resolve()):
            raise CheckpointError(
                f"the policy's object mesh {mesh[:200]!r} is outside of the current folder: name the file yourself, "
                "with --set objects.mesh=FILE (evaluate) or --env.objects.mesh FILE (train), or go to its folder"
            )

    def build_env(self, *, num_envs: int, backend: str, hand: "Hand | None" = None, seed: int = 0) -> "Env":
        """`make_env` with whatever mesh `env_config` names."""
        from dexsim.registry import find_task, make

        config = from_dict(find_task(self.task).config_class, self.env_config)
        hand = self.find_hand() if hand is None else hand
        env = cast(
            Any, adapt(make(self.task, config, backend=backend, num_envs=num_envs, hand=hand, seed=seed), self.task)
        )
        self.check_env(env)
        return env

    def check_env(self, env: Environment) -> None:
        """Whether an environment is the one that the policy was trained in.

        Warns (`OtherEnvWarning`) of settings that differ.

        Raises:
          CheckpointError: the environment's observation has other fields than the policy's.
        """
        given = layout_to_list(env.observation_layout["actor"])
        if given != layout_to_list(self.observation_layout):
            raise CheckpointError(
                f"the policy observes {layout_to_list(self.observation_layout)}, and {env.name} gives {given}"
            )
        trained = from_dict(type(env.config), self.env_config)  # with today's defaults for fields that are newer
        trained, now = _flat(to_dict(trained)), _flat(to_dict(env.config))
        changed = [
            f"{path} = {now.get(path)!r} (trained: {trained.get(path)!r})"
            for path in sorted(trained.keys() | now.keys())
            if trained.get(path) != now.get(path)
        ]
        if changed:
            warnings.warn(
                f"not the environment that the policy was trained in: {', '.join(changed)}",
                OtherEnvWarning,
                stacklevel=2,
            )

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
            spec=getattr(env, "spec", None),
            hand=record_of(getattr(env, "hand", None)),
        )

    @classmethod
    def _from_file(cls, file: checkpoint.Checkpoint) -> "Policy":
        content, leaves = file.content, file.leaves
        layout = tuple(Field(*field) for field in content["observation_layout"])
        _check_content(content, layout)
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
        _check_numbers(layers, normalizer)
        params = PolicyParams(layers, normalizer, content["squash"])
        env_config = migrate_config(content["env_config"], file.path)
        if content.get("hand") is not None:
            check_record(content["hand"])
        return cls(
            task=file.task,
            env_config=env_config,
            observation_layout=layout,
            params=jax.tree.map(jnp.asarray, params),
            control_rate=content["control_rate"],
            training=content["training"],
            spec=_read_spec(file, env_config),
            hand=content.get("hand"),
        )


def _check_content(content: dict[str, Any], layout: tuple[Field, ...]) -> None:
    """Raises ValueError: a value of another type, or beyond what a policy of a hand can have."""
    for name, kind in (("env_config", dict), ("training", dict), ("layers", int)):
        if type(content[name]) is not kind:
            raise ValueError(f"{name} is not a {kind.__name__}")
    # No hand is run at less than one command a second, and none answers a thousand.
    for name, low, high in (("control_rate", 1.0, 1000.0), ("clip", 0.1, 1e4), ("layers", 1, 64)):
        _check_number(name, content[name], low, high)
    if content["squash"] not in ("gaussian", "tanh"):
        raise ValueError(f"squash = {str(content['squash']):.50}")
    for field in layout:
        if not isinstance(field.name, str) or type(field.size) is not int:
            raise ValueError(f"observation field {str(tuple(field)):.100}")
        _check_number(f"size of {field.name:.50}", field.size, 1, 100_000)
        if field.scale is not None:
            _check_number(f"scale of {field.name:.50}", field.scale, 1e-9, 1e9)


def _check_number(name: str, value: Any, low: float, high: float) -> None:
    if type(value) not in (int, float) or not low <= value <= high:
        raise ValueError(f"{name} = {str(value):.50}: must be a number between {low:g} and {high:g}")


def _check_numbers(layers: MLP, normalizer: Normalizer) -> None:
    """Raises ValueError: some number is not finite, or some observation would give an action that is not."""
    arrays = {"normalizer.mean": normalizer.mean, "normalizer.std": normalizer.std}
    for i, layer in enumerate(layers):
        arrays |= {f"layers[{i}].kernel": layer.kernel, f"layers[{i}].bias": layer.bias}
    for name, array in arrays.items():
        if array.dtype != np.float32 or not np.all(np.isfinite(array)):
            raise ValueError(f"{name} holds what is not a finite float32")
    if not np.all(np.asarray(normalizer.std) >= 1e-12):
        raise ValueError("normalizer.std is not positive")
    largest = np.full(normalizer.mean.shape, float(normalizer.clip))
    for layer in layers:  # The activation does not go beyond its input or 1.
        kernel, bias = np.asarray(layer.kernel, float), np.asarray(layer.bias, float)
        largest = np.maximum(largest @ np.abs(kernel) + np.abs(bias), 1.0)
        if largest.max(initial=0.0) > 1e30:
            raise ValueError("its weights are so large that actions overflow")


def layout_to_list(fields: Fields) -> list[list[Any]]:
    """Fields as plain lists, `[name, size, scale]`."""
    return [[field.name, field.size, field.scale] for field in fields]


def load_policy(name: str | Path, *, task: str | None = None) -> Policy:
    """A policy from a file, or a shipped one by its name: the same as `Policy.load`."""
    return Policy.load(name, task=task)


def _find(name: str | Path) -> Path:
    """The file of a policy that is named by a path, or by the name of a shipped one."""
    text = str(name)
    if Path(text).exists() or "/" in text or text.endswith(".msgpack"):
        return Path(text)
    try:
        return Path(asset_path(f"policies/{text}.msgpack"))
    except AssetError:
        raise CheckpointError(f"{text}: no such file, and no shipped policy has that name") from None


def _read_spec(file: checkpoint.Checkpoint, env_config: dict[str, Any]) -> TaskSpec | None:
    if file.content.get("spec"):
        return from_dict(TaskSpec, file.content["spec"])
    return old_spec(file.task, env_config) if file.task in ("grasp", "rotate") else None


def _flat(config: Any, path: str = "") -> dict[str, Any]:
    """Nested plain data as one mapping from path to value."""
    if not isinstance(config, dict):
        return {path: config}
    return {k: v for name, value in config.items() for k, v in _flat(value, f"{path}.{name}" if path else name).items()}
