"""Taxels of a hand whose TOML gives a lattice in place of a file: laid on a capsule or sphere of each fingertip.

taxel_grid = [6, 8]               # columns around the pad, rows along it
taxel_pitch = [0.002, 0.003]      # m, across and along

[[fingers]]
pad = "index_pad"                 # a geom of the tip's body
facing = [1, 0, 0]                # where the lattice's middle faces, in that body's frame
"""

from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.errors import AssetError, ConfigError
from dexsim.hand.kinematics import Geom
from dexsim.hand.layout import lattice, on_surface, placed


def lay_taxels(path: Path, table: dict[str, Any], geoms: tuple[Geom, ...], tip_body: np.ndarray) -> np.ndarray:
    """The taxels [F, N, 7] of the pads: position, normal, area in the tip bodies' frames.

    Args:
      path: of the TOML, for errors.
      table: the TOML.
      geoms: of the hand.
      tip_body: [F] the body of each finger's tip.

    Raises:
      AssetError: an entry is missing or wrong, a pad is no capsule or sphere of its tip, or the lattice does not fit.
    """
    pitch: Any = table.get("taxel_pitch")
    if not are_numbers(pitch, 2, 0, 1):
        raise AssetError(f"{path}: taxel_pitch = {pitch!r:.60}: expected two numbers above 0 m (or taxels: a file)")
    points = lattice(*table["taxel_grid"], pitch=tuple(pitch))
    rows = []
    for finger, body in zip(table["fingers"], tip_body, strict=True):
        where = f"{path}: finger {finger['name']!r}"
        pads = [geom for geom in geoms if geom.name == finger.get("pad") and geom.body == body]
        if len(pads) != 1 or pads[0].kind not in ("capsule", "sphere"):
            raise AssetError(
                f"{where}: pad = {finger.get('pad')!r:.60}: expected a capsule or sphere of the tip's body"
            )
        pad = pads[0]
        try:
            half = float(pad.size[1]) if pad.kind == "capsule" else 0.0
            patch = on_surface(pad.kind, points, radius=float(pad.size[0]), half_length=half)
        except ConfigError as error:
            raise AssetError(f"{where}: {error}") from None
        patch = placed(patch, position=pad.position, rotation=_frame(where, pad, finger.get("facing")))
        rows.append(np.concatenate([patch.position, patch.normal, patch.area[:, None]], -1))
    return np.asarray(rows, np.float32)


def are_numbers(values: Any, count: int, above: float = -1e6, below: float = 1e6) -> bool:
    """Whether these are so many numbers in a range; NaN is in none, and a whole number of TOML may be no float."""
    numbers = isinstance(values, list) and all(type(x) in (int, float) and above < x < below for x in values)
    return numbers and len(values) == count


def _frame(where: str, pad: Geom, facing: Any) -> np.ndarray:
    """The rotation [3, 3] that takes a primitive's axis, z, to the pad's, and x to the direction that it faces."""
    if not are_numbers(facing, 3):
        raise AssetError(f"{where}: facing = {facing!r:.60}: expected a direction of three numbers")
    along = np.asarray(pad.rotation[:, 2], float)
    across = np.asarray(facing, float) - np.dot(facing, along) * along
    if not np.linalg.norm(across) > 1e-3 * np.linalg.norm(facing):
        raise AssetError(f"{where}: facing = {facing}: runs along the pad {pad.name!r}")
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(along, across), along], -1)
