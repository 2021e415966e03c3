"""The observations of a tick: the actor's from the readings, the critic's from the truth."""

import jax

from dexsim import observation
from dexsim.core.errors import ConfigError
from dexsim.env.config import EnvConfig
from dexsim.env.task import GroundTruth, Task
from dexsim.hand.kinematics import Hand
from dexsim.observation import Motion, Readings


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
                raise ConfigError(
                    f"ObservationConfig.leave_out = {self._configs[group].leave_out}: removes every {group} observation"
                )

    def observe(
        self, readings: Readings, truth: GroundTruth, goal: tuple[jax.Array, jax.Array]
    ) -> dict[str, jax.Array]:
        """The observation vectors by group; the critic sees the same fields, but the true values.

        Args:
          readings: for the actor.
          truth: for the critic.
          goal: command [] and goal orientation [4], as `Task.goal_readings` gives them.
        """
        command, goal_quat = goal
        true = Readings(
            joint_position=truth.joint_position,
            joint_torque=truth.joint_torque / self.hand.torque_limit,
            taxel_force=truth.touch.force,
            object_position=truth.object_position,
            object_velocity=truth.object_velocity,
            object_quat=truth.object_quat,
            goal_quat=goal_quat,
            command=command,
            last_action=readings.last_action,
            past_actions=readings.past_actions,
            palm_gravity=readings.palm_gravity,
        )
        motion = Motion(truth.joint_velocity, truth.object_spin)
        # The actor's pose follows from measured angles, which are not the true ones.
        arguments = {"actor": (readings, None), "critic": (true, truth.pose)}
        return {
            group: observation.observe(self.hand, readings_, names, self._configs[group], motion, pose)
            for group, names in self.fields.items()
            for readings_, pose in (arguments[group],)
        }
