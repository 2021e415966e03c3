"""What the kernel of the `cuda` engine is generated from: buffers and constants of a scene."""

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexsim.core.errors import AssetError
from dexsim.physics.cuda.arguments import Buffer
from dexsim.physics.cuda.links import Links, find_links, rotation_matrix
from dexsim.physics.interface import PhysicsScene

LANES = 32
MAX_CONTACTS = 32
"""Contacts of a world: one for each lane."""
_FAST = 4  # hinges of a finger that the kernel eliminates by itself


def buffers(scene: PhysicsScene, law: Sequence[Buffer]) -> list[Buffer]:
    """Arguments of the kernel in order, arrays [N, size]: inputs, the motor law's constants, outputs."""
    model, slots, pairs = scene.model, len(scene.slots), len(scene.object_pairs)
    inputs = {
        "qpos": model.nq,
        "qvel": model.nv,
        "warmstart": model.nv,
        "push": 3,
        "body_mass": 1,
        "body_inertia": 3,
        "body_ipos": 3,
        "geom_size": 3 * (slots + len(scene.tip_geoms)),
        "geom_pos": 3 * slots,
        "geom_quat": 4 * slots,
        "pair_friction": pairs,
        "pair_solref": 2 * pairs,
        "pair_solimp": 5 * pairs,
    }
    outputs = {
        "qpos_out": model.nq,
        "qvel_out": model.nv,
        "warmstart_out": model.nv,
        "finger_force": 3 * scene.hand.num_fingers,
        "stats": 4,
    }
    return [
        *(Buffer(name, size) for name, size in inputs.items()),
        *law,
        *(Buffer(name, size, output=True) for name, size in outputs.items()),
    ]


def check_scene(scene: PhysicsScene) -> None:
    """Raise AssetError with everything that the kernel lacks."""
    model = scene.model
    flags, joints = mujoco.mjtDisableBit, mujoco.mjtJoint
    joint = np.delete(np.arange(model.njnt), model.dof_jntid[scene.object_dof[0]])
    pairs, friction = len(model.pair_dim), model.pair_friction
    lacking = {
        f"{model.nv - 6} hinges (at most {LANES - 6})": model.nv > LANES,
        "joints that are no hinges": (model.jnt_type[joint] != joints.mjJNT_HINGE).any(),
        "bodies with several joints": (model.body_jntnum > 1).any(),
        "joints after the object's": not np.array_equal(scene.object_dof, np.arange(model.nv - 6, model.nv)),
        "mocap bodies": model.nmocap,
        "an object whose inertia has other axes than its body": model.body_iquat[scene.object_body, 0] != 1,
        "tendons": model.ntendon,
        "actuators": model.nu,
        "dry friction of joints": model.dof_frictionloss.any(),
        "gravity compensation": model.body_gravcomp.any(),
        "equality constraints other than between joints": (model.eq_type != mujoco.mjtEq.mjEQ_JOINT).any(),
        "coupled joints that are switched off": not model.eq_active0.all(),
        f"more than {LANES} coupled joints": model.neq > LANES,
        "contacts without pairs": model.geom_contype.any() or model.geom_conaffinity.any(),
        "contacts of another dimension than 3": (model.pair_dim != 3).any(),
        "margins or gaps of contacts": model.pair_margin.any() or model.pair_gap.any(),
        "solreffriction": model.pair_solreffriction.any(),
        "friction that depends on the direction": (friction[:pairs, 0] != friction[:pairs, 1]).any(),
        "pyramidal cones": model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC,
        "other integrators than Euler's": model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER,
        "implicit damping": not model.opt.disableflags & flags.mjDSBL_EULERDAMP,
        f"more than {LANES // 3} fingers": scene.hand.num_fingers > LANES // 3,
    }
    if found := [what for what, here in lacking.items() if here]:
        raise AssetError(f"{scene.hand.model_path}: backend cuda cannot simulate: {'; '.join(found)}")


def kernel_constants(scene: PhysicsScene) -> str:
    """The constants of a scene but for its contacts (`contact_tables`) as C++.

    Raises:
      AssetError: the kernel cannot run the scene.
    """
    check_scene(scene)
    links = find_links(scene)
    return "\n".join(
        [
            *_sizes(scene, links),
            *_tree(links, scene),
            *_bodies(scene, links),
            *_joints(scene),
            *_couplings(scene.model),
            *_pairs(scene, links),
            "",
        ]
    )


def table(name: str, values: ArrayLike, kind: str = "float") -> str:
    """A C++ table [...] of device memory."""
    array = np.asarray(values)
    sizes = "".join(f"[{n}]" for n in array.shape)

    def braces(part: np.ndarray) -> str:
        if part.ndim:
            return "{" + ", ".join(braces(row) for row in part) + "}"
        return number(part.item()) if kind == "float" else str(part.item())

    return f"__device__ const {kind} {name}{sizes} = {braces(array)};"


def number(value: float) -> str:
    """A C++ literal of a float32."""
    return f"{np.float32(value):.9e}f"


def _sizes(scene: PhysicsScene, links: Links) -> list[str]:
    option, blocks = scene.model.opt, _blocks(scene, links)
    sizes = {
        "HINGES": links.hinges,
        "CHAIN": max(map(len, links.chains())),
        # Hinges of a finger if every finger is one chain of few; 0: the hand is eliminated as a whole.
        "BLOCK": 0 if blocks is None else int(np.bincount(blocks).max()),
        "PRIMITIVES": len(scene.slots),
        "TIP_GEOMS": len(scene.tip_geoms),
        "OBJECT_PAIRS": len(scene.object_pairs),
        "FINGERS": scene.hand.num_fingers,
        "MAX_CONTACTS": MAX_CONTACTS,
    }
    numbers = {
        "TIMESTEP": option.timestep,
        "IMPRATIO": option.impratio,
        "GRAVITY_X": option.gravity[0],
        "GRAVITY_Y": option.gravity[1],
        "GRAVITY_Z": option.gravity[2],
    }
    return [
        *(f"constexpr int {name} = {value};" for name, value in sizes.items()),
        *(f"constexpr float {name} = {number(value)};" for name, value in numbers.items()),
    ]


def _tree(links: Links, scene: PhysicsScene) -> list[str]:
    steps, blocks = links.gathering(), _blocks(scene, links)
    first = np.zeros(links.hinges, int) if blocks is None else np.searchsorted(blocks, blocks)
    last = np.zeros(links.hinges, int) if blocks is None else np.searchsorted(blocks, blocks, side="right") - 1
    return [
        table("PARENT", _lanes(links.parent, -1), "int"),
        table("DEPTH", _lanes([len(chain) - 1 for chain in links.chains()]), "int"),
        table("BLOCK_FIRST", _lanes(first), "int"),
        table("BLOCK_LAST", _lanes(last), "int"),
        f"constexpr int GATHER_STEPS = {len(steps)};",
        table("GATHER_FROM", np.array([_lanes(step, -1) for step in steps] or [_lanes([], -1)]), "int"),
        table("CHAIN_MASK", [*(sum(1 << h for h in chain) for chain in links.chains()), 0], "int"),
        table("CHAIN_HINGE", _padded(links.chains()), "int"),
    ]


def _bodies(scene: PhysicsScene, links: Links) -> list[str]:
    """Offsets, masses, centres of mass and inertias of the links, in their frames."""
    model, hinges = scene.model, links.hinges
    mass, moment, about = np.zeros(hinges), np.zeros((hinges, 3)), np.zeros((hinges, 3, 3))
    parts = [(body, link) for body, link in enumerate(links.link) if 0 <= link < hinges]
    for body, link in parts:
        centre = links.place[body] + links.rotation[body] @ model.body_ipos[body]
        turn = links.rotation[body] @ rotation_matrix(model.body_iquat[body])
        mass[link] += model.body_mass[body]
        moment[link] += model.body_mass[body] * centre
        about[link] += turn @ np.diag(model.body_inertia[body]) @ turn.T + model.body_mass[body] * _spread(centre)
    centre = moment / mass[:, None]
    inertia = about - mass[:, None, None] * np.array([_spread(c) for c in centre])
    rows, columns = np.triu_indices(3)
    return [
        table("OFFSET_ROTATION", _lanes(links.offset_rotation.reshape(-1, 9)).T),
        table("OFFSET_PLACE", _lanes(links.offset_place).T),
        table("LINK_MASS", _lanes(mass)),
        table("LINK_CENTRE", _lanes(centre).T),
        table("LINK_INERTIA", _lanes(inertia[:, rows, columns]).T),
    ]


def _joints(scene: PhysicsScene) -> list[str]:
    model = scene.model
    joint = model.dof_jntid[: model.nv - 6]
    address = model.jnt_qposadr[joint]
    limited, margin = model.jnt_limited[joint] > 0, model.jnt_margin[joint]
    low, high = (np.where(limited, model.jnt_range[joint, k], far) for k, far in ((0, -1e6), (1, 1e6)))
    drive = np.full(len(joint), -1)
    drive[scene.joint_dof] = np.arange(len(scene.joint_dof))
    return [
        table("DRIVE", _lanes(drive, -1), "int"),
        table("ARMATURE", _lanes(model.dof_armature[: len(joint)])),
        table("DAMPING", _lanes(model.dof_damping[: len(joint)])),
        table("STIFFNESS", _lanes(model.jnt_stiffness[joint])),
        table("SPRING_ANGLE", _lanes(model.qpos_spring[address])),
        table("LIMIT_LOW", _lanes(low + margin)),
        table("LIMIT_HIGH", _lanes(high - margin)),
        table("LIMIT_COMPLIANCE", _lanes(model.dof_invweight0[: len(joint)])),
        table("LIMIT_SPRING", _lanes(np.hstack([model.jnt_solref[joint], model.jnt_solimp[joint]])).T),
    ]


def _couplings(model: mujoco.MjModel) -> list[str]:
    """Joints that follow others: q - q0 = polynomial of (q' - q0')."""
    first, second = (np.where(joint >= 0, model.jnt_dofadr[joint], -1) for joint in (model.eq_obj1id, model.eq_obj2id))
    zero = [np.where(dof >= 0, model.qpos0[dof], 0.0) for dof in (first, second)]
    compliance = model.dof_invweight0[first] + np.where(second >= 0, model.dof_invweight0[second], 0.0)
    springs = np.hstack([model.eq_solref, model.eq_solimp])
    return [
        f"constexpr int COUPLINGS = {model.neq};",
        "struct Coupling { int first, second; float zero[2], polynomial[5], spring[7], compliance; };",
        f"__device__ const Coupling COUPLING[{max(model.neq, 1)}] = {{",
        *(
            f"  {{{first[k]}, {second[k]}, {_list([zero[0][k], zero[1][k]])}, {_list(model.eq_data[k, :5])}, "
            f"{_list(springs[k])}, {number(compliance[k])}}},"
            for k in range(model.neq)
        ),
        "};",
    ]


def _pairs(scene: PhysicsScene, links: Links) -> list[str]:
    """What contacts of each pair move, and the springs of pairs within the hand, which are the same in every world."""
    model = scene.model
    bodies = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
    compliance = model.body_invweight0[bodies, 0].sum(0)
    fingers = {int(body): finger for finger, body in enumerate(scene.tip_bodies)}
    rows = {int(pair): row for row, pair in enumerate(scene.object_pairs)}
    lines: list[str] = []
    springs: list[list[float]] = []
    for pair, (one, two) in enumerate(bodies.T):
        first, second, side = int(links.link[one]), int(links.link[two]), 1.0
        if first == links.hinges:
            first, second, side = second, first, -1.0
        finger = fingers.get(int(two if side < 0 else one), -1) if second == links.hinges else -1
        row = rows.get(pair, -1 - len(springs))
        if row < 0:
            springs.append([model.pair_friction[pair, 0], *model.pair_solref[pair], *model.pair_solimp[pair]])
        lines.append(f"  {{{first}, {second}, {row}, {finger}, {number(side)}, {number(compliance[pair])}}},")
    return [
        "// Links (the object's last), row among the object's pairs (or -1 - that among the others), finger whose tip",
        "// presses on the object, -1 where the object is the pair's first, inverse weights of both bodies in 1/kg.",
        "struct Pair { int first, second, row, finger; float side, compliance; };",
        f"__device__ const Pair PAIR[{len(lines)}] = {{",
        *lines,
        "};",
        table("HAND_SPRING", np.array(springs or np.zeros((1, 8)))),
    ]


def _blocks(scene: PhysicsScene, links: Links) -> np.ndarray | None:
    """The finger [H] of each hinge if each is one chain of few; None where the hand has to be taken as a whole."""
    chains = links.chains()
    finger = np.array([chain[0] for chain in chains])
    model = scene.model
    coupled = [(first, second) for first, second in zip(model.eq_obj1id, model.eq_obj2id, strict=True) if second >= 0]
    across = any(finger[model.jnt_dofadr[a]] != finger[model.jnt_dofadr[b]] for a, b in coupled)
    branched = any(chain != list(range(chain[0], link + 1)) for link, chain in enumerate(chains))
    if across or branched or max(map(len, chains)) > _FAST:
        return None
    return finger


def _padded(rows: list[list[int]]) -> np.ndarray:
    width = max(map(len, rows))
    return np.array([row + [-1] * (width - len(row)) for row in rows])


def _lanes(values: ArrayLike, fill: float = 0.0) -> np.ndarray:
    """Values [H, ...] for all lanes [32, ...]."""
    array = np.asarray(values)
    return np.concatenate([array, np.full((LANES - len(array), *array.shape[1:]), fill, array.dtype)])


def _list(values: Iterable[float]) -> str:
    return "{" + ", ".join(map(number, values)) + "}"


def _spread(centre: np.ndarray) -> np.ndarray:
    """Inertia [3, 3] of a unit mass at `centre`."""
    return np.dot(centre, centre) * np.eye(3) - np.outer(centre, centre)
