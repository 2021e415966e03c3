"""Scene, motor law and kernel of an environment for the `cuda` engine, on any machine."""

import jax
import jax.numpy as jnp

from dexsim.env.motors import JointCommand
from dexsim.physics.cuda.law import print_law
from dexsim.physics.law import implicit, record
from dexsim.physics.model import build_scene


def cuda_scene(env):
    """The scene that `CudaBackend` would get from an environment of another engine."""
    task = env.task
    return build_scene(env.hand, task.slots, task.largest, env.config.physics, task.gravity, "cuda")


def motor_law(env):
    """The environment's motors, printed."""
    printed = []

    def trace(key):
        state = env.reset(key)
        target = state.joint_target
        command = JointCommand(action=0 * target, target=target, previous=target, valid=jnp.array(True))
        law = implicit(env.motors.law(state.episode.hand, command), env.config.physics.timestep)
        printed.append(print_law(record(law, jnp.zeros(env.hand.num_joints)), env.hand.num_joints))

    jax.eval_shape(trace, jax.random.key(0))
    return printed[0]
