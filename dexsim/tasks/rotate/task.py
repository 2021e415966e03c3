"""Rotate: turn an object in the palm-up hand by 90 degree goals about one axis, again and again.

Reward and success follow the paper (section Task Setup). Its weights alone give a policy that bats
the cube round, so the default configuration adds what makes a gait that a hand can follow: penalties
on speed and torque, a reward for fingertips that take part, and a limit on the spin at which a goal
counts. `paper()` is the paper's own configuration.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from dexsim import observation
from dexsim.core.pytree import pytree_dataclass
from dexsim.env.state import Start
from dexsim.env.task import GroundTruth, Task
from dexsim.errors import ConfigError
from dexsim.geometry import rotations
from dexsim.geometry.rotations import length
from dexsim.hand.description import Hand
from dexsim.hand.mirror import mirror_point
from dexsim.objects import params
from dexsim.objects.params import ObjectParams
from dexsim.tasks.rotate.config import RotateConfig, RotateReward
from dexsim.tasks.rotate.report import summarize
from dexsim.tasks.rotate.start import (
    CLEARANCE,
    largest_size,
    load_pool,
    lowest_point,
    sample_turned_object,
    solid_inertia,
)
from dexsim.tasks.shared import action_rate, joint_speed, palm_height, random_push

TOUCH = 0.1  # N, force from which a fingertip counts as touching
_EPSILON, _STEEPNESS = 0.1, 400.0  # rad and 1/m, of the paper's reward
# Fingertips that should take part, and the share of the time for which one must touch to count fully. From the first
# goal on, this teaches policies that have found one stroke to clamp the object with all fingers.
WORKING_TIPS, WORKING_DUTY, _FROM_GOAL = 3, 0.12, 2
_MEMORY = 2.0  # s, over which a fingertip's share of work and the joints' speed are averaged
_RECENT = 0.2  # s, a fingertip that touched within this time before a drop pushed the object out


@pytree_dataclass
class RotateGoal:
    """The goal, and what has happened since the episode began."""

    axis: jax.Array  # [3] of rotation
    turns: jax.Array  # [] int32 goals reached
    entered: jax.Array  # [] bool, inside the paper's window since this goal was set
    entries: jax.Array  # [] int32 goals reached as the paper counts
    clock: jax.Array  # [] s
    last_success: jax.Array  # [] s, clock at the last goal
    gives_up: jax.Array  # [] bool, whether `patience` and `drop_radius` end the episode
    duty: jax.Array  # [F] share of time touching, lately
    pace: jax.Array  # [] rad/s, mean joint speed, lately
    since_touch: jax.Array  # [] s since any fingertip touched
    totals: dict[str, jax.Array]  # sums over ticks


@pytree_dataclass
class Progress:
    """What a tick did for the goal."""

    angle: jax.Array  # [] rad, from the goal orientation
    distance: jax.Array  # [] m, from the reference
    spin: jax.Array  # [] rad/s about the axis, positive toward the goal
    entered: jax.Array  # [] bool
    success: jax.Array  # [] bool


def goal_quat(turns: jax.Array | int, axis: jax.Array, angle: jax.Array | float) -> jax.Array:
    """Orientation [4] of the goal after `turns` goals: (turns + 1) steps of `angle` about `axis`."""
    # Angles are taken modulo a full turn, so that single precision lasts for any number of goals.
    total = jnp.remainder(jnp.asarray(turns + 1, jnp.float32) * angle, 2 * jnp.pi)
    return rotations.axis_angle_to_quat(axis, total)


def goal_reward(angle: jax.Array, distance: jax.Array, weights: RotateReward) -> jax.Array:
    """1 / (|d_rot| + 0.1) / (1 + exp(400 (d_goal - gate)))."""
    gate = jax.nn.sigmoid(_STEEPNESS * (weights.gate - distance))
    return gate / (jnp.abs(angle) + _EPSILON)


class Rotate(Task):
    """The rules of the task, for `dexsim.env.env.Env`."""

    name = "rotate"
    fields = {"actor": observation.ROTATE, "critic": observation.ROTATE_CRITIC}
    evaluation = "totals"

    config: RotateConfig

    def __init__(self, config: RotateConfig, hand: Hand):
        own = mirror_point(hand.rotate_reference) if hand.side == "left" else hand.rotate_reference
        posture, reference = config.posture or hand.rotate_posture, config.reference or own
        if not (posture and reference):
            raise ConfigError(f"hand {hand.name!r} has no rotate: its TOML needs [rotate] with posture and reference")
        config = dataclasses.replace(config, posture=posture, reference=reference)
        self.config, self.hand, self.posture = config, hand, posture
        self._placed = placed = config.placed_on(hand)
        self.turn = placed.turn
        self.slots, self.largest = config.objects.slots, largest_size(config)
        # Palm up; the tilt lowers the wrist, the roll the thumb's side.
        level = 9.81 * math.cos(config.roll)
        self.gravity = (-level * math.cos(config.tilt), 9.81 * math.sin(placed.roll), -level * math.sin(config.tilt))
        (x, y, z), self._palm = placed.reference, palm_height(hand)
        self.reference = (x, y, z)
        axes = self.turn.axes or (self.turn.axis,)
        self._axes = jnp.asarray([dataclasses.replace(self.turn, axis=axis).unit_axis for axis in axes])
        self._step, self._sense = self.turn.step, math.copysign(1.0, self.turn.step)
        self._period = config.physics.control_period
        self.episode_ticks = max(round(config.episode_seconds / self._period), 1)
        self.evaluation_ticks = max(round(config.evaluation_seconds / self._period), 1)

    def make_pool(self, key: jax.Array) -> Start:
        """Objects that came to rest in random postures of the hand; see `dexsim.tasks.rotate.start`."""
        return load_pool(key, self.hand, self._placed, self.gravity)

    def sample_object(self, key: jax.Array, config: RotateConfig, shape_index: jax.Array | None = None) -> ObjectParams:
        """One object of `config`; there is only one kind."""
        return sample_turned_object(key, config.placed_on(self.hand))

    def unit_inertia(self, object: ObjectParams) -> jax.Array:
        """Inertia [3] m^2 of the object as a uniform solid of 1 kg."""
        if self.config.objects.mesh:
            return params.unit_inertia(object, self.config.objects)
        return solid_inertia(object)

    def begin(self, key: jax.Array | None, start: Start | None) -> RotateGoal:
        zero, none, fingers = jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.zeros(self.hand.num_fingers)
        which = 0 if key is None or len(self._axes) == 1 else jax.random.randint(key, (), 0, len(self._axes))
        return RotateGoal(
            axis=self._axes[which],
            turns=none,
            entered=jnp.zeros((), bool),
            entries=none,
            clock=zero,
            last_success=zero,
            gives_up=jnp.ones((), bool),
            duty=fingers,
            pace=zero,
            since_touch=jnp.full((), 10.0),
            totals={"spin": zero, "joint_speed": zero, "action_rate": zero, "tilt": zero, "touch": fingers},
        )

    def progress(self, goal: RotateGoal, truth: GroundTruth) -> Progress:
        """Where the object is with respect to the goal."""
        turn = self.config.turn
        angle = rotations.quat_angle(self._quat(goal), truth.object_quat)
        distance = length(truth.object_position - jnp.asarray(self.reference))
        spin = self._sense * jnp.sum(truth.object_spin * goal.axis)
        inside = (angle < turn.angle) & (distance < turn.distance)
        calm = jnp.abs(spin) <= turn.spin if turn.spin > 0 else True
        return Progress(angle, distance, spin, goal.entered | inside, inside & calm)

    def update(self, key: jax.Array | None, goal: RotateGoal, truth: GroundTruth) -> RotateGoal:
        now, period = self.progress(goal, truth), self._period
        touching = (length(truth.finger_force) > TOUCH).astype(jnp.float32)
        clock = goal.clock + period
        change = {
            "spin": now.spin,
            "joint_speed": jnp.mean(jnp.abs(truth.joint_velocity)),
            "action_rate": jnp.mean(jnp.abs(truth.action - truth.last_action)),
            "tilt": self._tilt(goal, truth),
            "touch": touching,
        }
        return RotateGoal(
            axis=goal.axis,
            turns=goal.turns + now.success.astype(jnp.int32),
            entered=now.entered & ~now.success,
            entries=goal.entries + (now.entered & ~goal.entered).astype(jnp.int32),
            clock=clock,
            last_success=jnp.where(now.success, clock, goal.last_success),
            gives_up=goal.gives_up,
            duty=goal.duty + period / _MEMORY * (touching - goal.duty),
            pace=goal.pace + period / _MEMORY * (change["joint_speed"] - goal.pace),
            since_touch=jnp.where(jnp.any(touching > 0), 0.0, goal.since_touch + period),
            totals={name: goal.totals[name] + change[name] for name in goal.totals},
        )

    def goal_readings(self, goal: RotateGoal) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros(()), self._quat(goal)

    def turns(self, goal: RotateGoal) -> jax.Array:
        return goal.turns

    def push(self, key: jax.Array, object: ObjectParams) -> jax.Array:
        return random_push(key, object.mass, self.config)

    def dropped(self, goal: RotateGoal, truth: GroundTruth) -> jax.Array:
        away = length(truth.object_position - jnp.asarray(self.reference))
        lost = (away > self.config.drop_distance) | (self._tilt(goal, truth) > self.config.drop_tilt)
        if self.config.support == "fingers":
            low = lowest_point(truth.object, truth.object_quat, truth.object_position)
            lost |= low < self._palm + CLEARANCE
        hopeless = (away > self.config.drop_radius) | (goal.clock - goal.last_success > self.config.patience)
        return lost | (goal.gives_up & hopeless)

    def reward(
        self, goal: RotateGoal, truth: GroundTruth, dropped: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The reward of a tick and its terms; nothing but penalties once dropped."""
        weights, now, after = self.config.reward, self.progress(goal, truth), self.update(None, goal, truth)
        fallen = dropped.astype(jnp.float32)
        held = 1.0 - fallen
        # Of the least busy of the busiest fingertips: with their mean, two would earn most of the bonus, and some seeds
        # use only two.
        work = jnp.minimum(jnp.sort(after.duty)[::-1][:WORKING_TIPS] / WORKING_DUTY, 1.0)[-1]
        calm = jnp.minimum(weights.bonus_speed / jnp.maximum(after.pace, 1e-6), 1.0) ** 2
        asked = weights.bonus_tips * (goal.turns >= _FROM_GOAL).astype(jnp.float32)
        share = calm * (1.0 - asked * (1.0 - work))
        terms = {
            "goal": held * weights.goal * goal_reward(now.angle, now.distance, weights),
            "bonus": held * weights.bonus * now.success.astype(jnp.float32) * share,
            "spin": held * weights.spin * jnp.clip(now.spin, -1.0, 1.0),
            "action": weights.action * action_rate(truth.action, truth.last_action),
            "velocity": weights.velocity * joint_speed(truth.joint_velocity),
            "torque": weights.torque * jnp.sum(truth.joint_torque**2),
            "drop": weights.drop * fallen,
        }
        if self.config.trap > 0:
            # 2 where objects get stuck, tipped by 0.6 rad and 22 mm toward the fingertips from the reference; 0 at it.
            ahead = jnp.maximum(truth.object_position[2] - self.reference[2], 0.0)
            terms["trap"] = -((self._tilt(goal, truth) / 0.6) ** 2 + (ahead / 0.022) ** 2)
        ticks = jnp.maximum(after.clock / self._period, 1.0)
        mean = {name: total / ticks for name, total in after.totals.items()}
        turns, recent = after.turns.astype(jnp.float32), after.since_touch <= _RECENT
        return jnp.asarray(sum(terms.values())), {
            **{f"reward/{name}": value for name, value in terms.items()},
            "goals_per_minute": turns / jnp.maximum(after.clock, self._period) * 60.0,
            "successes": turns,
            "paper_successes": after.entries.astype(jnp.float32),
            "time_at_last_success": after.last_success,
            "axis": jnp.argmax(self._axes @ goal.axis).astype(jnp.float32),
            "angle_error": now.angle,
            "distance": now.distance,
            "pushed_out": (dropped & recent).astype(jnp.float32),
            "slipped": (dropped & ~recent).astype(jnp.float32),
            **{name: mean[name] for name in ("spin", "joint_speed", "action_rate", "tilt")},
            "taxel_force": jnp.sum(truth.touch.force),
            **{f"duty/{i}": mean["touch"][i] for i in range(self.hand.num_fingers)},
        }

    def _quat(self, goal: RotateGoal) -> jax.Array:
        return goal_quat(goal.turns, goal.axis, self._step)

    def _tilt(self, goal: RotateGoal, truth: GroundTruth) -> jax.Array:
        """Angle [] rad between the object's own axis and the axis of rotation."""
        own = rotations.rotate(rotations.quat_to_matrix(truth.object_quat), goal.axis)
        across = jnp.linalg.norm(jnp.cross(own, goal.axis) + 1e-12)
        return jnp.arctan2(across, jnp.sum(own * goal.axis))

    def evaluation_plan(self, count: int, shape_index: np.ndarray) -> tuple[np.ndarray, RotateGoal]:
        """Rows [count], evenly spread over those of the pool outside the trap; goals that end with a drop only, their
        axes in turn."""
        goal = dataclasses.replace(self.begin(None, None), gives_up=jnp.zeros((), bool))
        goals = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), goal)
        goals = dataclasses.replace(goals, axis=self._axes[np.arange(count) % len(self._axes)])
        size = self.config.pool_size  # of each of the pools that follow one another here
        outside = size - round(self.config.trap * size) or size  # with all in the trap, those
        free = np.flatnonzero(np.arange(len(shape_index)) % size < outside)
        return free[np.linspace(0, len(free) - 1, count).round().astype(int)], goals

    def summarize(self, metrics: dict[str, np.ndarray], episode_length: np.ndarray, control_period: float) -> dict:
        """The report of an evaluation; see `dexsim.tasks.rotate.report`."""
        return summarize(metrics, episode_length, control_period, self.evaluation_ticks)
