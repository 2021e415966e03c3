"""The physics seam: the only room that imports `mujoco.mjx`, and not before a scene is compiled.

`Physics` compiles the hand, an object and explicit contact pairs into one model, and `advance`
runs it for one control tick on either backend: `jax` (differentiable, any device) or `warp`
(about six times faster on NVIDIA GPUs). The state that crosses this seam is Markov: positions,
velocities and the solver's warm start. Everything derived is recomputed, which keeps the state
small and lets an episode restart by selecting arrays, on both backends.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim import contact, rotations, substep, tactile
from dexsim.config import setting, validate
from dexsim.errors import AssetError, ConfigError
from dexsim.hand import Hand, forward_kinematics
from dexsim.model_guard import check_model
from dexsim.objects import ObjectParams, bounding_radius
from dexsim.pytree import pytree_dataclass

GEOM_TYPES = {"sphere": mujoco.mjtGeom.mjGEOM_SPHERE, "box": mujoco.mjtGeom.mjGEOM_BOX,
              "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
              "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
              "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID}


# Warp's flags for full buffers: constraint rows, their non-zeros, broad phase, narrow phase,
# convex collision, contact sensors. Its other flags tell of iteration limits, which are meant.
_OVERFLOW = 1 | 2 | 4 | 8 | 16 | 64


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Time step, solver and contact model."""

    timestep: float = setting(0.006, unit="s", low=1e-4, high=0.02)
    """One physics sub-step."""
    substeps: int = setting(5, unit="1", low=1, high=200)
    """Sub-steps in one control tick; the control rate is 1 / (timestep * substeps)."""
    iterations: int = setting(3, unit="1", low=1, high=100)
    """Newton iterations of the contact solver."""
    line_search: int = setting(6, unit="1", low=1, high=100)
    """Line-search iterations in each of them."""
    condim: int = setting(3, unit="1", low=1, high=6)
    """Contact dimension between hand and object: 3 sliding, 4 with torsion, 6 with rolling."""
    cone: str = setting("elliptic", choices=("elliptic", "pyramidal"))
    """Friction cone. A pyramid is a linear approximation, and what it holds creeps: at half of what
    friction can bear by 12 to 25 mm/s here (tests/test_contact.py), through the fingers in seconds."""
    friction_ratio: float = setting(20.0, unit="1", low=0.1, high=1000.0)
    """How much harder an elliptic cone resists sliding than penetration (MuJoCo's impratio)."""
    cover: float = setting(0.003, unit="m", low=0.0, high=0.01)
    """Rubber over the fingertips: their geoms, which follow the taxels, touch this far out. Keep it
    equal to `Skin.margin`, so that solver and taxels begin to feel at the same distance."""
    pad_points: int = setting(3, unit="1", low=1, high=8)
    """Spheres in a row that stand for each capsule of a fingertip against the object."""
    tips: str = setting("skin", choices=("skin", "constant"))
    """Stiffness of the fingertips: as the skin's law over the taxels has it, by the tick, which makes
    edges softer than faces; or the same everywhere."""
    settling: float = setting(0.03, unit="s", low=0.005, high=0.2)
    """Time scale on which a contact pushes out what lies in it (at least four time steps)."""
    palm: str = setting("face", choices=("face", "box"))
    """Palm as a half-space at its face (exact and cheap for every primitive) or as its box."""
    max_contacts: int = setting(20, unit="1", low=4, high=400)
    """Contacts kept per environment (JAX backend: the deepest; Warp: mean over the batch)."""

    def __post_init__(self):
        validate(self)
        if self.condim not in (1, 3, 4, 6):
            raise ConfigError(f"PhysicsConfig.condim = {self.condim}: must be 1, 3, 4 or 6")

    @property
    def control_period(self) -> float:
        """One control tick, s."""
        return self.timestep * self.substeps

    @property
    def pyramid_edges(self) -> int:
        """Edges of a contact's friction pyramid; 0 for an elliptic cone, and without friction."""
        return 2 * (self.condim - 1) if self.cone == "pyramidal" else 0

    @property
    def contact_period(self) -> float:
        """`settling`, s, as far as the time step allows."""
        return max(self.settling, 4 * self.timestep)


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

    def __init__(self, hand: Hand, slots: tuple[str, ...], largest: np.ndarray,
                 config: PhysicsConfig, *, gravity: tuple[float, float, float],
                 backend: str = "auto", num_envs: int = 1, skin: tactile.Skin | None = None,
                 rotor_share: float = 0.0):
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
        self.mj_model = build_model(hand, slots, largest, config, gravity, self.backend,
                                    rotor_share=rotor_share)
        try:
            self._model = _quiet(self._mjx.put_model(self.mj_model, impl=self.backend), self.backend)
        except NotImplementedError as error:
            raise AssetError(f"{hand.model_path}: backend {self.backend}: {error}") from None
        self._find_addresses()
        self._find_pairs()
        self._stepper = None
        if self.backend == "jax":
            self._stepper = substep.find_stepper(mjx, self.mj_model, tip_bodies(self.mj_model, hand),
                                                 most=config.max_contacts)

    def _find_addresses(self) -> None:
        model, hand = self.mj_model, self.hand
        joints = [model.joint(name) for name in hand.joint_names]
        self.joint_qpos = np.array([j.qposadr[0] for j in joints])
        self.joint_dof = np.array([j.dofadr[0] for j in joints])
        free = model.joint("object")
        self.object_qpos = np.arange(free.qposadr[0], free.qposadr[0] + 7)
        self.object_dof = np.arange(free.dofadr[0], free.dofadr[0] + 6)
        self.object_body = model.body("object").id
        self.object_geoms = np.array([model.geom(f"object_{k}").id
                                      for k in range(len(self.slots))])
        # finger_of_geom[g]: whose tip link a geom belongs to, -1 for none.
        tips = {int(body): f for f, body in enumerate(tip_bodies(model, hand))}
        self._finger_of_geom = np.array([tips.get(int(b), -1) for b in model.geom_bodyid])
        self._is_object_geom = np.isin(np.arange(model.ngeom), self.object_geoms)

    def _find_pairs(self) -> None:
        model, tips = self.mj_model, tip_bodies(self.mj_model, self.hand)
        self.object_pairs = contact.pairs_with(model, self.object_geoms)
        self._compliance, self._share, self._finger_of_pair = contact.pair_constants(
            model, self.object_pairs, tips)
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
            self._compliance, share * target.contact[0], target.contact[1], friction,
            period=self.config.contact_period, edges=self.config.pyramid_edges)
        return model.replace(
            geom_size=model.geom_size.at[geoms].set(target.size),
            geom_rbound=model.geom_rbound.at[geoms].set(
                bounding_radius(target.size, self.slots)),
            geom_pos=model.geom_pos.at[geoms].set(target.position),
            geom_quat=(model.geom_quat if target.quat is None
                       else model.geom_quat.at[geoms].set(target.quat)),
            body_mass=model.body_mass.at[body].set(target.mass),
            body_inertia=model.body_inertia.at[body].set(target.inertia),
            body_ipos=model.body_ipos.at[body].set(target.com),
            pair_friction=model.pair_friction.at[pair, :2].set(friction[:, None]),
            pair_solref=model.pair_solref.at[pair].set(solref),
            pair_solimp=model.pair_solimp.at[pair].set(solimp),
        )

    def advance(self, target: ObjectParams, state: PhysicsState,
                torque: Callable[[jax.Array, jax.Array, jax.Array], jax.Array],
                push: jax.Array) -> tuple[PhysicsState, jax.Array]:
        """Run one control tick with motors that remember nothing: `advance_motors` for all others.

        Args:
          torque: (sub-step, joint position [J], joint velocity [J]) to joint torque [J] Nm,
            called before every sub-step.
        """
        after, force, _ = self.advance_motors(
            target, state, lambda index, position, velocity, memory: (
                torque(index, position, velocity), memory), None, push)
        return after, force

    def advance_motors(self, target: ObjectParams, state: PhysicsState,
                       motors: Callable[..., tuple[jax.Array, Any]], memory: Any,
                       push: jax.Array) -> tuple[PhysicsState, jax.Array, Any]:
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
        data = self._make_data().replace(qpos=state.qpos, qvel=state.qvel,
                                         qacc_warmstart=state.warmstart)
        wrench = jnp.zeros((self.mj_model.nbody, 6)).at[self.object_body, :3].set(push)
        data = data.replace(xfrc_applied=wrench)

        def substep(carry: tuple[Any, Any], index: jax.Array) -> tuple[tuple[Any, Any], None]:
            data, memory = carry
            tau, memory = motors(index, data.qpos[self.joint_qpos], data.qvel[self.joint_dof],
                                 memory)
            applied = jnp.zeros(self.mj_model.nv).at[self.joint_dof].set(tau)
            return (self._mjx.step(model, data.replace(qfrc_applied=applied)), memory), None

        # Forces are read after the scan: stacking sensordata as a scan output more than doubled
        # the step and returned zeros on the GPU.
        (data, memory), _ = jax.lax.scan(substep, (data, memory), jnp.arange(self.config.substeps))
        after = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        return after, self._finger_force(data), memory

    def _advance_closed(self, model: Any, state: PhysicsState, motors: Callable[..., tuple[jax.Array, Any]],
                        memory: Any, push: jax.Array) -> tuple[PhysicsState, jax.Array, Any]:
        """`advance_motors` with our own contacts and solver (`dexsim.substep`)."""
        data = self._make_data()

        def run(carry: tuple[Any, ...], index: jax.Array) -> tuple[tuple[Any, ...], None]:
            (qpos, qvel, warmstart), memory, _ = carry
            tau, memory = motors(index, qpos[self.joint_qpos], qvel[self.joint_dof], memory)
            applied = jnp.zeros(self.mj_model.nv).at[self.joint_dof].set(tau)
            after, force = self._stepper.step(
                model, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart), applied, push)
            return (after, memory, force), None

        begin = ((state.qpos, state.qvel, state.warmstart), memory, jnp.zeros((self.hand.num_fingers, 3)))
        (after, memory, force), _ = jax.lax.scan(run, begin, jnp.arange(self.config.substeps))
        return PhysicsState(*after), force, memory

    def _make_data(self) -> Any:
        if self.backend == "jax":
            return self._mjx.make_data(self._model)
        return self._mjx.make_data(self.mj_model, impl="warp", naconmax=self._contact_buffer,
                             naccdmax=self._contact_buffer, njmax=self.constraint_rows)

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
            slide = [(rows[:, 2 * axis] - rows[:, 2 * axis + 1]) * touch.friction[use, axis]
                     for axis in (0, 1)]
            local = [jnp.sum(rows, -1), *slide]
        else:
            local = [rows[:, axis] if axis < self.config.condim else jnp.zeros(len(use))
                     for axis in range(3)]
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


def build_model(hand: Hand, slots: tuple[str, ...], largest: np.ndarray, config: PhysicsConfig,
                gravity: tuple[float, float, float], backend: str, *,
                rotor_share: float = 0.0) -> mujoco.MjModel:
    """The scene as a C MuJoCo model: hand, free object, explicit pairs, force sensors.

    Also what the tests and the emulated hand compare against.
    """
    spec = mujoco.MjSpec.from_file(str(hand.model_path))
    check_model(spec.compile(), backend, hand.model_path)
    for element in (*spec.actuators, *spec.sensors, *spec.keys):
        spec.delete(element)  # torques come from our actuator model, readings from our sensors
    for joint in spec.joints:
        joint.armature *= 1 - rotor_share
    palm = spec.body(hand.palm)
    palm.pos, palm.quat = [0, 0, 0], [1, 0, 0, 0]
    touching = _touching_geoms(spec, hand, config)
    contact.cover_tips(spec, hand, config.cover)
    touching = contact.split_pads(spec, hand, touching, config.pad_points)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0

    # A template of middling mass: its invweight0 sets the contact stiffness for all objects.
    body = spec.worldbody.add_body(name="object", mass=0.1, inertia=[5e-5] * 3,
                                   explicitinertial=True, pos=[0.1, 0, 0.1])
    body.add_freejoint(name="object")
    for k, kind in enumerate(slots):
        body.add_geom(name=f"object_{k}", type=GEOM_TYPES[kind], size=largest[k], contype=0,
                      conaffinity=0, mass=0, group=3, rgba=[0.85, 0.55, 0.25, 1])
        for name in touching:
            spec.add_pair(geomname1=name, geomname2=f"object_{k}", condim=config.condim,
                          friction=[0.9, 0.9, 0.005, 1e-4, 1e-4])
    if backend == "warp":
        for b in hand.tip_body:
            # data: bit 1 is the force; reduce: 3 is the net force, in the world frame.
            spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT,
                            objtype=mujoco.mjtObj.mjOBJ_BODY, objname=hand.body_names[b],
                            reftype=mujoco.mjtObj.mjOBJ_BODY, refname="object",
                            intprm=[2, 3, 1], dim=3)
    _set_options(spec, config, gravity, backend)
    for pair in spec.pairs:
        if pair.condim == 1 and spec.option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
            # MJX-JAX knows no frictionless contacts beside elliptic cones; this one slides as freely.
            pair.condim, pair.friction = 3, [1e-3, 1e-3, 0.005, 1e-4, 1e-4]
    model = spec.compile()
    geoms = np.flatnonzero(model.geom_bodyid == model.body("object").id)
    pairs = contact.pairs_with(model, geoms)
    compliance, share, _ = contact.pair_constants(model, pairs, tip_bodies(model, hand))
    model.pair_solref[pairs], model.pair_solimp[pairs] = contact.spring(
        compliance, share * contact.NOMINAL, 2.0, 0.9, period=config.contact_period, edges=config.pyramid_edges)
    return model


def tip_bodies(model: mujoco.MjModel, hand: Hand) -> np.ndarray:
    """Body ids [F] of the fingertips."""
    return np.array([model.body(hand.body_names[b]).id for b in hand.tip_body])


def _touching_geoms(spec: mujoco.MjSpec, hand: Hand, config: PhysicsConfig) -> list[str]:
    geoms = [g for g in hand.geoms if g.touches]
    palm = hand.body_names.index(hand.palm)
    planes = [g for g in geoms if g.body == palm and g.kind == "plane"]
    if planes:
        use_plane = config.palm == "face"
        geoms = [g for g in geoms if g.body != palm or (g.kind == "plane") == use_plane]
    if not geoms or any(not g.name for g in geoms):
        raise AssetError(f"{hand.model_path}: every geom that touches the object (contype or "
                         "conaffinity not 0) needs a name, and there must be at least one")
    return [g.name for g in geoms]


def _set_options(spec: mujoco.MjSpec, config: PhysicsConfig,
                 gravity: tuple[float, float, float], backend: str) -> None:
    option = spec.option
    option.timestep, option.gravity = config.timestep, gravity
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # Without friction the cone is a line, and the JAX backend knows it as a pyramid only.
    elliptic = config.cone == "elliptic" and config.condim > 1
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if elliptic else mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.impratio = config.friction_ratio if elliptic else 1.0
    if elliptic and backend == "warp":
        # Warp builds the Hessian of elliptic cones in one go only where the Jacobian is sparse: a
        # third faster here, though a dense one would fit as well.
        option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    option.iterations, option.ls_iterations = config.iterations, config.line_search
    # Box-box has its own kernel only with nativeccd off; eulerdamp costs a factorisation more.
    option.disableflags |= (mujoco.mjtDisableBit.mjDSBL_EULERDAMP
                            | mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
    # MJX also offers max_geom_pairs, a cull by bounding spheres. It drops touching pairs of long
    # capsules, one tick this finger, the next tick that one, so it stays off.
    spec.add_numeric(name="max_contact_points", data=[float(config.max_contacts)], size=1)
