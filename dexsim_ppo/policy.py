"""A trained policy: loads from one file, needs no simulator, runs anywhere JAX does.

    policy = load_policy("grasp")                   # a shipped one by name, or a file
    carry = policy.initial_carry()                  # at the start of an episode; None where the policy has no memory
    carry, action = policy.act(carry, observation)  # `act(policy.params, carry, observation)`, compiled

`Policy` is what a file holds: the parameters of `act` together with the task, the observation's layout and the control
rate.
"""

import dataclasses
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.assets import asset_path
from dexsim.core.config import Config, flat, from_dict, setting, to_dict
from dexsim.core.layout import LayoutEntry, layout_size
from dexsim.core.pytree import Array, pytree_dataclass
from dexsim.errors import AssetError, CheckpointError, ConfigError, OtherEnvWarning
from dexsim.hand.source import record_of, recorded_hand
from dexsim.task_spec import TaskSpec
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.adapter import adapt
from dexsim_ppo.learner.networks import GRU, MLP, Layer, apply_mlp, carry_size, step_memory, zero_carry
from dexsim_ppo.learner.running_stats import Normalizer, make_normalizer, normalize
from dexsim_ppo.learner.types import Environment

if TYPE_CHECKING:
    from dexsim.env.env import Env
    from dexsim.hand.description import Hand


@pytree_dataclass
class PolicyParams:
    """What `act` needs."""

    layers: MLP
    normalizer: Normalizer
    memory: GRU | None = None


def act(params: PolicyParams, carry: jax.Array | None, obs: jax.Array) -> tuple[jax.Array | None, jax.Array]:
    """One step of a policy, with or without memory, for use under `jit`, `vmap` and `scan`.

    Args:
      params: `policy.params`.
      carry: `[..., m]` from the step before; at the start of an episode `policy.initial_carry(...)`.
      obs: actor observation `[..., n]`, SI units.

    Returns:
      The next carry `[..., m]`, and the policy's mode: action `[..., A]` in [-1, 1].

    Raises:
      ConfigError: the observation has another size, or the carry is not that of this policy and batch.
    """
    size, shape = params.normalizer.mean.size, np.shape(obs)
    carried = None if params.memory is None else (*shape[:-1], carry_size(params.memory))
    given = None if carry is None else np.shape(carry)
    if shape[-1:] != (size,) or given != carried:
        raise ConfigError(
            f"expected an actor observation [..., {size}] and a carry of the shape {carried}, got {shape} and {given}: "
            "begin an episode with carry = policy.initial_carry(number of environments)"
        )
    carry, features = step_memory(params.memory, carry, normalize(params.normalizer, obs))
    return carry, jnp.clip(apply_mlp(params.layers, features), -1.0, 1.0)


_act = jax.jit(act)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Policy(Config):
    """A deterministic policy and what one must know to use it."""

    task: str
    env_config: dict[str, Any]
    """Configuration of the environment that it was trained in, as `dexsim.core.config.to_dict` gives it."""
    observation_layout: tuple[LayoutEntry, ...]
    """Layout of the actor's observation."""
    params: PolicyParams
    control_rate: float = setting(unit="Hz", low=1.0, high=1000.0)
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
        return zero_carry(self.params.memory, batch)

    def act(self, carry: Array | None, obs: Array) -> tuple[jax.Array | None, jax.Array]:
        """The next carry `[..., m]` and the action `[..., A]` for an actor observation `[..., n]`: the compiled
        `dexsim_ppo.act(self.params, carry, obs)`."""
        return _act(self.params, carry, obs)

    def ablate(self, *names: str) -> "Policy":
        """This policy with some observation fields replaced by their mean in training, those of a fixed scale by 0.

        Shows what the policy relies on. A policy that was trained without those fields may do better.
        """
        layout = self.observation_layout
        observed = sorted(entry.name for entry in layout)
        if unknown := sorted(set(names) - set(observed)):
            raise ConfigError(f"the policy does not observe {', '.join(unknown)}; it observes {', '.join(observed)}")
        ablated = np.repeat([entry.name in names for entry in layout], [entry.size for entry in layout])
        # Normalised observations have mean 0: the largest deviation leaves nothing else.
        std = jnp.where(ablated, np.finfo(np.float32).max, self.params.normalizer.std)
        normalizer = dataclasses.replace(self.params.normalizer, std=std)
        return dataclasses.replace(self, params=dataclasses.replace(self.params, normalizer=normalizer))

    def header(self) -> dict[str, Any]:
        """What its file says beside the numbers, as plain data."""
        names = ("env_config", "observation_layout", "control_rate", "training", "spec", "hand")
        return {name: to_dict(getattr(self, name)) for name in names} | {"clip": self.params.normalizer.clip}

    def arrays(self) -> dict[str, np.ndarray]:
        """The numbers of its file by name; see `dexsim_ppo.portable`."""
        names = _names(len(self.params.layers), self.params.memory is not None, self.params.normalizer.clip)
        return dict(zip(jax.tree.leaves(names), map(np.asarray, jax.tree.leaves(self.params)), strict=True))

    def save(self, path: str | Path) -> None:
        """Write to a file, whole or not at all."""
        checkpoint.save(path, kind="policy", task=self.task, content=self.header(), tree=self.arrays())

    def find_hand(self, given: str | Path | None = None) -> "Hand | None":
        """The hand that the policy was trained on, or the file that is `given`; None for the default one. Raises
        ConfigError if its files have changed, or if the given one has other joints, fingers or taxels."""
        return recorded_hand(self.hand, given, f"the policy of {self.task!r}")

    def make_env(self, *, backend: str = "auto", hand: "Hand | None" = None, seed: int = 0) -> "Env":
        """The environment that the policy was trained in; arguments as in `dexsim.make`. Raises
        CheckpointError if today's task gives another observation."""
        from dexsim.registry import find_task, make

        config = from_dict(find_task(self.task).config_class, self.env_config)
        hand = self.find_hand() if hand is None else hand
        env = adapt(make(self.task, config, backend=backend, hand=hand, seed=seed), self.task)
        self.check_env(env)
        return cast(Any, env)

    def check_fit(self, env: Environment) -> None:
        """Raises CheckpointError: the environment gives another observation, or takes other actions."""
        layouts = tuple(env.observation_layout["actor"]), self.observation_layout
        if layouts[0] != layouts[1]:
            given, expected = (", ".join(f"{entry.name} [{entry.size}]" for entry in layout) for layout in layouts)
            raise CheckpointError(f"{env.name} observes {given}; the policy expects {expected}")
        if (actions := self.params.layers[-1].bias.size) != env.action_size:
            raise CheckpointError(f"{env.name} takes {env.action_size} actions; the policy gives {actions}")

    def check_env(self, env: Environment) -> None:
        """Warn (`OtherEnvWarning`) of settings that differ from those that the policy was trained with. Raises
        CheckpointError if it cannot act in this environment."""
        self.check_fit(env)
        today = from_dict(type(env.config), self.env_config)  # with defaults for fields that are newer
        trained, now = flat(to_dict(today)), flat(to_dict(env.config))
        changed = [
            f"{path} = {now.get(path)!r} (trained: {trained.get(path)!r})"
            for path in sorted(trained.keys() | now.keys())
            if trained.get(path) != now.get(path)
        ]
        if changed:
            text = f"not the environment that the policy was trained in: {', '.join(changed)}"
            warnings.warn(text, OtherEnvWarning, stacklevel=2)

    @classmethod
    def from_training(cls, env: Environment, state: Any, training: dict[str, Any] | None = None) -> "Policy":
        """The policy of a learner's `TrainState`, whose arrays are copied; `training` is what to remember of its
        origin."""
        layout = tuple(env.observation_layout["actor"])
        normalizer = make_normalizer(state.observation_stats["actor"], layout)
        actor, memory = state.average
        params = PolicyParams(actor, normalizer, memory)
        return cls(
            task=env.name,
            env_config=to_dict(env.config),
            observation_layout=layout,
            params=jax.tree.map(jnp.copy, params),
            control_rate=1.0 / env.control_period,
            training=training or {},
            spec=getattr(env, "spec", None),
            hand=record_of(getattr(env, "hand", None)),
        )


def load_policy(name: str | Path, *, task: str | None = None) -> Policy:
    """A policy from a file, or a shipped one by its name.

    Args:
      name: path of a file, or the name of a shipped policy.
      task: the policy's task, or another name that it is registered under; with its module (`my_module:poke`) where
        that has to be imported. None takes any.

    Raises:
      CheckpointError: there is no such policy, it is of another task, or its file is unsound.
    """
    path = _find(name)
    file = checkpoint.load(path, kind="policy")
    try:
        policy = _from_file(file)
        jax.eval_shape(act, policy.params, policy.initial_carry(), np.zeros(layout_size(policy.observation_layout)))
    except (ConfigError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: invalid policy: {' '.join(str(error).split()):.300}") from None
    finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy.params))
    if not finite or not (policy.params.normalizer.std > 0).all():
        raise CheckpointError(f"{path}: holds numbers that are not finite, or deviations that are not positive")
    if task:
        from dexsim.registry import find_task

        # One task may be registered under several names; the file has one of them.
        entry, word = find_task(task), task.rpartition(":")[2]
        if policy.task != word and (entry.environment or find_task(policy.task).task is not entry.task):
            raise CheckpointError(f"{name}: is of the task {policy.task!r}, not {word!r}")
    return policy


def _find(name: str | Path) -> Path:
    """The file of a policy that is named by a path, or by the name of a shipped one."""
    path, text = Path(name), str(name)
    if path.is_file() or "/" in text or path.suffix == ".msgpack":
        return path
    try:
        return Path(asset_path(f"policies/{text}.msgpack"))
    except AssetError:
        shipped = ", ".join(sorted(path.stem for path in Path(asset_path("policies")).glob("*.msgpack")))
        raise CheckpointError(f"{text}: no such file, and no shipped policy has that name: {shipped}") from None


def _from_file(file: checkpoint.Checkpoint) -> Policy:
    header, paths = dict(file.content), file.leaves.keys()
    count = sum(path.startswith("['kernel_") for path in paths)
    names = _names(count, "['recurrent_kernel']" in paths, header.pop("clip"))
    # The path of a dictionary's leaf is ['mean'].
    params = jax.tree.map(lambda name: jnp.asarray(file.leaves[f"['{name}']"]), names)
    layout = tuple(LayoutEntry(*entry) for entry in header.pop("observation_layout"))
    return Policy(task=file.task, observation_layout=layout, params=params, **header)


def _names(layers: int, memory: bool, clip: float) -> PolicyParams:
    """The names of a file's arrays in place of the arrays."""
    named: Any = Layer
    layer = lambda kind, index="": named(f"{kind}kernel{index}", f"{kind}bias{index}")  # noqa: E731
    unit = GRU(layer("input_"), layer("recurrent_")) if memory else None
    normalizer = Normalizer(cast(Any, "mean"), cast(Any, "std"), clip)
    return PolicyParams(tuple(layer("", f"_{i}") for i in range(layers)), normalizer, unit)
