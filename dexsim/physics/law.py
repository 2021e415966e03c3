"""The motors' law as a list of operations: traced by JAX, evaluated by NumPy, printed as CUDA.

Motors have one source, which JAX traces for every engine. `record` writes the traced law down, so that engines can
evaluate it at every sub-step without going back to XLA: c by `evaluator`, cuda by `dexsim.physics.cuda.law`. All work
in the same precision and order; results differ where XLA fuses a product and a sum, by a rounding.
"""

import dataclasses
import functools
import itertools
import json
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import ConfigError
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
    literals: list[list[Any]]  # number, value, dtype
    steps: list[list[Any]]  # operation, operands, result, parameter
    torque: int
    inertia: int

    @property
    def text(self) -> str:
        """All but the constants, for `evaluator`."""
        inputs = range(len(self.constants), len(self.constants) + 3)
        return json.dumps([list(inputs), self.literals, self.steps, self.torque, self.inertia])


def record(law: ImplicitLaw, joints: jax.Array) -> Recorded:
    """Trace a law; of `joints` [J] only shape and type count.

    Raises:
      ConfigError: it has an operation that is not element by element.
    """
    traced = jax.make_jaxpr(law)(jnp.int32(0), joints, joints)
    literals: list[list[Any]] = []
    steps: list[list[Any]] = []
    numbers = itertools.count()

    def run(jaxpr: Any, inputs: list[int]) -> list[int]:
        """Numbers of a jaxpr's results."""
        names = dict(zip((*jaxpr.constvars, *jaxpr.invars), inputs, strict=True))

        def read(variable: Any) -> int:
            if not hasattr(variable, "val"):
                return names[variable]
            if np.ndim(variable.val):
                raise _unknown("an array that is written into it")
            literals.append([next(numbers), np.asarray(variable.val).item(), str(variable.aval.dtype)])
            return literals[-1][0]

        for equation in jaxpr.eqns:
            operands, options = [read(v) for v in equation.invars], equation.params
            inner = options.get("jaxpr", options.get("call_jaxpr"))
            if inner is not None and equation.primitive.name in _CALLS and not inner.consts:
                results = run(inner.jaxpr, operands)
            else:
                kind, parameter = _operation(equation)
                results = [next(numbers)]
                steps.append([kind, operands, results[0], parameter])
            names.update(zip(equation.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    inputs = [next(numbers) for _ in (*traced.jaxpr.constvars, *traced.jaxpr.invars)]
    torque, inertia = run(traced.jaxpr, inputs)
    return Recorded(traced.consts, literals, steps, torque, inertia)


def _operation(equation: Any) -> tuple[str, Any]:
    """An equation's operation and its parameter."""
    kind, options = equation.primitive.name, equation.params
    if kind == "broadcast_in_dim" and len(equation.invars) == 1:
        return kind, [list(options["shape"]), list(options["broadcast_dimensions"])]
    if kind == "convert_element_type":
        return kind, str(np.dtype(options["new_dtype"]))
    if kind in ("reshape", "squeeze"):
        return "reshape", list(equation.outvars[0].aval.shape)
    if kind not in OPERATIONS:
        raise _unknown(kind)
    if kind in _LOGICAL and (equation.invars[0].aval.dtype != bool or len(equation.invars) > 3):
        raise _unknown(f"{kind} of {equation.invars[0].aval.dtype}")
    return kind, None


def _unknown(what: str) -> ConfigError:
    return ConfigError(
        f"a motor law with {what}: backends c and cuda take laws of element-wise operations; choose backend mjx"
    )


BatchLaw = Callable[[int, np.ndarray, np.ndarray], list[np.ndarray]]
"""Sub-step, position rad and velocity rad/s [B, J] to torque Nm and inertia kg m^2 [B, J]."""


@functools.lru_cache(maxsize=64)
def evaluator(text: bytes) -> Callable[[list[np.ndarray]], BatchLaw]:
    """`Recorded.text` as a function of the law's constants, in NumPy: every array has a batch axis in front, of length
    one if the whole batch shares it."""
    inputs, literals, steps, *results = json.loads(text)
    written = {number: np.asarray(value, dtype) for number, value, dtype in literals}
    # What depends on constants alone is the same at all sub-steps of a tick.
    moving, once, always = set(inputs), list[Any](), list[Any]()
    for step in steps:
        _, operands, number, _ = step
        changes = not moving.isdisjoint(operands)
        (always if changes else once).append(step)
        if changes:
            moving.add(number)

    def bind(constants: list[np.ndarray]) -> BatchLaw:
        fixed = dict(enumerate(constants)) | written
        _evaluate(once, fixed)

        def law(substep: int, position: np.ndarray, velocity: np.ndarray) -> list[np.ndarray]:
            values = fixed | dict(zip(inputs, (np.asarray(substep, np.int32), position, velocity), strict=True))
            _evaluate(always, values)
            return [values[number] for number in results]

        return law

    return bind


def _evaluate(steps: list[Any], values: dict[int, np.ndarray]) -> None:
    """Add to `values` what `steps` make of them."""
    for kind, operands, number, parameter in steps:
        arguments = [values[operand] for operand in operands]
        if kind == "broadcast_in_dim":
            values[number] = _broadcast(arguments[0], *parameter)
        elif kind == "convert_element_type":
            values[number] = arguments[0].astype(parameter)
        elif kind == "reshape":
            values[number] = arguments[0].reshape(arguments[0].shape[:1] + tuple(parameter))
        else:
            values[number] = OPERATIONS[kind][0](*_aligned(arguments))


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
