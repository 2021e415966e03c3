"""States of a scene for tests of an engine, and what C MuJoCo makes of them in double precision."""

import copy
import types

import mujoco
import numpy as np
from c_scene import force_on

from dexsim.physics.config import PhysicsConfig
from dexsim.physics.contact import pairs_with
from dexsim.physics.interface import PhysicsScene, places

States = dict[str, np.ndarray]
"""By name, float32 [N, size]: qpos, qvel, warmstart, push, targets of the joints, and the fields of the object."""


def scene_of_model(model, slots, driven, tips, tip_geoms) -> PhysicsScene:
    """The scene of a hand of hinges, of which joints `driven` have motors, and of an object whose body is "object" and
    whose geoms are "object_0" and on, one for each of the slots."""
    geoms = np.array([model.geom(f"object_{k}").id for k in range(len(slots))])
    return PhysicsScene(
        hand=types.SimpleNamespace(num_fingers=len(tips), model_path="hand.xml"),
        config=PhysicsConfig(),
        slots=slots,
        model=model,
        joint_qpos=driven,
        joint_dof=driven,
        object_qpos=np.arange(model.nq - 7, model.nq),
        object_dof=np.arange(model.nv - 6, model.nv),
        object_body=model.body("object").id,
        object_geoms=geoms,
        object_pairs=pairs_with(model, geoms),
        tip_bodies=tips,
        tip_geoms=tip_geoms,
        tip_growth=np.ones((len(tip_geoms), 3)),
    )


def pd_torque(target: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Position control [J] Nm with a torque that falls with speed: a motor law for tests."""
    limit = 3.0 * np.maximum(1 - np.abs(velocity) / 20.0, 0)
    return np.clip(3.0 * (target - position) - 0.02 * velocity, -limit, limit)


def read_fields(scene: PhysicsScene, model: mujoco.MjModel) -> States:
    """What one world has in place of the scene's constants; one friction for both directions."""
    fields = {name: np.array(getattr(model, name)[where]) for name, where in places(scene).items()}
    return fields | {"pair_friction": fields["pair_friction"][:, 0]}


def write_fields(scene: PhysicsScene, model: mujoco.MjModel, states: States, row: int) -> None:
    """The opposite of `read_fields`, but for the bounds of the broad phase."""
    for name, where in places(scene).items():
        if name != "geom_rbound":
            here, value = getattr(model, name)[where], states[name][row].astype(float)
            getattr(model, name)[where] = value[:, None] if name == "pair_friction" else value.reshape(here.shape)
    model.body_subtreemass[scene.object_body] = model.body_mass[scene.object_body]


def private_model(scene: PhysicsScene) -> mujoco.MjModel:
    """A copy of the scene's model that objects may be written to, without a broad phase by size."""
    model = copy.copy(scene.model)
    model.geom_sameframe[scene.object_geoms] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.body_sameframe[scene.object_body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.geom_rbound[model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE] = 1.0
    model.opt.iterations = model.opt.ls_iterations = 100
    return model


def tumble(scene: PhysicsScene, count: int, start, seed: int = 0) -> States:
    """States while joints move at random and an object falls on the hand from the pose [7] that `start` draws."""
    model, random = private_model(scene), np.random.default_rng(seed)
    data, body, joints = mujoco.MjData(model), scene.object_body, len(scene.joint_dof)
    low, high = model.jnt_range[model.dof_jntid[scene.joint_dof]].T
    rows: list[States] = []
    while len(rows) < count:
        one = random.integers(len(scene.object_geoms))
        model.geom_size[scene.object_geoms] = 1e-4  # what is switched off
        geom = scene.object_geoms[one]
        model.geom_size[geom] = scene.model.geom_size[geom] * random.uniform(0.85, 1.1)
        model.body_mass[body] = random.uniform(0.05, 0.2)
        model.body_inertia[body] = model.body_mass[body] * random.uniform(2e-4, 6e-4, 3)
        model.body_ipos[body] = random.uniform(-0.005, 0.005, 3)
        model.pair_friction[scene.object_pairs, :2] = random.uniform(0.5, 1.2)
        mujoco.mj_resetData(model, data)
        data.qpos[scene.joint_qpos] = np.maximum(low, 0) + 0.3 * random.uniform(0, 1, joints) * (high - low)
        data.qpos[scene.object_qpos] = start(random)
        target = data.qpos[scene.joint_qpos] + 0.6 * random.uniform(0, 1, joints) * (high - low)
        push = random.normal(size=3) * 0.5
        acceleration = np.zeros(model.nv)
        for _ in range(random.integers(5, 120)):
            acceleration = _substep(scene, model, data, target, push, acceleration)
        if np.abs(data.qpos[scene.object_qpos[:3]]).max() < 0.25:  # still near the hand
            state = dict(qpos=data.qpos, qvel=data.qvel, warmstart=acceleration, push=push, target=target)
            rows.append({k: np.ravel(v).astype(np.float32) for k, v in (state | read_fields(scene, model)).items()})
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def mujoco_substeps(scene: PhysicsScene, states: States, substeps: int) -> dict[str, np.ndarray]:
    """C MuJoCo after some sub-steps with `pd_torque`: state, acceleration, finger_force, contacts of the first."""
    model = private_model(scene)
    data = mujoco.MjData(model)
    rows = []
    for row in range(len(states["qpos"])):
        write_fields(scene, model, states, row)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = states["qpos"][row], states["qvel"][row]
        acceleration, contacts = states["warmstart"][row].astype(float), 0
        for substep in range(substeps):
            target = states["target"][row].astype(float)
            acceleration = _substep(scene, model, data, target, states["push"][row], acceleration)
            if substep == 0:
                contacts = sum(contact.dist < 0 for contact in data.contact[: data.ncon])
        force = force_on(model, data, scene.tip_bodies, scene.object_body)
        rows.append((data.qpos.copy(), data.qvel.copy(), acceleration, force, contacts))
    names = ("qpos", "qvel", "acceleration", "finger_force", "contacts")
    return {name: np.array(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}


def _substep(scene, model, data, target, push, guess):
    """One step. Returns the acceleration [V]."""
    data.qfrc_applied[scene.joint_dof] = pd_torque(target, data.qpos[scene.joint_qpos], data.qvel[scene.joint_dof])
    data.xfrc_applied[scene.object_body, :3] = push
    data.qacc_warmstart[:] = guess
    mujoco.mj_step(model, data)
    return data.qacc.copy()
