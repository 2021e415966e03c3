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
from dexsim.sensing.taxel_reading import measure_tangential, measure_taxels
from dexsim.sensing.taxels import SensorModel, SensorParams, SensorState


@pytree_dataclass
class EpisodeSensors:
    """One episode's sensors, and what they remember."""

    draw: Draw
    orientation: SensorDraw
    array_params: SensorParams | None
    array: SensorState | None

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
        self.array = _array(config, hand)
        self._up = -jnp.asarray(task.gravity) / np.linalg.norm(task.gravity)

    def draw_orientation(self, key: jax.Array, scale: jax.Array | float, extreme: jax.Array | None) -> SensorDraw:
        """One episode's IMU; see `draw_sensor`."""
        return draw_sensor(key, self.config.sensing.orientation, scale, self.period, extreme)

    def draw_array(self, key: jax.Array, scale: jax.Array | float) -> tuple[SensorParams | None, SensorState | None]:
        """One episode's taxels, and their memory before the first tick."""
        if self.array is None:
            return None, None
        return self.array.sample(key, scale), self.array.init()

    def read(
        self,
        key: jax.Array,
        sample: Sample,
        before: Sample,
        sensors: EpisodeSensors,
        goal: Any,
        last_action: jax.Array,
        state: State | None = None,
    ) -> tuple[Readings, SensorState | None]:
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
        taxels, array = self._read_taxels(keys[2], late, sensors)
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

    def _read_taxels(
        self, key: jax.Array, late: Sample, sensors: EpisodeSensors
    ) -> tuple[jax.Array, SensorState | None]:
        force, gain = late.taxel_force, sensors.draw.taxel_gain
        if self.array is not None:
            array, taxels = self.array.apply(sensors.array_params, sensors.array, key, force * gain)
            return taxels, array
        if self.config.touch:
            return measure_taxels(force, gain, self.config.sensing.taxel, key), None
        return force, None

    def _read_tangential(self, key: jax.Array, late: Sample, sensors: EpisodeSensors) -> jax.Array:
        """[F, 3] N: by the same taxels, with the gains and the dead ones of their normal forces."""
        gain, params = sensors.draw.taxel_gain, sensors.array_params
        if params is not None and params.gain is not None:
            gain = gain * params.gain
        if params is not None and params.alive is not None:
            gain = gain * params.alive
        return measure_tangential(
            late.tangential_force, late.taxel_force, gain, self.config.sensing.taxel, jax.random.fold_in(key, 1)
        )


def _array(config: EnvConfig, hand: Hand) -> SensorModel | None:
    """The imperfect taxels of `Sensing.array`; None where they are off."""
    noise = config.sensing.array
    if noise.scale == 0 or not config.touch:
        return None
    return noise.model(hand.taxel_grid, fingers=hand.num_fingers, control_period=config.physics.control_period)
