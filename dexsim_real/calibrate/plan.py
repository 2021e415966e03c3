"""Plan of the presses: posture of each fingertip, and direction in which the joint targets advance.

A press loads the joints with a lever arm at the contact. Targets advance in proportion to these lever arms: joints with
equal gains then push along the skin's normal, with little shear. The pads load the flexing joints of a finger; the
joints that spread thumb and index finger are loaded by the sides.

A finger presses almost straight: its pad is then close to the line through its joints, so a shear force, which the
taxels may not show, has a short lever arm.
"""

import dataclasses

import numpy as np

from dexsim.calibration.press import lever_arms
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import flexion_joints
from dexsim_real.control.alarms import finger_joints
from dexsim_real.core.errors import HandError

_OPEN = 0.1  # rad, of the joints that do not press
_SHARE = 0.3  # of the longest lever arm, above which a joint takes part
_SPREADS = "index_bend"  # joint of the XHand: other hands are pressed on their pads alone
_SIDES = {0: "palm's normal", 1: "thumb"}  # its fingers with a joint that spreads them, and where that side faces
_BENT = (0.3, 0.3, 0.2), (0.35, 0.2)  # rad, joints of the pressing thumb, and of another finger, from the root on


@dataclasses.dataclass(frozen=True)
class Placement:
    """One press: a fingertip, and the place on it."""

    name: str  # "index pad"
    finger: int
    taxels: tuple[int, ...]  # at the middle of the contact
    joints: tuple[int, ...]  # joints that press
    posture: np.ndarray  # [J] rad, at the expected contact
    direction: np.ndarray  # [J] rad of targets for each rad of advance; the largest is 1
    task: str  # instruction for the user


def placements(hand: Hand, fingers: tuple[str, ...] = (), sides: bool = True) -> list[Placement]:
    """All presses, pads first and the thumb's last of them.

    Args:
      fingers: names; all by default.
      sides: also the sides of thumb and index finger.

    Raises:
      HandError: no such finger.
    """
    if unknown := sorted(set(fingers) - set(hand.finger_names)):
        raise HandError(f"no finger {unknown[0]!r}; choose from {', '.join(hand.finger_names)}")
    selected = [i for i, name in enumerate(hand.finger_names) if name in (fingers or hand.finger_names)]
    columns, rows = hand.taxel_grid
    middle = [c * rows + r for c in (columns // 2 - 1, columns // 2) for r in (rows // 2 - 2, rows // 2 - 1)]
    plan = []
    for finger in sorted(selected, key=lambda i: i == 0):
        # Bent a little more than the others.
        name = hand.finger_names[finger]
        joints = finger_joints(hand, 0) if finger == 0 else flexion_joints(hand, range(finger, finger + 1)).tolist()
        bent = dict(zip(joints, _BENT[finger > 0], strict=False))
        task = f"hold a round pen, backed by foam, across the pad of the {name}, 1 cm in front of it"
        plan.append(_placement(hand, f"{name} pad", finger, middle, bent, task))
    for finger in [i for i in selected if sides and i in _SIDES and _SPREADS in hand.joint_names]:
        name = hand.finger_names[finger]
        # The index finger of a left hand has the sensor of a right one: its first columns face the thumb.
        column = 1 if finger == 1 and hand.side == "left" else columns - 2
        side = [column * rows + r for r in (rows // 2 - 2, rows // 2 - 1)]
        bent = {0: 0.4} if finger == 0 else {3: -0.1, 4: 0.35, 5: 0.1}
        task = f"hold the pen across the side of the {name} that faces the {_SIDES[finger]}, 3 mm in front of it"
        plan.append(_placement(hand, f"{name} side", finger, side, bent, task))
    return plan


def _placement(hand: Hand, name: str, finger: int, taxels: list[int], bent: dict[int, float], task: str) -> Placement:
    """A press at the mean of these taxels; `bent` gives the angles rad of the joints that are not open."""
    posture = np.full(hand.num_joints, _OPEN)
    if _SPREADS in hand.joint_names:
        posture[hand.joint_names.index(_SPREADS)] = 0.0
    posture = np.clip(posture, hand.joint_lower, hand.joint_upper)
    posture[list(bent)] = list(bent.values())
    arms = lever_arms(hand, posture, finger, np.isin(np.arange(hand.num_taxels), taxels) / len(taxels))
    longest = np.max(np.abs(arms))
    joints = np.flatnonzero(np.abs(arms) > _SHARE * longest)
    direction = np.zeros(hand.num_joints)
    direction[joints] = arms[joints] / longest
    return Placement(name, finger, tuple(taxels), tuple(joints.tolist()), posture, direction, task)
