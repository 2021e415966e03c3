"""A torque law as CUDA: the steps that `dexsim.physics.host.law` records, printed as a function of one joint.

Motors have one source, which JAX traces for every engine. A recorded law works element by element on scalars and on
vectors over the joints, so one joint's torque takes one element of each. The order of operations is the recorded one;
the compiler may fuse a product and a sum, as XLA does.
"""

import dataclasses
import json
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dexsim.core.errors import ConfigError
from dexsim.physics.cuda.arguments import Buffer
from dexsim.physics.host.law import Recorded

_CTYPES = {"float32": "float", "int32": "int", "bool": "bool"}


def _infix(operator: str) -> Callable[..., str]:
    return lambda a, b: f"{a} {operator} {b}"


def _call(function: str) -> Callable[..., str]:
    return lambda *operands: f"{function}({', '.join(operands)})"


# JAX's primitives in C. NaNs need no care: a world whose state is not finite ends anyway.
_OPERATIONS: dict[str, Callable[..., str]] = {
    "abs": lambda x: f"{x} < 0 ? -{x} : {x}",
    "add": _infix("+"),
    "and": _infix("&&"),
    "broadcast_in_dim": lambda x: x,
    "clamp": lambda low, x, high: f"{x} < {low} ? {low} : {x} > {high} ? {high} : {x}",
    "convert_element_type": lambda x: x,
    "copy": lambda x: x,
    "cos": _call("cosf"),
    "div": _infix("/"),
    "eq": _infix("=="),
    "exp": _call("expf"),
    "ge": _infix(">="),
    "gt": _infix(">"),
    "le": _infix("<="),
    "lt": _infix("<"),
    "max": lambda a, b: f"{a} > {b} ? {a} : {b}",
    "min": lambda a, b: f"{a} < {b} ? {a} : {b}",
    "mul": _infix("*"),
    "ne": _infix("!="),
    "neg": lambda x: f"-{x}",
    "not": lambda x: f"!{x}",
    "or": _infix("||"),
    "reshape": lambda x: x,
    "select_n": lambda which, first, second: f"{which} ? {second} : {first}",
    "sign": lambda x: f"({x} > 0) - ({x} < 0)",
    "sin": _call("sinf"),
    "sqrt": _call("sqrtf"),
    "sub": _infix("-"),
    "tanh": _call("tanhf"),
}
_BOOLEAN = {"and", "or", "not", "eq", "ne", "ge", "gt", "le", "lt"}


@dataclasses.dataclass(frozen=True)
class PrintedLaw:
    """A law as CUDA, and the buffers of its constants."""

    text: str
    buffers: tuple[Buffer, ...]


def print_law(law: Recorded, joints: int) -> PrintedLaw:
    """`DEV float motor_law(const Args &args, int world, int joint, int substep, float position, float velocity)`.

    Joint torque, Nm, at a joint angle, rad, and velocity, rad/s.

    Args:
      law: as recorded.
      joints: J; every array of the law is [J] or [].

    Raises:
      ConfigError: the law has arrays of another shape or type.
    """
    stored = json.loads(law.text)
    shapes, types, names = dict[int, tuple[int, ...]](), dict[int, str](), dict[int, str]()

    def add(number: int, name: str, shape: tuple[int, ...], dtype: Any) -> None:
        if shape not in ((), (joints,)) or str(dtype) not in _CTYPES:
            raise ConfigError(
                f"backend 'cuda': the motor law has an array {list(shape)} {dtype}: "
                f"expected [] or [{joints}], {', '.join(_CTYPES)}"
            )
        names[number], shapes[number], types[number] = name, shape, _CTYPES[str(dtype)]

    buffers = []
    for number, constant in enumerate(law.constants):
        shape, dtype = np.shape(constant), jax.dtypes.result_type(constant)
        place = f"[world * {joints} + joint]" if shape else "[world]"
        add(number, f"args.law_{number}{place}", shape, dtype)
        buffers.append(Buffer(f"law_{number}", math.prod(shape), ctype=types[number]))
    first = len(law.constants)
    add(first, "substep", (), "int32")
    add(first + 1, "position", (joints,), "float32")
    add(first + 2, "velocity", (joints,), "float32")
    for number, value, kind in stored["literals"]:
        add(number, _literal(value, kind), (), kind)

    lines = []
    for kind, operands, number, parameter in stored["steps"]:
        shape = max((shapes[operand] for operand in operands), key=len)
        kept = {ctype: name for name, ctype in _CTYPES.items()}[types[operands[-1]]]
        if kind == "broadcast_in_dim":
            shape = tuple(parameter[0])
        elif kind == "reshape":
            shape = tuple(parameter)
        elif kind == "convert_element_type":
            kept = parameter
        elif kind in _BOOLEAN:
            kept = "bool"
        add(number, f"v{number}", shape, kept)
        value = _OPERATIONS[kind](*(names[operand] for operand in operands))
        lines.append(f"  const {types[number]} v{number} = {value};\n")
    return PrintedLaw(
        "DEV float motor_law(const Args &args, int world, int joint, int substep, float position, float velocity) {\n"
        f"{''.join(lines)}  return {names[stored['results'][0]]};\n}}\n",
        tuple(buffers),
    )


def _literal(value: Any, dtype: str) -> str:
    if dtype != "float32":
        return f"({str(value).lower()})"
    if math.isfinite(value):
        return f"({np.float32(value):.8e}f)"
    return "(0.f / 0.f)" if math.isnan(value) else f"({'-' if value < 0 else ''}1.f / 0.f)"
