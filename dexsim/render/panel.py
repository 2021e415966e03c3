"""The read-out next to the picture: one unrolled taxel map per finger, forces in newton, command and colour scale.

Drawn with Pillow and NumPy: matplotlib would cost more than the rest of a frame. A map shows the fingertip unrolled,
seen from outside: column 0 at the left, row 0 (base of the fingertip) at the bottom; taxel index = column * rows + row.
"""

import numpy as np

from dexsim.hand.description import Hand
from dexsim.render.snapshot import Snapshot

INK, FAINT, PANEL, EMPTY, ACCENT = ((233, 236, 241), (138, 146, 160), (24, 27, 33), (40, 44, 53), (94, 196, 255))
# matplotlib's colour map at even steps from 0.12, since the darkest eighth would vanish on the dark panel.
_INFERNO = """
1e0c45 380962 510e6c 69166e 801f6c 982766 b0315b c63d4d d94d3d e9612b f47918 fa9407 fcb014 f8cd37 f2ea69 fcffa4
"""
_KNOWN = np.array([tuple(bytes.fromhex(color)) for color in _INFERNO.split()])
_PLACE = np.linspace(0, len(_KNOWN) - 1, 256)
_COLORS = np.stack([np.interp(_PLACE, np.arange(len(_KNOWN)), channel) for channel in _KNOWN.T], -1)
_COLORS = _COLORS.round().astype(np.uint8)  # sRGB [256, 3]
_GAP = 1  # pixels between two cells
TRUE, FELT = ("maps: taxel force", "bars: contact force"), ("maps: taxel force", "bars: their sum")
"""Captions of a panel whose bars show the simulation's contact forces, or what the taxels feel."""


def taxel_image(values: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """One finger's taxels [N, ...] as an image [rows, columns, ...]: tip at the top, column 0 at the left."""
    columns, rows = grid
    return np.swapaxes(np.asarray(values).reshape(columns, rows, *np.shape(values)[1:]), 0, 1)[::-1]


def force_color(force: np.ndarray, force_range: float) -> np.ndarray:
    """sRGB bytes [..., 3] of forces [...] on the perceptual colour scale from 0 to `force_range`, both in N."""
    level = np.nan_to_num(np.asarray(force, np.float64) / force_range)
    return _COLORS[np.clip(level * (len(_COLORS) - 1), 0, len(_COLORS) - 1).astype(int)]


def draw_panel(
    hand: Hand, size: tuple[int, int], snapshot: Snapshot, force_range: float, finger_range: float, live: bool = False
) -> np.ndarray:
    """A panel of `size` (width, height) pixels, uint8 [height, width, 3]: two columns of blocks, the fingers in order
    and last the read-outs, which a `live` view has elsewhere.

    The bar under a map is the finger's force out of `finger_range` N; its mark is the target.
    """
    from PIL import Image, ImageDraw, ImageFont

    captions, lines = (FELT, {}) if live else (TRUE, read_outs(snapshot))
    (columns, rows), count = hand.taxel_grid, (hand.num_fingers + 2) // 2
    font_size = max(8, round(size[1] / 36))
    # A block is a title line, the map and a force bar, with air below.
    cell = max(2, min((size[1] // count - int(2.6 * font_size)) // rows, int(size[0] * 0.42) // columns))
    width, height, pad = cell * columns - _GAP, cell * rows, int(1.3 * font_size)
    step = cell * columns, height + int(2.0 * font_size)
    left, top = (size[0] - 2 * step[0]) // 3, (size[1] - count * step[1]) // (count + 1)
    slots = [(left + k % 2 * (step[0] + left), top + k // 2 * (step[1] + top)) for k in range(hand.num_fingers + 1)]
    image = Image.new("RGB", size, PANEL)
    draw, font, target = ImageDraw.Draw(image), ImageFont.load_default(font_size), float(snapshot.target_force)
    force = np.asarray(snapshot.taxel_force)
    colors = np.where(force[..., None] > 0, force_color(force, force_range), np.array(EMPTY, np.uint8))
    gap = np.arange(cell) >= cell - _GAP
    for f, (x, y) in enumerate(slots[:-1]):
        total = float(snapshot.finger_force[f])
        draw.text((x, y), hand.finger_names[f], fill=INK, font=font)
        draw.text((x + width, y), f"{total:.1f} N", fill=INK, font=font, anchor="ra")
        cells = taxel_image(colors[f], hand.taxel_grid).repeat(cell, 0).repeat(cell, 1)
        cells[np.tile(gap, rows)] = PANEL
        cells[:, np.tile(gap, columns)] = PANEL
        image.paste(Image.fromarray(cells), (x, y + pad))
        bar, thick = y + pad + height + 2, max(2, font_size // 4)
        draw.rectangle((x, bar, x + width - 1, bar + thick), fill=EMPTY)
        filled = int(np.clip(total / finger_range, 0, 1) * width)
        if filled > 0:
            draw.rectangle((x, bar, x + filled - 1, bar + thick), fill=ACCENT)
        if np.isfinite(target) and 0 < target <= finger_range:
            mark = x + int(target / finger_range * (width - 1))
            draw.rectangle((mark, bar - 1, mark + 1, bar + thick + 1), fill=INK)
    # The colour scale, and above it the read-outs; a small panel has little room.
    x, y = slots[-1]
    small, thick = ImageFont.load_default(font_size - 2), max(4, cell)
    bar = y + height - thick
    scale = force_color(np.linspace(0, force_range, width)[None].repeat(thick, 0), force_range)
    image.paste(Image.fromarray(scale), (x, bar))
    draw.text((x, bar + thick + 3), "0", fill=FAINT, font=small)
    draw.text((x + width, bar + thick + 3), f"{force_range:.2g} N / taxel", fill=FAINT, font=small, anchor="ra")
    pitch = min(round(1.35 * font_size), (height - thick) // max(len(captions) + len(lines), 1))
    small = ImageFont.load_default(min(font_size - 2, pitch))
    for caption in captions:
        draw.text((x, y), caption, fill=FAINT, font=small)
        y += pitch
    for name, value in lines.items():
        fits = draw.textlength(name + value, font) + font_size < width
        draw.text((x, y), name, fill=FAINT, font=font if fits else small)
        draw.text((x + width, y), value, fill=INK, font=font if fits else small, anchor="ra")
        y += pitch
    return np.asarray(image)


def read_outs(snapshot: Snapshot) -> dict[str, str]:
    """What a picture says in words, by name: time, quarter turns or command and target, total force."""
    lines = {}
    if snapshot.seconds is not None:
        lines["time"] = f"{float(snapshot.seconds):.1f} s"
    if snapshot.turns is not None:
        lines["quarter turns"] = f"{int(snapshot.turns)}"
    elif np.size(snapshot.command):
        lines["command"] = " ".join(f"{c:.2f}" for c in np.ravel(snapshot.command)[:3])
        if np.isfinite(snapshot.target_force):
            lines["target"] = f"{float(snapshot.target_force):.1f} N"
    return lines | {"total": f"{np.sum(snapshot.finger_force):.1f} N"}
