"""Parts of an environment's state, for tests that put others in."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp

from dexsim.env.motors import PhysicsTick


def with_episode(state, **parts):
    """`state` with other parts of what its episode drew: `hand`, `object`, `imu`, `taxels`."""
    return dataclasses.replace(state, episode=dataclasses.replace(state.episode, **parts))


def ground_truth(env, object, physics, force):
    """What a task would see of this object and physics state, under forces [F, 3] N on the finger tips."""
    zero = jnp.zeros(env.hand.num_joints)
    tick = PhysicsTick(
        physics=physics, finger_force=force, joint_torque=zero, gear=None, limited=zero > 0, finite=jnp.ones((), bool)
    )
    episode = SimpleNamespace(object=object, hand=SimpleNamespace(cover=0.0))
    return env._ground_truth(episode, tick, zero, zero)
