"""Contacts of the emulated fingertips with the object, from MuJoCo's solver."""

from typing import NamedTuple

import mujoco
import numpy as np

from dexsim_real.twin.plant.scene import Scene


class TipContact(NamedTuple):
    """One contact of object and fingertip; palm frame, forces act on the finger."""

    finger: int
    point: np.ndarray  # [3] m
    normal: np.ndarray  # [3] N
    tangent: np.ndarray  # [3] N


class TipContacts(NamedTuple):
    """All contacts of the object with the fingertips."""

    force: np.ndarray  # [5, 3] N on each fingertip
    normal: np.ndarray  # [5] N of it, along the sum of the fingertip's contact normals
    touches: list[TipContact]


def tip_contacts(scene: Scene, data: mujoco.MjData) -> TipContacts:
    """Contacts of the object with the fingertips in the state `data`."""
    contacts = TipContacts(np.zeros((5, 3)), np.zeros(5), [])
    inward, wrench = np.zeros((5, 3)), np.zeros(6)
    for i in range(data.ncon):
        first, second = data.contact.geom[i]
        finger = max(scene.finger_of_geom[first], scene.finger_of_geom[second])
        if finger < 0 or not (scene.is_object[first] or scene.is_object[second]):
            continue
        mujoco.mj_contactForce(scene.model, data, i, wrench)
        # The frame's first row points from the first geom to the second, which feels the force.
        frame = data.contact.frame[i].reshape(3, 3)
        sign = 1.0 if scene.is_object[first] else -1.0
        normal, tangent = sign * wrench[0] * frame[0], sign * wrench[1:3] @ frame[1:]
        contacts.force[finger] += normal + tangent
        inward[finger] += normal
        contacts.touches.append(TipContact(int(finger), data.contact.pos[i].copy(), normal, tangent))
    # As in simulation (`dexsim.touch.feel.keep_normal_part`), where one direction stands for the whole fingertip.
    length = np.maximum(np.linalg.norm(inward, axis=-1), 1e-12)
    contacts.normal[:] = np.maximum((contacts.force * inward).sum(-1) / length, 0.0)
    return contacts
