"""The mirror image of a hand: a right one becomes a left one, and the other way round.

    dexsim import-hand my_right.toml --mirror --out my_left

The palm's frame and every link's are reflected in their planes y = 0. Positions, velocities and forces are polar
vectors. Axes of rotation, angular velocities and torques are axial ones, which a reflection turns round in addition:
the same angle turns a link the mirrored way, so joint angles, limits, torques and postures stay as they are. A body's
orientation R becomes S R S, with S = diag(`POLAR`).
"""

import dataclasses
import functools
import re
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar, cast
from xml.etree import ElementTree

import numpy as np

from dexsim.core.files import write_atomic
from dexsim.errors import AssetError
from dexsim.hand.description import Hand
from dexsim.hand.load import load_hand, read_mjcf

POLAR = np.array([1.0, -1.0, 1.0], np.float32)
AXIAL = -POLAR
QUAT = np.array([1.0, -1.0, 1.0, -1.0], np.float32)
"""Of (w, x, y, z): the angle stays, the axis is axial."""
MATRIX = np.outer(POLAR, POLAR)
OTHER = {"right": "left", "left": "right"}
Point = TypeVar("Point", bound=tuple[float, ...])
_SIGNS: dict[str, tuple[int, ...]] = {
    "pos": (1,),
    "dir": (1,),
    "zaxis": (1,),
    "fromto": (1, 4),
    "gravity": (1,),
    "quat": (1, 3),
    "axis": (0, 2),
    "axisangle": (0, 2),
    "xyaxes": (1, 3, 5),  # y' = z' x x': its sign is the opposite of a polar vector's
    "fullinertia": (3, 5),  # xy and yz of xx, yy, zz, xy, xz, yz
}
"""Numbers of an MJCF's attributes that change sign."""
_FOLDERS = ("meshdir", "texturedir", "assetdir")
_SAME = 1e-4  # m, between a lattice and its mirror image that are one part


@functools.cache
def mirror_hand(hand: Hand) -> Hand:
    """The mirror image of a hand's description. `model_path` and names stay: files are mirrored by `write_mirror`."""
    geoms = tuple(
        dataclasses.replace(geom, position=geom.position * POLAR, rotation=geom.rotation * MATRIX)
        for geom in hand.geoms
    )
    polar = ("body_position", "joint_anchor", "tip_offset", "taxel_position", "taxel_normal")
    return dataclasses.replace(
        hand,
        side=OTHER[hand.side],
        body_rotation=hand.body_rotation * MATRIX,
        joint_axis=np.where(hand.body_joint[:, None] >= 0, hand.joint_axis * AXIAL, hand.joint_axis),
        geoms=geoms,
        grasp_centre=mirror_point(hand.grasp_centre),
        rotate_reference=mirror_point(hand.rotate_reference),
        **{name: getattr(hand, name) * POLAR for name in polar},
    )


def mirror_point(point: Point) -> Point:
    """The mirror image of a position [3] m; of an empty one itself."""
    return cast(Point, tuple(-value if axis == 1 else value for axis, value in enumerate(point)))


def is_mirror_image(hand: Hand, other: Hand) -> bool:
    """Whether two hands are each other's mirror image in what a policy moves and observes, names of sides aside."""
    image = mirror_hand(other)
    parts = ("body_position", "body_rotation", "joint_axis", "joint_anchor", "tip_offset", "joint_lower", "joint_upper")
    return (
        hand.side == image.side
        and hand.joint_names == tuple(swap_sides(name) for name in other.joint_names)
        and all(np.array_equal(getattr(hand, name), getattr(image, name)) for name in parts)
    )


def swap_sides(text: str) -> str:
    """A text with its words right and left exchanged; "_" and digits end a word."""
    words = {style(one): style(two) for one, two in OTHER.items() for style in (str.lower, str.title, str.upper)}
    return re.sub("[a-zA-Z]+", lambda word: words.get(word[0], word[0]), text)


def mirror_toml(text: str, stem: str) -> str:
    """The mirror image's TOML, whose files are `stem`.xml and `stem`_taxels.csv."""
    table = tomllib.loads(text)
    text = re.sub(r"^[^#\n]+", lambda match: swap_sides(match[0]), text, flags=re.MULTILINE)  # comments stay
    # Of positions [3], the second number. Other entries are names, or the same for either hand.
    second = r"(\b(?:centre|reference|facing)\s*=\s*\[[^],]*,\s*)([^],]*)"
    text = re.sub(second, lambda match: match[1] + _negate(match[2]), text)
    text = re.sub(r'^(model\s*=\s*)"[^"]*"', rf'\1"{stem}.xml"', text, flags=re.MULTILINE)
    text = re.sub(r'^(taxels\s*=\s*)"[^"]*"', rf'\1"{stem}_taxels.csv"', text, flags=re.MULTILINE)
    if "name" in table:  # the first of that name; the others are fingers'
        text = re.sub(r'^name\s*=\s*"[^"]*"', f'name = "{stem}"', text, count=1, flags=re.MULTILINE)
    if "side" in table:  # swapped above
        return text
    return re.sub(r"^(?=[^#\s])", 'side = "left"\n', text, count=1, flags=re.MULTILINE)


def mirror_mjcf(model: ElementTree.Element) -> None:
    """Mirror an MJCF, in place."""
    order = next((c.attrib["eulerseq"] for c in model.iter("compiler") if "eulerseq" in c.attrib), "xyz")
    signs = _SIGNS | {"euler": tuple(i for i, axis in enumerate(order.lower()) if axis != "y")}
    first = model.find("default")
    if first is None:
        first = ElementTree.Element("default")
        model.insert(0, first)
    # MuJoCo's own defaults, which files need not state.
    for tag, name, value in (("joint", "axis", "0 0 1"), ("mesh", "scale", "1 1 1")):
        if model.find(f".//{tag}") is not None:
            default = first.find(tag)
            default = ElementTree.SubElement(first, tag) if default is None else default
            default.attrib.setdefault(name, value)
    for element in model.iter():
        for name, value in element.attrib.items():
            which = (1,) if (element.tag, name) == ("mesh", "scale") else signs.get(name)
            if which:
                value = " ".join(_negate(n) if i in which else n for i, n in enumerate(value.split()))
            elif name not in ("file", *_FOLDERS):
                value = swap_sides(value)
            element.set(name, value)


def mirror_taxels(text: str) -> str:
    """The mirror image's table of taxels (`dexsim.hand.layout`).

    A lattice that is its own mirror image stays as it is, index by index: it is the same part on either hand, and its
    columns run the same way round the finger.
    """
    head, *rows = [line.split(",") for line in text.splitlines() if line]
    for finger in {row[0] for row in rows}:
        taxels = [row for row in rows if row[0] == finger]
        place = np.array([row[3:6] for row in taxels], float)
        if np.abs(place[:, None] - place * POLAR).max(-1).min(1).max() > _SAME:
            for row in taxels:
                row[4], row[7] = _negate(row[4]), _negate(row[7])  # y, ny
    return "".join(",".join(row) + "\n" for row in (head, *rows))


def check_new(*paths: Path) -> None:
    """Raise AssetError: one of these files exists, and somebody may have edited it."""
    for path in paths:
        if path.exists():
            raise AssetError(f"{path}: exists; give another folder with --out")


def write_mirror(path: Path, folder: Path) -> Path:
    """Write the files of a hand's mirror image, its meshes included, from its TOML; the path of the new TOML. Raises
    AssetError: a file of the hand is missing or broken, or the new one exists."""
    hand = load_hand(path)
    stem = swap_sides(path.stem)
    stem = f"{stem}_{OTHER[hand.side]}" if stem == path.stem else stem
    toml, mjcf, layout = (folder / f"{stem}{end}" for end in (".toml", ".xml", "_taxels.csv"))
    text = path.read_text()
    model = ElementTree.fromstring(read_mjcf(hand.model_path))
    parts = {folder / name: source for name, source in _gather_files(model, hand.model_path.parent)}
    check_new(toml, mjcf, layout, *parts)
    folder.mkdir(parents=True, exist_ok=True)
    for part, source in parts.items():
        shutil.copyfile(source, part)
    mirror_mjcf(model)
    model.insert(0, ElementTree.Comment(f" Mirror image of {hand.model_path.name} in the plane y = 0. "))
    ElementTree.indent(model)
    write_atomic(mjcf, [ElementTree.tostring(model) + b"\n"])
    if taxels := tomllib.loads(text).get("taxels"):
        write_atomic(layout, [mirror_taxels((path.parent / taxels).read_text()).encode()])
    write_atomic(toml, [mirror_toml(text, stem).encode()])
    return toml


def _negate(number: str) -> str:
    """The digits of a file with the other sign, so that mirroring twice gives the same number."""
    number = number.strip()
    return number if float(number) == 0 else number[1:] if number.startswith("-") else f"-{number.lstrip('+')}"


def _gather_files(model: ElementTree.Element, folder: Path) -> Iterator[tuple[str, Path]]:
    """Let the MJCF look for its meshes and textures beside itself; yields their names there, and where they are."""
    places: dict[str, str] = {}
    for compiler in model.iter("compiler"):
        places |= {name: compiler.attrib.pop(name) for name in _FOLDERS if name in compiler.attrib}
    for element in model.iter():
        if not (file := element.get("file")):
            continue
        element.attrib.setdefault("name", Path(file).stem)
        place = places.get("meshdir" if element.tag == "mesh" else "texturedir", places.get("assetdir", ""))
        name = "_".join(part for part in Path(file).parts if part not in ("..", "/"))
        element.set("file", name)
        yield name, folder / place / file
