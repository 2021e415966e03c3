"""The read-out next to the picture: one unrolled taxel map per finger, forces in newton, command and colour scale.

Drawn with Pillow and NumPy: matplotlib would cost more than the rest of a frame. A map shows the fingertip unrolled,
seen from outside: column 0 at the left, row 0 (base of the fingertip) at the bottom; taxel index = column * rows + row.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from dexsim.hand.description import Hand
from dexsim.render.snapshot import Snapshot

INK, FAINT, PANEL, EMPTY, ACCENT = ((233, 236, 241), (138, 146, 160), (24, 27, 33), (40, 44, 53), (94, 196, 255))
# matplotlib's colour map at even steps from 0.12, since the darkest eighth would vanish on the dark panel.
_INFERNO = """
1e0c45 380962 510e6c 69166e 801f6c 982766 b0315b c63d4d d94d3d e9612b f47918 fa9407 fcb014 f8cd37 f2ea69 fcffa4
"""
_GAP = 1  # pixels between two cells
TRUE, FELT = ("maps: taxel force", "bars: contact force"), ("maps: taxel force", "bars: their sum")
"""Captions of a panel whose bars show the simulation's contact forces, or what the taxels feel."""


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


class Panel:
    """A panel of `width` x `height` pixels for a hand: two columns of blocks, its fingers in order and the read-outs
    last."""

    def __init__(self, hand: Hand, width: int, height: int):
        self.names, self.grid, self.size = hand.finger_names, hand.taxel_grid, (width, height)
        columns, rows = self.grid
        lines = (len(self.names) + 2) // 2
        self._font_size = max(8, round(height / 36))
        # A block is a title line, the map and a force bar, with air below.
        self._cell = max(2, min((height // lines - int(2.6 * self._font_size)) // rows, int(width * 0.42) // columns))
        block_width, block_height = self._cell * columns, self._cell * rows + int(2.0 * self._font_size)
        left, top = (width - 2 * block_width) // 3, (height - lines * block_height) // (lines + 1)
        self._slots = [
            (left + (k % 2) * (block_width + left), top + (k // 2) * (block_height + top))
            for k in range(len(self.names) + 1)
        ]

    def draw(
        self,
        snapshot: Snapshot,
        force_range: float,
        finger_range: float,
        lines: Mapping[str, str],
        captions: tuple[str, str] = TRUE,
    ) -> np.ndarray:
        """The panel as uint8 [height, width, 3].

        `lines` are read-outs (`read_outs`), `captions` say what maps and bars show. The bar under a map is the finger's
        force out of `finger_range` N; its mark is the target.
        """
        from PIL import Image, ImageDraw

        image = Image.new("RGB", self.size, PANEL)
        draw = ImageDraw.Draw(image)
        self._draw_scale(image, draw, force_range)
        font_size, cell = self._font_size, self._cell
        font, pad = _font(font_size), int(1.3 * font_size)
        width, height = cell * self.grid[0] - _GAP, cell * self.grid[1]
        force, target = np.asarray(snapshot.taxel_force), float(snapshot.target_force)
        colors = np.where(force[..., None] > 0, force_color(force, force_range), np.array(EMPTY, np.uint8))
        gap = np.arange(cell) >= cell - _GAP
        for f, (x, y) in enumerate(self._slots[:-1]):
            total = float(snapshot.finger_force[f])
            draw.text((x, y), self.names[f], fill=INK, font=font)
            draw.text((x + width, y), f"{total:.1f} N", fill=INK, font=font, anchor="ra")
            cells = taxel_image(colors[f], self.grid).repeat(cell, 0).repeat(cell, 1)
            cells[np.tile(gap, self.grid[1])] = PANEL
            cells[:, np.tile(gap, self.grid[0])] = PANEL
            image.paste(Image.fromarray(cells), (x, y + pad))
            bar, thick = y + pad + height + 2, max(2, font_size // 4)
            draw.rectangle((x, bar, x + width - 1, bar + thick), fill=EMPTY)
            filled = int(np.clip(total / finger_range, 0, 1) * width)
            if filled > 0:
                draw.rectangle((x, bar, x + filled - 1, bar + thick), fill=ACCENT)
            if np.isfinite(target) and 0 < target <= finger_range:
                mark = x + int(target / finger_range * (width - 1))
                draw.rectangle((mark, bar - 1, mark + 1, bar + thick + 1), fill=INK)
        x, y = self._slots[-1]
        # Above the colour scale; a small panel has little room.
        room = height - max(4, cell)
        pitch = min(round(1.35 * font_size), room // max(len(captions) + len(lines), 1))
        small = _font(min(font_size - 2, pitch))
        for caption in captions:
            draw.text((x, y), caption, fill=FAINT, font=small)
            y += pitch
        for name, value in lines.items():
            fits = draw.textlength(name + value, font) + font_size < width
            draw.text((x, y), name, fill=FAINT, font=font if fits else small)
            draw.text((x + width, y), value, fill=INK, font=font if fits else small, anchor="ra")
            y += pitch
        return np.asarray(image)

    def _draw_scale(self, image: Any, draw: Any, force_range: float) -> None:
        """The colour scale at the bottom of the read-outs' block."""
        from PIL import Image

        width = self._cell * self.grid[0] - _GAP
        x, y = self._slots[-1]
        small, bar = _font(self._font_size - 2), max(4, self._cell)
        top = y + self._cell * self.grid[1] - bar
        scale = force_color(np.linspace(0, force_range, width)[None].repeat(bar, 0), force_range)
        image.paste(Image.fromarray(scale), (x, top))
        draw.text((x, top + bar + 3), "0", fill=FAINT, font=small)
        draw.text((x + width, top + bar + 3), f"{force_range:.2g} N / taxel", fill=FAINT, font=small, anchor="ra")


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
