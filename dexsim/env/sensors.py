"""Between the truth and what is seen of it: latency, noise, counts, what a sensor remembers, and the observations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dexsim import observation
from dexsim.core.pytree import pytree_dataclass
from dexsim.env.config import EnvConfig
from dexsim.env.state import Episode, State
from dexsim.env.task import GroundTruth, Task
from dexsim.geometry import rotations
from dexsim.hand.description import Hand
from dexsim.observation import Motion, Readings
from dexsim.randomization import tilted_down
from dexsim.sensing.imu import measure_orientation
from dexsim.sensing.taxels import TaxelArray, TaxelMemory
from dexsim.task_spec import VELOCITY_WEIGHT


@pytree_dataclass
class SensorInput:
    """What the sensors see at one instant, before latency, noise and counts."""

    joint_position: jax.Array  # [J] rad
    joint_torque: jax.Array  # [J] 1, torque over its limit
    taxel_force: jax.Array  # [F, N] N
    object_position: jax.Array  # [3] m
    object_quat: jax.Array  # [4]


class SensorSuite:
    """From the truth to `Readings`, and to what actor and critic observe. Pure methods, for one environment."""

    def __init__(self, config: EnvConfig, hand: Hand, task: Task):
        self.config, self.hand, self.task = config, hand, task
        self.period = config.physics.control_period
        self.taxels = TaxelArray(config.sensing.taxel, hand, self.period)
        self._up = -jnp.asarray(task.gravity) / np.linalg.norm(task.gravity)
        critic = dataclasses.replace(config.observation, leave_out=())  # it may always look
        self._views = {"actor": config.observation, "critic": critic}
        self.layout = {group: observation.layout(hand, task.fields[group], self._views[group]) for group in self._views}

    def input(self, truth: GroundTruth) -> SensorInput:
        """What the sensors see after a tick."""
        torque = truth.joint_torque / self.hand.torque_limit
        return SensorInput(truth.joint_position, torque, truth.touch.force, truth.object_position, truth.object_quat)

    def read(
        self,
        key: jax.Array,
        episode: Episode,
        now: SensorInput,
        before: SensorInput,
        goal: tuple[jax.Array, jax.Array],
        last_action: jax.Array,
        last: State | None = None,
    ) -> tuple[Readings, TaxelMemory]:
        """What the host gets to know, and what the taxels remember.

        Args:
          now, before: what the sensors see, and saw a tick ago.
          goal: command [] and goal orientation [4], as `Task.goal_readings` gives them.
          last_action: [J], the action that led here, as observations show it.
          last: the state one tick ago; None at the start of an episode.
        """
        sensing, hand = self.config.sensing, episode.hand
        age = hand.sensing_latency
        late = jax.tree.map(lambda new, old: (1 - age) * new + age * old, now, before)
        keys = jax.random.split(key, 5)
        joints = late.joint_position + hand.actuator.encoder_bias
        joints = joints + sensing.joint_noise * jax.random.normal(keys[0], joints.shape)
        if sensing.joint_resolution > 0:
            joints = jnp.round(joints / sensing.joint_resolution) * sensing.joint_resolution
        torque = late.joint_torque * hand.torque_gain
        torque = torque + sensing.torque_noise * jax.random.normal(keys[1], torque.shape)
        memory = self.taxels.init() if last is None else last.taxel_memory
        memory, taxels = self.taxels.apply(episode.taxels, memory, keys[2], late.taxel_force, hand.taxel_gain)
        position, velocity = self._read_place(keys[3], late, last)
        past = (last_action,) * 2 if last is None else (last.readings.last_action, last.readings.past_actions[0])
        readings = Readings(
            joint_position=joints,
            joint_torque=torque,
            taxel_force=taxels,
            object_position=position,
            object_velocity=velocity,
            object_quat=self._read_orientation(keys[4], now, before, episode, last),
            goal_quat=goal[1],
            command=goal[0],
            last_action=last_action,
            past_actions=jnp.stack(past),
            palm_gravity=self._palm_gravity(episode),
        )
        return readings, memory

    def observe(
        self, readings: Readings, truth: GroundTruth, goal: tuple[jax.Array, jax.Array]
    ) -> dict[str, jax.Array]:
        """The observation vectors by group: the actor's of the readings; the critic's, of the same fields and more, of
        the truth and of the goal as `Task.goal_readings` gives it."""
        true = dataclasses.replace(
            readings,
            **vars(self.input(truth)),
            object_velocity=truth.object_velocity,
            command=goal[0],
            goal_quat=goal[1],
        )
        motion, fields, views = Motion(truth.joint_velocity, truth.object_spin), self.task.fields, self._views
        return {
            # Its pose follows from measured angles, which are not the true ones.
            "actor": observation.observe(self.hand, readings, fields["actor"], views["actor"], motion),
            "critic": observation.observe(self.hand, true, fields["critic"], views["critic"], motion, truth.pose),
        }

    def _palm_gravity(self, episode: Episode) -> jax.Array:
        """Where gravity [3] points, by an IMU whose frame the object's pose at rest has aligned, with that error."""
        down, bias = tilted_down(-np.asarray(self._up), episode.hand.tilt), episode.imu.bias
        angle = jnp.sqrt(jnp.sum(bias**2) + 1e-20)
        return rotations.rotate(rotations.quat_to_matrix(rotations.axis_angle_to_quat(bias / angle, angle)), down)

    def _read_place(self, key: jax.Array, late: SensorInput, last: State | None) -> tuple[jax.Array, jax.Array]:
        """The object's position [3] m and the filtered estimate of its velocity [3] m/s."""
        sensing, reference = self.config.sensing, jnp.asarray(self.task.reference)
        noise = sensing.object_noise * jax.random.normal(key, (3,))
        position = jnp.where(jnp.array(sensing.object_axes), late.object_position + noise, reference)
        if last is None:
            return position, jnp.zeros(3)
        step = (position - last.readings.object_position) / self.period
        velocity = last.readings.object_velocity
        return position, velocity + VELOCITY_WEIGHT * (step - velocity)

    def _read_orientation(
        self, key: jax.Array, now: SensorInput, before: SensorInput, episode: Episode, last: State | None
    ) -> jax.Array:
        """The object's orientation [4] by its IMU, which has just read for the first time at an episode's start."""
        length, held = jnp.zeros(()), now.object_quat
        if last is not None:
            length, held = last.length.astype(jnp.float32) + 1.0, last.readings.object_quat
        quats, config = (now.object_quat, before.object_quat, held), self.config.sensing.orientation
        return measure_orientation(key, config, episode.imu, length, *quats, self._up, self.period)
