"""Which numbers of a compiled model one environment replaces: its object, its contacts' parameters, its fingertips."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.objects.params import ObjectParams, bounding_radius
from dexsim.physics.interface import ContactParams, PhysicsScene


def places(scene: PhysicsScene) -> dict[str, Any]:
    """Fields of `mujoco.MjModel` that change, and where in them.

    `body_invweight0` is not among them: the contact's parameters are worked out from it, and stiffness must not change
    with the mass of what is touched.
    """
    geoms, body, pairs = scene.object_geoms, scene.object_body, scene.object_pairs
    return {
        "geom_size": np.concatenate([geoms, scene.tip_geoms]),
        "geom_rbound": np.concatenate([geoms, scene.tip_geoms]),
        "geom_pos": geoms,
        "geom_quat": geoms,
        "body_mass": body,
        "body_inertia": body,
        "body_ipos": body,
        "pair_friction": (pairs, slice(0, 2)),
        "pair_solref": pairs,
        "pair_solimp": pairs,
    }


def values(scene: PhysicsScene, object: ObjectParams, contacts: ContactParams) -> dict[str, jax.Array]:
    """What goes to those places; without `geom_quat` where the object's primitives are aligned with it."""
    tips = scene.model.geom_size[scene.tip_geoms] + contacts.pad_thickness_delta * scene.tip_growth
    # The broad phase leaves out what is farther away. Of thinner rubber the sphere round it may stay.
    around = scene.model.geom_rbound[scene.tip_geoms]
    around = around + jnp.maximum(contacts.pad_thickness_delta, 0.0) * np.linalg.norm(scene.tip_growth, axis=-1)
    changed = {
        "geom_size": jnp.concatenate([object.size, tips]),
        "geom_rbound": jnp.concatenate([bounding_radius(object.size, scene.slots), around]),
        "geom_pos": object.position,
        "body_mass": object.mass,
        "body_inertia": object.inertia,
        "body_ipos": object.com,
        "pair_friction": jnp.stack([contacts.friction] * 2, -1),
        "pair_solref": contacts.solref,
        "pair_solimp": contacts.solimp,
    }
    return changed if object.quat is None else changed | {"geom_quat": object.quat}


def configured(scene: PhysicsScene, object: ObjectParams, contacts: ContactParams) -> dict[str, jax.Array]:
    """The whole fields of one environment's model, the scene's with `values` in their `places`."""
    where = places(scene)
    return {
        name: jnp.asarray(getattr(scene.model, name), jnp.float32).at[where[name]].set(value)
        for name, value in values(scene, object, contacts).items()
    }
