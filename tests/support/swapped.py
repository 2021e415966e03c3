"""What episodes drew, one value after another given to the next world: whether motion or a reading shows it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

READINGS = ("joint_position", "joint_torque", "taxel_force", "object_position", "object_quat", "palm_gravity")


def drawn(episode) -> dict[str, np.ndarray]:
    """Leaves by their path in a batch of episodes, of which no two worlds have the same."""
    leaves = jax.tree_util.tree_leaves_with_path(episode)
    named = {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in leaves}
    return {name: leaf for name, leaf in named.items() if np.any(leaf != leaf[:1])}


def rollout(step, states, ticks):
    """`shows(path)`: names of what differs, "motion" or readings, where every world has its neighbour's value there."""
    shape = (ticks, *states.joint_target.shape)
    actions = jnp.asarray(np.random.default_rng(4).uniform(-1.0, 1.0, shape) + 0.5, jnp.float32)

    def run(episode):
        state, rows = dataclasses.replace(states, episode=episode), []
        for action in actions:
            state = step(state, action)
            rows.append([state.physics.qpos, *(getattr(state.readings, name) for name in READINGS)])
        return [np.stack(column) for column in zip(*rows, strict=True)]

    plain = run(states.episode)

    def shows(path):
        def swap(place, leaf):
            here = jax.tree_util.keystr(place, simple=True, separator=".")
            return jnp.roll(leaf, 1, 0) if here == path else leaf

        found = run(jax.tree_util.tree_map_with_path(swap, states.episode))
        changed = [np.abs(a - b).max() > 1e-6 for a, b in zip(plain, found, strict=True)]
        return [name for name, moved in zip(("motion", *READINGS), changed, strict=True) if moved]

    return shows
