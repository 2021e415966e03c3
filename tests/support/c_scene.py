"""The grasp scene in C MuJoCo, written down a second time: what our physics are held against.

Nothing here comes from `dexsim.physics.interface`. The object is compiled with its true sizes, places and
inertia (C MuJoCo ignores geom offsets that are set on a compiled model whose geoms lie at their
body's origin), only its active primitives exist, and forces are summed from `mj_contactForce`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.geometry import rotations
from dexsim.hand.kinematics import forward_kinematics
from dexsim.objects.config import SHAPES
from dexsim.touch.taxel_force import compute_touch

GRAVITY = (9.81, 0.0, 0.0)
# Solved to the end, so that what differs between engines is arithmetic and contact geometry.
CONVERGED = {"iterations": 50, "line_search": 50}
COVER = 0.003  # m, rubber over the pads
SETTLING = 0.03  # s, of the contacts' springs
ROW = 3  # spheres along a pad
KINDS = ("box", "capsule", "cylinder")  # the order of `dexsim.objects.config.SLOTS`


def compile_scene(hand, target, *, iterations=3, line_search=6, margin=0.0, exact=False, cover=COVER) -> mujoco.MjModel:
    """One object (`ObjectParams` of NumPy leaves) under the hand.

    Fingertips wear `cover` m of rubber; each of their three spheres presses with half of
    `target.contact[0]` newtons a metre of depth (see `follow_skin`), other links and the palm with
    2.5 of it. `margin` m lists contacts that far apart, for clearances, which are those of the bare
    pads. `exact` takes C MuJoCo's native convex collisions, whose one contact of a capsule on a
    cylinder is right; the older ones, which box on box needs, give up to five at once, some of them
    millimetres too deep.
    """
    spec = mujoco.MjSpec.from_file(str(hand.model_path))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    names = [g.name for g in spec.geoms if (g.contype or g.conaffinity) and g.name != "palm"]
    if not margin:
        names = [name for geom in names for name in _clad(spec, geom, cover)]
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    tips = {hand.body_names[body] for body in hand.tip_body}
    body = spec.worldbody.add_body(
        name="object", mass=float(target.mass), explicitinertial=True, ipos=target.com, inertia=target.inertia
    )
    body.add_freejoint()
    for k in np.flatnonzero(target.active):
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{KINDS[k].upper()}")
        body.add_geom(
            name=KINDS[k], type=kind, size=target.size[k], pos=target.position[k], contype=0, conaffinity=0, mass=0
        )
        for name in names:
            tip = spec.geom(name).parent.name in tips
            slide = target.friction if tip else target.link_friction
            friction = [slide, slide, 0.005, 1e-4, 1e-4]
            spec.add_pair(geomname1=name, geomname2=KINDS[k], condim=3, margin=margin, friction=friction)
    option = spec.option
    option.timestep, option.gravity = 0.01, GRAVITY
    option.iterations, option.ls_iterations = iterations, line_search
    option.integrator, option.solver = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtSolver.mjSOL_NEWTON
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 20.0
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_MULTICCD
    if not exact:
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    for pair in spec.pairs:
        if pair.condim == 1:  # between fingers
            pair.condim, pair.friction = 3, [1e-3, 1e-3, 0.005, 1e-4, 1e-4]
    model = spec.compile()
    # Contact softness is the skin's: that of a 0.1 kg object with 5e-5 kg m^2, whatever is held.
    model.body_invweight0[model.body("object").id] = 1 / 0.1, 1 / 5e-5
    _set_springs(model, target)
    return model


def _clad(spec: mujoco.MjSpec, name: str, cover: float) -> list[str]:
    """Rubber over a pad, and what of it meets the object: a row of spheres along its axis."""
    if "_pad" not in name:
        return [name]
    pad = spec.geom(name)
    radius, ends = pad.size[0] + cover, np.reshape(pad.fromto, (2, 3))
    pad.size = [radius, *pad.size[1:]]
    for k in range(ROW):
        share = k / (ROW - 1)
        pad.parent.add_geom(
            name=f"{name}/{k}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius, 0, 0],
            pos=(1 - share) * ends[0] + share * ends[1],
            mass=0,
        )
    return [f"{name}/{k}" for k in range(ROW)]


def follow_skin(model: mujoco.MjModel, data: mujoco.MjData, hand, target, felt) -> None:
    """Give each fingertip's springs the stiffness with which they press as the skin does: sum K r = S.

    Depths r are those of C MuJoCo's own contacts; `felt` [F] N is S (`skin_law`).
    """
    mujoco.mj_fwdPosition(model, data)
    tips = [model.body(hand.body_names[b]).id for b in hand.tip_body]
    first, second = model.geom_bodyid[data.contact.geom].reshape(-1, 2).T
    deep = np.where(second == model.body("object").id, np.maximum(-data.contact.dist, 0.0), 0.0)
    depth = np.array([deep[first == tip].sum() for tip in tips])
    ratio = np.clip((felt + 0.425) / (850 * depth + 0.425), 0.25, 4)  # 850 N/m, 0.5 mm
    _set_springs(model, target, dict(zip(tips, ratio, strict=True)))


def _set_springs(model: mujoco.MjModel, target, tips=None) -> None:
    """The contact's stiffness in MuJoCo's terms: N = K r with aref = r / SETTLING^2."""
    stiffness, ratio = (float(x) for x in target.contact)
    pairs = np.flatnonzero(model.geom_bodyid[model.pair_geom2] == model.body("object").id)
    links, first = model.geom_bodyid[model.pair_geom1[pairs]], model.geom_type[model.pair_geom1[pairs]]
    pad = 0.5 if tips is None else np.array([0.5 * tips.get(body, 0.0) for body in links])
    spring = stiffness * np.where(first == mujoco.mjtGeom.mjGEOM_SPHERE, pad, 2.5)
    weight = model.body_invweight0[links, 0] + model.body_invweight0[model.body("object").id, 0]
    # mj_diagApprox and mj_makeImpedance: R = weight (1 - d) / d, and at rest N = aref / R.
    d = weight / (weight + 1 / (SETTLING**2 * spring))
    model.pair_solref[pairs] = np.stack([-d / SETTLING**2, -2 * ratio * d / SETTLING], -1)
    model.pair_solimp[pairs] = np.stack([d, d, *np.tile([[0.001], [0.5], [2]], len(d))], -1)


def start(model: mujoco.MjModel, qpos, qvel, warmstart=None) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    if warmstart is not None:
        data.qacc_warmstart[:] = warmstart
    return data


def step(hand, target, begun, torque, exact):
    """One step of the converged scene from (qpos, qvel, warm start) under joint torques: data, finger forces [F, 3]."""
    model = compile_scene(hand, target, exact=exact, **CONVERGED)
    data = start(model, *begun)
    data.qfrc_applied[:12] = torque
    mujoco.mj_step(model, data)
    return data, finger_force(model, data, hand)


def finger_force(model: mujoco.MjModel, data: mujoco.MjData, hand) -> np.ndarray:
    """Force of the object on each tip link [F, 3] N, world axes."""
    tips = [model.body(hand.body_names[body]).id for body in hand.tip_body]
    return force_on(model, data, tips, model.body("object").id)


def force_on(model: mujoco.MjModel, data: mujoco.MjData, tips, target: int) -> np.ndarray:
    """Force of the body `target` on each of the bodies `tips` [F, 3] N, world axes: a sum over `mj_contactForce`."""
    total, tips, wrench = np.zeros((len(tips), 3)), list(tips), np.zeros(6)
    for index, contact in enumerate(data.contact):
        first, second = model.geom_bodyid[contact.geom]
        other = second if first == target else first
        if contact.efc_address >= 0 and target in (first, second) and other in tips:
            mujoco.mj_contactForce(model, data, index, wrench)
            on_second = contact.frame.reshape(3, 3).T @ wrench[:3]
            total[tips.index(other)] += on_second if other == second else -on_second
    return total


def skin_law(hand, skin):
    """`law(qpos [n, J + 7], target, cover [n] m)`: the fingers' forces [n, F] N by the skin's law alone."""
    bare = dataclasses.replace(skin, margin=0.0)

    def law(qpos, target, cover):
        pose, place = forward_kinematics(hand, qpos[: hand.num_joints]), qpos[hand.num_joints :]
        turn, unit = rotations.quat_to_matrix(place[3:]), jnp.ones(hand.num_fingers)
        return compute_touch(hand, pose, target.shape(), place[:3], turn, unit, bare, cover).skin_force.sum(-1)

    compiled = jax.jit(jax.vmap(law))
    return lambda qpos, target, cover=COVER: compiled(qpos, target, jnp.broadcast_to(jnp.float32(cover), len(qpos)))


# --- worlds to compare in ---------------------------------------------------------------------


def row(tree, index):
    """One row of a batch, as NumPy."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)


def rows_of(pool, shape: str) -> np.ndarray:
    """Rows of a pool of start states with this shape."""
    return np.flatnonzero(np.asarray(pool.object.shape_index) == SHAPES.index(shape))


def stack(trees):
    """A batch of such rows."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def squeeze(hand, begun, rng: np.random.Generator, steps=100):
    """Close the hand round a weightless object of the pool, for 0.5 s.

    Returns (model, qpos, qvel, warm start, joint torque), the numbers in single precision.
    """
    model = compile_scene(hand, begun.object, exact=bool(begun.object.active[2]), **CONVERGED)
    data = start(model, begun.qpos, 0 * begun.qvel)
    angle = begun.qpos[:12] + rng.uniform(0.3, 0.8, 12) * (np.arange(12) > 3)
    angle[1:3] += rng.uniform(0.0, 0.5, 2)
    model.opt.gravity[:] = 0
    for _ in range(steps):
        position, velocity = data.qpos[:12], data.qvel[:12]
        reach = np.clip(angle - position, -0.3, 0.3)
        torque = np.clip(3 * reach - 0.1 * velocity, -hand.torque_limit, hand.torque_limit)
        data.qfrc_applied[:12] = torque
        mujoco.mj_step(model, data)
    model.opt.gravity[:] = GRAVITY
    single = [np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart)]
    return model, *single, np.float32(torque * rng.uniform(0.5, 1.2, 12))
