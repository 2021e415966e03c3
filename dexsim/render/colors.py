"""The colours of hand, object and goal in pictures, films and the live view: sRGB bytes."""

import numpy as np

Color = tuple[int, int, int]

PALM: Color = (62, 66, 72)
LINK: Color = (172, 176, 182)
TIP: Color = (58, 98, 92)
OBJECT: Color = (52, 128, 172)
FACES: tuple[Color, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (204, 121, 167),
)
"""Sides of a box, +x, -x, +y, -y, +z, -z: told apart also by eyes that see fewer colours (Okabe and Ito)."""


def linear(color: Color) -> tuple[float, float, float]:
    """A colour as linear light in [0, 1]."""
    red, green, blue = (np.asarray(color) / 255) ** 2.2
    return float(red), float(green), float(blue)
