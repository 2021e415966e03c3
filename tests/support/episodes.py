"""Parts of an environment's state, for tests that put others in."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.env.task import GroundTruth
from dexsim.hand.kinematics import forward_kinematics
from dexsim.physics.interface import StepResult
from dexsim.touch.taxel_force import Touch

# Of the rotation task's pools, which are kept on disk: another size is settled anew.
POOL_SIZE = 32


def with_episode(state, **parts):
    """`state` with other parts of what its episode drew: `hand`, `object`, `imu`, `taxels`."""
    return dataclasses.replace(state, episode=dataclasses.replace(state.episode, **parts))


def ones_of(env, count, *given):
    """A batch of states with ones everywhere, of the shapes that `env.reset(key, *given)` gives, and keys."""
    keys = jax.random.split(jax.random.key(0), count)
    shapes = jax.eval_shape(jax.vmap(env.reset), keys, *given)
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return jax.tree.map(lambda x: keys if is_key(x) else jnp.ones(x.shape, x.dtype), shapes)


def by_field(layout, observation):
    """Columns [..., n] of an observation by their field's name."""
    ends = np.cumsum([entry.size for entry in layout])
    return dict(zip((entry.name for entry in layout), jnp.split(observation, ends[:-1], axis=-1), strict=True))


def ground_truth(env, object, physics, force, hand=SimpleNamespace(pad_thickness_delta=0.0)):  # noqa: B008
    """What a task would see of this object and physics state, under forces [F, 3] N on the finger tips."""
    zero = jnp.zeros(env.hand.num_joints)
    episode = SimpleNamespace(object=object, hand=hand)
    return env._ground_truth(episode, StepResult(physics, force), (zero, zero > 0), zero, zero)


@functools.cache
def _middle(hand):
    """The middle posture and the hand in it."""
    joints = jnp.asarray((hand.joint_lower + hand.joint_upper) / 2)
    return joints, jax.jit(forward_kinematics, static_argnums=0)(hand, joints)


def still_moment(hand, position, **changes):
    """A `GroundTruth` at rest: the middle posture, an object at `position` that nothing touches; with these changes."""
    joints, pose = _middle(hand)
    zero, fingers, nothing = jnp.zeros(hand.num_joints), jnp.zeros(hand.num_fingers), jnp.zeros(hand.taxel_area.shape)
    moment = GroundTruth(
        object=None,
        joint_position=joints,
        joint_velocity=zero,
        joint_torque=zero,
        torque_limited=zero > 0,
        pose=pose,
        finger_force=jnp.zeros((hand.num_fingers, 3)),
        normal_force=fingers,
        touch=Touch(nothing, nothing, nothing),
        tip_stiffness=fingers + 1,
        object_position=jnp.asarray(position),
        object_quat=jnp.array([1.0, 0, 0, 0]),
        object_velocity=jnp.zeros(3),
        object_spin=jnp.zeros(3),
        action=zero,
        last_action=zero,
    )
    kept = {name: value if name in ("object", "touch") else jnp.asarray(value) for name, value in changes.items()}
    return dataclasses.replace(moment, **kept)


def reset_to(env):
    """`reset_to(key, index, goal=None)`: a new episode from a row of the pool, with ranges of full width."""

    def reset(key, index, goal=None):
        return env.reset_from(key, jax.tree.map(lambda rows: jnp.asarray(rows)[index], env.pool), goal, jnp.ones(()))

    return reset
