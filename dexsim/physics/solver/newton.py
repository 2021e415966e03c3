"""Contact forces by Newton's method with elliptic friction cones, for the JAX backend.

The problem is MuJoCo's (documentation, chapter Computation, section Constraint model): the acceleration that
minimises the Gauss distance to the free one plus the cost of contacts and joint limits. MJX solves the same,
through a square matrix over all rows that it fills contact by contact and a line search of three
points a step; here contacts stay blocks of three rows and the search is Newton's on the slope, kept
in a bracket: less to compute on a CPU, and a smaller program to compile.
"""

import jax
import jax.numpy as jnp

from dexsim.core.pytree import align, pytree_dataclass

_TINY = 1e-15


@pytree_dataclass
class Rows:
    """Contacts of three rows each (normal, two sliding), and limits of single degrees of freedom.

    A row presses with `weight` times what acceleration falls short of `wanted`; inactive ones weigh 0.
    """

    jacobian: jax.Array  # [C, 3, V]
    reference: jax.Array  # [C, 3] m/s^2, MuJoCo's aref
    weight: jax.Array  # [C, 3] kg, MuJoCo's efc_D
    scale: jax.Array  # [C, 3] friction: of the regularised cone, and of both directions
    limit_side: jax.Array  # [V] 1 at the lower limit, -1 at the upper
    limit_reference: jax.Array  # [V] rad/s^2
    limit_weight: jax.Array  # [V] kg m^2


@pytree_dataclass
class _Cone:
    """Where contacts are with respect to their cones."""

    normal: jax.Array  # [C]
    slide: jax.Array  # [C, 2]
    length: jax.Array  # [C] of slide
    bottom: jax.Array  # [C] sticking
    middle: jax.Array  # [C] sliding
    stiff: jax.Array  # [C] kg, along the cone, 0 unless sliding
    short: jax.Array  # [C] how far inside the dual cone


def _cone(rows: Rows, miss: jax.Array) -> _Cone:
    mu, u = rows.scale[:, 0], miss * rows.scale
    normal, slide = u[:, 0], u[:, 1:]
    length = jnp.sqrt(slide[:, 0] ** 2 + slide[:, 1] ** 2 + _TINY)
    bottom = mu * normal + length <= 0
    middle = ~bottom & (normal < mu * length)
    stiff = jnp.where(middle, rows.weight[:, 0] / (mu**2 * (1 + mu**2)), 0.0)
    return _Cone(normal, slide, length, bottom, middle, stiff, normal - mu * length)


def contact_force(rows: Rows, acceleration: jax.Array) -> jax.Array:
    """Forces [C, 3] N along the rows of the contacts."""
    miss = jnp.sum(rows.jacobian * align(acceleration, rows.jacobian), -1) - rows.reference
    return _force(rows, miss, _cone(rows, miss))


def _force(rows: Rows, miss: jax.Array, cone: _Cone) -> jax.Array:
    press = -cone.stiff * cone.short * rows.scale[:, 0]
    slide = -(press / cone.length)[:, None] * cone.slide * rows.scale[:, 1:]
    sliding = jnp.concatenate([press[:, None], slide], -1)
    return jnp.where(cone.bottom[:, None], -rows.weight * miss, sliding)


def _hessian(rows: Rows, cone: _Cone) -> jax.Array:
    """Second derivatives [C, 3, 3] of the contacts' cost."""
    mu, length = rows.scale[:, 0], cone.length
    unit = cone.slide / length[:, None]
    across = mu * cone.normal / length
    bend = across[:, None, None] * unit[:, :, None] * unit[:, None, :]
    block = bend + (mu**2 - across)[:, None, None] * jnp.eye(2)[None]
    edge = -mu[:, None] * unit
    top = jnp.concatenate([jnp.ones_like(mu)[:, None], edge], -1)[:, None, :]
    full = jnp.concatenate([top, jnp.concatenate([edge[:, :, None], block], -1)], 1)
    full = full * cone.stiff[:, None, None] * rows.scale[:, :, None] * rows.scale[:, None, :]
    return jnp.where(cone.bottom[:, None, None], rows.weight[:, :, None] * jnp.eye(3)[None], full)


def _cost(rows: Rows, mass: jax.Array, force: jax.Array, acceleration: jax.Array) -> jax.Array:
    """What is minimised, but for a constant."""
    miss = jnp.sum(rows.jacobian * align(acceleration, rows.jacobian), -1) - rows.reference
    cone = _cone(rows, miss)
    limit = jnp.minimum(rows.limit_side * acceleration - rows.limit_reference, 0.0)
    return 0.5 * (
        jnp.dot(acceleration, mass @ acceleration - 2 * force)
        + jnp.sum(rows.limit_weight * limit**2)
        + jnp.sum(cone.stiff * cone.short**2)
        + jnp.sum(jnp.where(cone.bottom, jnp.sum(rows.weight * miss**2, -1), 0.0))
    )


def solve(
    rows: Rows, mass: jax.Array, force: jax.Array, guess: jax.Array, *, iterations: int, line_search: int
) -> jax.Array:
    """The acceleration [V] under contacts and limits.

    Args:
      mass: [V, V] inertia of the degrees of freedom.
      force: [V] all other forces.
      guess: [V] where to start from, unless the free acceleration is the better start.
      iterations: Newton steps; `line_search`: steps of the search along each.
    """
    free = _solve_positive(mass, force)
    better = _cost(rows, mass, force, guess) < _cost(rows, mass, force, free)
    flat = rows.jacobian.reshape(-1, rows.jacobian.shape[-1])

    def improve(_, now):
        miss = (flat @ now).reshape(rows.reference.shape) - rows.reference
        limit = rows.limit_side * now - rows.limit_reference
        cone = _cone(rows, miss)
        pressed = jnp.where(limit < 0, rows.limit_weight, 0.0)
        push = _force(rows, miss, cone).reshape(-1) @ flat - pressed * limit * rows.limit_side
        unbalanced = mass @ now - force
        blocks = jnp.sum(_hessian(rows, cone)[:, :, :, None] * rows.jacobian[:, None, :, :], 2)
        curvature = mass + flat.T @ blocks.reshape(flat.shape) + jnp.diag(pressed * rows.limit_side**2)
        step = -_solve_positive(curvature, unbalanced - push)
        moved = (flat @ step).reshape(rows.reference.shape)
        line = (jnp.dot(step, unbalanced), jnp.dot(step, mass @ step))
        return now + _search(rows, miss, moved, limit, rows.limit_side * step, line, line_search) * step

    return jax.lax.fori_loop(0, iterations, improve, jnp.where(better, guess, free))


def _search(
    rows: Rows,
    miss: jax.Array,
    moved: jax.Array,
    limit: jax.Array,
    limit_moved: jax.Array,
    line: tuple[jax.Array, jax.Array],
    steps: int,
) -> jax.Array:
    """How far [] along a Newton step the cost is least: Newton's method on its slope, which only rises."""
    mu, v = rows.scale[:, 0], moved * rows.scale

    def closer(_, bracket):
        here, low, high = bracket
        cone = _cone(rows, miss + here * moved)
        along = jnp.sum(cone.slide * v[:, 1:], -1) / cone.length
        bend = (v[:, 1] ** 2 + v[:, 2] ** 2 - along**2) / cone.length
        rate = v[:, 0] - mu * along
        stuck = jnp.where(cone.bottom[:, None], rows.weight * moved, 0.0)
        limited = jnp.where(limit + here * limit_moved < 0, rows.limit_weight * limit_moved, 0.0)
        slope = (
            line[0]
            + here * line[1]
            + jnp.sum(stuck * (miss + here * moved))
            + jnp.sum(limited * (limit + here * limit_moved))
            + jnp.sum(cone.stiff * cone.short * rate)
        )
        curve = (
            line[1]
            + jnp.sum(stuck * moved)
            + jnp.sum(limited * limit_moved)
            + jnp.sum(cone.stiff * (rate**2 - cone.short * mu * bend))
        )
        low, high = jnp.where(slope < 0, here, low), jnp.where(slope < 0, high, here)
        newton = here - slope / jnp.maximum(curve, _TINY)
        return jnp.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high)), low, high

    # Of each environment's own from the first, or vmap would trace the loops around this twice.
    nothing = 0.0 * line[1]
    start = (nothing + 1, nothing, nothing + 1e6)
    return jax.lax.fori_loop(0, steps, closer, start)[0]


def _solve_positive(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    factor = jax.lax.linalg.cholesky(matrix, symmetrize_input=False)
    half = jax.lax.linalg.triangular_solve(factor, vector[:, None], left_side=True, lower=True)
    return jax.lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)[:, 0]
