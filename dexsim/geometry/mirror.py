"""Reflection in the plane y = 0, which makes a left hand of a right one: signs to multiply by.

Positions, velocities and forces are polar vectors. Axes of rotation, angular velocities and torques are axial ones,
which a reflection turns round in addition. A body's orientation R becomes S R S, with S = diag(`POLAR`).
"""

import numpy as np

POLAR = np.array([1.0, -1.0, 1.0], np.float32)
AXIAL = -POLAR
QUAT = np.array([1.0, -1.0, 1.0, -1.0], np.float32)
"""Of (w, x, y, z): the angle stays, the axis is axial."""
MATRIX = np.outer(POLAR, POLAR)
