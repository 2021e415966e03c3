"""The links of the kernel of the `cuda` engine: what the hinges of a hand carry.

There is one link for each hinge, in the order of the degrees of freedom. A body without a joint belongs to the link of
its parent. A link's frame has its origin on the hinge and its third axis along it, so that a joint's rotation is one
about z. Link -1 is fixed in the world (the palm), link `hinges` the object, whose frame is its body's.
"""

import dataclasses

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexsim.physics.interface import PhysicsScene


@dataclasses.dataclass(frozen=True, eq=False)
class Links:
    """Where the bodies of a model are in the kernel's links."""

    link: np.ndarray  # [B] of a body; -1 fixed in the world
    rotation: np.ndarray  # [B, 3, 3] of the body's frame in its link's
    place: np.ndarray  # [B, 3] m
    parent: np.ndarray  # [H] link that carries the hinge of a link; -1 the world
    offset_rotation: np.ndarray  # [H, 3, 3] of a link's frame in its parent's, at joint angle 0
    offset_place: np.ndarray  # [H, 3] m

    @property
    def hinges(self) -> int:
        """Hinges of the hand, which is also the link of the object."""
        return len(self.parent)

    def chains(self) -> list[list[int]]:
        """The hinges that carry each link, from the palm on."""
        found: list[list[int]] = []
        for link, parent in enumerate(self.parent):
            found.append([*(found[parent] if parent >= 0 else []), link])
        return found

    def gathering(self) -> list[list[int]]:
        """Steps [H] in which each link adds up what its children have added up: from whom, -1 from none."""
        children: list[list[int]] = [[] for _ in self.parent]
        for link, parent in enumerate(self.parent):
            if parent >= 0:
                children[parent].append(link)
        steps: list[list[int]] = []
        done = np.zeros(self.hinges, int)  # the step after which a link is complete
        for link in reversed(range(self.hinges)):
            for child in sorted(children[link], key=lambda child: done[child]):
                step = max(done[link], done[child])
                while len(steps) <= step:
                    steps.append([-1] * self.hinges)
                steps[step][link] = child
                done[link] = step + 1
        return steps


def find_links(scene: PhysicsScene) -> Links:
    """The links of a scene that `check_scene` has passed."""
    model = scene.model
    hinges = model.nv - 6
    link = np.full(model.nbody, -1)
    rotation, place = np.tile(np.eye(3), (model.nbody, 1, 1)), np.zeros((model.nbody, 3))
    parent, offset_rotation, offset_place = np.full(hinges, -1), np.zeros((hinges, 3, 3)), np.zeros((hinges, 3))
    for body in range(1, model.nbody):
        above = model.body_parentid[body]
        turn = rotation[above] @ rotation_matrix(model.body_quat[body])
        origin = place[above] + rotation[above] @ model.body_pos[body]
        link[body], rotation[body], place[body] = link[above], turn, origin
        if body == scene.object_body:
            link[body], rotation[body], place[body] = hinges, np.eye(3), 0.0
        elif model.body_jntnum[body]:
            joint = model.body_jntadr[body]
            hinge = model.jnt_dofadr[joint]
            axes, anchor = _axes_along(model.jnt_axis[joint]), model.jnt_pos[joint]
            zero = -model.qpos0[model.jnt_qposadr[joint]]
            parent[hinge] = link[above]
            offset_place[hinge] = origin + turn @ anchor
            offset_rotation[hinge] = turn @ axes @ rotation_matrix([np.cos(zero / 2), 0, 0, np.sin(zero / 2)])
            link[body], rotation[body], place[body] = hinge, axes.T, -axes.T @ anchor
    return Links(link, rotation, place, parent, offset_rotation, offset_place)


def rotation_matrix(quat: ArrayLike) -> np.ndarray:
    """[3, 3] of a quaternion (w, x, y, z)."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, float))
    return matrix.reshape(3, 3)


def _axes_along(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is `axis`."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    first = np.cross(other, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis], -1)
