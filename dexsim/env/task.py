"""What a task is: the truth that it sees, and the rules that it adds.

A task of one's own is a subclass of `Task`, made from a configuration and a hand, and registered by `dexsim.register`.
SI units; positions, velocities and forces are in the palm frame, quaternions (w, x, y, z). Shapes: J joints, F fingers,
N taxels a finger, K primitives of an object, P start states.
"""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import leaf, pytree_dataclass
from dexsim.env.config import EnvConfig
from dexsim.env.state import Start
from dexsim.errors import ConfigError
from dexsim.hand.kinematics import HandPose
from dexsim.objects import params
from dexsim.objects.config import KINDS, PROPERTY_RANGES
from dexsim.objects.params import ObjectParams
from dexsim.observation import FIELDS
from dexsim.task_spec import TurnSpec
from dexsim.touch.taxel_force import Touch


@pytree_dataclass
class GroundTruth:
    """The truth after a tick: what reward, termination and the critic may look at."""

    object: ObjectParams = leaf("the episode's object: size, mass, friction")
    joint_position: jax.Array = leaf("[J] rad")
    joint_velocity: jax.Array = leaf("[J] rad/s")
    joint_torque: jax.Array = leaf("[J] Nm, of the motors, before friction")
    torque_limited: jax.Array = leaf("[J] bool, whether the motor is at its torque limit")
    pose: HandPose = leaf("poses of all links and finger tips")
    finger_force: jax.Array = leaf("[F, 3] N, of the object on the finger tips")
    normal_force: jax.Array = leaf("[F] N of it, into the skin; 0 where the finger touches with no taxel")
    touch: Touch = leaf("[F, N] depth and force of every taxel")
    tip_stiffness: jax.Array = leaf("[F] 1, stiffness of the fingertips' contacts over nominal, in the next tick")
    object_position: jax.Array = leaf("[3] m")
    object_quat: jax.Array = leaf("[4] (w, x, y, z)")
    object_velocity: jax.Array = leaf("[3] m/s")
    object_spin: jax.Array = leaf("[3] rad/s")
    action: jax.Array = leaf("[J] in [-1, 1], that led here")
    last_action: jax.Array = leaf("[J], the one before")


class Task(abc.ABC):
    """What a task adds to a hand and an object.

    Methods are pure and written for one environment: JAX traces and vmaps them, but for `make_pool`,
    `evaluation_plan` and `summarize`, which run once, on the host. `Goal` stands for the task's own pytree of arrays,
    which an episode carries from tick to tick. A task sets the attributes without a value here, and overrides the
    abstract methods at least.

    Attributes:
      name: of the task.
      fields: names of the observation's fields (`dexsim.observation.FIELDS`), for "actor" and for "critic".
      gravity: [3] m/s^2; it says how the hand is mounted.
      reference: [3] m, where the object belongs; readings show it for coordinates that are not measured.
      episode_ticks: time limit of a training episode, control ticks.
      slots: [K] kinds of the primitives that objects consist of: "box", "capsule", "cylinder".
      largest: [K, 3] m, upper bound of each primitive's size.
      evaluation_ticks: length of an evaluation episode, control ticks.
      evaluation: what `summarize` is given: "series" or "totals".
      config: an `EnvConfig` or a subclass with settings of the task's own.
      object_ranges: ranges of physical properties, as "objects.mass", that are drawn anew at every episode start; the
        others, and sizes, stay as the pool has them.
      shape_names: what `ObjectParams.shape_index` counts.
      posture: [J] rad, joint angles that an episode on a hand starts from; empty: from wherever the hand is.
      turn: goals that follow one another about an axis, for a task that has them; see `turns`.
      finger_force: [2] N, force of a touching finger at the commands 0 and 1, for a task with a force command.
    """

    name: str
    fields: dict[str, tuple[str, ...]]
    gravity: tuple[float, float, float]
    reference: tuple[float, float, float]
    episode_ticks: int
    slots: tuple[str, ...]
    largest: np.ndarray
    evaluation_ticks: int
    evaluation: str
    config: EnvConfig
    object_ranges: tuple[str, ...] = tuple(f"objects.{name}" for name in PROPERTY_RANGES)
    shape_names: tuple[str, ...] = KINDS
    posture: tuple[float, ...] = ()
    turn: TurnSpec | None = None
    finger_force: tuple[float, float] | None = None

    @abc.abstractmethod
    def make_pool(self, key: jax.Array) -> Start:
        """Start states [P, ...] of which every episode begins with one; made once for training, and once for each
        evaluation, with keys of their own.

        Raises:
          ConfigError: the configuration leaves too few of them.
        """

    def sample_object(self, key: jax.Array, config: Any, shape_index: jax.Array | None = None) -> ObjectParams:
        """One object.

        Args:
          config: a configuration of this task, whose ranges may be others than `self.config`'s.
          shape_index: [] int32 into `dexsim.objects.config.SHAPES`; None for any that the task has.
        """
        return params.sample_object(key, config.objects, shape_index)

    def unit_inertia(self, object: ObjectParams) -> jax.Array:
        """Inertia [3] m^2 of the object as a uniform solid of 1 kg, which a narrowed range of inertia is about."""
        return params.unit_inertia(object, self.config.objects)

    @abc.abstractmethod
    def begin(self, key: jax.Array, start: Start) -> Any:
        """The Goal of a new episode that begins with `start`."""

    @abc.abstractmethod
    def update(self, key: jax.Array, goal: Any, truth: GroundTruth) -> Any:
        """The Goal after a tick; of the same structure, shapes and types."""

    def goal_readings(self, goal: Any) -> tuple[jax.Array, jax.Array]:
        """What readings carry of the goal: grip command [] in [0, 1], and the object's goal orientation [4]."""
        return jnp.zeros(()), jnp.array([1.0, 0.0, 0.0, 0.0])

    def push(self, key: jax.Array, object: ObjectParams) -> jax.Array:
        """Force [3] N on the object's centre of mass during the next tick; zeros for none."""
        return jnp.zeros(3)

    def held(self, goal: Any) -> jax.Array | None:
        """Whether [] bool somebody holds the object where it is during the next tick; None for never."""
        return None

    @abc.abstractmethod
    def dropped(self, goal: Any, truth: GroundTruth) -> jax.Array:
        """Whether [] bool the episode has failed and ends here. `goal` is the one after the tick."""

    @abc.abstractmethod
    def reward(self, goal: Any, truth: GroundTruth, dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The reward [] of a tick, and metrics [] by name.

        Names must be the same in every tick; "return", "length", "shape", "non_finite" and "torque_limited" (whether a
        joint is at its torque limit) are the environment's.

        Args:
          goal: the one that held during the tick.
          truth: after the tick.
          dropped: [] bool, whether the episode ends by failure: `dropped`, or physics that diverged.
        """

    def target_force(self, goal: Any) -> jax.Array:
        """Force [] N that each finger is asked for; it is shown in pictures only. Zero for none."""
        return jnp.zeros(())

    def turns(self, goal: Any) -> jax.Array | None:
        """Goals [] int32 reached since the episode began, for pictures of a task with `turn`."""
        return None

    @abc.abstractmethod
    def evaluation_plan(self, count: int, shape_index: np.ndarray) -> tuple[np.ndarray, Any]:
        """The episodes of an evaluation.

        Args:
          shape_index: [P] of the objects in the evaluation's pool.

        Returns:
          Rows [count] of that pool, and Goals [count, ...]. Rows repeat only where there are too few
          of them, or where episodes are meant to share a start.
        """

    @abc.abstractmethod
    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray, control_period: float) -> dict[str, Any]:
        """An evaluation's report: plain data that JSON can hold. "headline" maps names to what is
        printed, figures that a hand that does nothing fails: numbers, or dictionaries with "value", "low" and "high",
        and a "unit" to print; "%" is that of a share.

        Args:
          metrics: the environment's, by name. For "series" [T, N], zero once an episode has ended; for "totals" [N],
            of each episode's last tick.
          alive: for "series" [T, N] bool, whether an episode had not ended; for "totals" [N], the ticks it lived.
          control_period: s.
        """


def check_task(task: Any) -> Task:
    """`task`, if it is a `Task` with all attributes, and observes fields that exist.

    Raises:
      ConfigError: it is not.
    """
    if not isinstance(task, Task):
        raise ConfigError(f"{type(task).__name__}: expected a subclass of dexsim.Task")
    if missing := [name for name in Task.__annotations__ if not hasattr(task, name)]:
        raise ConfigError(
            f"task {type(task).__name__}: missing attributes: {', '.join(missing)}; see help(dexsim.Task)"
        )
    for group in ("actor", "critic"):
        if not task.fields.get(group):
            raise ConfigError(f"task {task.name!r}: fields[{group!r}] is missing or empty")
        if unknown := [name for name in task.fields[group] if name not in FIELDS]:
            raise ConfigError(
                f"task {task.name!r}: no observation field {unknown[0]!r}: choose from {', '.join(FIELDS)}"
            )
    return task


def reward_of(task: Task, goal: Any, truth: GroundTruth, dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The task's reward [] as a float, and its metrics; raises ConfigError where it returns something else."""
    reward, metrics = task.reward(goal, truth, dropped)
    for name, value in {"reward": reward, **metrics}.items():
        if jnp.shape(value) != ():
            raise ConfigError(f"task {task.name!r}: {name} must be a scalar; got shape {jnp.shape(value)}")
    # The state begins with a float, and a compiled loop carries it.
    return jnp.asarray(reward, float), metrics
