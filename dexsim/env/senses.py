"""Between the truth and the host: latency, noise, counts, and what a sensor remembers.

`SensorSuite` belongs to one environment and has no state of its own; what an episode draws and what the
taxels remember is passed in and out.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import pytree_dataclass
from dexsim.env.config import EnvConfig
from dexsim.env.state import Sample, State
from dexsim.env.task import Task
from dexsim.hand.kinematics import Hand
from dexsim.observation import ObservationConfig, Readings, ThreeAxisReadings
from dexsim.randomization import Draw
from dexsim.sensing.imu import SensorDraw, draw_sensor, measure_orientation
from dexsim.sensing.taxels import TaxelArray, TaxelMemory, TaxelParams


@pytree_dataclass
class EpisodeSensors:
    """One episode's sensors, and what they remember."""

    draw: Draw
    orientation: SensorDraw
    array_params: TaxelParams
    array: TaxelMemory

    @classmethod
    def of(cls, state: State) -> "EpisodeSensors":
        return cls(state.draw, state.orientation_sensor, state.array_params, state.array)


class SensorSuite:
    """From `Sample` to `Readings`. Pure methods, for one environment."""

    def __init__(self, config: EnvConfig, hand: Hand, task: Task, configs: tuple[ObservationConfig, ...]):
        """`configs`: what the groups observe, which may ask for three axes of touch."""
        self.config, self.hand, self.task = config, hand, task
        self.period = config.physics.control_period
        self.three_axis = config.touch and (
            config.sensing.three_axis or any("tangential_force" in view.add for view in configs)
        )
        self.taxels = TaxelArray(config.sensing.taxel, tuple(hand.taxel_grid), hand.num_fingers, self.period)
        self._up = -jnp.asarray(task.gravity) / np.linalg.norm(task.gravity)

    def draw_orientation(self, key: jax.Array, scale: jax.Array | float, extreme: jax.Array | None) -> SensorDraw:
        """One episode's IMU; see `draw_sensor`."""
        return draw_sensor(key, self.config.sensing.orientation, scale, self.period, extreme)

    def draw_array(self, key: jax.Array, scale: jax.Array | float) -> tuple[TaxelParams, TaxelMemory]:
        """One episode's taxels, and their memory before the first tick."""
        return self.taxels.sample(key, scale), self.taxels.init()

    def read(
        self,
        key: jax.Array,
        sample: Sample,
        before: Sample,
        sensors: EpisodeSensors,
        goal: Any,
        last_action: jax.Array,
        state: State | None = None,
    ) -> tuple[Readings, TaxelMemory]:
        """What the host gets to know of `sample`.

        Args:
          key: of the noise.
          sample, before: the truth at this tick and at the one before.
          sensors: of this episode.
          goal: the task's own.
          last_action: [J], as the observation shows it.
          state: before this tick; None at a reset.

        Returns:
          The readings, and the taxels' memory after them.
        """
        sensing, draw = self.config.sensing, sensors.draw
        age = draw.sensing_latency
        late = jax.tree.map(lambda new, old: (1 - age) * new + age * old, sample, before)
        keys = jax.random.split(key, 5)
        joints = late.joint_position + draw.encoder_bias
        joints = joints + sensing.joint_noise * jax.random.normal(keys[0], joints.shape)
        if sensing.joint_resolution > 0:
            joints = jnp.round(joints / sensing.joint_resolution) * sensing.joint_resolution
        torque = late.joint_torque * draw.torque_gain
        torque = torque + sensing.torque_noise * jax.random.normal(keys[1], torque.shape)
        array, taxels = self._read_taxels(keys[2], late, sensors)
        noise = sensing.object_noise * jax.random.normal(keys[3], (3,))
        position = jnp.where(
            jnp.array(sensing.object_axes), late.object_position + noise, jnp.asarray(self.task.reference)
        )
        velocity = jnp.zeros(3)
        if state is not None:
            step = (position - state.readings.object_position) / self.period
            velocity = state.object_velocity
            velocity = velocity + sensing.velocity_filter * (step - velocity)
        command, goal_quat = self.task.goal_readings(goal)
        # At a reset the sensor has just read for the first time.
        length, held = (
            (jnp.zeros(()), sample.object_quat) if state is None else (state.length + 1.0, state.readings.object_quat)
        )
        quat = measure_orientation(
            keys[4],
            sensing.orientation,
            sensors.orientation,
            length,
            sample.object_quat,
            before.object_quat,
            held,
            self._up,
            self.period,
        )
        known = (joints, torque, taxels, position, velocity, quat, goal_quat, command, last_action)
        if not self.three_axis:
            return Readings(*known), array
        return ThreeAxisReadings(*known, self._read_tangential(keys[2], late, sensors)), array

    def _read_taxels(self, key: jax.Array, late: Sample, sensors: EpisodeSensors) -> tuple[TaxelMemory, jax.Array]:
        if not self.config.touch:
            return sensors.array, late.taxel_force
        return self.taxels.apply(sensors.array_params, sensors.array, key, late.taxel_force, sensors.draw.taxel_gain)

    def _read_tangential(self, key: jax.Array, late: Sample, sensors: EpisodeSensors) -> jax.Array:
        """[F, 3] N: by the same taxels, with the gains and the dead ones of their normal forces."""
        key, gain = jax.random.fold_in(key, 1), sensors.draw.taxel_gain
        return self.taxels.apply_tangential(sensors.array_params, key, late.tangential_force, late.taxel_force, gain)
