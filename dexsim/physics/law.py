"""The motors' law as a list of operations: traced by JAX, evaluated by NumPy, printed as CUDA.

Motors have one source, which JAX traces for every engine. `record` writes the traced law down, so that engines can
evaluate it at every sub-step without going back to XLA: c by `evaluator`, cuda by `cuda.program.print_law`. All work
in the same precision and order; results differ where XLA fuses a product and a sum, by a rounding.

A law works element by element on scalars and on vectors over the joints. So one joint's torque takes one element of
each, and changes of shape are none.
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.errors import ConfigError
from dexsim.physics.interface import ImplicitLaw, TorqueLaw

# JAX's primitives that work element by element, in NumPy and as an expression in C. In C NaNs need no care: a world
# whose state is not finite ends anyway.
OPERATIONS: dict[str, tuple[Callable[..., Any], str]] = {
    "abs": (np.abs, "{0} < 0 ? -{0} : {0}"),
    "add": (np.add, "{0} + {1}"),
    "add_any": (np.add, "{0} + {1}"),  # sums of derivatives
    "and": (np.logical_and, "{0} && {1}"),
    "clamp": (lambda low, x, high: np.minimum(np.maximum(x, low), high), "{1} < {0} ? {0} : {1} > {2} ? {2} : {1}"),
    "copy": (np.asarray, "{0}"),
    "cos": (np.cos, "cosf({0})"),
    "div": (np.divide, "{0} / {1}"),
    "eq": (np.equal, "{0} == {1}"),
    "exp": (np.exp, "expf({0})"),
    "ge": (np.greater_equal, "{0} >= {1}"),
    "gt": (np.greater, "{0} > {1}"),
    "le": (np.less_equal, "{0} <= {1}"),
    "lt": (np.less, "{0} < {1}"),
    "max": (np.maximum, "{0} > {1} ? {0} : {1}"),
    "min": (np.minimum, "{0} < {1} ? {0} : {1}"),
    "mul": (np.multiply, "{0} * {1}"),
    "ne": (np.not_equal, "{0} != {1}"),
    "neg": (np.negative, "-{0}"),
    "not": (np.logical_not, "!{0}"),
    "or": (np.logical_or, "{0} || {1}"),
    "select_n": (lambda which, first, second: np.where(which, second, first), "{0} ? {2} : {1}"),
    "sign": (np.sign, "({0} > 0) - ({0} < 0)"),
    "sin": (np.sin, "sinf({0})"),
    "sqrt": (np.sqrt, "sqrtf({0})"),
    "sub": (np.subtract, "{0} - {1}"),
    "tanh": (np.tanh, "tanhf({0})"),
}
_SAME = {"broadcast_in_dim", "convert_element_type", "reshape", "squeeze"}  # values that only change shape or type
_TYPES = ("float32", "int32", "bool")
_LOGICAL = {"and", "or", "not", "select_n"}  # on integers they are something else
_CALLS = ("jit", "pjit", "custom_jvp_call", "custom_vjp_call", "closed_call")


def implicit(law: TorqueLaw, timestep: float) -> ImplicitLaw:
    """Motors whose damping acts at the middle of a sub-step, within the engine's solver.

    With the torque of a sub-step's start stiff motors chatter: at 8 ms a fifth of all hands that are drawn. To first
    order the torque at the mean speed of the sub-step, v + h a / 2, is

        tau(q, v) - (h k_d / 2) a,    k_d = -d tau / d v.

    The last term goes to the left of M a = tau + contacts as an inertia. The solver so finds motors and contacts
    together, and a stalled motor, whose speed and slope are zero, keeps its torque: with 10 ms, forces of grips are
    those of 1 ms. A slope that would destabilise (a torque limit that falls with speed, driven back) is left explicit.

    Args:
      law: joint by joint: the torque of a joint depends on its own angle and speed alone.
      timestep: h, s.
    """

    def motors(substep: jax.Array, position: jax.Array, velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        torque, slope = jax.jvp(lambda v: law(substep, position, v), (velocity,), (jnp.ones_like(velocity),))
        return torque, 0.5 * timestep * jnp.maximum(-slope, 0.0)

    return motors


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A law over numbered values: first the constants, then sub-step, position and velocity."""

    constants: list[jax.Array]  # of the trace
    literals: list[list[Any]]  # number, value
    steps: list[list[Any]]  # operation, operands, result
    types: list[list[Any]]  # of every value: whether it is a vector over the joints, dtype
    torque: int
    inertia: int

    @property
    def text(self) -> str:
        """All but the constants, for `evaluator`."""
        return json.dumps([len(self.constants), self.literals, self.steps, self.types, self.torque, self.inertia])


def record(law: ImplicitLaw, joints: jax.Array) -> Recorded:
    """Trace a law; of `joints` [J] only shape and type count. Raises ConfigError: it has an operation that is not
    element by element, or arrays of another shape or type."""
    traced = jax.make_jaxpr(law)(jnp.int32(0), joints, joints)
    literals: list[list[Any]] = []
    steps: list[list[Any]] = []
    types: list[list[Any]] = []

    def number(variable: Any) -> int:
        """The next number, for a value of this type."""
        types.append([bool(variable.aval.shape), str(variable.aval.dtype)])
        return len(types) - 1

    def run(jaxpr: Any, inputs: list[int]) -> list[int]:
        """Numbers of a jaxpr's results."""
        names = dict(zip((*jaxpr.constvars, *jaxpr.invars), inputs, strict=True))

        def read(variable: Any) -> int:
            if not hasattr(variable, "val"):
                return names[variable]
            literals.append([number(variable), np.asarray(variable.val).item()])
            return literals[-1][0]

        for equation in jaxpr.eqns:
            operands, options = [read(v) for v in equation.invars], equation.params
            inner = options.get("jaxpr", options.get("call_jaxpr"))
            if inner is not None and equation.primitive.name in _CALLS and not inner.consts:
                results = run(inner.jaxpr, operands)
            else:
                if not _is_elementwise(equation, joints.shape):
                    raise ConfigError(
                        f"a motor law with {equation.primitive.name}: backends c and cuda take laws of element-wise "
                        f"operations on [] and {list(joints.shape)}; choose backend mjx"
                    )
                results = [number(equation.outvars[0])]
                steps.append([equation.primitive.name, operands, results[0]])
            names.update(zip(equation.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    inputs = [number(v) for v in (*traced.jaxpr.constvars, *traced.jaxpr.invars)]
    torque, inertia = run(traced.jaxpr, inputs)
    return Recorded(traced.consts, literals, steps, types, torque, inertia)


def _is_elementwise(equation: Any, joints: tuple[int, ...]) -> bool:
    """Whether it works joint by joint, on scalars and vectors [J] of `_TYPES` alone."""
    kind, operands = equation.primitive.name, equation.invars
    values = [variable.aval for variable in (*operands, *equation.outvars)]
    if kind in _LOGICAL and (values[0].dtype != bool or len(operands) > 3):
        return False
    typed = all(value.shape in ((), joints) and str(value.dtype) in _TYPES for value in values)
    return typed and (kind in OPERATIONS or (kind in _SAME and len(operands) == 1))


BatchLaw = Callable[[int, np.ndarray, np.ndarray], list[np.ndarray]]
"""Sub-step, position rad and velocity rad/s [B, J] to torque Nm and inertia kg m^2 [B, J]."""


@functools.lru_cache(maxsize=64)
def evaluator(text: bytes) -> Callable[[list[np.ndarray]], BatchLaw]:
    """`Recorded.text` as a function of the law's constants, in NumPy: every array has a batch axis in front, of length
    one if the whole batch shares it. A scalar of each environment is [B, 1] beside vectors [B, J]."""
    constants, literals, steps, types, *results = json.loads(text)
    inputs = range(constants, constants + 3)
    written = {number: np.asarray(value, types[number][1]) for number, value in literals}

    def bind(values: list[np.ndarray]) -> BatchLaw:
        fixed = {k: value.reshape(len(value), -1) for k, value in enumerate(values)} | written

        def law(substep: int, position: np.ndarray, velocity: np.ndarray) -> list[np.ndarray]:
            values = fixed | dict(zip(inputs, (np.asarray(substep, np.int32), position, velocity), strict=True))
            for kind, operands, number in steps:
                arguments = [values[operand] for operand in operands]
                if kind in _SAME:
                    values[number] = arguments[0].astype(types[number][1], copy=False)
                else:
                    values[number] = OPERATIONS[kind][0](*arguments)
            return [values[number] for number in results]

        return law

    return bind
