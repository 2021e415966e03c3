"""A trained policy: loads from one file, needs no simulator, runs anywhere JAX does.

    policy = load_policy("grasp")                   # a shipped one by name, or a file
    carry = policy.initial_carry()                  # at the start of an episode; None where the policy has no memory
    carry, action = policy.act(carry, observation)  # `act(policy.params, carry, observation)`, compiled

`Policy` is what a file holds: the parameters of `act` together with the task, the observation's layout and the control
rate.
"""

import dataclasses
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.assets import asset_path
from dexsim.core.config import flat, from_dict, to_dict
from dexsim.core.errors import AssetError, CheckpointError, ConfigError, OtherEnvWarning
from dexsim.core.pytree import Array
from dexsim.hand.source import check_record, check_same, record_of, recorded_hand
from dexsim.task_spec import TaskSpec
from dexsim_ppo import checkpoint
from dexsim_ppo.acting import PolicyParams, act, initial_carry
from dexsim_ppo.learner.adapter import adapt
from dexsim_ppo.learner.memory import History
from dexsim_ppo.learner.networks import Layer
from dexsim_ppo.learner.running_stats import make_normalizer
from dexsim_ppo.learner.types import Environment, Field, Fields
from dexsim_ppo.policy_file import memory_to_list, read_network
from dexsim_ppo.retired import migrate_config, old_spec, read_spec

if TYPE_CHECKING:
    from dexsim.env.env import Env
    from dexsim.hand.kinematics import Hand


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

    def initial_carry(self, *batch: int) -> jax.Array | None:
        """The carry `[*batch, m]` at the start of an episode, such as `initial_carry(8)` of eight environments; None
        for a policy without memory."""
        return initial_carry(self.params, batch)

    def act(self, carry: Array | None, obs: Array) -> tuple[jax.Array | None, jax.Array]:
        """The next carry `[..., m]` and the action `[..., A]` for an actor observation `[..., n]`: the compiled
        `dexsim_ppo.act(self.params, carry, obs)`.

        Raises:
          ConfigError: the observation has another size, or the carry is not that of this policy and batch.
        """
        return _act(self.params, carry, obs)

    def ablate(self, *names: str) -> "Policy":
        """This policy with some observation fields replaced by their mean in training, those of a fixed scale by 0.

        Shows what the policy relies on. A policy that was trained without those fields may do better.

        Raises:
          ConfigError: it observes no such field.
        """
        fields = sorted(field.name for field in self.observation_layout)
        if unknown := sorted(set(names) - set(fields)):
            raise ConfigError(f"the policy does not observe {', '.join(unknown)}; it observes {', '.join(fields)}")
        kept = np.concatenate([np.full(field.size, field.name not in names) for field in self.observation_layout])
        (first, *others), memory = self.params.layers, self.params.memory
        rows = np.ones(first.kernel.shape[0], bool)
        rows[: kept.size] = kept
        if isinstance(memory, History):
            rows = np.tile(kept, memory.length + 1)
        elif memory is not None:
            memory = dataclasses.replace(memory, input=_without(memory.input, kept))
        layers = (_without(first, rows), *others)
        return dataclasses.replace(self, params=dataclasses.replace(self.params, layers=layers, memory=memory))

    def save(self, path: str | Path) -> None:
        """Write to a file, whole or not at all."""
        content = {
            "env_config": self.env_config,
            "control_rate": self.control_rate,
            "observation_layout": layout_to_list(self.observation_layout),
            "squash": self.params.squash,
            "clip": self.params.normalizer.clip,
            "layers": len(self.params.layers),
            "memory": memory_to_list(self.params.memory),
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
        file = checkpoint.load(_find(name), kind="policy", task=task)
        try:
            return cls._from_file(file)
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError, ConfigError) as error:
            text = " ".join(repr(error).split())
            raise CheckpointError(f"{file.path}: is not a sound policy ({text:.300})") from None

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
          CheckpointError: the environment's observation has other fields than the policy's, or it takes other actions.
        """
        given, actions = layout_to_list(env.observation_layout["actor"]), self.params.layers[-1].bias.size
        if given != layout_to_list(self.observation_layout):
            raise CheckpointError(
                f"the policy observes {layout_to_list(self.observation_layout)}, and {env.name} gives {given}"
            )
        if actions != env.action_size:
            raise CheckpointError(f"the policy gives {actions} actions, and {env.name} takes {env.action_size}")
        today = from_dict(type(env.config), self.env_config)  # with defaults for fields that are newer
        trained, now = flat(to_dict(today)), flat(to_dict(env.config))
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
        params = PolicyParams(state.params.actor, normalizer, config.distribution, state.params.memory)
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
        content = file.content
        layout, layers, normalizer, memory = read_network(content, file.leaves)
        params = PolicyParams(layers, normalizer, content["squash"], memory)
        env_config, hand = migrate_config(content["env_config"], file.path), content.get("hand")
        if hand is not None:
            check_record(hand)
        return cls(
            task=file.task,
            env_config=env_config,
            observation_layout=layout,
            params=jax.tree.map(jnp.asarray, params),
            control_rate=content["control_rate"],
            training=content["training"],
            spec=_read_spec(file, env_config),
            hand=hand,
        )


def layout_to_list(fields: Fields) -> list[list[Any]]:
    """Fields as plain lists, `[name, size, scale]`."""
    return [[field.name, field.size, field.scale] for field in fields]


def _without(layer: Layer, kept: np.ndarray) -> Layer:
    """A layer that gets 0 for the inputs that are not `kept` [in]."""
    return dataclasses.replace(layer, kernel=jnp.where(kept[:, None], layer.kernel, 0.0))


def load_policy(name: str | Path, *, task: str | None = None) -> Policy:
    """A policy from a file, or a shipped one by its name; `task` is also any other name of its task, with its module
    (`my_module:poke`) where that has to be imported. In all else the same as `Policy.load`."""
    policy = Policy.load(name)
    if task:
        from dexsim.registry import find_task

        entry, word = find_task(task), task.rpartition(":")[2]
        # One task may be registered under several names; the file has one of them.
        if policy.task != word and (entry.environment or find_task(policy.task).task is not entry.task):
            raise CheckpointError(f"{name}: is of the task {policy.task!r}, not {word!r}")
    return policy


def _find(name: str | Path) -> Path:
    """The file of a policy that is named by a path, or by the name of a shipped one."""
    if not isinstance(name, str | Path):
        raise CheckpointError(f"{name!r:.80}: give a policy's file, or the name of a shipped one")
    path, text = Path(name), str(name)
    if (path.exists() and not path.is_dir()) or "/" in text or text.endswith(".msgpack"):
        return path
    try:
        return Path(asset_path(f"policies/{text}.msgpack"))
    except AssetError:
        if path.is_dir():
            return path
        shipped = ", ".join(sorted(path.stem for path in Path(asset_path("policies")).glob("*.msgpack")))
        raise CheckpointError(f"{text}: no such file, and no shipped policy has that name: {shipped}") from None


def _read_spec(file: checkpoint.Checkpoint, env_config: dict[str, Any]) -> TaskSpec | None:
    if file.content.get("spec"):
        return read_spec(file.content["spec"], file.path)
    return old_spec(file.task, env_config) if file.task in ("grasp", "rotate") else None
