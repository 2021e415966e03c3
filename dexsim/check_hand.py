"""Checks the files of a hand: what every hand must fulfil, one line each.

python -m dexsim.check_hand my_hand.toml

Beside what the files need in order to load, it checks the conventions that they follow: palm frame, signs of joints,
reach of the first grasp, limits. A check returns what is wrong, and nothing of a sound hand.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

from dexsim import registry
from dexsim.core import cli
from dexsim.core.compilation import jit
from dexsim.env.state import State
from dexsim.errors import AssetError, ConfigError
from dexsim.geometry import sdf
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import finger_bodies, flexion_joints, forward_kinematics, open_hand
from dexsim.hand.load import load_hand
from dexsim.hand.mjcf import hand_poses
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.shared import clearance, palm_height

_POSES, _ENVS = 20, 16
_NEAR, _ALIGNED = 1e-5, 1e-4  # m and rad, of link poses in float32
TORQUES, SPEEDS = (0.02, 5.0), (0.3, 40.0)
"""Nm and rad/s: what motors of a hand have. A finger of 10 cm would press with 50 N."""
_DEEP = 1.5e-3  # m, of a taxel in its link: pads are capsules fitted to the real skin
_AWAY = 3e-3  # m, how far from its link a taxel may be: as thick as the rubber
_STEP = 3e-3  # m, along a taxel's normal, which must lead away from the link
_REACH = 0.06  # m, from the object's centre to the nearest fingertip
_BALL, _OVERLAP = 0.022, 0.002  # m, radius of the smallest sphere of the default objects; depth that start states allow
_UPRIGHT = 0.5  # share of an open finger's length along +z
_SIDEWAYS = 0.01  # m, how far a thumb must be to a side for it to have one
_pose = jax.jit(forward_kinematics, static_argnums=0)


def check_kinematics(hand: Hand) -> str:
    """Link poses against C MuJoCo at random joint angles."""
    angles = np.random.default_rng(0).uniform(hand.joint_lower, hand.joint_upper, (_POSES, hand.num_joints))
    pose = jax.device_get(jax.jit(jax.vmap(lambda joints: forward_kinematics(hand, joints)))(np.float32(angles)))
    for drawn, position, rotation in zip(hand_poses(hand, angles), pose.body_position, pose.body_rotation, strict=True):
        away = np.linalg.norm(position - drawn.body_position, axis=-1)
        turned = np.linalg.norm(rotation - drawn.body_rotation, axis=(-2, -1)) / np.sqrt(2)  # small angles
        for error, limit, unit in ((away, _NEAR, "m from"), (turned, _ALIGNED, "rad turned from")):
            if error.max() > limit:
                name = hand.body_names[int(error.argmax())]
                return f"link {name!r} is {error.max():.3g} {unit} where MuJoCo has it"
    return ""


def check_fingertips(hand: Hand) -> str:
    """Every fingertip has a primitive that touches the object; a mesh does not count."""
    touching = {geom.body for geom in hand.geoms if geom.touches}
    bare = [name for name, body in zip(hand.finger_names, hand.tip_body, strict=True) if body not in touching]
    return f"finger {bare[0]!r} has no primitive at its tip that touches (no mesh)" if bare else ""


def check_taxels(hand: Hand) -> str:
    """The taxels of every finger are on the primitives of the link that carries them, and face outwards."""
    for finger, name in enumerate(hand.finger_names):
        parts = [geom for geom in hand.geoms if geom.body == hand.tip_body[finger] and geom.kind in sdf.DISTANCE]
        if not parts:
            continue
        arrays = [np.stack([getattr(part, field) for part in parts]) for field in ("size", "position", "rotation")]
        kinds, size, position, rotation = tuple(part.kind for part in parts), *arrays
        shape = sdf.Shape(kinds, size, position, rotation, np.ones(len(parts), bool))
        position, normal = hand.taxel_position[finger], hand.taxel_normal[finger]
        distance, ahead = (np.asarray(sdf.signed_distance(position + s * normal, shape)) for s in (0.0, _STEP))
        depth, away = -1e3 * distance.min(), 1e3 * distance.max()
        for wrong, error, what in (
            (distance < -_DEEP, -distance, f"lies {depth:.2g} mm inside its link"),
            (distance > _AWAY, distance, f"is {away:.3g} mm away from its link: metres, in the link's frame?"),
            (ahead <= distance, distance, "faces into its link: is the normal outward?"),
        ):
            if wrong.any():
                column, row = divmod(int(np.argmax(np.where(wrong, error, -np.inf))), hand.taxel_grid[1])
                count = f"{wrong.sum()} of {len(wrong)}"
                return f"finger {name!r}: taxel column {column}, row {row} {what} ({count})"
    return ""


def check_frame(hand: Hand) -> str:
    """With the joints at 0, fingers point along +z, and the thumb is on the side of +y, of a left hand on that of
    -y."""
    pose = _pose(hand, open_hand(hand))
    tips, bodies = np.asarray(pose.tip_position), np.asarray(pose.body_position)
    roots = np.array([bodies[finger_bodies(hand, finger)[-2]] for finger in range(hand.num_fingers)])
    ways = (tips - roots) / np.linalg.norm(tips - roots, axis=1, keepdims=True)
    for name, way in list(zip(hand.finger_names, ways, strict=True))[1:]:
        if way[2] < _UPRIGHT:
            return f"finger {name!r} points along {way.round(2)} of {hand.palm!r} with its joints at 0, expected +z"
    aside = roots[0, 1] - roots[1:, 1].mean() if hand.num_fingers > 1 else 0.0
    if aside * hand.thumb_side < -_SIDEWAYS:
        side, expected = ("-y", "+y") if hand.side == "right" else ("+y", "-y")
        return f"the thumb is on the side of {side}, of a {hand.side} hand expected {expected}: turn palm or give side"
    return ""


def check_signs(hand: Hand) -> str:
    """Positive angles close: a finger's tip moves toward the palm's normal from where it is open, the thumb's to where
    its taxels face in the grasp."""
    opened, wrong = open_hand(hand), []
    grasp = np.asarray(hand.grasp_posture, np.float32) if hand.grasp_posture else opened
    motion = jax.jit(jax.jacfwd(lambda joints: forward_kinematics(hand, joints).tip_position))
    jacobian, way = np.array(motion(opened)), np.tile([1.0, 0.0, 0.0], (hand.num_fingers, 1))
    jacobian[0] = motion(grasp)[0]
    way[0] = np.asarray(_pose(hand, grasp).tip_rotation[0]) @ hand.taxel_normal[0].mean(0)
    for finger in range(hand.num_fingers):
        for joint in flexion_joints(hand, range(finger, finger + 1)):
            step = jacobian[finger, :, joint]
            if step @ way[finger] < -0.2 * np.linalg.norm(step) * np.linalg.norm(way[finger]):
                wrong.append(hand.joint_names[joint])
    return f"positive angles open {', '.join(wrong)}: negate the axis and range of these joints" if wrong else ""


def check_reach(hand: Hand) -> str:
    """The grasp's posture has a fingertip near the object's centre, and room for a ball between fingers and palm."""
    if not hand.grasp_posture or not hand.grasp_centre:
        return f"hand {hand.name!r} has no grasp: its TOML needs [grasp] with posture and centre"
    posture, centre = np.asarray(hand.grasp_posture, np.float32), np.asarray(hand.grasp_centre)
    tips = np.asarray(_pose(hand, posture).tip_position)
    away = 1e3 * np.linalg.norm(tips - centre, axis=-1).min()
    if away > 1e3 * _REACH:
        return f"[grasp]: the fingertip nearest to centre is {away:.0f} mm away, expected {1e3 * _REACH:.0f} mm at most"
    centre[0] = palm_height(hand) + 0.005 + _BALL
    ball = sdf.Shape(("sphere",), jnp.full((1, 3), _BALL), jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.ones(1, bool))
    gap = float(jax.jit(clearance, static_argnums=0)(hand, posture, ball, centre, np.eye(3, dtype=np.float32)))
    deep = f"{-1e3 * gap:.0f} mm deep in a ball of {2e3 * _BALL:.0f} mm at centre"
    return f"[grasp]: a link is {deep}: open the posture or move centre" if gap < -_OVERLAP else ""


def check_limits(hand: Hand) -> str:
    """Torques and speeds are those of a hand's motors."""
    for what, values, (low, high), unit in (
        ("stall torque", hand.torque_limit, TORQUES, "Nm"),
        ("no-load speed", hand.speed_limit, SPEEDS, "rad/s"),
    ):
        for joint in np.flatnonzero((values < low) | (values > high)):
            name, expected = hand.joint_names[joint], f"expected {low:g} to {high:g} {unit}"
            return f"joint {name!r} has a {what} of {values[joint]:g} {unit}, {expected}"
    return ""


def check_rollout(hand: Hand) -> str:
    """Random actions in the grasp task, as fast as they may change, for a second: all that is measured is finite."""
    env = registry.make("grasp", GraspConfig(pool_size=_ENVS), hand=hand)

    def episode(key: jax.Array) -> jax.Array:
        begin, *keys = jax.random.split(key, 1 + round(1 / env.control_period))

        def step(state: State, key: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, jax.random.uniform(key, (env.action_size,), minval=-1.0))
            return state, (state.metrics["non_finite"] > 0) | ~jnp.isfinite(state.obs["actor"]).all()

        return jax.lax.scan(step, env.reset(begin), jnp.stack(keys))[1]

    bad = np.asarray(jit(jax.vmap(episode), once=True)(jax.random.split(jax.random.key(0), _ENVS)))
    return f"physics diverged in {np.sum(bad.any(1))} of {_ENVS} episodes" if bad.any() else ""


CHECKS: dict[str, Callable[[Hand], str]] = {
    "kinematics agree with MuJoCo": check_kinematics,
    "fingertips touch": check_fingertips,
    "taxels are on the skin": check_taxels,
    "fingers point along +z, the thumb is at its side": check_frame,
    "positive angles close": check_signs,
    "fingertips reach the object": check_reach,
    "limits are plausible": check_limits,
    "random actions stay finite": check_rollout,
}
"""What every hand must fulfil, beside what `load_hand` requires."""


def describe(hand: Hand) -> list[str]:
    """Motors, touch and self-collisions of a hand, a line each."""
    lines = [
        f"{hand.name}: {hand.num_joints} joints, {hand.num_fingers} fingers of {hand.num_taxels} taxels",
        "motor             range [rad]     stall [Nm]  no load [rad/s]  moves",
    ]
    for joint, name in enumerate(hand.joint_names):
        moved = [f"{hand.body_names[b]} (x {hand.body_ratio[b]:.4g})" for b in np.flatnonzero(hand.body_joint == joint)]
        lines.append(
            f"  {name:15s} {hand.joint_lower[joint]:6.2f} to {hand.joint_upper[joint]:5.2f} "
            f"{hand.torque_limit[joint]:12.2f} {hand.speed_limit[joint]:16.2f}  {', '.join(moved)}"
        )
    lines.append("finger            taxels          area [mm^2]")
    for finger, name in enumerate(hand.finger_names):
        columns, rows = hand.taxel_grid
        lines.append(f"  {name:15s} {columns:3d} x {rows:3d} {1e6 * hand.taxel_area[finger].sum():18.0f}")
    pairs = mujoco.MjModel.from_xml_path(str(hand.model_path)).npair
    return [*lines, f"self-collision: {pairs} pairs. Links touch each other only where a <pair> in the MJCF says so"]


def report(path: Path) -> tuple[list[str], bool]:
    """The lines of the report on a hand's TOML, and whether all checks passed."""
    try:
        hand = load_hand(path)
    except AssetError as error:
        return [f"FAIL  files load: {error}"], False
    lines, passed = [*describe(hand), "ok    files load"], True
    for name, check in CHECKS.items():
        if check is check_rollout and not passed:
            lines.append(f"-     {name}: not tried")
            continue
        try:
            wrong = check(hand)
        except (AssetError, ConfigError) as error:  # of what the check needs: a hand that nothing touches, for one
            wrong = str(error)
        lines.append(f"FAIL  {name}: {wrong}" if wrong else f"ok    {name}")
        passed &= not wrong
    return lines, passed


@dataclass(frozen=True, kw_only=True)
class CheckHandArguments:
    """Check the TOML of a hand and the files that it names."""

    hand: Annotated[Path, tyro.conf.Positional]
    """The TOML of a hand, or the name of a shipped one."""
    view: bool = False
    """Then show the hand in the browser, at the start of a grasp."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns 0 if the hand passes, else 1."""
    arguments = cli.parse(CheckHandArguments, argv)
    lines, passed = report(arguments.hand)
    print("\n".join(lines), flush=True)
    if passed and arguments.view:
        from dexsim.view.__main__ import main as show

        return show(["grasp", "--hand", str(arguments.hand)])
    return 0 if passed else 1


if __name__ == "__main__":
    cli.run(main)
