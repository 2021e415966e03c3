"""One physics sub-step on the JAX backend: MJX's rigid bodies, our contacts and solver.

The same equations of motion as `mjx.step` in this library's scenes. Contacts are where C MuJoCo has them, but for links
on cylinders, which MJX has elsewhere, too; fingers' forces differ accordingly (docs/experiments/physics.jsonl). It is
faster on a CPU and quicker to compile (`collide`, `newton`). Other scenes need `mjx.step`; see `find_stepper`.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.core.pytree import Array, align
from dexsim.geometry import rotations
from dexsim.physics.solver import collide, newton

# Newton steps beyond the configured ones: they are cheap here, and with few of them some grips stay unsettled
# between sticking and sliding, where rounding decides (docs/decisions.md).
# MJX's line search looks at three points in each of its steps, this one at one.
_MORE_STEPS = 7
_JOINTS = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


@dataclasses.dataclass(frozen=True, eq=False)
class Stepper:
    """Constants of a scene; `step` is pure and written for one environment."""

    mjx: Any  # the module, imported when a scene is compiled
    collider: collide.Collider
    max_contacts: int  # contacts kept: the deepest
    iterations: int
    line_search: int
    timestep: float
    impratio: float
    moves: np.ndarray  # [P, V] 1 where a degree of freedom moves the second geom's body, -1 the first's
    compliance: np.ndarray  # [P] 1/kg, inverse weights of both bodies
    finger: np.ndarray  # [P, F] 1 where the object presses on a finger as the pair's first, -1 as its second
    root: np.ndarray  # [V] root body of a degree of freedom
    push: np.ndarray  # [V] 1 where a force on the object acts
    object_body: int
    limit: dict[str, np.ndarray]  # joint limits by degree of freedom
    scalar: np.ndarray  # [Q', 2] addresses in qpos and qvel of hinges and slides
    free: np.ndarray  # [N, 2] addresses of free joints

    def step(
        self, model: Any, data: Any, applied: jax.Array, push: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array]:
        """A sub-step under generalised forces [V] and a force [3] N on the object's centre of mass.

        `data` holds the state. Returns (qpos, qvel, acceleration) and the force of the object on each
        finger [F, 3] N.
        """
        # TF32, the default of products on NVIDIA GPUs, is too coarse for a solver.
        with jax.default_matmul_precision("highest"):
            return self._step(model, data, applied, push)

    def _step(
        self, model: Any, data: Any, applied: jax.Array, push: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array]:
        # MJX relies on implicit promotion, which the caller may have made an error.
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            for part in ("kinematics", "com_pos", "crb", "com_vel", "passive", "rne"):
                data = getattr(self.mjx, part)(model, data)
        # Motion of each degree of freedom at the world's origin; MJX gives it at its tree's centre of mass.
        turn = data.cdof[:, :3]
        shift = data.cdof[:, 3:] - jnp.cross(turn, data.subtree_com[self.root])
        arm = data.xipos[self.object_body]
        pushed = self.push * (shift @ push + turn @ jnp.cross(arm, push))
        force = data.qfrc_passive - data.qfrc_bias + applied + pushed
        rows, frame, finger = self._rows(model, data, turn, shift)
        mass = self.mjx.full_m(model, data)
        acceleration = newton.solve(
            rows, mass, force, data.qacc_warmstart, iterations=self.iterations, line_search=self.line_search
        )
        press = newton.contact_force(rows, acceleration)
        world = jnp.sum(frame * press[:, :, None], 1)  # on the second geom; the first feels the opposite
        on_finger = -jnp.sum(finger[:, :, None] * world[:, None, :], 0)
        return (*self._integrate(data, acceleration), acceleration), on_finger

    def _rows(
        self, model: Any, data: Any, turn: jax.Array, shift: jax.Array
    ) -> tuple[newton.Rows, jax.Array, jax.Array]:
        """The constraints, frames [C, 3, 3] of the contacts, and whose finger they press [C, F]."""
        gap, point, normal = self.collider.touch(data.geom_xpos, data.geom_xmat, model.geom_size)
        count, dofs, fingers = min(self.max_contacts, len(self.collider.pair)), turn.shape[0], self.finger.shape[1]
        pair = jnp.asarray(self.collider.pair)
        gap = gap - model.pair_margin[pair]
        _, best = jax.lax.top_k(-gap, count)
        # One table, one gather.
        table = jnp.concatenate(
            [
                self.moves,
                self.compliance[:, None],
                self.finger,
                model.pair_friction[:, :2],
                model.pair_solref,
                model.pair_solimp,
            ],
            -1,
        )[pair[best]]
        moves, compliance, finger, friction, solref, solimp = jnp.split(table, np.cumsum([dofs, 1, fingers, 2, 2]), -1)
        picked = jnp.concatenate([gap[:, None], point, normal], -1)[best]
        gap, point, frame = picked[:, 0], picked[:, 1:4], _frame(picked[:, 4:])
        # n.(shift + turn x p) = n.shift + (p x n).turn
        lever = jnp.cross(point[:, None, :], frame)
        motion = jnp.concatenate([frame, lever], -1) @ jnp.concatenate([shift, turn], -1).T
        jacobian = motion * moves[:, None, :]
        stiffness, damping, impedance = _spring(solref, solimp, gap, self.timestep)
        speed = jnp.sum(jacobian * align(data.qvel, jacobian), -1)
        reference = -damping[:, None] * speed
        reference = reference.at[:, 0].add(-stiffness * impedance * gap)
        friction = jnp.maximum(friction, 1e-15)
        weight = jnp.where(gap < 0, impedance / jnp.maximum(compliance[:, 0] * (1 - impedance), 1e-15), 0.0)
        along = weight * self.impratio
        across = along * friction[:, 1] ** 2 / friction[:, 0] ** 2
        rows = newton.Rows(
            jacobian=jacobian,
            reference=reference,
            weight=jnp.stack([weight, along, across], -1),
            scale=jnp.concatenate([friction[:, :1] / np.sqrt(self.impratio), friction], -1),
            **self._limits(data.qpos, data.qvel),
        )
        return rows, frame, finger

    def _limits(self, qpos: jax.Array, qvel: jax.Array) -> dict[str, jax.Array]:
        limit = self.limit
        place = qpos[limit["address"]]
        below, above = place - limit["low"], limit["high"] - place
        side, gap = jnp.where(below < above, 1.0, -1.0), jnp.minimum(below, above) - limit["margin"]
        stiffness, damping, impedance = _spring(limit["solref"], limit["solimp"], gap, self.timestep)
        reference = -damping * side * qvel - stiffness * impedance * gap
        weight = impedance / jnp.maximum(limit["compliance"] * (1 - impedance), 1e-15)
        return {"limit_side": side, "limit_reference": reference, "limit_weight": jnp.where(gap < 0, weight, 0.0)}

    def _integrate(self, data: Any, acceleration: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Semi-implicit Euler."""
        step, qpos = self.timestep, data.qpos
        qvel = data.qvel + step * acceleration
        if len(self.scalar):
            qpos = qpos.at[self.scalar[:, 0]].add(step * qvel[self.scalar[:, 1]])
        for place, motion in self.free:
            qpos = qpos.at[place : place + 3].add(step * qvel[motion : motion + 3])
            spin = qvel[motion + 3 : motion + 6]
            speed = jnp.sqrt(jnp.sum(spin**2) + 1e-20)
            turned = rotations.quat_multiply(
                qpos[place + 3 : place + 7], rotations.axis_angle_to_quat(spin / speed, step * speed)
            )
            qpos = qpos.at[place + 3 : place + 7].set(turned / jnp.sqrt(jnp.sum(turned**2)))
        return qpos, qvel


def find_stepper(mjx: Any, model: mujoco.MjModel, tips: np.ndarray, *, max_contacts: int) -> Stepper | None:
    """The stepper of a scene, or None where it needs `mjx.step`.

    Args:
      tips: [F] bodies of the fingertips.
      max_contacts: contacts kept in each environment.
    """
    option = model.opt
    plain = (
        option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
        and option.integrator == mujoco.mjtIntegrator.mjINT_EULER
        and option.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
        and np.isin(model.jnt_type, _JOINTS).all()
        and not (model.neq or model.ntendon or model.nu)
        and not (model.dof_frictionloss.any() or model.geom_contype.any() or model.geom_conaffinity.any())
        and (model.pair_dim == 3).all()
        and not (model.pair_gap.any() or model.pair_solreffriction.any())
    )
    collider = collide.find_collider(model) if plain else None
    if collider is None:
        return None
    bodies = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
    held = model.body("object").id
    finger = ((bodies[0][:, None] == tips) & (bodies[1] == held)[:, None]).astype(np.float32)
    finger -= (bodies[1][:, None] == tips) & (bodies[0] == held)[:, None]
    moves = _moved(model)
    kinds = model.jnt_type
    scalar, free = kinds != mujoco.mjtJoint.mjJNT_FREE, kinds == mujoco.mjtJoint.mjJNT_FREE
    address = np.stack([model.jnt_qposadr, model.jnt_dofadr], -1)
    return Stepper(
        mjx=mjx,
        collider=collider,
        max_contacts=max_contacts,
        iterations=int(option.iterations) + _MORE_STEPS,
        line_search=2 * int(option.ls_iterations),
        timestep=float(option.timestep),
        impratio=float(option.impratio),
        moves=moves[bodies[1]].astype(np.float32) - moves[bodies[0]].astype(np.float32),
        compliance=model.body_invweight0[bodies, 0].sum(0).astype(np.float32),
        finger=finger,
        root=model.body_rootid[model.dof_bodyid],
        push=moves[held].astype(np.float32),
        object_body=held,
        limit=_limit_constants(model),
        scalar=address[scalar],
        free=address[free],
    )


def _moved(model: mujoco.MjModel) -> np.ndarray:
    """Whether body b is moved by degree of freedom v: [B, V]."""
    moves = np.zeros((model.nbody, model.nv), bool)
    for body in range(1, model.nbody):
        moves[body] = moves[model.body_parentid[body]]
        first = model.body_dofadr[body]
        moves[body, first : first + model.body_dofnum[body]] = True
    return moves


def _limit_constants(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    joints = model.dof_jntid
    limited = (model.jnt_limited[joints] > 0) & (model.jnt_type[joints] != mujoco.mjtJoint.mjJNT_FREE)
    far = 1e6
    constants = {
        "low": np.where(limited, model.jnt_range[joints, 0], -far),
        "high": np.where(limited, model.jnt_range[joints, 1], far),
        "margin": model.jnt_margin[joints],
        "solref": model.jnt_solref[joints],
        "solimp": model.jnt_solimp[joints],
        "compliance": model.dof_invweight0,
    }
    return {"address": model.jnt_qposadr[joints]} | {name: np.float32(x) for name, x in constants.items()}


def _frame(normal: jax.Array) -> jax.Array:
    """Right-handed frames [C, 3, 3], rows from `normal` [C, 3] on."""
    x, y, z = (normal[:, k] for k in range(3))
    zero, upright = jnp.zeros_like(x), jnp.abs(y) < 0.5
    # Of the second and third axis that which is less along the normal, made orthogonal to it.
    other = jnp.where(upright[:, None], jnp.stack([zero, zero + 1, zero], -1), jnp.stack([zero, zero, zero + 1], -1))
    side = other - normal * jnp.where(upright, y, z)[:, None]
    side = side / jnp.sqrt(jnp.sum(side**2, -1, keepdims=True) + 1e-20)
    return jnp.stack([normal, side, jnp.cross(normal, side)], 1)


def _spring(solref: Array, solimp: Array, gap: jax.Array, timestep: float) -> tuple[jax.Array, jax.Array, jax.Array]:
    """MuJoCo's stiffness 1/s^2, damping 1/s and impedance from solref [N, 2], solimp [N, 5] and gaps [N] m."""
    low, high = (jnp.clip(solimp[:, k], 1e-4, 0.9999) for k in (0, 1))
    width, middle = jnp.maximum(solimp[:, 2], 1e-15), jnp.clip(solimp[:, 3], 1e-4, 0.9999)
    power = jnp.maximum(solimp[:, 4], 1.0)
    period, ratio = jnp.maximum(solref[:, 0], 2 * timestep), solref[:, 1]
    stiffness = jnp.where(solref[:, 0] > 0, 1 / (high * period * ratio) ** 2, -solref[:, 0] / high**2)
    damping = jnp.where(solref[:, 1] > 0, 2 / (high * period), -solref[:, 1] / high)
    deep = jnp.minimum(jnp.abs(gap) / width, 1.0)
    rise = deep**power / middle ** (power - 1)
    fall = 1 - (1 - deep) ** power / (1 - middle) ** (power - 1)
    return stiffness, damping, low + jnp.where(deep < middle, rise, fall) * (high - low)
