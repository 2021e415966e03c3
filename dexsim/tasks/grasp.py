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
from dexsim.config import check_ranges, setting, validate
from dexsim.env import EnvConfig, Moment, Start
from dexsim.errors import ConfigError
from dexsim.hand import Hand, flexion_joints
from dexsim.objects import ObjectParams, plain_inertia, sample_object
from dexsim.pytree import pytree_dataclass
from dexsim.tasks.grasp_report import summarize
from dexsim.tasks.grasp_start import make_pool
from dexsim.tasks.terms import action_rate, joint_speed, mean_where, random_push

COMMANDS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""The commands of an evaluation."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspReward:
    """Weights and widths of the reward terms, per control tick."""

    force: float = setting(2.0, unit="1", low=0.0, high=1000.0)
    """R_force: each touching finger's force against its target."""
    torque: float = setting(0.2, unit="1", low=0.0, high=1000.0)
    """R_torque: each touching finger's root-joint torque against its target."""
    alive: float = setting(0.5, unit="1", low=0.0, high=1000.0)
    """Each tick that the object is held."""
    spread: float = setting(-0.5, unit="1/rad^2", low=-1000.0, high=0.0)
    """R_diff: variance of the four inner fingers' first joint angles."""
    outer: float = setting(-0.05, unit="1/rad", low=-1000.0, high=0.0)
    """R_outer: distance of the four fingers' joints from their centre posture."""
    action: float = setting(-0.02, unit="1", low=-1000.0, high=0.0)
    """R_action: squared change of the action."""
    velocity: float = setting(-0.002, unit="s^2/rad^2", low=-1000.0, high=0.0)
    """R_vel: squared joint velocity."""
    drop: float = setting(-20.0, unit="1", low=-10000.0, high=0.0)
    """Once, when the object is lost."""
    sigma: float = setting(0.10, unit="1", low=0.001, high=10.0)
    """Width of the Gaussians, on quantities over their maxima (the paper's value)."""
    tail_sigma: float = setting(0.40, unit="1", low=0.001, high=10.0)
    """Width of the wide Gaussian that carries a gradient far from the target."""
    tail: float = setting(0.4, unit="1", low=0.0, high=1.0)
    """Share of the wide Gaussian."""
    overload: float = setting(0.0, unit="1", low=-1000.0, high=0.0)
    """What the four fingers press beyond `margin` above their target, over `max_force`. The Gaussians are flat there:
    a finger that bears an object nearly alone gains nothing by letting go a little."""
    margin: float = setting(1.5, unit="N", low=0.0, high=100.0)
    """Force above the target that `overload` leaves alone."""
    thumb: str = setting("loose", choices=("loose", "track", "binary"))
    """Thumb: it opposes all other fingers, so a balanced grasp needs more of it than of each of
    them. "loose": only the wide Gaussian; "track": like the fingers; "binary": the paper's, any
    force within the bounds."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspConfig(EnvConfig):
    """The grasp task."""

    episode_seconds: float = setting(6.0, unit="s", low=0.2, high=3600.0)
    """Time limit of a training episode. Short, for objects are lost while they are caught, and longer than 3 s, from
    where forces count: at 4 s the force follows the command less well."""
    evaluation_seconds: float = setting(8.0, unit="s", low=0.2, high=3600.0)
    """Length of an evaluation episode: an object must be held this long."""
    finger_force: tuple[float, float] = setting((2.0, 7.0), unit="N", low=0.05, high=40.0)
    """Target force of a touching finger at command 0 and 1."""
    max_force: float = setting(10.0, unit="N", low=0.5, high=200.0)
    """Calibrated maximum that forces are normalised by."""
    force_per_torque: float = setting(19.0, unit="N/Nm", low=1.0, high=200.0)
    """Finger force per root-joint torque; ties the torque target to the force target."""
    command_change: float = setting(0.005, unit="1", low=0.0, high=1.0)
    """Probability per tick that the command is drawn anew within an episode."""
    push_probability: float = setting(0.015, unit="1", low=0.0, high=1.0)
    """Probability per tick of a push on the object."""
    push_speed: float = setting(0.3, unit="m/s", low=0.0, high=5.0)
    """Largest change of the object's speed by a push."""
    drop_distance: float = setting(0.12, unit="m", low=0.02, high=1.0)
    """The object is lost when its centre is farther than this from the grasp centre."""
    posture: tuple[float, ...] = setting(
        (1.45, 0.15, 0.25, 0.0, 1.1, 0.8, 1.1, 0.8, 1.1, 0.8, 1.1, 0.8), unit="rad", low=-3.2, high=3.2
    )
    """Joint angles that episodes start near."""
    posture_noise: float = setting(0.12, unit="rad", low=0.0, high=1.0)
    """Largest deviation from them."""
    curl: tuple[float, float] = setting((-0.3, 0.1), unit="rad", low=-3.0, high=3.0)
    """Added to all joints of the four fingers alike: how far closed they start."""
    release_gap: tuple[float, float] = setting((0.001, 0.009), unit="m", low=0.0, high=0.1)
    """Gap between palm and object at release."""
    release_speed: tuple[float, float] = setting((0.0, 0.1), unit="m/s", low=0.0, high=3.0)
    """Speed of the object away from the palm at release."""
    release_drift: float = setting(0.05, unit="m/s", low=0.0, high=3.0)
    """Largest speed along the palm, in each direction, at release."""
    release_spin: float = setting(1.0, unit="rad/s", low=0.0, high=30.0)
    """Largest spin about each of the object's axes at release."""
    place_noise: float = setting(0.012, unit="m", low=0.0, high=0.1)
    """Largest shift of the object along the palm, in each direction."""
    turn_noise: tuple[float, float] = setting((0.6, 0.3), unit="rad", low=0.0, high=3.2)
    """Largest turn of an object about the palm's normal, and how far askew it lies; its roll is free."""
    reward: GraspReward = setting(GraspReward())
    """Reward weights."""

    def __post_init__(self):
        validate(self)
        check_ranges(self, "finger_force", "curl", "release_gap", "release_speed")


@pytree_dataclass
class Goal:
    """What the policy is asked for."""

    command: jax.Array  # [] in [0, 1]
    fixed: jax.Array  # [] bool, the command never changes (evaluation)


# --- reward terms: small pure functions ------------------------------------------------------


def target_force(command: jax.Array, span: tuple[float, float]) -> jax.Array:
    """Force [] N that each touching finger should press with."""
    return span[0] + command * (span[1] - span[0])


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
    """R_diff: variance of the inner fingers' first joint angles."""
    return jnp.var(first_joints)


def posture_distance(joints: jax.Array, centre: jax.Array) -> jax.Array:
    """R_outer: Euclidean distance from the centre posture."""
    return jnp.sqrt(jnp.sum((joints - centre) ** 2) + 1e-12)


class Grasp:
    """The rules of the task, for `dexsim.env.Env`."""

    name = "grasp"
    evaluation = "series"
    fields = {"actor": observation.GRASP, "critic": observation.GRASP}
    gravity = (9.81, 0.0, 0.0)  # upside down: the palm's normal points to the ground
    reference = (0.055, -0.005, 0.090)  # m, between palm and half-closed fingers

    def __init__(self, config: GraspConfig, hand: Hand):
        if len(config.posture) != hand.num_joints:
            raise ConfigError(
                f"GraspConfig.posture has {len(config.posture)} angles, the hand {hand.num_joints} joints"
            )
        self.config, self.hand = config, hand
        self.slots, self.largest = config.objects.slots, config.objects.largest
        self.object_ranges = tuple(f"objects.{name}" for name in config.objects.ranges)
        self._roots = hand.root_joint
        self._max_torque = jnp.asarray(hand.torque_limit[hand.root_joint])
        self._finger_joints = flexion_joints(hand, range(1, hand.num_fingers))
        self._centre = jnp.asarray((hand.joint_lower + hand.joint_upper) / 2)
        period = config.physics.control_period
        self.episode_ticks = max(round(config.episode_seconds / period), 1)
        self.evaluation_ticks = max(round(config.evaluation_seconds / period), 1)

    def make_pool(self, key: jax.Array) -> Start:
        """Objects released below the palm, between the half-closed fingers."""
        return make_pool(key, self.hand, self.config, self.reference)

    def draw_object(self, key: jax.Array, config: GraspConfig, shape_index: jax.Array | None = None) -> ObjectParams:
        """One object of `config`, of a random or the given kind (index into SHAPES)."""
        return sample_object(key, config.objects, shape_index)

    def plain_inertia(self, target: ObjectParams) -> jax.Array:
        """Inertia [3] m^2 of the object as a uniform solid of 1 kg."""
        return plain_inertia(target, self.config.objects)

    def begin(self, key: jax.Array, start: Start) -> Goal:
        del start
        return Goal(jax.random.uniform(key), jnp.zeros((), bool))

    def update(self, key: jax.Array, goal: Goal, moment: Moment) -> Goal:
        del moment
        when, what = jax.random.split(key)
        change = jax.random.bernoulli(when, self.config.command_change) & ~goal.fixed
        return dataclasses.replace(goal, command=jnp.where(change, jax.random.uniform(what), goal.command))

    def goal_readings(self, goal: Goal) -> tuple[jax.Array, jax.Array]:
        """Command and target orientation, as `Readings` carry them."""
        return goal.command, jnp.array([1.0, 0.0, 0.0, 0.0])

    def target_force(self, goal: Goal) -> jax.Array:
        return target_force(goal.command, self.config.finger_force)

    def push(self, key: jax.Array, target: ObjectParams) -> jax.Array:
        """Force [3] N that changes the object's velocity by up to `push_speed` in one tick."""
        return random_push(
            key,
            target.mass,
            probability=self.config.push_probability,
            speed=self.config.push_speed,
            period=self.config.physics.control_period,
        )

    def dropped(self, goal: Goal, moment: Moment) -> jax.Array:
        del goal
        away = jnp.linalg.norm(moment.object_position - jnp.asarray(self.reference))
        return away > self.config.drop_distance

    def reward(self, goal: Goal, moment: Moment, dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The reward of a tick and its terms; zero for all but the penalties once dropped."""
        config, weights = self.config, self.config.reward
        force = jnp.linalg.norm(moment.finger_force, axis=-1)
        contact = force > 0.01
        wanted = self.target_force(goal)
        torque = moment.joint_torque[self._roots]
        held = 1.0 - dropped
        fingers = self._finger_joints
        terms = {
            "force": held
            * weights.force
            * command_reward(force, wanted, contact, (0.01, 200.0), config.max_force, weights),
            "torque": held
            * weights.torque
            * command_reward(
                torque / self._max_torque,
                wanted / config.force_per_torque / self._max_torque,
                contact & (torque >= 0.01),
                (0.0, 1.0),
                1.0,
                weights,
            ),
            "alive": held * weights.alive,
            "overload": held * weights.overload * overload(force[1:], wanted + weights.margin) / config.max_force,
            "spread": weights.spread * joint_spread(moment.joint_position[self._roots[1:]]),
            "outer": weights.outer * posture_distance(moment.joint_position[fingers], self._centre[fingers]),
            "action": weights.action * action_rate(moment.action, moment.last_action),
            "velocity": weights.velocity * joint_speed(moment.joint_velocity),
            "drop": weights.drop * dropped,
        }
        reward = sum(terms.values())
        # The command speaks to the four fingers; the thumb balances them.
        mean_force = mean_where(contact[1:], force[1:])
        pressing = jnp.sum(moment.touch.force, -1)
        return reward, {
            **{f"reward/{name}": value for name, value in terms.items()},
            "success": held,
            "command": goal.command,
            "force_error": jnp.abs(mean_force - wanted),
            "finger_force": mean_force,
            "finger_pressing": mean_where(contact[1:], pressing[1:]),
            "total_force": jnp.sum(force),
            "taxel_force": jnp.sum(pressing),
            "skin_force": jnp.sum(moment.touch.skin_force),
            "thumb_force": force[0],
            "touching": jnp.sum(contact).astype(jnp.float32),
            "joint_speed": jnp.mean(jnp.abs(moment.joint_velocity)),
            "action_rate": jnp.mean(jnp.abs(moment.action - moment.last_action)),
            **{f"force/{i}": force[i] for i in range(force.shape[0])},
        }

    # --- evaluation ------------------------------------------------------------------------

    def evaluation_plan(self, count: int, shape_index: np.ndarray) -> tuple[np.ndarray, Goal]:
        """Pool rows [count] and goals: five commands for each shape, evenly, never changing."""
        rows = np.arange(count)
        command = (rows % len(COMMANDS))[:, None] == np.arange(len(COMMANDS))
        present = np.unique(shape_index)
        wanted = present[(rows // len(COMMANDS)) % len(present)]
        turn = rows // (len(COMMANDS) * len(present))
        index = np.empty(count, int)
        for shape in present:
            of_shape = np.flatnonzero(shape_index == shape)
            mine = wanted == shape
            index[mine] = of_shape[(turn[mine] * len(COMMANDS) + rows[mine] % len(COMMANDS)) % len(of_shape)]
        goal = Goal(jnp.asarray(command @ np.asarray(COMMANDS), jnp.float32), jnp.ones(count, bool))
        return index, goal

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray, control_period: float) -> dict:
        """The report of an evaluation; see `grasp_report`."""
        return summarize(metrics, alive, control_period, self.config.finger_force)
