"""Mount of the emulated hand: direction of gravity in the palm frame."""

import numpy as np

from dexsim_real.twin.plant.shapes import matrix, turn

MOUNT: dict[str, tuple[float, float] | None] = {"grasp": None, "rotate": (-0.2, -0.2)}
"""Nominal pitch and roll rad of a hand mounted palm up: wrist and thumb side lowered (raised if negative). None is
upside down."""
GRAVITY = 9.81  # m/s^2


def nominal_gravity(task: str) -> np.ndarray:
    """Gravity [3] m/s^2 in the palm frame of a hand with the nominal mount."""
    mount = MOUNT[task]
    if mount is None:
        return GRAVITY * np.array([1.0, 0.0, 0.0])
    pitch, roll = mount
    return GRAVITY * np.array([-np.cos(pitch) * np.cos(roll), np.sin(roll), -np.sin(pitch) * np.cos(roll)])


def tilted_gravity(task: str, tilt: np.ndarray) -> np.ndarray:
    """Gravity [3] m/s^2 in the palm frame of a hand tilted by angles [2] rad about two horizontal axes."""
    down = nominal_gravity(task)
    way = down / GRAVITY
    side = np.array([0.0, 1.0, 0.0]) - way[1] * way  # the palm's y, made horizontal
    side = side / np.linalg.norm(side)
    for axis, angle in ((side, tilt[0]), (np.cross(way, side), tilt[1])):
        down = matrix(turn(axis, float(angle))) @ down
    return down
