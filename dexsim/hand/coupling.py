"""Hinges that follow a motor: one motor, two joints.

A follower's angle is that of its motor's joint times a ratio, plus an offset. The MJCF says so by an `<equality>` of
joints, which the physics honours too. MuJoCo's polynomial is q1 - ref1 = a0 + a1 (q2 - ref2) + ...
"""

from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.errors import AssetError

_SLACK = 1e-3  # rad, how far a follower may have to go beyond its range


def read_followers(path: Path, model: Any, motors: list[int]) -> dict[int, tuple[int, float, float]]:
    """Which joints of a model follow others.

    Args:
      path: of the MJCF, for errors.
      model: the compiled MJCF.
      motors: its joints that have motors.

    Returns:
      For each follower its motor's joint, the ratio and the offset [rad].

    Raises:
      AssetError: a tendon, an equality that does not couple two joints linearly, a follower of a follower, or one
        that cannot go where its motor takes it.
    """
    import mujoco

    if model.ntendon:
        raise AssetError(f"{path}: tendon {model.tendon(0).name or '#0'!r}: tendons are not supported")
    followers: dict[int, tuple[int, float, float]] = {}
    for index in range(model.neq):
        first, second = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
        what = f"{path}: equality {model.equality(index).name or f'#{index}'!r}"
        if model.eq_type[index] != mujoco.mjtEq.mjEQ_JOINT or second < 0 or not model.eq_active0[index]:
            raise AssetError(f"{what}: only active ones of two joints are supported")
        a0, ratio, *higher = model.eq_data[index, :5]
        if any(higher) or not ratio:
            raise AssetError(f"{what}: polycoef {model.eq_data[index, :5].tolist()} is not of the form a0 a1 0 0 0")
        names = [model.joint(joint).name for joint in (first, second)]
        if first in motors or first in followers:
            raise AssetError(f"{what}: joint {names[0]!r} has a motor or follows another joint already")
        if second not in motors:
            raise AssetError(f"{what}: joint {names[0]!r} follows {names[1]!r}, which has no motor (see joints)")
        reference = model.qpos0[model.jnt_qposadr[[first, second]]]
        followers[first] = second, float(ratio), float(reference[0] + a0 - ratio * reference[1])
        reach = np.sort(followers[first][1] * model.jnt_range[second] + followers[first][2])
        low, high = model.jnt_range[first]
        if model.jnt_limited[first] and (reach[0] < low - _SLACK or reach[1] > high + _SLACK):
            raise AssetError(
                f"{path}: joint {names[0]!r} has the range {low:.4g} to {high:.4g} rad, and {names[1]!r} takes it from "
                f"{reach[0]:.4g} to {reach[1]:.4g}"
            )
    return followers
