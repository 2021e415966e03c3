"""The observations of a tick: the actor's from the readings, the critic's from the truth."""

import jax

from dexsim import observation
from dexsim.core.errors import ConfigError
from dexsim.env.config import EnvConfig
from dexsim.env.task import GroundTruth, Task
from dexsim.hand.kinematics import Hand
from dexsim.observation import Motion, Readings, ThreeAxisReadings


class Observer:
    """What each group of a task observes. Pure methods, for one environment."""

    def __init__(self, config: EnvConfig, hand: Hand, task: Task):
        """Raises ConfigError: nothing is left to observe, or see `group_configs`."""
        actor, critic = observation.group_configs(config.observation)
        self.hand, self.fields = hand, task.fields
        self._configs = {group: actor if group == "actor" else critic for group in task.fields}
        self.layout = {
            group: observation.layout(hand, names, self._configs[group]) for group, names in task.fields.items()
        }
        for group, fields in self.layout.items():
            if not fields:
                out = self._configs[group].leave_out
                raise ConfigError(f"ObservationConfig.leave_out = {out}: leaves the {group} of {task.name!r} nothing")

    def observe(
        self, readings: Readings, truth: GroundTruth, command: jax.Array, goal_quat: jax.Array
    ) -> dict[str, jax.Array]:
        """The observation vectors by group; the critic sees the same fields, but the true values.

        Args:
          readings: for the actor.
          truth: for the critic.
          command, goal_quat: [] and [4], the task's goal as readings carry it.
        """
        seen = {"actor": readings, "critic": self._true_readings(readings, truth, command, goal_quat)}
        motion = Motion(truth.joint_velocity, truth.object_spin)
        return {
            group: observation.observe(self.hand, seen[group], names, self._configs[group], motion)
            for group, names in self.fields.items()
        }

    def _true_readings(
        self, readings: Readings, truth: GroundTruth, command: jax.Array, goal_quat: jax.Array
    ) -> Readings:
        known = {
            "joint_position": truth.joint_position,
            "joint_torque": truth.joint_torque / self.hand.torque_limit,
            "taxel_force": truth.touch.force,
            "object_position": truth.object_position,
            "object_velocity": truth.object_velocity,
            "object_quat": truth.object_quat,
            "goal_quat": goal_quat,
            "command": command,
            "last_action": readings.last_action,
        }
        if isinstance(readings, ThreeAxisReadings):
            assert truth.tangential_force is not None, "three-axis taxels are off"
            return ThreeAxisReadings(**known, tangential_force=truth.tangential_force)
        return Readings(**known)
