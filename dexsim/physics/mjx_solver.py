"""MJX's contact solver with derivatives, forward and reverse.

MJX iterates in a loop that has no reverse mode, and its forward mode gives NaN. But the solution a is where

    F(a) = M a - tau - J^T f(J a - a_ref) = 0

(MuJoCo's documentation, chapter Computation, section Constraint model), so it changes by da = -H^-1 dF, of which
H = M - J^T f' J is the Hessian of the solver's convex problem.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx


@contextlib.contextmanager
def mjx_arithmetic() -> Iterator[None]:
    """MJX relies on implicit promotion, which the caller may have made an error. TF32, the default of products on
    NVIDIA GPUs, is too coarse for a solver."""
    with (
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        jax.default_matmul_precision("highest"),
    ):
        yield


@jax.custom_jvp
def solve(model: Any, data: Any) -> tuple[jax.Array, jax.Array]:
    """Acceleration [V] and the force [R] of each constraint's row, of `mjx.Data` before `mjx.solve`."""
    data = mjx.solve(model, data)
    return data.qacc, data._impl.efc_force


@solve.defjvp
@mjx_arithmetic()
def _solve_jvp(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    acceleration, force = solve(*primals)
    _, change = jax.jvp(lambda model, data: _residual(model, data, acceleration), primals, tangents)
    hessian = jax.jacfwd(lambda a: _residual(*primals, a))(acceleration)
    moved = -jax.scipy.linalg.solve(hessian, change, assume_a="pos")
    _, pressed = jax.jvp(row_force, (*primals, acceleration), (*tangents, moved))
    return (acceleration, force), (moved, pressed)


def _residual(model: Any, data: Any, acceleration: jax.Array) -> jax.Array:
    """F [V], zero at the solution."""
    force = row_force(model, data, acceleration)
    return mjx.mul_m(model, data, acceleration) - data.qfrc_smooth - data._impl.efc_J.T @ force


def row_force(model: Any, data: Any, acceleration: jax.Array) -> jax.Array:
    """Force f [R] of each row: couplings, dry friction, joint limits, and contacts of three rows (elliptic cones)."""
    rows, contact = data._impl, data._impl.contact
    miss = rows.efc_J @ acceleration - rows.efc_aref
    spring = -rows.efc_D * miss
    # Couplings push and pull, dry friction does so up to a bound, limits push.
    row = jnp.arange(len(miss))
    coupling, dry = row < rows.ne, row < rows.ne + rows.nf
    most = jnp.where(dry & ~coupling, rows.efc_frictionloss, jnp.inf)
    force = jnp.clip(spring, jnp.where(dry, -most, 0.0), most)

    start = len(miss) - 3 * len(contact.dim)  # contacts are last
    friction = contact.friction[:, :2]
    mu = friction[:, 0] / jnp.sqrt(model.opt.impratio)  # of the regularised cone
    normal, slide = mu * miss[start::3], friction * miss[start:].reshape(-1, 3)[:, 1:]
    square = jnp.sum(slide**2, -1)
    moves = square > 0
    length = jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0)
    sticks = jnp.where(moves, mu * normal + length <= 0, normal < 0)
    slides = moves & ~sticks & (normal < mu * length)
    press = rows.efc_D[start::3] / (mu * (1 + mu**2)) * (mu * length - normal)
    drag = -press[:, None] * friction * slide / jnp.where(moves, length, 1.0)[:, None]
    cone = jnp.where(slides[:, None], jnp.concatenate([press[:, None], drag], -1), 0.0)
    cone = jnp.where(sticks[:, None], spring[start:].reshape(-1, 3), cone)
    return force.at[start:].set(cone.reshape(-1))
