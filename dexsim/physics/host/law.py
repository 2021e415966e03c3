"""A torque law on the host: traced by JAX, evaluated by NumPy.

Motors have one source, which JAX traces for every engine. `record` writes the traced law down as a list of NumPy
operations, which `Law` evaluates for a batch at every sub-step, without going back to XLA. Both work in the same
precision and order; results differ where XLA fuses a product and a sum, by a rounding.
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.physics.interface import PhysicsScene, PhysicsState, StepResult, TorqueLaw

# JAX's primitives that work element by element, in NumPy.
_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "add": np.add,
    "and": np.logical_and,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "copy": np.asarray,
    "cos": np.cos,
    "div": np.divide,
    "eq": np.equal,
    "exp": np.exp,
    "ge": np.greater_equal,
    "gt": np.greater,
    "le": np.less_equal,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.logical_not,
    "or": np.logical_or,
    "select_n": lambda which, first, second: np.where(which, second, first),
    "sign": np.sign,
    "sin": np.sin,
    "sqrt": np.sqrt,
    "sub": np.subtract,
    "tanh": np.tanh,
}
_LOGICAL = {"and", "or", "not", "select_n"}


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A law as text, and the arrays of the trace that it refers to."""

    text: str
    constants: list[jax.Array]


def record(law: TorqueLaw, joints: jax.Array) -> Recorded | None:
    """Trace `law` (`dexsim.physics.interface.TorqueLaw`); None if it has a primitive that `Law` lacks.

    Of `joints` [J] only shape and type count.
    """
    traced = jax.make_jaxpr(law)(jnp.int32(0), joints, joints)
    writer = _Writer()
    try:
        numbers = writer.run(traced.jaxpr, [writer.new() for _ in (*traced.jaxpr.constvars, *traced.jaxpr.invars)])
    except _Unknown:
        return None
    text = json.dumps({"literals": writer.literals, "steps": writer.steps, "results": numbers})
    return Recorded(text, traced.consts)


def one_by_one(
    scene: PhysicsScene,
    substep: Callable[[TorqueLaw, PhysicsState], StepResult],
    torque: TorqueLaw,
    state: PhysicsState,
) -> StepResult:
    """`Backend.advance` with the law left to XLA: an engine's `substep` for each, under torques that are constant."""

    def run(state: PhysicsState, index: jax.Array) -> tuple[PhysicsState, jax.Array]:
        tau = torque(index, state.qpos[scene.joint_qpos], state.qvel[scene.joint_dof])
        return substep(lambda *_: tau, state)

    state, forces = jax.lax.scan(run, state, jnp.arange(scene.config.substeps))
    return StepResult(state, forces[-1])


class _Unknown(Exception):
    pass


class _Writer:
    """Turns a jaxpr into steps (operation, operands, result, parameter) over numbered values."""

    def __init__(self):
        self.steps: list[list[Any]] = []
        self.literals: list[list[Any]] = []  # number, value, dtype
        self._count = 0

    def new(self) -> int:
        self._count += 1
        return self._count - 1

    def run(self, jaxpr: Any, inputs: list[int]) -> list[int]:
        names = dict(zip((*jaxpr.constvars, *jaxpr.invars), inputs, strict=True))

        def read(variable: Any) -> int:
            if not hasattr(variable, "val"):
                return names[variable]
            if np.ndim(variable.val):
                raise _Unknown
            number = self.new()
            self.literals.append([number, np.asarray(variable.val).item(), str(variable.aval.dtype)])
            return number

        for equation in jaxpr.eqns:
            operands, kind, options = [read(v) for v in equation.invars], equation.primitive.name, equation.params
            inner = options.get("jaxpr", options.get("call_jaxpr"))
            if inner is not None and kind in ("jit", "pjit", "custom_jvp_call", "custom_vjp_call", "closed_call"):
                if inner.consts:
                    raise _Unknown
                numbers = self.run(inner.jaxpr, operands)
            else:
                numbers = [self._step(kind, options, operands, equation)]
            names.update(zip(equation.outvars, numbers, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _step(self, kind: str, options: dict[str, Any], operands: list[int], equation: Any) -> int:
        parameter: Any = None
        if kind == "broadcast_in_dim" and len(operands) == 1:
            parameter = [list(options["shape"]), list(options["broadcast_dimensions"])]
        elif kind == "convert_element_type":
            parameter = str(np.dtype(options["new_dtype"]))
        elif kind in ("reshape", "squeeze"):
            kind, parameter = "reshape", list(equation.outvars[0].aval.shape)
        elif kind in _LOGICAL:
            if equation.invars[0].aval.dtype != bool or len(operands) > 3:
                raise _Unknown
        elif kind not in _ELEMENTWISE or len(equation.outvars) != 1:
            raise _Unknown
        number = self.new()
        self.steps.append([kind, operands, number, parameter])
        return number


class Law:
    """A recorded law for a batch: every array has one batch axis in front, of length one if it is shared."""

    def __init__(self, text: bytes):
        stored = json.loads(text)
        self._steps, (self._result,) = stored["steps"], stored["results"]
        self._literals = {number: np.asarray(value, dtype) for number, value, dtype in stored["literals"]}

    def __call__(
        self, constants: list[np.ndarray], substep: int, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Torque [B, J] Nm."""
        values = dict(enumerate([*constants, np.asarray(substep, np.int32), position, velocity])) | self._literals
        for kind, operands, number, parameter in self._steps:
            given = [values[operand] for operand in operands]
            if kind == "broadcast_in_dim":
                values[number] = _broadcast(given[0], *parameter)
            elif kind == "convert_element_type":
                values[number] = given[0].astype(parameter)
            elif kind == "reshape":
                values[number] = given[0].reshape(given[0].shape[:1] + tuple(parameter))
            else:
                values[number] = _ELEMENTWISE[kind](*_aligned(given))
        return values[self._result]


@functools.lru_cache(maxsize=64)
def read_law(text: bytes) -> Law:
    """The law of `Recorded.text`."""
    return Law(text)


def _aligned(values: list[np.ndarray]) -> list[np.ndarray]:
    """A scalar of each environment [B] beside vectors [B, J] needs an axis; JAX broadcasts scalars by itself."""
    rank = max(value.ndim for value in values)
    return [
        value.reshape(value.shape + (1,) * (rank - value.ndim)) if 0 < value.ndim < rank else value for value in values
    ]


def _broadcast(value: np.ndarray, shape: list[int], axes: list[int]) -> np.ndarray:
    batch = value.shape[:1] or (1,)
    own = [1] * len(shape)
    for axis, length in zip(axes, value.shape[1:], strict=True):
        own[axis] = length
    return np.broadcast_to(value.reshape(batch + tuple(own)), batch + tuple(shape))
