"""Checks the files of a hand: what every hand must fulfil, one line each.

python -m dexsim.check_hand my_hand.toml
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import tyro

from dexsim.core import cli
from dexsim.core.errors import AssetError
from dexsim.hand.kinematics import Hand, forward_kinematics, hinge_angles
from dexsim.hand.layout import check_hand as check_taxels
from dexsim.hand.load import load_hand

_POSES = 20
_TOLERANCE = 1e-5  # m, of link positions in float32


def check_kinematics(hand: Hand) -> None:
    """Link positions against C MuJoCo at random joint angles.

    Raises:
      AssetError: a link is elsewhere.
    """
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    palm, bodies = model.body(hand.palm).id, [model.body(name).id for name in hand.body_names]
    for _ in range(_POSES):
        angle = random.uniform(hand.joint_lower, hand.joint_upper)
        data.qpos[:] = hinge_angles(hand, angle)
        mujoco.mj_kinematics(model, data)
        expected = (data.xpos[bodies] - data.xpos[palm]) @ data.xmat[palm].reshape(3, 3)
        found = np.asarray(forward_kinematics(hand, angle.astype(np.float32)).body_position)
        error = np.linalg.norm(found - expected, axis=-1)
        if error.max() > _TOLERANCE:
            name = hand.body_names[int(error.argmax())]
            raise AssetError(f"{hand.model_path}: link {name!r} is {1e3 * error.max():.3g} mm from where MuJoCo has it")


def check_fingertips(hand: Hand) -> None:
    """Every fingertip has a primitive that touches the object.

    Raises:
      AssetError: one has none; a mesh does not count.
    """
    for name, body in zip(hand.finger_names, hand.tip_body, strict=True):
        if not any(geom.touches and geom.body == body for geom in hand.geoms):
            raise AssetError(f"{hand.model_path}: finger {name!r} has no primitive at its tip that touches (no mesh)")


CHECKS: dict[str, Callable[[Hand], None]] = {
    "kinematics agree with MuJoCo": check_kinematics,
    "fingertips touch": check_fingertips,
    "taxels are on the skin": check_taxels,
}
"""What every hand must fulfil, beside what `load_hand` requires."""


def report(path: Path) -> tuple[list[str], bool]:
    """The lines of the report on a hand's TOML, and whether all checks passed."""
    try:
        hand = load_hand(path)
    except AssetError as error:
        return [f"FAIL  files load: {error}"], False
    lines = [f"{hand.name}: {hand.num_joints} joints, {hand.num_fingers} fingers of {hand.num_taxels} taxels"]
    lines.append("ok    files load")
    passed = True
    for name, check in CHECKS.items():
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
    """The TOML of a hand."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns 0 if the hand passes, else 1."""
    arguments = cli.parse(
        CheckHandArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim.check_hand",
        description="Check the TOML of a hand and the files that it names.",
    )
    lines, passed = report(arguments.hand)
    print("\n".join(lines))
    return 0 if passed else 1


if __name__ == "__main__":
    cli.run(main)
