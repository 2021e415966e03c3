"""A recorded torque law (`dexsim.physics.law`) as CUDA: a function of one joint.

The order of operations is the recorded one; the compiler may fuse a product and a sum, as XLA does.
"""

import dataclasses
import math
from typing import Any

import numpy as np

from dexsim.physics.cuda.scene import Buffer
from dexsim.physics.law import OPERATIONS, Recorded

_CTYPES = {"float32": "float", "int32": "int", "bool": "bool"}


@dataclasses.dataclass(frozen=True)
class PrintedLaw:
    """A law as CUDA, and the buffers of its constants."""

    text: str
    buffers: tuple[Buffer, ...]


def print_law(law: Recorded, joints: int) -> PrintedLaw:
    """`DEV Motor motor_law(const Args &args, int world, int joint, int substep, float position, float velocity)`.

    `Motor` is torque, Nm, and inertia, kg m^2, at a joint angle, rad, and velocity, rad/s (`implicit`).

    Args:
      law: as recorded.
      joints: J.
    """
    names, buffers = dict[int, str](), []
    count = len(law.constants)
    for number, (vector, dtype) in enumerate(law.types[:count]):
        place = f"[world * {joints} + joint]" if vector else "[world]"
        names[number] = f"args.law_{number}{place}"
        buffers.append(Buffer(f"law_{number}", joints if vector else 1, ctype=_CTYPES[dtype]))
    names |= {count: "substep", count + 1: "position", count + 2: "velocity"}
    names |= {number: _literal(value, law.types[number][1]) for number, value in law.literals}
    lines = []
    for kind, operands, number in law.steps:
        names[number] = f"v{number}"
        _, expression = OPERATIONS.get(kind, (None, "{0}"))
        value = expression.format(*(names[operand] for operand in operands))
        lines.append(f"  const {_CTYPES[law.types[number][1]]} v{number} = {value};\n")
    return PrintedLaw(
        "DEV Motor motor_law(const Args &args, int world, int joint, int substep, float position, float velocity) {\n"
        f"{''.join(lines)}  return {{{names[law.torque]}, {names[law.inertia]}}};\n}}\n",
        tuple(buffers),
    )


def _literal(value: Any, dtype: str) -> str:
    if dtype != "float32":
        return f"({str(value).lower()})"
    if math.isfinite(value):
        return f"({np.float32(value):.8e}f)"
    return "(0.f / 0.f)" if math.isnan(value) else f"({'-' if value < 0 else ''}1.f / 0.f)"
