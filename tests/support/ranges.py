"""Drawing one range of the randomisation by itself: what changes in the draw, and then in motion and readings."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.config import flat, from_dict, override, to_dict
from dexsim.core.pytree import align
from dexsim.env.episode import EpisodeSampler
from dexsim.env.sensors import SensorSuite
from dexsim.objects.config import SHAPES, nominal
from dexsim.randomization import NOMINAL

READINGS = ("joint_position", "joint_torque", "taxel_force", "object_position", "object_quat", "palm_gravity")
# What must be there for a range to show.
AIDS = {
    "randomization.ripple_count": {"randomization.ripple": (0.03, 0.03)},
    "sensing.taxel.hysteresis_time": {"sensing.taxel.hysteresis": (0.3, 0.3)},
}
DEVIATIONS = ("encoder_bias", "gravity_tilt", "com_offset", "orientation.bias", "orientation.drift")
SHAPE_OF = {"sphere_radius": "sphere", "neck_radius": "composition", "neck_half": "composition"}
SHAPE_OF |= {"cylinder_radius": "cylinder", "cylinder_half": "cylinder"}
_NOMINAL = {}  # episodes without any range, and what comes of them


def range_paths(env):
    """All ranges that are drawn, as paths in the configuration, but for those that are off."""
    values = flat(to_dict(env.config))
    drawn = [
        path
        for path, value in values.items()
        if path.startswith(("randomization.", "sensing.orientation.", "sensing.taxel."))
        and (isinstance(value, list) or path.endswith(DEVIATIONS))
    ]
    if values["sensing.taxel.hysteresis"] is None:
        drawn.remove("sensing.taxel.hysteresis_time")
    return [*drawn, *env.task.object_ranges]


def with_values(config, values):
    return from_dict(type(config), override(to_dict(config), [f"{k}={json.dumps(v)}" for k, v in values.items()]))


def without_width(env, path):
    """The value of a range that is not drawn."""
    name = path.rpartition(".")[2]
    if path.endswith(DEVIATIONS):
        return 0.0
    if path in env.task.object_ranges:
        return (nominal(env.config.objects, name),) * 2
    perfect = {"gain": 1.0, "hysteresis_time": 0.1, "rate": 1 / env.control_period}  # of a taxel array
    return (perfect.get(name, 0.0) if path.startswith("sensing.") else NOMINAL.get(name, 0.0),) * 2


def shape_of(env, path):
    """The shape that has this range; None where it is not an object's."""
    return SHAPE_OF.get(path.rpartition(".")[2], "box") if path in env.task.object_ranges else None


def draw_alone(env, step, states, path, *, ticks):
    """A range drawn with all others at their nominal values, from the same starts under the same actions.

    Returns:
      Names of the leaves of the episode's draw, or of the compiled model, that differ, and the largest difference of
      "motion" and of each of `READINGS`.
    """
    paths, (key, action_key) = range_paths(env), jax.random.split(jax.random.key(1))
    # Fingers close, and all joints are thrown about: contact, full torque and speed occur.
    throw = jax.random.uniform(action_key, (ticks, len(states.tick), env.action_size), minval=-1.0)
    close = jnp.where(jnp.asarray(env.hand.joint_lower) < 0, 0.0, 0.5)
    actions = jnp.clip(throw + align(close, throw), -1.0, 1.0)
    base = with_values(env.config, {other: without_width(env, other) for other in paths} | AIDS.get(path, {}))
    span = flat(to_dict(env.config))[path]

    def draw(config):
        sampler = EpisodeSampler(config, env.hand, env.task, SensorSuite(config, env.hand, env.task))
        keys, objects = jax.random.split(key, (4, len(states.tick))), states.episode.object
        if path in env.task.object_ranges:  # of a shape that has this range
            shape = jnp.int32(SHAPES.index(shape_of(env, path)))
            objects = jax.vmap(lambda one: env.task.sample_object(one, config, shape))(keys[3])
        return jax.vmap(sampler.sample)(keys[0], keys[1], keys[2], objects)

    def run(episode):
        state, rows = dataclasses.replace(states, episode=episode), []
        for action in actions:
            state = step(state, action)
            rows.append([state.physics.qpos, *(getattr(state.readings, name) for name in READINGS)])
        return [np.stack(column) for column in zip(*rows, strict=True)]

    known = env, ticks, str(AIDS.get(path)), shape_of(env, path)
    if known not in _NOMINAL:  # the same for most ranges
        nominal_episode = draw(base)
        _NOMINAL[known] = nominal_episode, run(nominal_episode)
    before, still = _NOMINAL[known]
    after = draw(with_values(base, {path: span}))
    moved = [float(np.abs(a - b).max()) for a, b in zip(still, run(after), strict=True)]
    if path in env.task.object_ranges:  # what the physics is given must differ, not only what was drawn
        before, after = (env.physics.configure(jax.tree.map(lambda leaf: leaf[0], e.object)) for e in (before, after))
    pairs = zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True)
    changed = [
        jax.tree_util.keystr(place, simple=True, separator=".")
        for (place, old), new in pairs
        if not np.array_equal(old, new)
    ]
    return changed, dict(zip(("motion", *READINGS), moved, strict=True))
