"""Grasp: catch an object that drops from the inverted palm and hold it at a commanded force.

The hand is fixed upside down, so gravity is the palm's +x. Rewards follow the paper (section
Task Setup), each a small pure function, with two changes that experiments asked for: the force
target is per touching finger, and each Gaussian has a wide one beside it, so that a policy far
from its target feels a gradient.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dexsim import observation
from dexsim.control import closing
from dexsim.core.errors import ConfigError
from dexsim.core.pytree import pytree_dataclass
from dexsim.env.state import Start
from dexsim.env.task import GroundTruth, Task
from dexsim.force_loop import commanded_force, target_force
from dexsim.geometry.vectors import length
from dexsim.hand.kinematics import Hand, flexion_joints
from dexsim.objects.config import KINDS
from dexsim.objects.params import ObjectParams
from dexsim.tasks.grasp.config import GraspConfig, GraspReward
from dexsim.tasks.grasp.report import summarize
from dexsim.tasks.grasp.start import make_pool
from dexsim.tasks.terms import action_rate, joint_speed, random_push

COMMANDS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""The commands of an evaluation."""
_CONTACT = 0.01  # N, force from which a finger counts as touching


@pytree_dataclass
class GraspGoal:
    """What the policy is asked for."""

    command: jax.Array  # [] in [0, 1]
    fixed: jax.Array  # [] bool, the command never changes (evaluation)


def tailed_gaussian(error: jax.Array, sigma: float, tail_sigma: float, tail: float) -> jax.Array:
    """(1 - tail) exp(-e^2 / 2 sigma^2) + tail exp(-e^2 / 2 tail_sigma^2)."""
    narrow = jnp.exp(-0.5 * (error / sigma) ** 2)
    wide = jnp.exp(-0.5 * (error / tail_sigma) ** 2)
    return (1 - tail) * narrow + tail * wide


def command_reward(
    value: jax.Array, goal: jax.Array, contact: jax.Array, bounds: tuple, scale: float, weights: GraspReward
) -> jax.Array:
    """Sum over touching fingers of the match between `value` [F] and `goal`, over F.

    R_force and R_torque of the paper: zero outside `bounds` and without contact. The first
    finger is the thumb; see `GraspReward.thumb`.
    """
    valid = contact & (value >= bounds[0]) & (value <= bounds[1])
    match = tailed_gaussian((value - goal) / scale, weights.sigma, weights.tail_sigma, weights.tail)
    if weights.thumb == "binary":
        match = match.at[0].set(1.0)
    elif weights.thumb == "loose":
        loose = tailed_gaussian((value - goal) / scale, 1.0, weights.tail_sigma, 1.0)
        match = match.at[0].set(loose[0])
    return jnp.sum(jnp.where(valid, match, 0.0)) / value.shape[0]


def overload(force: jax.Array, limit: jax.Array) -> jax.Array:
    """Forces [F] N beyond a limit [] N, summed."""
    return jnp.sum(jnp.maximum(force - limit, 0.0))


def joint_spread(first_joints: jax.Array) -> jax.Array:
    """R_diff: variance of the inner fingers' first joint angles; 0 of a hand of one finger, which has none."""
    return jnp.var(first_joints) if first_joints.size else jnp.zeros(())


def posture_distance(joints: jax.Array, centre: jax.Array) -> jax.Array:
    """R_outer: Euclidean distance from the centre posture."""
    return jnp.sqrt(jnp.sum((joints - centre) ** 2) + 1e-12)


class Grasp(Task):
    """The rules of the task, for `dexsim.env.env.Env`."""

    name = "grasp"
    evaluation = "series"
    fields: dict[str, tuple[str, ...]] = {"actor": observation.GRASP, "critic": observation.GRASP}
    gravity = (9.81, 0.0, 0.0)  # upside down: the palm's normal points to the ground
    shape_names = KINDS
    """What `ObjectParams.shape_index` counts."""

    config: GraspConfig

    def __init__(self, config: GraspConfig, hand: Hand):
        if not hand.grasp_centre or not (config.posture or hand.grasp_posture):
            raise ConfigError(f"hand {hand.name!r} has no grasp: its TOML needs [grasp] with posture and centre")
        config = dataclasses.replace(config, posture=config.posture or hand.grasp_posture)
        if len(config.posture) != hand.num_joints:
            raise ConfigError(
                f"GraspConfig.posture has {len(config.posture)} angles, the hand {hand.num_joints} joints"
            )
        x, y, z = hand.grasp_centre
        self.config, self.hand, self.reference = config, hand, (x, y, z)
        self.posture, self.finger_force = config.posture, config.finger_force
        self.slots, self.largest = config.objects.slots, config.objects.largest
        self.object_ranges = tuple(f"objects.{name}" for name in config.objects.ranges)
        self._roots, self._closing = hand.root_joint, closing(hand)
        self._max_torque = jnp.asarray(hand.torque_limit[hand.root_joint])
        self._finger_joints = flexion_joints(hand, range(1, hand.num_fingers))
        self._centre = jnp.asarray((hand.joint_lower + hand.joint_upper) / 2)
        period = config.physics.control_period
        self.episode_ticks = max(round(config.episode_seconds / period), 1)
        self.evaluation_ticks = max(round(config.evaluation_seconds / period), 1)

    def make_pool(self, key: jax.Array) -> Start:
        """Objects released below the palm, between the half-closed fingers."""
        return make_pool(key, self)

    @property
    def drawn_shapes(self) -> tuple[str, ...]:
        """Names, of `shape_names`, of what the pool has."""
        return self.config.objects.kinds

    def begin(self, key: jax.Array, start: Start) -> GraspGoal:
        del start
        return GraspGoal(jax.random.uniform(key), jnp.zeros((), bool))

    def update(self, key: jax.Array, goal: GraspGoal, truth: GroundTruth) -> GraspGoal:
        del truth
        when, what = jax.random.split(key)
        change = jax.random.bernoulli(when, self.config.command_change) & ~goal.fixed
        return dataclasses.replace(goal, command=jnp.where(change, jax.random.uniform(what), goal.command))

    def goal_readings(self, goal: GraspGoal) -> tuple[jax.Array, jax.Array]:
        return goal.command, jnp.array([1.0, 0.0, 0.0, 0.0])

    def target_force(self, goal: GraspGoal) -> jax.Array:
        return target_force(goal.command, self.config.finger_force)

    def push(self, key: jax.Array, object: ObjectParams) -> jax.Array:
        """Force [3] N that changes the object's velocity by up to `push_speed` in one tick."""
        return random_push(
            key,
            object.mass,
            probability=self.config.push_probability,
            speed=self.config.push_speed,
            period=self.config.physics.control_period,
        )

    def dropped(self, goal: GraspGoal, truth: GroundTruth) -> jax.Array:
        del goal
        away = length(truth.object_position - jnp.asarray(self.reference))
        return away > self.config.drop_distance

    def reward(self, goal: GraspGoal, truth: GroundTruth, dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The reward of a tick and its terms; zero for all but the penalties once dropped."""
        config, weights = self.config, self.config.reward
        force = length(truth.finger_force)
        contact = force > _CONTACT
        target = self.target_force(goal)
        torque = truth.joint_torque[self._roots] * self._closing
        fallen = dropped.astype(jnp.float32)
        held = 1.0 - fallen
        fingers = self._finger_joints
        terms = {
            "force": held
            * weights.force
            * command_reward(force, target, contact, (0.01, 200.0), config.max_force, weights),
            "torque": held
            * weights.torque
            * command_reward(
                torque / self._max_torque,
                target / config.force_per_torque / self._max_torque,
                contact & (torque >= 0.01),
                (0.0, 1.0),
                1.0,
                weights,
            ),
            "alive": held * weights.alive,
            "overload": held * weights.overload * overload(force[1:], target + weights.margin) / config.max_force,
            "spread": weights.spread * joint_spread(truth.joint_position[self._roots[1:]]),
            "outer": weights.outer * posture_distance(truth.joint_position[fingers], self._centre[fingers]),
            "action": weights.action * action_rate(truth.action, truth.last_action),
            "velocity": weights.velocity * joint_speed(truth.joint_velocity),
            "drop": weights.drop * fallen,
        }
        metrics = {f"reward/{name}": value for name, value in terms.items()}
        return jnp.asarray(sum(terms.values())), metrics | self._metrics(goal, truth, held)

    def _metrics(self, goal: GraspGoal, truth: GroundTruth, held: jax.Array) -> dict[str, jax.Array]:
        force = length(truth.finger_force)
        contact = force > _CONTACT
        pressing = jnp.sum(truth.touch.force, -1)
        parts = {"force": force, "normal": truth.normal_force, "taxels": pressing}
        commanded = {f"finger_{name}": commanded_force(part, contact) for name, part in parts.items()}
        return {
            "success": held,
            "command": goal.command,
            "force_error": jnp.abs(commanded["finger_force"] - self.target_force(goal)),
            **commanded,
            "total_force": jnp.sum(force),
            "total_torque": jnp.sum(
                jnp.where(contact, jnp.abs(truth.joint_torque[self._roots]), 0.0) / self._max_torque
            ),
            "taxel_force": jnp.sum(pressing),
            "skin_force": jnp.sum(truth.touch.skin_force),
            "thumb_force": force[0],
            "touching": jnp.sum(contact).astype(jnp.float32),
            "joint_speed": jnp.mean(jnp.abs(truth.joint_velocity)),
            "action_rate": jnp.mean(jnp.abs(truth.action - truth.last_action)),
            **{f"force/{i}": force[i] for i in range(force.shape[0])},
        }

    # --- evaluation ------------------------------------------------------------------------

    def evaluation_plan(self, count: int, shape_index: np.ndarray) -> tuple[np.ndarray, GraspGoal]:
        """Pool rows [count] and goals: five commands for each shape, evenly, never changing."""
        rows = np.arange(count)
        command = (rows % len(COMMANDS))[:, None] == np.arange(len(COMMANDS))
        present = np.unique(shape_index)
        target = present[(rows // len(COMMANDS)) % len(present)]
        turn = rows // (len(COMMANDS) * len(present))
        index = np.empty(count, int)
        for shape in present:
            of_shape = np.flatnonzero(shape_index == shape)
            mine = target == shape
            index[mine] = of_shape[(turn[mine] * len(COMMANDS) + rows[mine] % len(COMMANDS)) % len(of_shape)]
        goal = GraspGoal(jnp.asarray(command @ np.asarray(COMMANDS), jnp.float32), jnp.ones(count, bool))
        return index, goal

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray, control_period: float) -> dict:
        """The report of an evaluation; see `dexsim.tasks.grasp.report`."""
        config = self.config
        return summarize(metrics, alive, control_period, config.finger_force, self.shape_names)
