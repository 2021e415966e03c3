"""A recorded torque law (`dexsim.physics.law`) as CUDA: a function of one joint.

A law works element by element on scalars and on vectors over the joints, so one joint's torque takes one element of
each. The order of operations is the recorded one; the compiler may fuse a product and a sum, as XLA does.
"""

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from dexsim.core.errors import ConfigError
from dexsim.physics.cuda.scene import Buffer
from dexsim.physics.law import OPERATIONS, Recorded

_CTYPES = {"float32": "float", "int32": "int", "bool": "bool"}
_BOOLEAN = {"and", "or", "not", "eq", "ne", "ge", "gt", "le", "lt"}


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
      joints: J; every array of the law is [J] or [].

    Raises:
      ConfigError: the law has arrays of another shape or type.
    """
    shapes, types, names = dict[int, tuple[int, ...]](), dict[int, str](), dict[int, str]()

    def add(number: int, name: str, shape: tuple[int, ...], dtype: str) -> None:
        if shape not in ((), (joints,)) or dtype not in _CTYPES:
            raise ConfigError(
                f"backend 'cuda': the motor law has an array {list(shape)} {dtype}: "
                f"expected [] or [{joints}], {', '.join(_CTYPES)}"
            )
        names[number], shapes[number], types[number] = name, shape, dtype

    buffers = []
    for number, constant in enumerate(law.constants):
        shape = np.shape(constant)
        place = f"[world * {joints} + joint]" if shape else "[world]"
        add(number, f"args.law_{number}{place}", shape, str(jax.dtypes.result_type(constant)))
        buffers.append(Buffer(f"law_{number}", math.prod(shape), ctype=_CTYPES[types[number]]))
    first = len(law.constants)
    add(first, "substep", (), "int32")
    add(first + 1, "position", (joints,), "float32")
    add(first + 2, "velocity", (joints,), "float32")
    for number, value, dtype in law.literals:
        add(number, _literal(value, dtype), (), dtype)

    lines = []
    for kind, operands, number, parameter in law.steps:
        shape, dtype = max((shapes[operand] for operand in operands), key=len), types[operands[-1]]
        if kind == "broadcast_in_dim":
            shape = tuple(parameter[0])
        elif kind == "reshape":
            shape = tuple(parameter)
        elif kind == "convert_element_type":
            dtype = parameter
        elif kind in _BOOLEAN:
            dtype = "bool"
        add(number, f"v{number}", shape, dtype)
        _, expression = OPERATIONS.get(kind, (None, "{0}"))
        value = expression.format(*(names[operand] for operand in operands))
        lines.append(f"  const {_CTYPES[dtype]} v{number} = {value};\n")
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
