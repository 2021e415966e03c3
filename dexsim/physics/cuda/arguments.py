"""What crosses into the kernel: one list of buffers, printed as the C++ struct `Args` and packed as its bytes."""

import ctypes
import dataclasses
from collections.abc import Sequence


@dataclasses.dataclass(frozen=True)
class Buffer:
    """An array on the device, [worlds, size] in one piece."""

    name: str  # in `Args`
    size: int  # values of a world
    output: bool = False
    ctype: str = "float"  # or int, bool


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is the same for all worlds, in the order of `Args`."""

    substeps: int
    iterations: int  # Newton's, at most
    line_search: int  # evaluations in each of them, at most
    tolerance: float  # of the Newton decrement, where iterations stop
    line_search_tolerance: float  # share of the decrement, where the line search stops


_NUMBERS = [
    ("n", int),
    *((field.name, float if field.type is float else int) for field in dataclasses.fields(Settings)),
]


def declare_args(buffers: Sequence[Buffer]) -> str:
    """`struct Args` in C++: pointers in the order of `buffers`, the number of worlds, `Settings`."""
    pointers = "".join(f"  {'' if buffer.output else 'const '}{buffer.ctype} *{buffer.name};\n" for buffer in buffers)
    numbers = "".join(f"  {kind.__name__} {name};\n" for name, kind in _NUMBERS)
    return f"struct Args {{\n{pointers}{numbers}}};\n"


def args_type(count: int) -> type[ctypes.Structure]:
    """The same struct in ctypes, with one array `pointers` in place of `count` names."""
    numbers = [(name, ctypes.c_float if kind is float else ctypes.c_int) for name, kind in _NUMBERS]
    return type("Args", (ctypes.Structure,), {"_fields_": [("pointers", ctypes.c_void_p * count), *numbers]})
