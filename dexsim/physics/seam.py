"""The physics seam: the only room that imports `mujoco.mjx`, and not before a scene is compiled.

`Physics` compiles the hand, an object and explicit contact pairs into one model, and `advance`
runs it for one control tick on either backend: `jax` (differentiable, any device) or `warp`
(about six times faster on NVIDIA GPUs). The state that crosses this seam is Markov: positions,
velocities and the solver's warm start. Everything derived is recomputed, which keeps the state
small and lets an episode restart by selecting arrays, on both backends.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import AssetError, ConfigError
from dexsim.core.pytree import pytree_dataclass
from dexsim.geometry import rotations
from dexsim.hand.kinematics import Hand, forward_kinematics
from dexsim.objects.params import ObjectParams, bounding_radius
from dexsim.physics import contact
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.jax_backend import substep
from dexsim.physics.model import build_model, tip_bodies
from dexsim.touch.skin import Skin

# Warp's flags for full buffers: constraint rows, their non-zeros, broad phase, narrow phase,
# convex collision, contact sensors. Its other flags tell of iteration limits, which are meant.
_OVERFLOW = 1 | 2 | 4 | 8 | 16 | 64


@pytree_dataclass
class PhysicsState:
    """The Markov state: hand joints first, then the object's free joint."""

    qpos: jax.Array  # [J + 7] rad; m and unit quaternion
    qvel: jax.Array  # [J + 6] rad/s; m/s (palm frame) and rad/s (object frame)
    warmstart: jax.Array  # [J + 6] last accelerations, the solver's first guess


def choose_backend(backend: str) -> str:
    """`auto` is Warp where it can be imported and JAX runs on an NVIDIA GPU, else JAX."""
    if backend not in ("auto", "jax", "warp"):
        raise ConfigError(f"backend {backend!r}: choose auto, jax or warp")
    if backend == "jax":
        return backend
    import importlib.util

    found = importlib.util.find_spec("warp") is not None
    if backend == "warp" and not found:
        raise ConfigError("backend 'warp' needs the extra: pip install 'dexsim[warp]'")
    on_gpu = jax.default_backend() in ("gpu", "cuda")
    return "warp" if backend == "warp" or (found and on_gpu) else "jax"


class Physics:
    """The compiled scene. Immutable; its methods are pure and written for one environment."""

    def __init__(
        self,
        hand: Hand,
        slots: tuple[str, ...],
        largest: np.ndarray,
        config: PhysicsConfig,
        *,
        gravity: tuple[float, float, float],
        backend: str = "auto",
        num_envs: int = 1,
        skin: Skin | None = None,
        rotor_share: float = 0.0,
    ):
        """Compile.

        Args:
          hand: the hand; its MJCF is read again here.
          slots: kinds of the object's primitives.
          largest: [K, 3] m, the largest size of each slot (broad phase bounds).
          config: solver and contact model.
          gravity: m/s^2 in the palm frame, which is the world's.
          backend: "auto", "jax" or "warp".
          num_envs: batch size that Warp's contact buffer is sized for.
          skin: of the fingertips, whose stiffness it sets; without one it is constant.
          rotor_share: share of the joints' armature that is left out of the scene.

        Raises:
          AssetError: the model uses what the backend ignores or lacks.
        """
        from mujoco import mjx

        self.hand, self.slots, self.config = hand, slots, config
        self.skin = skin if config.tips == "skin" else None
        self._mjx = mjx
        self.backend = choose_backend(backend)
        # Warp shares one contact buffer among all worlds; the rest is per world.
        # Candidates of the broad phase need more room than contacts: up to 15 a world were seen
        # against 16 contacts, and a full buffer ends episodes.
        self._contact_buffer = max(config.max_contacts * num_envs * 3 // 2, 256)
        self.mj_model = build_model(hand, slots, largest, config, gravity, self.backend, rotor_share=rotor_share)
        try:
            self._model = _quiet(self._mjx.put_model(self.mj_model, impl=self.backend), self.backend)
        except NotImplementedError as error:
            raise AssetError(f"{hand.model_path}: backend {self.backend}: {error}") from None
        self._find_addresses()
        self._find_pairs()
        self._stepper = None
        if self.backend == "jax" and config.contacts == "closed":
            self._stepper = substep.find_stepper(
                mjx, self.mj_model, tip_bodies(self.mj_model, hand), most=config.max_contacts
            )

    def _find_addresses(self) -> None:
        model, hand = self.mj_model, self.hand
        joints = [model.joint(name) for name in hand.joint_names]
        self.joint_qpos = np.array([j.qposadr[0] for j in joints])
        self.joint_dof = np.array([j.dofadr[0] for j in joints])
        free = model.joint("object")
        self.object_qpos = np.arange(free.qposadr[0], free.qposadr[0] + 7)
        self.object_dof = np.arange(free.dofadr[0], free.dofadr[0] + 6)
        self.object_body = model.body("object").id
        self.object_geoms = np.array([model.geom(f"object_{k}").id for k in range(len(self.slots))])
        # finger_of_geom[g]: whose tip link a geom belongs to, -1 for none.
        tips = {int(body): f for f, body in enumerate(tip_bodies(model, hand))}
        self._finger_of_geom = np.array([tips.get(int(b), -1) for b in model.geom_bodyid])
        self._is_object_geom = np.isin(np.arange(model.ngeom), self.object_geoms)

    def _find_pairs(self) -> None:
        model, tips = self.mj_model, tip_bodies(self.mj_model, self.hand)
        self.object_pairs = contact.pairs_with(model, self.object_geoms)
        self._compliance, self._share, self._finger_of_pair = contact.pair_constants(model, self.object_pairs, tips)
        self._pads = contact.find_pads(model, self.object_pairs, tips)

    def tip_stiffness(self, target: ObjectParams, qpos: jax.Array) -> jax.Array:
        """How much stiffer [F] than nominal the fingertips are where they press now."""
        place = qpos[self.object_qpos]
        turn = rotations.quat_to_matrix(place[3:] / jnp.linalg.norm(place[3:]))
        pose = forward_kinematics(self.hand, qpos[self.joint_qpos])
        return contact.follow_skin(self.hand, self._pads, self.skin, pose, target, place[:3], turn)

    def configure(self, target: ObjectParams, tips: jax.Array | None = None) -> Any:
        """The MJX model with one environment's object and contact parameters put in.

        `tips` [F] is the fingertips' stiffness over the nominal one (`tip_stiffness`).
        """
        model, geoms, body = self._model, self.object_geoms, self.object_body
        pair = self.object_pairs
        friction = target.pair_friction(self._finger_of_pair >= 0)
        # body_invweight0 keeps its template value on purpose: the contact's parameters are worked
        # out from it, and stiffness must not change with the mass of what is touched.
        share = jnp.asarray(self._share)
        if tips is not None:
            share *= jnp.append(tips, 1.0)[self._finger_of_pair]  # -1, no finger's: the last
        solref, solimp = contact.spring(
            self._compliance,
            share * target.contact[0],
            target.contact[1],
            friction,
            period=self.config.contact_period,
            edges=self.config.pyramid_edges,
        )
        return model.replace(
            geom_size=model.geom_size.at[geoms].set(target.size),
            geom_rbound=model.geom_rbound.at[geoms].set(bounding_radius(target.size, self.slots)),
            geom_pos=model.geom_pos.at[geoms].set(target.position),
            geom_quat=(model.geom_quat if target.quat is None else model.geom_quat.at[geoms].set(target.quat)),
            body_mass=model.body_mass.at[body].set(target.mass),
            body_inertia=model.body_inertia.at[body].set(target.inertia),
            body_ipos=model.body_ipos.at[body].set(target.com),
            pair_friction=model.pair_friction.at[pair, :2].set(friction[:, None]),
            pair_solref=model.pair_solref.at[pair].set(solref),
            pair_solimp=model.pair_solimp.at[pair].set(solimp),
        )

    def advance(
        self,
        target: ObjectParams,
        state: PhysicsState,
        torque: Callable[[jax.Array, jax.Array, jax.Array], jax.Array],
        push: jax.Array,
    ) -> tuple[PhysicsState, jax.Array]:
        """Run one control tick with motors that remember nothing: `advance_motors` for all others.

        Args:
          torque: (sub-step, joint position [J], joint velocity [J]) to joint torque [J] Nm,
            called before every sub-step.
        """
        after, force, _ = self.advance_motors(
            target,
            state,
            lambda index, position, velocity, memory: (torque(index, position, velocity), memory),
            None,
            push,
        )
        return after, force

    def advance_motors(
        self,
        target: ObjectParams,
        state: PhysicsState,
        motors: Callable[..., tuple[jax.Array, Any]],
        memory: Any,
        push: jax.Array,
    ) -> tuple[PhysicsState, jax.Array, Any]:
        """Run one control tick.

        Args:
          target: the object.
          state: where to start from.
          motors: (sub-step, joint position [J], joint velocity [J], memory) to joint torque [J] Nm
            and the memory after it, called before every sub-step.
          memory: what the motors carry from sub-step to sub-step; any pytree.
          push: [3] N, force on the object's centre of mass during the whole tick.

        Returns:
          The state after the tick, the contact force of the object on each finger's tip link
          [F, 3] N in the palm frame, at the last sub-step, and the motors' memory.
        """
        tips = None if self.skin is None else self.tip_stiffness(target, state.qpos)
        model = self.configure(target, tips)
        if self._stepper is not None:
            return self._advance_closed(model, state, motors, memory, push)
        data = self._make_data().replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart)
        wrench = jnp.zeros((self.mj_model.nbody, 6)).at[self.object_body, :3].set(push)
        data = data.replace(xfrc_applied=wrench)

        def substep(carry: tuple[Any, Any], index: jax.Array) -> tuple[tuple[Any, Any], None]:
            data, memory = carry
            tau, memory = motors(index, data.qpos[self.joint_qpos], data.qvel[self.joint_dof], memory)
            applied = jnp.zeros(self.mj_model.nv).at[self.joint_dof].set(tau)
            return (self._mjx.step(model, data.replace(qfrc_applied=applied)), memory), None

        # Forces are read after the scan: stacking sensordata as a scan output more than doubled
        # the step and returned zeros on the GPU.
        (data, memory), _ = jax.lax.scan(substep, (data, memory), jnp.arange(self.config.substeps))
        after = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        return after, self._finger_force(data), memory

    def _advance_closed(
        self,
        model: Any,
        state: PhysicsState,
        motors: Callable[..., tuple[jax.Array, Any]],
        memory: Any,
        push: jax.Array,
    ) -> tuple[PhysicsState, jax.Array, Any]:
        """`advance_motors` with our own contacts and solver (`dexsim.physics.jax_backend.substep`)."""
        data = self._make_data()

        def run(carry: tuple[Any, ...], index: jax.Array) -> tuple[tuple[Any, ...], jax.Array]:
            (qpos, qvel, warmstart), memory = carry
            tau, memory = motors(index, qpos[self.joint_qpos], qvel[self.joint_dof], memory)
            applied = jnp.zeros(self.mj_model.nv).at[self.joint_dof].set(tau)
            after, force = self._stepper.step(
                model, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart), applied, push
            )
            return (after, memory), force

        # The force is no part of the carry: zeros to begin with, which no environment's own, would have
        # vmap trace all of this twice.
        begin = ((state.qpos, state.qvel, state.warmstart), memory)
        (after, memory), forces = jax.lax.scan(run, begin, jnp.arange(self.config.substeps))
        return PhysicsState(*after), forces[-1], memory

    def _make_data(self) -> Any:
        if self.backend == "jax":
            return self._mjx.make_data(self._model)
        return self._mjx.make_data(
            self.mj_model,
            impl="warp",
            naconmax=self._contact_buffer,
            naccdmax=self._contact_buffer,
            njmax=self.constraint_rows,
        )

    @property
    def constraint_rows(self) -> int:
        """Constraint rows that Warp allocates for a world: contacts and joint limits."""
        rows = self.config.pyramid_edges or self.config.condim
        return rows * 2 * self.config.max_contacts + self.hand.num_joints

    def _finger_force(self, data: Any) -> jax.Array:
        if self.backend == "warp":
            force = -data.sensordata.reshape(self.hand.num_fingers, 3)
            # What does not fit Warp's buffers it leaves out, down to all contacts of a world. NaN
            # ends such an episode and is counted as non-finite.
            return jnp.where((data._impl.overflow & _OVERFLOW) != 0, jnp.nan, force)
        return self._force_from_contacts(data)

    def _force_from_contacts(self, data: Any) -> jax.Array:
        """Sum the solver's forces per finger; the JAX backend has no body-matching sensor."""
        touch = data._impl.contact
        dim, address = np.asarray(touch.dim), np.asarray(touch.efc_address)
        use = np.flatnonzero((dim == self.config.condim) & (address >= 0))
        edges = self.config.pyramid_edges
        rows = data._impl.efc_force[address[use][:, None] + np.arange(edges or self.config.condim)]
        if edges:  # opposite edges, see mju_decodePyramid
            slide = [(rows[:, 2 * axis] - rows[:, 2 * axis + 1]) * touch.friction[use, axis] for axis in (0, 1)]
            local = [jnp.sum(rows, -1), *slide]
        else:
            local = [rows[:, axis] if axis < self.config.condim else jnp.zeros(len(use)) for axis in range(3)]
        frame = touch.frame[use]  # rows are the axes; the normal points from geom1 to geom2
        force = jnp.sum(frame * jnp.stack(local, -1)[..., None], 1)
        touching = (touch.dist[use] < touch.includemargin[use])[:, None]
        force = jnp.where(touching, force, 0.0)
        finger = jnp.asarray(self._finger_of_geom)[touch.geom[use]]
        is_object = jnp.asarray(self._is_object_geom)[touch.geom[use]]
        # MuJoCo's contact force acts on geom2; geom1 feels the opposite.
        on_second = is_object[:, 0] * jax.nn.one_hot(finger[:, 1], self.hand.num_fingers).T
        on_first = is_object[:, 1] * jax.nn.one_hot(finger[:, 0], self.hand.num_fingers).T
        return jnp.sum((on_second - on_first)[..., None] * force, 1)


def _quiet(model: Any, backend: str) -> Any:
    """Warp prints from the device whenever a solver stops at its iteration limit, as it is meant
    to here; full buffers show in `_finger_force` instead."""
    if backend != "warp":
        return model
    option = model.opt
    return model.replace(opt=option.replace(_impl=option._impl.replace(warn_overflow=0)))
