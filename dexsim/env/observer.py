"""The observations of a tick: the actor's from the readings, the critic's from the truth."""

import dataclasses

import jax

from dexsim import observation
from dexsim.env.config import EnvConfig
from dexsim.env.task import GroundTruth, Task
from dexsim.hand.description import Hand
from dexsim.observation import Motion, Readings


class Observer:
    """What each group of a task observes. Pure methods, for one environment."""

    def __init__(self, config: EnvConfig, hand: Hand, task: Task):
        self.hand, self.fields = hand, task.fields
        self._actor = config.observation
        self._critic = dataclasses.replace(config.observation, leave_out=())  # it may always look
        self.layout = {
            "actor": observation.layout(hand, task.fields["actor"], self._actor),
            "critic": observation.layout(hand, task.fields["critic"], self._critic),
        }

    def observe(
        self, readings: Readings, truth: GroundTruth, goal: tuple[jax.Array, jax.Array]
    ) -> dict[str, jax.Array]:
        """The observation vectors by group; the critic sees the same fields, but the true values.

        Args:
          readings: for the actor.
          truth: for the critic.
          goal: command [] and goal orientation [4], as `Task.goal_readings` gives them.
        """
        true = dataclasses.replace(
            readings,
            joint_position=truth.joint_position,
            joint_torque=truth.joint_torque / self.hand.torque_limit,
            taxel_force=truth.touch.force,
            object_position=truth.object_position,
            object_velocity=truth.object_velocity,
            object_quat=truth.object_quat,
            command=goal[0],
            goal_quat=goal[1],
        )
        motion, fields = Motion(truth.joint_velocity, truth.object_spin), self.fields
        return {
            # Its pose follows from measured angles, which are not the true ones.
            "actor": observation.observe(self.hand, readings, fields["actor"], self._actor, motion),
            "critic": observation.observe(self.hand, true, fields["critic"], self._critic, motion, truth.pose),
        }
