"""What an episode draws at its start: the hand, the object's properties, the IMU and the taxels."""

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.ranges import sample_extreme
from dexsim.env.config import EnvConfig
from dexsim.env.sensors import SensorSuite
from dexsim.env.state import Episode
from dexsim.env.task import Task
from dexsim.hand.description import Hand
from dexsim.objects.config import PROPERTY_RANGES
from dexsim.objects.params import ObjectParams, resample_properties, toward_nominal
from dexsim.randomization import sample_hand, tilted_down
from dexsim.sensing.imu import sample_imu


class EpisodeSampler:
    """Draws an `Episode`. Pure methods, for one environment."""

    def __init__(self, config: EnvConfig, hand: Hand, task: Task, sensors: SensorSuite):
        self.config, self.hand, self.task, self.sensors = config, hand, task, sensors
        self._drawn = tuple(name for name in PROPERTY_RANGES if f"objects.{name}" in task.object_ranges)
        self._weight = float(np.linalg.norm(task.gravity))  # m/s^2
        self._down = np.asarray(task.gravity, float) / np.linalg.norm(task.gravity)

    def sample(
        self,
        hand_key: jax.Array,
        sensor_key: jax.Array,
        object_key: jax.Array,
        object: ObjectParams,
        scale: jax.Array | None = None,
    ) -> Episode:
        """One episode.

        Args:
          hand_key, sensor_key, object_key: of hand and IMU, of the sensors, and of the object's physical properties.
          object: of the start state. Its shape stays, for the state was chosen for it; the physical properties that the
            task draws (`Task.object_ranges`) are drawn anew.
          scale: [] in [0, 1], narrows every range about nominal; None for 1.
        """
        config, ranges, period = self.config, self.config.randomization, self.config.physics.control_period
        if self._drawn:
            plain = self.task.unit_inertia(object)
            object = resample_properties(object_key, object, config.objects, plain, self._drawn)
        if scale is not None:
            object = toward_nominal(object, config.objects, self.task.unit_inertia(object), scale)
        width = 1.0 if scale is None else scale
        times = {"timestep": config.physics.timestep, "control_period": period}
        extreme = sample_extreme(hand_key, ranges.extremes)  # the one that `sample_hand` draws
        return Episode(
            hand=sample_hand(hand_key, ranges, self.hand, **times, scale=width),
            object=object,
            imu=sample_imu(sensor_key, config.sensing.orientation, ranges.scale * width, period, extreme),
            taxels=self.sensors.taxels.sample(jax.random.fold_in(sensor_key, 1), width),
        )

    def tilt_force(self, episode: Episode) -> jax.Array:
        """The object's share [3] N of a tilted gravity; the links' share is small and left out."""
        tilted = tilted_down(self._down, episode.hand.tilt)
        return episode.object.mass * self._weight * (tilted - jnp.asarray(self._down))
