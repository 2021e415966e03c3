"""Grasp: catch an object that drops from the inverted palm and hold it at a commanded force.

The hand is fixed upside down, so gravity is the palm's +x. Rewards follow the paper (section
Task Setup), each a small pure function, with two changes that experiments asked for: the force
target is per touching finger, and each Gaussian has a wide one beside it, so that a policy far
from its target feels a gradient.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from dexsim import observation
from dexsim.control import commanded_force, target_force
from dexsim.core import compilation
from dexsim.core.pytree import pytree_dataclass
from dexsim.core.ranges import uniforms
from dexsim.env.state import Start
from dexsim.env.task import GroundTruth, Task
from dexsim.errors import ConfigError
from dexsim.geometry import rotations
from dexsim.geometry.rotations import length
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import flexion_joints, hinge_angles
from dexsim.objects.params import ObjectParams, extent
from dexsim.tasks.grasp.config import GraspConfig, GraspReward
from dexsim.tasks.grasp.report import summarize
from dexsim.tasks.shared import action_rate, clearance, close_fingers, joint_speed, palm_height, random_push

COMMANDS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""The commands of an evaluation."""
_CONTACT = 0.01  # N, force from which a finger counts as touching
_TAIL_SIGMA = 0.40  # width of the wide Gaussian, in units of the maximum force or torque
_FORCE_PER_TORQUE = 19.0  # N/Nm, of the root joint; ties the torque target to the force target
_MARGIN = 1.0  # N above the target that is no overload
_COMMAND_CHANGE = 0.005  # probability per tick that a new command is sampled within an episode
_OVERLAP = 0.001  # m, hand and object may start this deep in each other
# Largest deviations of start states: of a joint from the posture, rad; of the object along the palm, in each direction,
# m; its turn about the palm's normal and its tilt, rad. Its roll is free.
_POSTURE_NOISE, _PLACE_NOISE, _TURN_NOISE, _TILT_NOISE = 0.12, 0.012, 0.6, 0.3


@pytree_dataclass
class GraspGoal:
    """What the policy is asked for."""

    command: jax.Array  # [] in [0, 1]
    fixed: jax.Array  # [] bool, the command never changes (evaluation)
    delay: jax.Array  # [] s until the object is let go


def tailed_gaussian(error: jax.Array, sigma: float, tail: float) -> jax.Array:
    """(1 - tail) exp(-e^2 / 2 sigma^2) + tail exp(-e^2 / 2 0.4^2)."""
    narrow = jnp.exp(-0.5 * (error / sigma) ** 2)
    wide = jnp.exp(-0.5 * (error / _TAIL_SIGMA) ** 2)
    return (1 - tail) * narrow + tail * wide


def command_reward(
    value: jax.Array, goal: jax.Array, contact: jax.Array, bounds: tuple, scale: float, weights: GraspReward
) -> jax.Array:
    """Sum over touching fingers of the match between `value` [F] and `goal`, over F.

    R_force and R_torque of the paper: zero outside `bounds` and without contact. The first
    finger is the thumb; see `GraspReward.thumb`.
    """
    valid, error = contact & (value >= bounds[0]) & (value <= bounds[1]), (value - goal) / scale
    match = tailed_gaussian(error, weights.sigma, weights.tail)
    thumb = tailed_gaussian(error, 1.0, 1.0)[0] if weights.thumb == "loose" else 1.0
    return jnp.sum(jnp.where(valid, match.at[0].set(thumb), 0.0)) / value.shape[0]


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

    config: GraspConfig
    finger_force: tuple[float, float]

    def __init__(self, config: GraspConfig, hand: Hand):
        if not hand.grasp_centre or not (config.posture or hand.grasp_posture):
            raise ConfigError(f"hand {hand.name!r} has no grasp: its TOML needs [grasp] with posture and centre")
        force = config.finger_force or hand.grasp_force
        config = dataclasses.replace(config, posture=config.posture or hand.grasp_posture, finger_force=force)
        x, y, z = hand.grasp_centre
        self.config, self.hand, self.reference = config, hand, (x, y, z)
        self.posture, self.finger_force = config.posture, force
        self.slots, self.largest = config.objects.slots, config.objects.largest
        self.drawn_shapes = ("mesh",) if config.objects.mesh else config.objects.shapes  # of `shape_names`, in the pool
        self._max_torque = jnp.asarray(hand.torque_limit[hand.root_joint])
        self._finger_joints = flexion_joints(hand, range(1, hand.num_fingers))
        self._centre = jnp.asarray((hand.joint_lower + hand.joint_upper) / 2)
        period = config.physics.control_period
        self.episode_ticks = max(round(config.episode_seconds / period), 1)
        self.evaluation_ticks = max(round(config.evaluation_seconds / period), 1)

    def make_pool(self, key: jax.Array) -> Start:
        """Objects released below the palm, between the half-closed fingers, where the hand is clear of them.

        Every shape gets an equal share of the pool: large boxes overlap far more often than small spheres, and a plain
        rejection would all but leave them out of training.

        Raises:
          ConfigError: next to no candidate of a shape is clear, so the ranges do not fit the hand.
        """
        config, shapes = self.config, self.drawn_shapes
        share = -(-config.pool_size // len(shapes))
        chunk = max(min(2 * share, 4096), 64)

        @functools.partial(compilation.jit, once=True)
        def sample(key: jax.Array, shape_index: jax.Array) -> tuple[Start, jax.Array]:
            return jax.vmap(lambda k: self._candidate(k, shape_index))(jax.random.split(key, chunk))

        pools = []
        for name in shapes:
            clear_starts, count, index = [], 0, self.shape_names.index(name)
            for trial in range(40):
                shape_key = jax.random.fold_in(jax.random.fold_in(key, index), trial)
                starts, clear = sample(shape_key, jnp.int32(index))
                rows = np.flatnonzero(np.asarray(clear))[: share - count]
                clear_starts.append(jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], starts))
                count += rows.size
                if count == share:
                    break
            if count < share:
                raise ConfigError(
                    f"{type(config).__name__}: only {count} of {share} start states of "
                    f"shape {name!r} are free of overlap; open the posture or shrink it"
                )
            pools.append(jax.tree.map(lambda *parts: np.concatenate(parts), *clear_starts))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[: config.pool_size], *pools)

    def _candidate(self, key: jax.Array, shape_index: jax.Array) -> tuple[Start, jax.Array]:
        """A start state with an object of this shape, and whether [] the hand is clear of it."""
        hand, config, reference = self.hand, self.config, self.reference
        keys, sides = jax.random.split(key, 7), (-1.0, 1.0)  # the sixth is free
        object = self.sample_object(keys[0], config, shape_index)
        spans = sides, sides, config.release_gap, sides, config.curl
        drawn = uniforms(keys[np.array([1, 2, 3, 4, 6])], spans, None, (max(hand.num_joints, 3),))
        noise = _POSTURE_NOISE * drawn[0, : hand.num_joints]
        (roll, turn, askew), shift = drawn[1, :3], _PLACE_NOISE * drawn[3, :2]
        gap, curl = drawn[2, 0], drawn[4, 0]
        joints = jnp.asarray(config.posture) + noise + curl * close_fingers(hand, range(1, hand.num_fingers))
        joints = jnp.clip(joints, hand.joint_lower, hand.joint_upper)

        # Long objects lie across the fingers (their z along the palm's y, either way), turned about the palm's normal
        # and a little askew; the roll about their own axis is free.
        quat = rotations.axis_angle_to_quat(jnp.array([0.0, 0.0, 1.0]), roll * jnp.pi)
        for axis, angle in (
            ((1.0, 0.0, 0.0), jnp.where(drawn[3, 2] < 0.0, -0.5, 0.5) * jnp.pi),
            ((0.0, 0.0, 1.0), _TILT_NOISE * askew),
            ((1.0, 0.0, 0.0), _TURN_NOISE * turn),
        ):
            quat = rotations.quat_multiply(rotations.axis_angle_to_quat(jnp.array(axis), jnp.asarray(angle)), quat)
        matrix = rotations.quat_to_matrix(quat)
        # How far the object reaches [6] along the palm's axes, in both directions. Its middle, not its origin, is put
        # where the fingers meet: that of a composition is in its body, beside which the neck juts out.
        ways = jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
        reach = jax.vmap(lambda way: extent(object, rotations.rotate_inverse(matrix, way)))(ways)
        middle = (reach[1:3] - reach[4:]) / 2
        position = jnp.stack([palm_height(hand) + gap + reach[3], *(jnp.asarray(reference[1:]) + shift - middle)])
        qpos = jnp.concatenate([hinge_angles(hand, joints), position, quat])
        start = Start(qpos=qpos, qvel=jnp.zeros(hand.num_hinges + 6), object=object)
        return start, clearance(hand, joints, object.shape(), position, matrix) > -_OVERLAP

    def begin(self, key: jax.Array, start: Start) -> GraspGoal:
        low, high = self.config.release_delay
        delay = jax.random.uniform(jax.random.fold_in(key, 1), minval=low, maxval=high)
        return GraspGoal(jax.random.uniform(key), jnp.zeros((), bool), delay)

    def update(self, key: jax.Array, goal: GraspGoal, truth: GroundTruth) -> GraspGoal:
        when, what = jax.random.split(key)
        change = jax.random.bernoulli(when, _COMMAND_CHANGE) & ~goal.fixed
        return dataclasses.replace(
            goal,
            command=jnp.where(change, jax.random.uniform(what), goal.command),
            delay=goal.delay - self.config.physics.control_period,
        )

    def held(self, goal: GraspGoal) -> jax.Array:
        return goal.delay > 0

    def goal_readings(self, goal: GraspGoal) -> tuple[jax.Array, jax.Array]:
        return goal.command, jnp.array([1.0, 0.0, 0.0, 0.0])

    def target_force(self, goal: GraspGoal) -> jax.Array:
        return target_force(goal.command, self.finger_force)

    def push(self, key: jax.Array, object: ObjectParams) -> jax.Array:
        return random_push(key, object.mass, self.config)

    def dropped(self, goal: GraspGoal, truth: GroundTruth) -> jax.Array:
        away = length(truth.object_position - jnp.asarray(self.reference))
        return away > self.config.drop_distance

    def reward(self, goal: GraspGoal, truth: GroundTruth, dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The reward of a tick and its terms; zero for all but the penalties once dropped."""
        config, weights = self.config, self.config.reward
        force = length(truth.finger_force)
        contact = force > _CONTACT
        target = self.target_force(goal)
        torque = truth.joint_torque[self.hand.root_joint]  # positive closes the finger; `dexsim check-hand` checks it
        fallen = dropped.astype(jnp.float32)
        held = 1.0 - fallen
        fingers, too_much = self._finger_joints, jnp.maximum(force[1:] - (target + _MARGIN), 0.0)
        share, target_share = torque / self._max_torque, target / _FORCE_PER_TORQUE / self._max_torque
        pulling = contact & (torque >= 0.01)
        follows_force = command_reward(force, target, contact, (0.01, 200.0), config.max_force, weights)
        follows_torque = command_reward(share, target_share, pulling, (0.0, 1.0), 1.0, weights)
        terms = {
            "force": held * weights.force * follows_force,
            "torque": held * weights.torque * follows_torque,
            "alive": held * weights.alive,
            "overload": held * weights.overload * jnp.sum(too_much) / config.max_force,
            "spread": weights.spread * joint_spread(truth.joint_position[self.hand.root_joint[1:]]),
            "outer": weights.outer * posture_distance(truth.joint_position[fingers], self._centre[fingers]),
            "action": weights.action * action_rate(truth.action, truth.last_action),
            "velocity": weights.velocity * joint_speed(truth.joint_velocity),
            "drop": weights.drop * fallen,
        }
        parts = {"force": force, "normal": truth.normal_force, "taxels": jnp.sum(truth.touch.force, -1)}
        commanded = {f"finger_{name}": commanded_force(part, contact) for name, part in parts.items()}
        pull = jnp.where(contact, jnp.abs(torque), 0.0)
        return jnp.asarray(sum(terms.values())), {
            **{f"reward/{name}": value for name, value in terms.items()},
            "success": held,
            "command": goal.command,
            "force_error": jnp.abs(commanded["finger_force"] - target),
            **commanded,
            "total_force": jnp.sum(force),
            "total_torque": jnp.sum(pull / self._max_torque),
            "touching": jnp.sum(contact).astype(jnp.float32),
            "joint_speed": jnp.mean(jnp.abs(truth.joint_velocity)),
            "action_rate": jnp.mean(jnp.abs(truth.action - truth.last_action)),
        }

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
        commands = jnp.asarray(command @ np.asarray(COMMANDS), jnp.float32)
        delay = np.random.default_rng(0).uniform(*self.config.release_delay, count)
        return index, GraspGoal(commands, jnp.ones(count, bool), jnp.asarray(delay, jnp.float32))

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray, control_period: float) -> dict:
        """The report of an evaluation; see `dexsim.tasks.grasp.report`."""
        return summarize(metrics, alive, control_period, self.finger_force, self.shape_names)
