"""Episodes in brax's own viewers (extra `brax`): an HTML page to turn and play, without OpenGL.

    from brax.io import html
    html.save("episode.html", *brax_scene(env, trajectory))

brax's viewer draws one set of shapes for a whole trajectory, so the trajectory must be one episode
of one environment: the object's shape is the first state's.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np

from dexsim.hand.kinematics import forward_kinematics
from dexsim.wrappers.brax import BraxEnv

_TYPES = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    # The viewer knows no ellipsoids: a ball of the largest axis stands in.
    "ellipsoid": mujoco.mjtGeom.mjGEOM_SPHERE,
}
_HAND, _OBJECT = (0.30, 0.32, 0.36, 1.0), (0.85, 0.55, 0.25, 1.0)


def brax_scene(env: BraxEnv, trajectory: Sequence[Any]) -> tuple[Any, list[Any]]:
    """System and states for `brax.io.html.render`, `save` and `brax.io.json.dumps`.

    Args:
      trajectory: brax states of one environment (no batch axis), in order.
    """
    hand = env.env.hand
    frames = [env.snapshot(state) for state in trajectory]
    rows = [
        (geom.kind, geom.size, geom.body, geom.position, geom.rotation, _HAND)
        for geom in hand.geoms
        if geom.kind in _TYPES
    ]
    first = frames[0]
    rows += [
        (
            kind,
            first.primitive_size[k],
            len(hand.body_names),
            first.primitive_position[k],
            first.primitive_rotation[k],
            _OBJECT,
        )
        for k, kind in enumerate(env.env.primitive_kinds)
        if first.primitive_active[k]
    ]
    kinds, extents, links, positions, rotations, colours = zip(*rows, strict=True)
    sizes = [np.max(size).repeat(3) if kind == "ellipsoid" else size for kind, size in zip(kinds, extents, strict=True)]
    system = SimpleNamespace(
        opt=SimpleNamespace(timestep=env.dt),
        link_names=[*hand.body_names, "object"],
        ngeom=len(rows),
        geom_type=[int(_TYPES[kind]) for kind in kinds],
        geom_bodyid=np.array(links) + 1,  # 0 is the world
        geom_pos=np.array(positions),
        geom_quat=_quats(rotations),
        geom_size=np.array(sizes),
        mj_model=SimpleNamespace(geom_rgba=np.array(colours)),
    )
    kinematics = jax.jit(lambda joints: forward_kinematics(hand, joints))
    states = []
    for frame in frames:
        pose = kinematics(frame.joint_position)
        position = np.concatenate([pose.body_position, frame.object_position[None]])
        rotation = np.concatenate([pose.body_rotation, frame.object_rotation[None]])
        states.append(SimpleNamespace(x=SimpleNamespace(pos=position, rot=_quats(rotation))))
    return system, states


def _quats(matrices: Any) -> np.ndarray:
    """Rotation matrices [N, 3, 3] as quaternions [N, 4]."""
    quats = np.zeros((len(matrices), 4))
    for quat, matrix in zip(quats, np.asarray(matrices, np.float64), strict=True):
        mujoco.mju_mat2Quat(quat, matrix.ravel())
    return quats
