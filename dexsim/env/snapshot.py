"""What a picture shows of an environment's state."""

import jax.numpy as jnp

from dexsim.env.env import Env
from dexsim.env.state import State
from dexsim.geometry import rotations
from dexsim.render.snapshot import Snapshot


def take_snapshot(env: Env, state: State) -> Snapshot:
    """What a frame of video shows of one environment's state."""
    place = state.physics.qpos[env.physics.object_qpos]
    shape = state.episode.object.shape()
    turning = env.task.turn is not None
    return Snapshot(
        joint_position=state.physics.qpos[env.physics.joint_qpos],
        object_position=place[:3],
        object_rotation=rotations.quat_to_matrix(place[3:]),
        primitive_size=shape.size,
        primitive_position=shape.position,
        primitive_rotation=shape.rotation,
        primitive_active=shape.active,
        taxel_force=state.readings.taxel_force,
        command=state.readings.command,
        target_force=env.task.target_force(state.goal),
        finger_force=state.finger_force,
        goal_rotation=rotations.quat_to_matrix(state.readings.goal_quat) if turning else None,
        turns=env.task.turns(state.goal),
        seconds=state.length.astype(jnp.float32) * env.control_period,
    )
