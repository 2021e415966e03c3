"""The read-out next to the picture: one unrolled taxel map per finger, forces in newton, command and colour scale.

Drawn with Pillow and NumPy: matplotlib would cost more than the rest of a frame. A map shows the fingertip unrolled,
seen from outside: column 0 at the left, row 0 (base of the fingertip) at the bottom; taxel index = column * rows + row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from dexsim.render.snapshot import Snapshot

INK, FAINT, PANEL, EMPTY, ACCENT = ((233, 236, 241), (138, 146, 160), (24, 27, 33), (40, 44, 53), (94, 196, 255))
# matplotlib's colour map at even steps from 0.12, since the darkest eighth would vanish on the dark panel.
_INFERNO = """
1e0c45 380962 510e6c 69166e 801f6c 982766 b0315b c63d4d d94d3d e9612b f47918 fa9407 fcb014 f8cd37 f2ea69 fcffa4
"""
_GAP = 1  # pixels between two cells
TRUE, FELT = ("maps: taxel force", "bars: contact force"), ("maps: taxel force", "bars: their sum")
"""Captions of a panel whose bars show the simulation's contact forces, or what the taxels feel."""


@dataclass(frozen=True)
class Layout:
    """Positions in a panel of `width` x `height` pixels."""

    width: int
    height: int
    cell: int  # pitch of the taxels, pixels
    grid: tuple[int, int]  # columns, rows
    slots: tuple[tuple[int, int], ...]  # top left corner of each finger's block, then the read-outs' block
    font: int  # pixels


def make_layout(width: int, height: int, grid: tuple[int, int], fingers: int) -> Layout:
    """Two columns of blocks, the fingers in order and the read-outs last."""
    columns, rows = grid
    lines = (fingers + 2) // 2
    font = max(8, round(height / 36))
    # A block is a title line, the map and a force bar, with air below.
    cell = max(2, min((height // lines - int(2.6 * font)) // rows, int(width * 0.42) // columns))
    block_width, block_height = cell * columns, cell * rows + int(2.0 * font)
    left = (width - 2 * block_width) // 3
    top = (height - lines * block_height) // (lines + 1)
    slots = [(left + (k % 2) * (block_width + left), top + (k // 2) * (block_height + top)) for k in range(fingers + 1)]
    return Layout(width, height, cell, grid, tuple(slots), font)


def taxel_image(values: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """One finger's taxels [N, ...] as an image [rows, columns, ...]: tip at the top, column 0 at the left."""
    columns, rows = grid
    return np.swapaxes(np.asarray(values).reshape(columns, rows, *np.shape(values)[1:]), 0, 1)[::-1]


def force_color(force: np.ndarray, force_range: float) -> np.ndarray:
    """sRGB bytes [..., 3] of forces [...] on the perceptual colour scale from 0 to `force_range`, both in N."""
    table = _color_table()
    level = np.nan_to_num(np.asarray(force, np.float64) / force_range)
    return table[np.clip(level * (len(table) - 1), 0, len(table) - 1).astype(int)]


@lru_cache(maxsize=1)
def _color_table() -> np.ndarray:
    known = np.array([tuple(bytes.fromhex(color)) for color in _INFERNO.split()])
    place = np.linspace(0, len(known) - 1, 256)
    table = [np.interp(place, np.arange(len(known)), channel) for channel in known.T]
    return np.stack(table, -1).round().astype(np.uint8)


@lru_cache(maxsize=8)
def _font(size: int):
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _draw_scale(layout: Layout, image: Any, draw: Any, force_range: float) -> None:
    """The colour scale at the bottom of the read-outs' block."""
    from PIL import Image

    width = layout.cell * layout.grid[0] - _GAP
    x, y = layout.slots[-1]
    small, bar = _font(layout.font - 2), max(4, layout.cell)
    top = y + layout.cell * layout.grid[1] - bar
    scale = force_color(np.linspace(0, force_range, width)[None].repeat(bar, 0), force_range)
    image.paste(Image.fromarray(scale), (x, top))
    draw.text((x, top + bar + 3), "0", fill=FAINT, font=small)
    draw.text((x + width, top + bar + 3), f"{force_range:.2g} N / taxel", fill=FAINT, font=small, anchor="ra")


def draw_panel(
    layout: Layout,
    names: tuple[str, ...],
    taxel_force: np.ndarray,
    finger_force: np.ndarray,
    lines: Mapping[str, str],
    target_force: float,
    force_range: float,
    finger_range: float,
    captions: tuple[str, str] = TRUE,
) -> np.ndarray:
    """The panel as uint8 [height, width, 3].

    `taxel_force` [F, N] N, `finger_force` [F] N, `lines` are read-outs (`read_outs`), `captions` say what maps and bars
    show. The bar under a map is the finger's force out of `finger_range` N; its mark is the target [N].
    """
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (layout.width, layout.height), PANEL)
    draw = ImageDraw.Draw(image)
    _draw_scale(layout, image, draw, force_range)
    font, pad = _font(layout.font), int(1.3 * layout.font)
    width, height = layout.cell * layout.grid[0] - _GAP, layout.cell * layout.grid[1]
    colors = np.where(taxel_force[..., None] > 0, force_color(taxel_force, force_range), np.array(EMPTY, np.uint8))
    grid = np.arange(layout.cell) >= layout.cell - _GAP
    for f, (x, y) in enumerate(layout.slots[:-1]):
        draw.text((x, y), names[f], fill=INK, font=font)
        draw.text((x + width, y), f"{finger_force[f]:.1f} N", fill=INK, font=font, anchor="ra")
        cells = taxel_image(colors[f], layout.grid).repeat(layout.cell, 0).repeat(layout.cell, 1)
        cells[np.tile(grid, layout.grid[1])] = PANEL
        cells[:, np.tile(grid, layout.grid[0])] = PANEL
        image.paste(Image.fromarray(cells), (x, y + pad))
        bar = y + pad + height + 2
        thick = max(2, layout.font // 4)
        draw.rectangle((x, bar, x + width - 1, bar + thick), fill=EMPTY)
        filled = int(np.clip(finger_force[f] / finger_range, 0, 1) * width)
        if filled > 0:
            draw.rectangle((x, bar, x + filled - 1, bar + thick), fill=ACCENT)
        if np.isfinite(target_force) and 0 < target_force <= finger_range:
            mark = x + int(target_force / finger_range * (width - 1))
            draw.rectangle((mark, bar - 1, mark + 1, bar + thick + 1), fill=INK)
    x, y = layout.slots[-1]
    # Above the colour scale; a small panel has little room.
    room = pad + height - max(4, layout.cell) - int(1.3 * layout.font)
    pitch = min(round(1.35 * layout.font), room // max(len(captions) + len(lines), 1))
    small = _font(min(layout.font - 2, pitch))
    for caption in captions:
        draw.text((x, y), caption, fill=FAINT, font=small)
        y += pitch
    for name, value in lines.items():
        fits = draw.textlength(name + value, font) + layout.font < width
        draw.text((x, y), name, fill=FAINT, font=font if fits else small)
        draw.text((x + width, y), value, fill=INK, font=font if fits else small, anchor="ra")
        y += pitch
    return np.asarray(image)


def read_outs(snapshot: Snapshot) -> dict[str, str]:
    """What a picture says in words, by name: time, turns or command and target, and the fingers' force in all."""
    lines = {}
    if snapshot.seconds is not None:
        lines["time"] = f"{float(snapshot.seconds):.1f} s"
    if snapshot.turns is not None:
        lines["turns"] = f"{int(snapshot.turns)}"
    elif np.size(snapshot.command):
        lines["command"] = " ".join(f"{c:.2f}" for c in np.ravel(snapshot.command)[:3])
        if np.isfinite(snapshot.target_force):
            lines["target"] = f"{float(snapshot.target_force):.1f} N"
    return lines | {"total": f"{np.sum(snapshot.finger_force):.1f} N"}
