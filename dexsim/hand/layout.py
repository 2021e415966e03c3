"""Taxel layouts for any hand or pad: lattices on primitives, the layout file, and its checks.

    patch = on_surface("cylinder", lattice(10, 12, pitch=0.0022), radius=0.008)
    patch = placed(patch, position=(0, 0, 0.02), rotation=turn)       # in the link's frame
    check_outside(patch, geometry)                                       # no taxel inside the link
    write_layout("taxels.csv", {"index": patch, "thumb": other})

The file is the one that a hand's TOML names as `taxels`; `finger` in it is the link that carries the taxels.
Taxel index = column * rows + row. Shapes: N taxels. Units: m, m^2.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.errors import AssetError, ConfigError
from dexsim.core.files import write_atomic

SURFACES = ("plane", "cylinder", "capsule", "sphere")
_AWAY = 3e-3  # m, how far from its link a taxel may be: as thick as the rubber
_SMALLEST, _LARGEST = 1e-12, 1e-2  # m^2, area of a taxel: square millimetres are refused
MOST = 1000
"""Columns or rows of taxels, at most."""
_STEP = 3e-3  # m, along a normal, which must lead away from the link
COLUMNS = ("finger", "column", "row", "x", "y", "z", "nx", "ny", "nz", "area")


@dataclasses.dataclass(frozen=True, eq=False)
class Lattice:
    """Points of a lattice in arc length, before they are laid on a surface."""

    grid: tuple[int, int]  # columns, rows
    u: np.ndarray  # [N] m, across the columns
    v: np.ndarray  # [N] m, along the rows
    cell: float  # m^2


@dataclasses.dataclass(frozen=True, eq=False)
class Patch:
    """Taxels of one link, in its frame."""

    grid: tuple[int, int]  # columns, rows
    position: np.ndarray  # [N, 3] m
    normal: np.ndarray  # [N, 3] unit, outward
    area: np.ndarray  # [N] m^2


def lattice(columns: int, rows: int, *, pitch: float | tuple[float, float], kind: str = "rect") -> Lattice:
    """A lattice centred on zero.

    Args:
      pitch: distance of neighbours; for "rect" also (across, along).
      kind: "rect", or "hex" with every other row shifted by half a pitch and rows sqrt(3)/2 pitches apart.

    Raises:
      ConfigError: an unknown kind.
    """
    if kind not in ("rect", "hex"):
        raise ConfigError(f"lattice kind {kind!r}: choose rect or hex")
    across, along = (pitch, pitch) if isinstance(pitch, (int, float)) else pitch
    if kind == "hex":
        along = across * np.sqrt(3) / 2
    column, row = (x.ravel() for x in np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"))
    shift = 0.25 * np.where(row % 2, 1, -1) if kind == "hex" else 0.0
    return Lattice(
        (columns, rows), across * (column - (columns - 1) / 2 + shift), along * (row - (rows - 1) / 2), across * along
    )


def on_surface(kind: str, points: Lattice, *, radius: float = 0.0, half_length: float = 0.0) -> Patch:
    """Lay a lattice on a primitive without stretching it along the rows.

    plane: z = 0, facing +z, u along x, v along y. cylinder (radius, axis z): u round the axis from +x, v along z.
    capsule (radius, half_length of the straight part): like a cylinder, rows beyond the straight part go over the
    caps. sphere (radius): u along the equator from +x, v along the meridian. Where meridians draw together, areas
    shrink with them.

    Raises:
      ConfigError: an unknown kind, or a lattice that does not fit on the surface.
    """
    u, v = points.u, points.v
    if kind not in SURFACES:
        raise ConfigError(f"surface {kind!r}: choose from {', '.join(SURFACES)}")
    if kind == "plane":
        normal = np.tile([0.0, 0.0, 1.0], (len(u), 1))
        return Patch(points.grid, np.stack([u, v, 0 * u], -1), normal, np.full(len(u), points.cell))
    angle = u / radius
    if np.ptp(u) >= 2 * np.pi * radius:
        raise ConfigError(
            f"surface {kind!r}: the lattice is {np.ptp(u):.4g} m wide and laps itself on a girth of "
            f"{2 * np.pi * radius:.4g} m"
        )
    straight = {"cylinder": np.inf, "capsule": half_length, "sphere": 0.0}[kind]
    over = np.sign(v) * np.maximum(np.abs(v) - straight, 0.0)
    polar = over / radius
    if np.any(np.abs(polar) >= np.pi / 2 - 1e-6):
        raise ConfigError(f"surface {kind!r}: rows reach {np.abs(v).max():.4g} m from the middle, beyond the pole")
    normal = np.stack([np.cos(polar) * np.cos(angle), np.cos(polar) * np.sin(angle), np.sin(polar)], -1)
    position = radius * normal + np.stack([0 * v, 0 * v, v - over], -1)
    return Patch(points.grid, position, normal, points.cell * np.cos(polar))


def placed(patch: Patch, *, position: Any = (0, 0, 0), rotation: Any = None) -> Patch:
    """The patch moved by a rotation matrix [3, 3] and then a shift [3] m."""
    turn = np.eye(3) if rotation is None else np.asarray(rotation, float)
    return dataclasses.replace(
        patch, position=patch.position @ turn.T + np.asarray(position, float), normal=patch.normal @ turn.T
    )


def check_outside(patch: Patch, geometry: Any, *, tolerance: float = 1e-4, name: str = "patch") -> None:
    """Require that no taxel is deeper than `tolerance` m inside its link, whose surface `grid.bake` gives for example.

    Raises:
      AssetError: names the deepest one.
    """
    from dexsim.geometry.distance import signed_distance  # JAX, which reading a layout does without

    distance = np.asarray(signed_distance(np.asarray(patch.position, np.float32), geometry))
    _refuse(name, patch, distance < -tolerance, -distance, f"lies {-1e3 * distance.min():.2g} mm inside its link")


def check_hand(hand: Any, *, tolerance: float = 1.5e-3) -> None:
    """That the taxels of every finger are on the primitives of the link that carries them, and face outwards.

    The default tolerance allows for pads that are capsules fitted to the real skin.

    Raises:
      AssetError: a taxel is inside its link (`check_outside`), away from it, or faces inwards.
    """
    from dexsim.geometry import sdf
    from dexsim.geometry.distance import signed_distance

    for finger, name in enumerate(hand.finger_names):
        geometry = sdf.of_geoms(g for g in hand.geoms if g.body == hand.tip_body[finger])
        if geometry is None:
            continue
        patch = Patch(hand.taxel_grid, hand.taxel_position[finger], hand.taxel_normal[finger], hand.taxel_area[finger])
        check_outside(patch, geometry, tolerance=tolerance, name=f"finger {name!r}")
        distance, ahead = (
            np.asarray(signed_distance(np.asarray(patch.position + step * patch.normal, np.float32), geometry))
            for step in (0.0, _STEP)
        )
        away = f"is {1e3 * distance.max():.3g} mm away from its link: metres, in the link's frame?"
        _refuse(f"finger {name!r}", patch, distance > _AWAY, distance, away)
        inward = "faces into its link: is the normal outward?"
        _refuse(f"finger {name!r}", patch, ahead <= distance, distance, inward)


def _refuse(name: str, patch: Patch, wrong: np.ndarray, size: np.ndarray, what: str) -> None:
    """Raise the error of the taxel that is `wrong` [N] with the largest `size` [N], if any is."""
    if wrong.any():
        column, row = divmod(int(np.argmax(np.where(wrong, size, -np.inf))), patch.grid[1])
        raise AssetError(f"{name}: taxel column {column}, row {row} {what} ({wrong.sum()} of {len(wrong)})")


def write_layout(path: str | Path, patches: dict[str, Patch]) -> Path:
    """Write the taxels of named fingers (or links) as a layout file, whole or not at all; all must have the same grid.

    Raises:
      ConfigError: grids differ.
      OSError: the file cannot be written.
    """
    if len({patch.grid for patch in patches.values()}) != 1:
        raise ConfigError(f"layout: one grid for all fingers expected, got {[p.grid for p in patches.values()]}")
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(COLUMNS)
    for name, patch in patches.items():
        for index, (position, normal, area) in enumerate(zip(patch.position, patch.normal, patch.area, strict=True)):
            place = [f"{x:.6f}" for x in (*position, *normal)]
            out.writerow([name, *divmod(index, patch.grid[1]), *place, f"{area:.6g}"])
    path = Path(path)
    write_atomic(path, [text.getvalue().encode()])
    return path


def read_taxels(path: Path, fingers: tuple[str, ...], grid: tuple[int, int]) -> np.ndarray:
    """The taxels [F, N, 7] of a layout file: position, normal, area. Every finger must have columns * rows of them.

    Raises:
      AssetError: missing or broken file, with the line.
    """
    columns, rows = grid
    table = np.full((len(fingers), columns, rows, 7), np.nan, np.float32)
    line = 1
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:  # spreadsheets begin a CSV with a byte order mark
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise ValueError(f"the first line must read {','.join(COLUMNS)}")
            for entry in reader:
                line = reader.line_num
                if entry["finger"] not in fingers:
                    raise ValueError(f"no finger {entry['finger']!r:.60}; the hand has {', '.join(fingers)}")
                place = fingers.index(entry["finger"]), int(entry["column"]), int(entry["row"])
                values = np.array([float(entry[name]) for name in COLUMNS[3:]])
                if not 0 <= place[1] < columns or not 0 <= place[2] < rows:
                    raise ValueError(f"column {place[1]}, row {place[2]} is outside the {columns} x {rows} grid")
                if not abs(np.linalg.norm(values[3:6]) - 1) <= 0.01 or not _SMALLEST <= values[6] <= _LARGEST:
                    raise ValueError(f"the normal must be of length 1, the area above 0 and at most {_LARGEST:g} m^2")
                table[place] = values
    except FileNotFoundError:
        raise AssetError(f"{path}: no such file") from None
    except (OSError, TypeError, ValueError, csv.Error) as error:
        raise AssetError(f"{path}:{line}: {error}") from None
    count = np.sum(np.isfinite(table).all(-1), axis=(1, 2))
    if np.any(count != columns * rows):
        worst = int(np.argmin(count))
        raise AssetError(
            f"{path}: finger {fingers[worst]!r} has {count[worst]} valid taxels, expected {columns * rows}"
        )
    return table.reshape(len(fingers), -1, 7)
