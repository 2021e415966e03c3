"""MuJoCo's own MJX: any device, and gradients through contacts, forward and reverse.

MJX's contact solver iterates in a loop that has no reverse mode, and its forward mode gives NaN. But the solution a is
where

    F(a) = M a - tau - J^T f(J a - a_ref) = 0

(MuJoCo's documentation, chapter Computation, section Constraint model), so it changes by da = -H^-1 dF, of which
H = M - J^T f' J is the Hessian of the solver's convex problem.
"""

import contextlib
import io
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.errors import AssetError
from dexsim.physics.interface import Fields, ImplicitLaw, PhysicsScene, PhysicsState, StepResult, configured

with contextlib.redirect_stdout(io.StringIO()):  # It prints that Warp is missing, which nothing here uses.
    from mujoco import mjx


class MjxBackend:
    """`dexsim.physics.interface.Backend` in JAX."""

    def __init__(self, scene: PhysicsScene):
        """Raises AssetError: MJX lacks what the scene uses."""
        self.scene, model = scene, scene.model
        try:
            self.model = mjx.put_model(model, device=jax.local_devices()[0], impl="jax")
        except NotImplementedError as error:
            raise AssetError(f"{scene.hand.model_path}: backend mjx: {error}") from None
        fingers = {int(body): finger for finger, body in enumerate(scene.tip_bodies)}
        # Whose tip link a geom belongs to, -1 for none.
        self._finger_of_geom = np.array([fingers.get(int(body), -1) for body in model.geom_bodyid])
        self._is_object_geom = np.isin(np.arange(model.ngeom), scene.object_geoms)

    def advance(self, fields: Fields, state: PhysicsState, law: ImplicitLaw, push: jax.Array) -> StepResult:
        """One control tick by MJX."""
        scene, model = self.scene, self.model.replace(**configured(self.scene, fields))
        wrench = jnp.zeros((scene.model.nbody, 6)).at[scene.object_body, :3].set(push)
        data = mjx.make_data(self.model).replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, xfrc_applied=wrench
        )

        def substep(data: Any, index: jax.Array) -> tuple[Any, None]:
            torque, inertia = law(index, data.qpos[scene.joint_qpos], data.qvel[scene.joint_dof])
            applied = jnp.zeros(scene.model.nv).at[scene.joint_dof].set(torque)
            armature = self.model.dof_armature.at[scene.joint_dof].add(inertia)
            return _step(model.replace(dof_armature=armature), data.replace(qfrc_applied=applied)), None

        # Forces are read after the scan: as an output of it they would double the step's time.
        with mjx_arithmetic():
            data, _ = jax.lax.scan(substep, data, jnp.arange(scene.config.substeps))
        return StepResult(PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), self.finger_force(data))

    def finger_force(self, data: Any) -> jax.Array:
        """Force [F, 3] N of the object on each finger, from data after a step: MJX has no sensor that matches bodies,
        so the solver's forces are added up."""
        fingers = self.scene.hand.num_fingers
        touch = data._impl.contact
        dim, address = np.asarray(touch.dim), np.asarray(touch.efc_address)
        use = np.flatnonzero((dim == 3) & (address >= 0))
        local = data._impl.efc_force[address[use][:, None] + np.arange(3)]
        frame = touch.frame[use]  # rows are the axes; the normal points from geom1 to geom2
        force = jnp.sum(frame * local[..., None], 1)
        touching = (touch.dist[use] < touch.includemargin[use])[:, None]
        force = jnp.where(touching, force, 0.0)
        # The force acts on geom2; geom1 feels the opposite. The object is no finger's, and not twice in a pair.
        finger = jnp.max(jnp.asarray(self._finger_of_geom)[touch.geom[use]], -1)
        first, second = jnp.asarray(self._is_object_geom, jnp.float32)[touch.geom[use]].T
        share = (first - second)[None] * jax.nn.one_hot(finger, fingers).T
        return jnp.sum(share[..., None] * force[None], 1)


def _step(model: Any, data: Any) -> Any:
    """`mjx.step`, with a solver that has derivatives. Our scenes have no sensors."""
    for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    acceleration, force = solve(model, data)
    return mjx.euler(model, data.tree_replace({"qacc": acceleration, "_impl.efc_force": force}))


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
