"""Single primitives as shapes, their bounds, and grids of them; what C MuJoCo makes of an object's solid."""

import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.geometry import grid, sdf


def solid(kind, *size):
    """A primitive at the origin; sizes as in MuJoCo, those left out are 0."""
    return sdf.Shape(
        (kind,), jnp.asarray([(*size, 0, 0)[:3]], jnp.float32), jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.array([True])
    )


def bounds(shape):
    """Lowest and highest corner [2, 3] m of the boxes round the active primitives."""
    boxes = []
    for k in np.flatnonzero(np.asarray(shape.active)):
        kind, size, turn = shape.kinds[k], np.asarray(shape.size[k], float), np.asarray(shape.rotation[k], float)
        along = np.minimum(np.abs(turn[:, 2]), 1.0)
        reach = {
            "box": np.abs(turn) @ size,
            "cylinder": size[0] * np.sqrt(1 - along**2) + size[1] * along,
            "capsule": size[0] + size[1] * along,
            "sphere": np.full(3, size[0]),
        }[kind]
        boxes.append(np.asarray(shape.position[k], float) + np.outer([-1, 1], reach))
    return np.stack([np.min(boxes, (0, 1)), np.max(boxes, (0, 1))])


def bake(shape, nodes=grid.NODES):
    """A grid of a shape's exact distances."""
    axes = [np.linspace(low - grid.PAD, high + grid.PAD, nodes) for low, high in bounds(shape).T]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return grid.from_distances(axes, np.asarray(sdf.signed_distance(jnp.asarray(points, jnp.float32), shape)))


def integrate(object):
    """Mass, centre [3] and inertia [3, 3] about it, of an object's active primitives at density one."""
    spec, turn = mujoco.MjSpec(), np.zeros(9)
    body = spec.worldbody.add_body()
    for slot in np.flatnonzero(object.active):
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{object.kinds[slot].upper()}")
        quat = (1, 0, 0, 0) if object.quat is None else object.quat[slot]
        body.add_geom(type=kind, size=object.size[slot], pos=object.position[slot], quat=quat, density=1.0)
    model = spec.compile()
    mujoco.mju_quat2Mat(turn, model.body_iquat[1])
    axes = turn.reshape(3, 3)
    return model.body_mass[1], model.body_ipos[1], axes @ np.diag(model.body_inertia[1]) @ axes.T
