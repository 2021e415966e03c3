"""Taxel layouts for any hand or pad: lattices on capsules, and the layout file.

    tip = lay_taxels((10, 12), pitch=0.0022, radius=0.008, half_length=0.02, position=(0, 0, 0.02))
    write_layout("taxels.csv", {"index": tip, "thumb": other}, (10, 12))

The file is the one that a hand's TOML names as `taxels`; `finger` in it is the link that carries the taxels.
Taxel index = column * rows + row. Taxels are arrays [N, 7] in the link's frame: position, outward normal, area.
Units: m, m^2.
"""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.files import write_atomic
from dexsim.errors import AssetError, ConfigError

_SMALLEST, _LARGEST = 1e-12, 1e-2  # m^2, area of a taxel: square millimetres are refused
MOST = 1000
"""Columns or rows of taxels, at most."""
COLUMNS = ("finger", "column", "row", "x", "y", "z", "nx", "ny", "nz", "area")


def lay_taxels(
    grid: tuple[int, int],
    *,
    pitch: float | tuple[float, float],
    radius: float,
    half_length: float = 0.0,
    kind: str = "rect",
    position: Any = (0.0, 0.0, 0.0),
    rotation: Any = None,
) -> np.ndarray:
    """Taxels [N, 7] of a lattice that is laid on a capsule without stretching it along the rows.

    Columns run round the axis, z, from +x; rows along z, and beyond the straight part over the caps. Where meridians
    draw together, areas shrink with them. A capsule without a straight part is a sphere.

    Args:
      grid: columns, rows.
      pitch: distance of neighbours; for "rect" also (across, along).
      radius, half_length: m, of the capsule and its straight part.
      kind: "rect", or "hex" with every other row shifted by half a pitch and rows sqrt(3)/2 pitches apart.
      position, rotation: [3] and [3, 3], where the capsule is in the link's frame.

    Raises:
      ConfigError: an unknown kind, or a lattice that does not fit on the capsule.
    """
    if kind not in ("rect", "hex"):
        raise ConfigError(f"lattice {kind!r}: choose from rect, hex")
    across, along = (pitch, pitch) if isinstance(pitch, (int, float)) else pitch
    along = across * np.sqrt(3) / 2 if kind == "hex" else along
    column, row = (x.ravel() for x in np.meshgrid(*map(np.arange, grid), indexing="ij"))
    shift = 0.25 * np.where(row % 2, 1, -1) if kind == "hex" else 0.0
    # Arc lengths from the lattice's middle.
    u, v = across * (column - (grid[0] - 1) / 2 + shift), along * (row - (grid[1] - 1) / 2)
    girth = 2 * np.pi * radius
    if np.ptp(u) >= girth:
        raise ConfigError(f"the lattice is {np.ptp(u):.4g} m wide and laps itself on a girth of {girth:.4g} m")
    over = np.sign(v) * np.maximum(np.abs(v) - half_length, 0.0)
    angle, polar = u / radius, over / radius
    if np.any(np.abs(polar) >= np.pi / 2 - 1e-6):
        raise ConfigError(f"rows reach {np.abs(v).max():.4g} m from the lattice's middle, beyond the pole")
    normal = np.stack([np.cos(polar) * np.cos(angle), np.cos(polar) * np.sin(angle), np.sin(polar)], -1)
    place = radius * normal + np.outer(v - over, [0, 0, 1])
    turn = np.eye(3) if rotation is None else np.asarray(rotation, float)
    area = across * along * np.cos(polar)
    return np.column_stack([place @ turn.T + np.asarray(position, float), normal @ turn.T, area])


def write_layout(path: str | Path, taxels: Mapping[str, np.ndarray], grid: tuple[int, int]) -> Path:
    """Write the taxels of named fingers (or links) as a layout file, whole or not at all.

    Raises:
      OSError: the file cannot be written.
    """
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(COLUMNS)
    for name, rows in taxels.items():
        for index, (*place, area) in enumerate(rows):
            out.writerow([name, *divmod(index, grid[1]), *(f"{x:.6f}" for x in place), f"{area:.6g}"])
    path = Path(path)
    write_atomic(path, [text.getvalue().encode()])
    return path


def read_taxels(path: Path, fingers: tuple[str, ...], grid: tuple[int, int]) -> np.ndarray:
    """The taxels [F, N, 7] of a layout file: position, normal, area. Every finger must have columns * rows of them.

    Raises:
      AssetError: a broken file, with the line.
      OSError: it cannot be read.
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
    except (TypeError, ValueError, csv.Error) as error:
        raise AssetError(f"{path}:{line}: {error}") from None
    for finger, count in zip(fingers, np.isfinite(table).all(-1).sum((1, 2)), strict=True):
        if count != columns * rows:
            raise AssetError(f"{path}: finger {finger!r} has {count} valid taxels, expected {columns * rows}")
    return table.reshape(len(fingers), -1, 7)
