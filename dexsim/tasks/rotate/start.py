"""Objects of the rotation task (a cube, a box of three edges, an upright cylinder, or a mesh) and its start states:
objects that came to rest in random postures of the hand.

Settling runs in C MuJoCo on the host's cores, once: the pool is kept on disk under the hash of the hand's files and the
configuration.
"""

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from dexsim.core.assets import cached_arrays
from dexsim.core.compilation import available_cores
from dexsim.core.config import to_dict
from dexsim.core.pytree import Array
from dexsim.core.ranges import sample_extreme, uniform
from dexsim.env.state import Start
from dexsim.errors import ConfigError
from dexsim.geometry import rotations
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import flexion_joints, hinge_angles
from dexsim.objects.config import INACTIVE_SIZE, SHAPES, load_mesh_object
from dexsim.objects.params import ObjectParams, extent, sample_object, unit_inertia
from dexsim.physics import contact
from dexsim.physics.interface import PhysicsScene
from dexsim.physics.model import build_scene
from dexsim.tasks.shared import clearance, close_fingers, palm_height

CLEARANCE = 0.001  # m, smallest gap between palm and object with support "fingers"
_Z_TO_X = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
_TRIALS = 300  # rounds of candidates in which every object should find a posture
_VERSION = 5  # of the procedure: raise it when older pools no longer hold
_SETTLING = 0.8  # s, for start states to come to rest; those that do not are discarded
_AT_REST = (0.05, 1.0)  # m/s, rad/s
_HEADING_NOISE = 0.7  # rad, largest turn of the object about the axis at the start
_HEADING_NOISE_AXES = 0.35  # rad, where the axis is commanded: a cube that lies nearly square can roll, too
_LEVEL = 0.35  # rad, largest angle from upright
_UNUSED = (
    *("reward", "sensing", "observation", "skin", "control", "randomization", "turn"),
    *("episode_seconds", "evaluation_seconds", "push_probability", "push_speed"),
)
"""Settings that no start state depends on; what does of `turn` and `randomization` is named in `_fingerprint`."""
_TRAPS = 128  # different starts in the trap; few candidates stay there
_TRAP_PITCH, _TRAP_PLACE = (0.35, 0.9), 0.017  # rad toward the wrist; m from the reference toward the fingertips


def largest_size(config: Any) -> np.ndarray:
    """Upper bound [K, 3] m of the size of each primitive that the object consists of."""
    if config.objects.mesh:
        return config.objects.largest
    half = config.edge[1] / 2 * config.proportions[1]
    size = {"box": [half, half, half], "cylinder": [half, half, 0.0]}
    return np.array([size[slot] for slot in config.objects.slots])


def sample_turned_object(key: jax.Array, config: Any) -> ObjectParams:
    """Draw one object."""
    if config.objects.mesh:
        return sample_object(key, config.objects)
    edge_key, base_key, scale_key = jax.random.split(key, 3)
    shape_key, proportion_key = jax.random.split(jax.random.fold_in(key, 1))
    shapes = jnp.array([SHAPES.index(name) for name in config.objects.shapes], jnp.int32)
    base = sample_object(base_key, config.objects, jax.random.choice(shape_key, shapes))
    extreme = sample_extreme(base_key, config.objects.extremes)  # the one that `sample_object` draws
    half = uniform(edge_key, config.edge, extreme) / 2
    half = half * uniform(proportion_key, config.proportions, extreme, (3,))
    solid = base.mass * uniform(scale_key, config.objects.inertia_scale, extreme)
    stand, kinds = upright(config.turn.unit_axis), config.objects.slots
    active = jnp.array([SHAPES.index(kind) for kind in kinds]) == base.shape_index
    # Slots lie along the object's axes; the axis of a cylinder, z, is the palm's normal, x.
    sizes = {"box": half, "cylinder": jnp.stack([half[1], half[0], jnp.zeros(())])}
    turned = {"box": (1.0, 0.0, 0.0, 0.0) if stand is None else stand, "cylinder": _Z_TO_X}
    object = dataclasses.replace(
        base,
        size=jnp.where(active[:, None], jnp.stack([sizes[kind] for kind in kinds]), INACTIVE_SIZE),
        position=jnp.zeros((len(kinds), 3)),
        active=active,
        quat=None if kinds == ("box",) and stand is None else jnp.array([turned[kind] for kind in kinds], jnp.float32),
        kinds=kinds,
    )
    return dataclasses.replace(object, inertia=solid * solid_inertia(object))


def upright(axis: np.ndarray) -> np.ndarray | None:
    """The shortest turn [4] that takes x to this unit vector, on which a face of a cube stands; None for x."""
    if axis[0] > 1 - 1e-9:
        return None
    if axis[0] < -1 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0], np.float32)
    half = np.array([1 + axis[0], 0.0, -axis[2], axis[1]])  # (1 + x . axis, x cross axis)
    return (half / np.linalg.norm(half)).astype(np.float32)


def solid_inertia(object: ObjectParams) -> jax.Array:
    """Inertia [3] m^2 about its axes of a uniform box, or cylinder along x, of 1 kg."""
    inertia = unit_inertia(object)  # of a cylinder along z
    if "cylinder" not in object.kinds:
        return inertia
    return jnp.where(object.active[object.kinds.index("cylinder")], inertia[::-1], inertia)


def lowest_point(object: ObjectParams, quat: Array, position: Array) -> jax.Array:
    """Smallest coordinate [] m of the object along the palm's normal (x)."""
    down = rotations.rotate_inverse(rotations.quat_to_matrix(quat), jnp.array([-1.0, 0.0, 0.0]))
    return position[0] - extent(object, down)


def load_pool(key: jax.Array, hand: Hand, config: Any, gravity: tuple[float, float, float]) -> Any:
    """The pool of start states, from disk if it has been made before. Raises ConfigError: next to nothing stays in the
    hand."""
    structure = jax.tree.structure(jax.eval_shape(lambda: sample_turned_object(key, config)))

    def make() -> dict[str, np.ndarray]:
        pool = _make(key, hand, config, gravity, config.pool_size)
        if trapped := round(config.trap * config.pool_size):
            few = _make(jax.random.fold_in(key, 1), hand, config, gravity, min(trapped, _TRAPS), trap=True)
            pool = [
                np.concatenate([rows[trapped:], np.resize(more, (trapped, *more.shape[1:]))])
                for rows, more in zip(pool, few, strict=True)
            ]
        return {f"{index:02d}": rows for index, rows in enumerate(pool)}

    stored = cached_arrays("pools", _fingerprint(key, hand, config), make)
    qpos, qvel, joint_target, *rows = [stored[name] for name in sorted(stored)]
    return Start(qpos=qpos, qvel=qvel, object=jax.tree.unflatten(structure, rows), joint_target=joint_target)


def _fingerprint(key: jax.Array, hand: Hand, config: Any) -> str:
    """What the pool depends on; rewards, sensing and observation do not belong to it."""
    settings = {name: value for name, value in to_dict(config).items() if name not in _UNUSED}
    motors = config.randomization.stiffness, config.randomization.damping  # objects settle under these
    turn = config.turn.axis, config.turn.distance, *config.turn.axes
    boxes = load_mesh_object(config.objects).boxes if config.objects.mesh else None
    mesh = [part.tolist() for part in (boxes.size, boxes.position, boxes.quat)] if boxes else None
    given = settings, motors, turn, mesh, hand.digest, np.asarray(jax.random.key_data(key)).tolist()
    return json.dumps([*given, _VERSION, mujoco.__version__], sort_keys=True)


def _make(
    key: jax.Array, hand: Hand, config: Any, gravity: tuple[float, float, float], size: int, trap: bool = False
) -> list[Any]:
    """A start state for each of `size` objects: qpos, qvel, joint targets, object leaves.

    Objects are drawn first, and each is tried in posture after posture until it stays: large ones fit into few, and
    where whatever stays is kept they are all but left out.
    """
    chunk = 1024
    object_key, key = jax.random.split(key)
    draw = jax.jit(jax.vmap(lambda k: sample_turned_object(k, config)))
    objects = jax.device_get(draw(jax.random.split(object_key, size)))
    candidate = _trap_candidate if trap else _candidate
    sample = jax.jit(jax.vmap(lambda k, object: candidate(k, object, hand, config)))
    starts, waiting, tried = {}, np.arange(size), 0
    scene = _scene(hand, config, gravity)
    batch = Batch(scene.model, chunk, available_cores())
    for trial in range(_TRIALS):
        which = np.resize(waiting, chunk)
        keys = jax.random.split(jax.random.fold_in(key, trial), chunk)
        candidates = jax.device_get(sample(keys, jax.tree.map(lambda leaf, which=which: leaf[which], objects)))
        rows = np.flatnonzero(candidates["clear"])
        rows = np.sort(rows[np.unique(which[rows], return_index=True)[1]])  # one posture for each object
        good, qpos = _settle(batch, scene, config, candidates, rows, trap)
        for k in _clear_of_palm(hand, config, candidates["object"], good, qpos):
            starts[which[good[k]]] = qpos[k], candidates["joint_target"][good[k]]
        waiting, tried = np.setdiff1d(waiting, list(starts)), tried + len(rows)
        if not len(waiting) or tried > 1000 and len(starts) < tried / (2000 if trap else 200):
            break
    if len(starts) < (1 if trap else 0.9 * size):
        raise ConfigError(
            f"RotateConfig: only {len(starts)} of {size} objects have a start state that stayed "
            f"in the hand ({tried} tried); change posture, tilt, edge or support"
        )
    # The few that fit nowhere leave their rows to others.
    chosen = np.resize(sorted(starts), size)
    return [
        np.stack([starts[k][0] for k in chosen]),
        np.zeros((size, hand.num_hinges + 6), np.float32),
        np.stack([starts[k][1] for k in chosen]),
        *(leaf[chosen] for leaf in jax.tree.leaves(objects)),
    ]


def _candidate(key: jax.Array, object: ObjectParams, hand: Hand, config: Any) -> dict[str, Any]:
    """This object just above where it will rest, in a random posture."""
    keys = jax.random.split(key, 5)
    noise = config.posture_noise * jax.random.uniform(keys[0], (hand.num_joints,), minval=-1.0)
    flexion = close_fingers(hand, range(1, hand.num_fingers))
    curl = jax.random.uniform(keys[3], minval=config.curl[0], maxval=config.curl[1])
    joints = jnp.clip(jnp.asarray(config.posture) + noise + curl * flexion, hand.joint_lower, hand.joint_upper)
    most = _HEADING_NOISE_AXES if config.turn.axes else _HEADING_NOISE
    heading = most * jax.random.uniform(keys[1], minval=-1.0)
    quat = rotations.axis_angle_to_quat(jnp.asarray(config.turn.unit_axis), heading)
    shift = config.place_noise * jax.random.uniform(keys[2], (2,), minval=-1.0)
    place = jnp.asarray(config.reference).at[1:].add(jnp.asarray(config.start_offset) + shift)
    if config.support == "palm":
        floor = palm_height(hand) + 0.001 - lowest_point(object, quat, jnp.zeros(3))
        place = place.at[0].set(floor)
    squeeze = jax.random.uniform(keys[4], minval=config.squeeze[0], maxval=config.squeeze[1])
    target = joints + squeeze * (flexion + close_fingers(hand, range(1)))
    return _at(hand, object, joints, target, place, quat)


def _trap_candidate(key: jax.Array, object: ObjectParams, hand: Hand, config: Any) -> dict[str, Any]:
    """This object where rotations get stuck: ahead of the reference, tipped toward the wrist, under the fingertip of
    the middle finger, which closes."""
    keys = jax.random.split(key, 6)
    noise = config.posture_noise * jax.random.uniform(keys[0], (hand.num_joints,), minval=-1.0)
    joints = jnp.asarray(config.posture) + noise
    middle = flexion_joints(hand, range(hand.num_fingers // 2, hand.num_fingers // 2 + 1))
    bent = jax.random.uniform(keys[1], (len(middle),), minval=0.2, maxval=1.5)
    joints = jnp.clip(joints.at[middle].set(bent), hand.joint_lower, hand.joint_upper)
    target = joints.at[middle].add(jax.random.uniform(keys[2], minval=0.1, maxval=0.6))
    heading = _HEADING_NOISE * jax.random.uniform(keys[3], minval=-1.0)
    pitch = jax.random.uniform(keys[4], minval=_TRAP_PITCH[0], maxval=_TRAP_PITCH[1])
    quat = rotations.quat_multiply(
        rotations.axis_angle_to_quat(jnp.array([0.0, 1.0, 0.0]), pitch),
        rotations.axis_angle_to_quat(jnp.asarray(config.turn.unit_axis), heading),
    )
    low, high = jnp.array([0.0, -0.025, 0.0]), jnp.array([0.03, 0.0, 0.015])
    shift = jax.random.uniform(keys[5], (3,), minval=low, maxval=high)
    shift = shift * jnp.array([1.0, hand.thumb_side, 1.0])
    place = jnp.asarray(config.reference) + shift + jnp.array([0.0, 0.0, _TRAP_PLACE])
    return _at(hand, object, joints, target, place, quat)


def _at(
    hand: Hand, object: ObjectParams, joints: jax.Array, target: jax.Array, place: jax.Array, quat: jax.Array
) -> dict[str, Any]:
    overlap = clearance(hand, joints, object.shape(), place, rotations.quat_to_matrix(quat))
    return {
        "qpos": jnp.concatenate([hinge_angles(hand, joints), place, quat]),
        "joint_target": jnp.clip(target, hand.joint_lower, hand.joint_upper),
        "object": object,
        "clear": overlap > -0.001,
    }


def _scene(hand: Hand, config: Any, gravity: tuple[float, float, float]) -> PhysicsScene:
    """The scene in C, with springs at the joints for the motors."""
    physics, margin = config.physics, config.skin.margin
    scene = build_scene(hand, config.objects.slots, largest_size(config), physics, gravity, "mjx", margin)
    model, dofs = scene.model, scene.joint_dof
    model.jnt_stiffness[model.dof_jntid[dofs]] = config.randomization.stiffness
    model.dof_damping[dofs] += config.randomization.damping
    model.opt.timestep = 0.005  # s; the springs are explicit here, unlike the motors of an environment
    # C MuJoCo takes shortcuts for frames that coincided when it compiled; sizes change here.
    model.geom_sameframe[:] = model.body_sameframe[:] = 0
    return scene


def _settle(
    batch: Batch, scene: PhysicsScene, config: Any, candidates: dict[str, Any], rows: np.ndarray, trap: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Those of `rows` that came to rest where they belong, and their qpos; of one world each."""
    object, body, at = candidates["object"], scene.object_body, rows[:, None]
    batch.expand("geom_size")[at, scene.object_geoms] = object.size[rows]
    batch.expand("geom_pos")[at, scene.object_geoms] = object.position[rows]
    if object.quat is not None:
        batch.expand("geom_quat")[at, scene.object_geoms] = object.quat[rows]
    for name, values in (("mass", object.mass), ("inertia", object.inertia), ("ipos", object.com)):
        batch.expand(f"body_{name}")[rows, body] = values[rows]
    rubber = contact.pair_constants(scene.model, scene.object_pairs, scene.tip_bodies)[2] >= 0
    slide = np.where(rubber, object.friction[at], object.link_friction[at])
    batch.expand("pair_friction")[at, scene.object_pairs, :2] = slide[..., None]
    batch.expand("qpos_spring")[at, scene.joint_qpos] = candidates["joint_target"][rows]
    batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
    batch.bind("qpos")[rows], batch.warning[:] = candidates["qpos"][rows], 0
    batch.step(rows, max(round(_SETTLING / scene.model.opt.timestep), 1))
    qpos, qvel = batch.bind("qpos")[rows], batch.bind("qvel")[rows]
    sound = np.isfinite(qpos).all(1) & ~batch.warning[rows, :, 1].any(1)
    stays = sound & _stays(config, qpos[:, scene.object_qpos], qvel[:, scene.object_dof], trap)
    return rows[stays], qpos[stays].astype(np.float32)


def _clear_of_palm(hand: Hand, config: Any, object: ObjectParams, rows: np.ndarray, qpos: np.ndarray) -> np.ndarray:
    """Which of these rows, by their place in `rows`, are no drop from the beginning, where touching the palm is one."""
    if config.support == "palm" or not len(rows):
        return np.arange(len(rows))
    low = jax.vmap(lowest_point)(jax.tree.map(lambda leaf: leaf[rows], object), qpos[:, -4:], qpos[:, -7:-4])
    return np.flatnonzero(np.asarray(low) > palm_height(hand) + CLEARANCE)


def _stays(config: Any, place: np.ndarray, motion: np.ndarray, trap: bool) -> np.ndarray:
    """Whether objects at [N, 7], with these velocities [N, 6], are at rest where they belong [N]."""
    axis = config.turn.unit_axis
    turned = Rotation.from_quat(place[:, 3:], scalar_first=True).apply(axis)
    rest = (np.linalg.norm(motion[:, :3], axis=1) < _AT_REST[0]) & (np.linalg.norm(motion[:, 3:], axis=1) < _AT_REST[1])
    away = np.linalg.norm(place[:, :3] - config.reference, axis=1)
    if not trap:
        tilt = np.arccos(np.clip(turned @ axis, -1.0, 1.0))
        return rest & (tilt < _LEVEL) & (away < 0.6 * config.turn.distance)
    pitch, ahead = np.arctan2(-turned[:, 2], turned[:, 0]), place[:, 2] - config.reference[2] > _TRAP_PLACE
    return rest & ahead & (_TRAP_PITCH[0] < pitch) & (pitch < _TRAP_PITCH[1]) & (away < config.drop_radius)
