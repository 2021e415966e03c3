"""Checks the files of a hand: what every hand must fulfil, one line each.

python -m dexsim.check_hand my_hand.toml
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
from dexsim.core.errors import AssetError, ConfigError
from dexsim.env.state import State
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import forward_kinematics, hinge_angles
from dexsim.hand.layout import check_hand as check_taxels
from dexsim.hand.load import load_hand
from dexsim.tasks.grasp.config import GraspConfig

_POSES, _ENVS = 20, 16
_NEAR, _ALIGNED = 1e-5, 1e-4  # m and rad, of link poses in float32


def check_kinematics(hand: Hand) -> None:
    """Link poses against C MuJoCo at random joint angles.

    Raises:
      AssetError: a link is elsewhere or turned.
    """
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    palm, bodies = model.body(hand.palm).id, [model.body(name).id for name in hand.body_names]
    for _ in range(_POSES):
        angle = random.uniform(hand.joint_lower, hand.joint_upper)
        data.qpos[:] = hinge_angles(hand, angle)
        mujoco.mj_kinematics(model, data)
        frame = data.xmat[palm].reshape(3, 3)
        place, turn = (data.xpos[bodies] - data.xpos[palm]) @ frame, frame.T @ data.xmat[bodies].reshape(-1, 3, 3)
        pose = forward_kinematics(hand, angle.astype(np.float32))
        away = np.linalg.norm(pose.body_position - place, axis=-1)
        turned = np.linalg.norm(pose.body_rotation - turn, axis=(-2, -1)) / np.sqrt(2)  # small angles
        for error, limit, unit in ((away, _NEAR, "m from"), (turned, _ALIGNED, "rad turned from")):
            if error.max() > limit:
                name = hand.body_names[int(error.argmax())]
                raise AssetError(f"{hand.model_path}: link {name!r} is {error.max():.3g} {unit} where MuJoCo has it")


def check_fingertips(hand: Hand) -> None:
    """Every fingertip has a primitive that touches the object.

    Raises:
      AssetError: one has none; a mesh does not count.
    """
    for name, body in zip(hand.finger_names, hand.tip_body, strict=True):
        if not any(geom.touches and geom.body == body for geom in hand.geoms):
            raise AssetError(f"{hand.model_path}: finger {name!r} has no primitive at its tip that touches (no mesh)")


def check_rollout(hand: Hand) -> None:
    """Random actions in the grasp task, as fast as they may change, for a second.

    Raises:
      AssetError: the hand has no grasp, or something that it measures is not finite.
    """
    try:
        env = registry.make("grasp", GraspConfig(pool_size=_ENVS), hand=hand)
    except ConfigError as error:
        raise AssetError(str(error)) from None

    def episode(key: jax.Array) -> jax.Array:
        begin, *keys = jax.random.split(key, 1 + round(1 / env.control_period))

        def step(state: State, key: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, jax.random.uniform(key, (env.action_size,), minval=-1.0))
            return state, (state.metrics["non_finite"] > 0) | ~jnp.isfinite(state.obs["actor"]).all()

        return jax.lax.scan(step, env.reset(begin), jnp.stack(keys))[1]

    bad = np.asarray(jit(jax.vmap(episode), once=True)(jax.random.split(jax.random.key(0), _ENVS)))
    if bad.any():
        raise AssetError(f"{hand.model_path}: physics diverged in {np.sum(bad.any(1))} of {_ENVS} episodes")


CHECKS: dict[str, Callable[[Hand], None]] = {
    "kinematics agree with MuJoCo": check_kinematics,
    "fingertips touch": check_fingertips,
    "taxels are on the skin": check_taxels,
    "random actions stay finite": check_rollout,
}
"""What every hand must fulfil, beside what `load_hand` requires."""


def describe(hand: Hand) -> list[str]:
    """Motors, touch and self-collisions of a hand, a line each."""
    lines = ["motor             range [rad]     stall [Nm]  no load [rad/s]  moves"]
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
    lines.append(
        f"self-collision: {pairs} pairs. Links touch each other where a <pair> in the MJCF says so; contype and "
        "conaffinity only say what touches the object"
    )
    return lines


def report(path: Path) -> tuple[list[str], bool]:
    """The lines of the report on a hand's TOML, and whether all checks passed."""
    try:
        hand = load_hand(path)
    except AssetError as error:
        return [f"FAIL  files load: {error}"], False
    lines = [f"{hand.name}: {hand.num_joints} joints, {hand.num_fingers} fingers of {hand.num_taxels} taxels"]
    lines += describe(hand)
    lines.append("ok    files load")
    passed = True
    for name, check in CHECKS.items():
        if check is check_rollout and not passed:
            lines.append(f"-     {name}: not tried")
            continue
        try:
            check(hand)
            lines.append(f"ok    {name}")
        except AssetError as error:
            lines.append(f"FAIL  {name}: {error}")
            passed = False
    return lines, passed


@dataclass(frozen=True, kw_only=True)
class CheckHandArguments:
    """Options of `python -m dexsim.check_hand`."""

    hand: Annotated[Path, tyro.conf.Positional]
    """The TOML of a hand, or the name of a shipped one."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns 0 if the hand passes, else 1."""
    description = "Check the TOML of a hand and the files that it names."
    arguments = cli.parse(CheckHandArguments, argv, prog="python -m dexsim.check_hand", description=description)
    lines, passed = report(arguments.hand)
    print("\n".join(lines))
    return 0 if passed else 1


if __name__ == "__main__":
    cli.run(main)
