"""Makes a hand's folder from a maker's URDF or MJCF: palm frame, capsules, pads, limits and a first grasp.

    python -m dexsim.import_hand maker/hand.urdf --out my_hand
    python -m dexsim.import_hand my_hand/my_hand.toml --mirror --out my_left

It prints what it found and what it assumed, and checks the result (`dexsim.check_hand`).
"""

import dataclasses
import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from dexsim.check_hand import SPEEDS, TORQUES, report
from dexsim.core import cli
from dexsim.core.config import Config, setting
from dexsim.core.errors import AssetError, ConfigError
from dexsim.hand.anatomy import Anatomy, Finger, flexion_links, orient, tip_of
from dexsim.hand.description import Hand
from dexsim.hand.files import find_hand
from dexsim.hand.fit import Capsule, fit_capsule, fit_palm
from dexsim.hand.folder import FingerSheet, HandSheet, write_hand
from dexsim.hand.kinematics import fingertip_strength
from dexsim.hand.load import load_hand
from dexsim.hand.mirror import swap_sides, write_mirror
from dexsim.hand.posture import Grasp, find_grasp
from dexsim.hand.vendor import Joint, Link, read_description

_TORQUE, _SPEED = 1.0, 8.0  # Nm and rad/s, where a file says nothing
_SMALLEST = 0.008  # m, extent of a link that can touch
_RUBBER = 0.003  # m, by which the environment enlarges fingertips (`PhysicsConfig.pad_thickness`)
_GAPS = (0.006, 0.010, 0.015, 0.020)  # m, between ball and links; the first that leaves room for boxes is taken
_PRESSING = 2.75  # fingers that oppose the thumb at once: gives the XHand's highest target, 4.8 N, of its 13.2 N
_CARRYING = 1.0  # N, of each of two fingers that carry 0.2 kg, the heaviest of the default objects
_DENSITY = 1000.0  # kg/m^3, of links without a mass


@dataclass(frozen=True, kw_only=True)
class ImportArguments(Config):
    """Options of `python -m dexsim.import_hand`."""

    file: Annotated[Path, tyro.conf.Positional]
    """The maker's URDF or MJCF; with --mirror also a hand's TOML, or the name of a shipped one. Meshes may be missing:
    their links get no capsule, fingertips an assumed one."""
    out: Path
    """Folder to write."""
    mirror: bool = False
    """Write the mirror image: a left hand of a right one, or the other way round."""
    name: str = ""
    """The hand's name; empty for the folder's."""
    palm: str = ""
    """Body of the palm; empty for the one where all fingers begin."""
    thumb: str = ""
    """A link or joint of the thumb; empty to find it."""
    fingers: str = ""
    """Axis of the file along which the fingers point, as +z or 0,0.5,1; empty to find it."""
    normal: str = ""
    """Axis of the file that the palm faces; empty to find it."""
    freeze: tuple[str, ...] = ()
    """Joints to fix at 0. Joints above the palm are fixed anyway."""
    couple: tuple[str, ...] = ()
    """FOLLOWER=LEADER:RATIO: a joint that follows another by a tendon."""
    drop_tendons: bool = False
    """Leave tendons out; see --couple."""
    torque: float = setting(0.0, unit="Nm", low=0.0, high=100.0)
    """Stall torque of all motors; 0 for the file's."""
    speed: float = setting(0.0, unit="rad/s", low=0.0, high=1000.0)
    """No-load speed of all motors; 0 for the file's."""
    yes: bool = False
    """Take the palm frame as found, without a question."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns 0 if the hand passes its checks, else 1.

    Raises:
      AssetError: the file cannot be imported; says why and what to do.
      ConfigError: an option does not fit.
    """
    description = "Make a hand's folder from a maker's URDF or MJCF."
    arguments = cli.parse(ImportArguments, argv, prog="python -m dexsim.import_hand", description=description)
    path, passed = arguments.file, True
    with tempfile.TemporaryDirectory() as scratch:
        if not arguments.mirror or path.suffix in (".urdf", ".xml"):
            path, passed = _import(arguments, Path(scratch) if arguments.mirror else arguments.out)
        if arguments.mirror:
            path = write_mirror(find_hand(path), arguments.out)
    print(f"wrote {path}" + ("" if passed else ": it does not pass yet; edit it, and see docs/your_own_hand.md"))
    return 0 if passed else 1


def _import(arguments: ImportArguments, folder: Path) -> tuple[Path, bool]:
    """Write a maker's hand into a folder: the TOML, and whether it passes its checks."""
    name = arguments.name or re.sub(r"\W", "_", arguments.out.resolve().name)
    name = swap_sides(name) if arguments.mirror else name
    source = read_description(
        arguments.file,
        palm=arguments.palm,
        freeze=arguments.freeze,
        couple=arguments.couple,
        drop_tendons=arguments.drop_tendons,
    )
    axes = (parse_axis(text) if text else None for text in (arguments.fingers, arguments.normal))
    anatomy = orient(source, thumb=arguments.thumb, along=next(axes), normal=next(axes))
    print("\n".join(frame_lines(anatomy)))
    if not arguments.yes:
        _confirm()
    sheet, assumed = make_sheet(anatomy, name, arguments.torque, arguments.speed, arguments.file.name)
    for gap in _GAPS:
        sheet, grasp = close_hand(sheet, anatomy.fingers, gap)
        path = write_hand(sheet, folder)
        sheet = dataclasses.replace(sheet, finger_force=force_targets(load_hand(path)))
        path = write_hand(sheet, folder)
        checks, passed = report(path)
        if not any("free of overlap" in line for line in checks):
            break
    lines = [*table(sheet, grasp), *(f"assumed      {text}" for text in assumed)]
    print("\n".join([*lines, *(line for line in checks if re.match(r"ok|FAIL|-  ", line))]))
    return path, passed


def force_targets(hand: Hand) -> tuple[float, float]:
    """A finger's target [N] at the commands 0 and 1. The highest is the thumb's strength in the grasp's posture, shared
    by the fingers that press at once, or the weakest finger's; the lowest is a quarter of it, as on the XHand, or what
    carries an object."""
    thumb, *others = fingertip_strength(hand, np.asarray(hand.grasp_posture, np.float32))
    highest = float(np.clip(min(thumb / min(_PRESSING, len(others)), *others), 0.05, 40.0))
    return min(max(highest / 4, _CARRYING), highest), highest


def parse_axis(text: str) -> np.ndarray:
    """A direction [3] from +z, -x or 0,0.5,1.

    Raises:
      ConfigError: neither.
    """
    if match := re.fullmatch(r"([+-]?)([xyz])", text):
        return (-1.0 if match[1] == "-" else 1.0) * np.eye(3)["xyz".index(match[2])]
    try:
        vector = np.array([float(x) for x in text.split(",")])
        if vector.shape == (3,) and np.linalg.norm(vector) > 0:
            return vector / np.linalg.norm(vector)
    except ValueError:
        pass
    raise ConfigError(f"axis {text!r}: expected +x, -y, z or three numbers as 0,0.5,1")


def frame_lines(anatomy: Anatomy) -> list[str]:
    """What was found of palm, fingers and signs."""
    source, links = anatomy.description, anatomy.description.links
    motors = sum(link.joint is not None and not link.joint.leader for link in links)
    fingers = ", ".join(f"{finger.name} ({links[finger.links[-1]].name})" for finger in anatomy.fingers)
    x, _, z = anatomy.rotation
    lines = [
        f"{source.name}: {source.kind}, {motors} motors, {len(links) - 1 - motors} joints that follow them",
        f"palm         body {links[0].name}",
        f"fingers      {fingers}",
        f"palm frame   fingers along {_axis(z)} of the file's body, palm facing {_axis(x)}; a {anatomy.side} hand",
    ]
    if source.frozen:
        lines.append(f"frozen at 0  {', '.join(source.frozen)}: above the palm, or by --freeze")
    if anatomy.reversed:
        lines.append(f"reversed     {', '.join(anatomy.reversed)}: positive opens in the file, closes here")
    return lines + [f"note         {note}" for note in (*anatomy.doubts, *source.notes)]


def _axis(vector: np.ndarray) -> str:
    at = int(np.argmax(np.abs(vector)))
    if abs(vector[at]) > 0.9999:
        return f"{'-' if vector[at] < 0 else '+'}{'xyz'[at]}"
    return ",".join(f"{x:.3f}" for x in vector)


def _confirm() -> None:
    """Ask whether the palm frame is right.

    Raises:
      ConfigError: it is not, or nobody is there to be asked.
    """
    if not sys.stdin.isatty():
        raise ConfigError("not a terminal: --yes accepts the palm frame above, --fingers and --normal give another")
    if input("Is this palm frame right? [y/N] ").strip().lower() not in ("y", "yes"):
        raise ConfigError("give --fingers, --normal, --thumb or --palm")


def make_sheet(anatomy: Anatomy, name: str, torque: float, speed: float, source: str) -> tuple[HandSheet, list[str]]:
    """All that the hand's folder will hold but the grasp, and what was assumed.

    Args:
      torque, speed: of all motors, Nm and rad/s; 0 for the file's.

    Raises:
      AssetError: a finger has no motor.
    """
    links, assumed = _with_limits(anatomy.description.links, torque, speed)
    links, more = _with_masses(links)
    assumed += more
    if links[0].surface is None:
        spread = np.array([link.joint.anchor for link in links if link.joint and link.parent == 0])
        links = (dataclasses.replace(links[0], surface=_box_round(spread)), *links[1:])
        assumed.append("palm: no mesh, a box of 15 mm round the fingers' roots")
    anatomy = dataclasses.replace(anatomy, description=dataclasses.replace(anatomy.description, links=links))
    tips = {finger.links[-1] for finger in anatomy.fingers}
    capsules = {}
    for at, link in enumerate(links):
        if at == 0 or (at not in tips and (link.surface is None or np.max(link.surface.extents) < _SMALLEST)):
            continue
        capsules[at] = _pad(anatomy, at, assumed) if at in tips else fit_capsule(link.surface, _along(anatomy, at))
    palm = fit_palm(links[0].surface)
    fingers = _finger_sheets(anatomy)
    order = [at for finger in anatomy.fingers for at in finger.links]
    motors = tuple(dict.fromkeys(j.name for at in order if (j := links[at].joint) and not j.leader))
    pads = [capsules[finger.tip_link] for finger in fingers]
    # Six columns over the front two thirds of a pad, eight rows along it.
    across = min(0.0035, min(pad.radius for pad in pads) * np.pi * 2 / 3 / 5)
    along = min(0.0035, min(float(np.linalg.norm(pad.ends[1] - pad.ends[0])) + pad.radius for pad in pads) / 7)
    signs = f"signs: {', '.join(anatomy.reversed)} turned round" if anatomy.reversed else "signs: as in the file"
    frame = f"palm frame in that of {links[0].name}: x {_axis(anatomy.rotation[0])}, z {_axis(anatomy.rotation[2])}"
    sheet = HandSheet(
        name=name,
        side=anatomy.side,
        links=links,
        palm=palm,
        capsules=capsules,
        fingers=fingers,
        motors=motors,
        taxel_grid=(6, 8),
        taxel_pitch=(across, along),
        remarks=(f"Imported from {source} by dexsim import-hand.", frame, signs, *(f"assumed: {a}" for a in assumed)),
    )
    return sheet, assumed


def close_hand(sheet: HandSheet, fingers: Sequence[Finger], gap: float) -> tuple[HandSheet, Grasp]:
    """The sheet with a first grasp, `gap` m between ball and links."""
    grasp = find_grasp(sheet.links, fingers, sheet.capsules, sheet.palm, gap)
    posture = {motor: grasp.posture[motor] for motor in sheet.motors}
    return dataclasses.replace(sheet, posture=posture, centre=grasp.centre), grasp


def _finger_sheets(anatomy: Anatomy) -> tuple[FingerSheet, ...]:
    """What the TOML says of the fingers.

    Raises:
      AssetError: one has no motor.
    """
    links = anatomy.description.links
    sheets: list[FingerSheet] = []
    for finger in anatomy.fingers:
        chain = (*flexion_links(links, finger.links), *finger.links)
        roots = [joint.name for at in chain if (joint := links[at].joint) and not joint.leader]
        last = links[finger.links[-1]]
        if not roots:
            raise AssetError(f"finger {finger.name!r} ({last.name}) has no motor of its own")
        assert last.joint is not None
        facing = np.cross(last.joint.axis, tip_of(links, finger.links) - last.joint.anchor)
        facing = facing / np.linalg.norm(facing)
        sheets.append(FingerSheet(name=finger.name, tip_link=finger.links[-1], root_joint=roots[0], facing=facing))
    return tuple(sheets)


def table(sheet: HandSheet, grasp: Grasp) -> list[str]:
    """A line for each link, the palm and the grasp."""
    lines = ["link                    joint                    range [rad]    Nm   rad/s  radius, fit mean, max [mm]"]
    for at, link in enumerate(sheet.links):
        joint, capsule = link.joint, sheet.capsules.get(at)
        text = f"{link.name[:22]:23} "
        if joint is not None:
            text += f"{joint.name[:22]:23} {joint.low:6.2f} {joint.high:5.2f} "
            text += f"{joint.torque:6.2f} {joint.speed:6.1f}" if not joint.leader else f" = {joint.leader[:10]:10}"
        if capsule:
            fit = tuple(1e3 * x for x in (capsule.radius, capsule.mean_error, capsule.largest_error))
            text += f"  {fit[0]:5.1f} {fit[1]:6.1f} {fit[2]:5.1f}"
        lines.append(text)
    sides, face = " x ".join(f"{2e3 * x:.0f}" for x in sheet.palm.half), sheet.palm.centre[0] + sheet.palm.half[0]
    beyond = 1e3 * sheet.palm.largest_error
    lines.append(
        f"palm         box of {sides} mm, face at x = {1e3 * face:.0f} mm; the palm reaches {beyond:.0f} mm beyond it"
    )
    low, high = sheet.finger_force
    lines.append(f"force        targets of {low:.1f} to {high:.1f} N a finger: what the thumb can oppose")
    lines.append(
        f"grasp        ball at {', '.join(f'{1e3 * x:.0f}' for x in grasp.centre)} mm, {grasp.reaching} of "
        f"{len(sheet.fingers)} fingertips near it, the farthest {1e3 * grasp.farthest:.0f} mm away"
    )
    return lines


def _with_limits(links: tuple[Link, ...], torque: float, speed: float) -> tuple[tuple[Link, ...], list[str]]:
    """The links with plausible limits at all motors, and what was assumed for it."""
    motors = {link.joint.name: link.joint for link in links if link.joint and not link.joint.leader}
    limits: dict[str, dict[str, float]] = {}
    assumed = []
    for what, given, (low, high), usual, unit in (
        ("torque", torque, TORQUES, _TORQUE, "Nm"),
        ("speed", speed, SPEEDS, _SPEED, "rad/s"),
    ):
        said = {name: getattr(joint, what) for name, joint in motors.items()}
        odd = {name: value for name, value in said.items() if not low <= value <= high}
        good = [value for name, value in said.items() if name not in odd]
        best = given or (float(np.median(good)) if good else usual)
        limits[what] = said | dict.fromkeys(said if given else odd, best)
        if odd and not given:
            wrong = ", ".join(sorted({f"{value:g}" for value in odd.values() if value})) or "nothing"
            assumed.append(f"{what} {best:g} {unit} at {len(odd)} motors: the file says {wrong}; --{what} gives it")

    def limited(joint: Joint) -> Joint:
        if joint.leader:
            # Where its motor takes it.
            ends = joint.offset + joint.ratio * np.array([motors[joint.leader].low, motors[joint.leader].high])
            return dataclasses.replace(joint, low=float(ends.min()), high=float(ends.max()))
        return dataclasses.replace(joint, torque=limits["torque"][joint.name], speed=limits["speed"][joint.name])

    return tuple(dataclasses.replace(link, joint=link.joint and limited(link.joint)) for link in links), assumed


def _with_masses(links: tuple[Link, ...]) -> tuple[tuple[Link, ...], list[str]]:
    """The links with a mass, that of water in their hull where the file has none."""
    done, names = [], []
    for link in links:
        if link.mass < 1e-3 and link.surface is not None:
            hull = link.surface.convex_hull
            hull.density = _DENSITY
            link = dataclasses.replace(link, mass=hull.mass, centre=hull.center_mass, inertia=hull.moment_inertia)
            names.append(link.name)
        done.append(dataclasses.replace(link, mass=max(link.mass, 1e-3), inertia=link.inertia + 1e-9 * np.eye(3)))
    return tuple(done), [f"mass by volume: {', '.join(names)}"] if names else []


def _box_round(points: np.ndarray) -> Any:
    import trimesh

    box = trimesh.creation.box(np.ptp(points, axis=0) + 0.015)
    return box.apply_translation((points.max(0) + points.min(0)) / 2)


def _along(anatomy: Anatomy, at: int) -> np.ndarray:
    """Direction [3] of a link: from its hinge to the next one's, or to its tip."""
    links = anatomy.description.links
    joint = links[at].joint
    assert joint is not None
    after = [link.joint.anchor for link in links if link.parent == at and link.joint]
    ends = after or [tip_of(links, [at])]
    arm = max((end - joint.anchor for end in ends), key=np.linalg.norm)
    length = np.linalg.norm(arm)
    return arm / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])


def _pad(anatomy: Anatomy, at: int, assumed: list[str]) -> Capsule:
    """The capsule of a fingertip, without the rubber, which the environment adds, and not back to the hinge."""
    link, along = anatomy.description.links[at], _along(anatomy, at)
    if link.surface is None:
        joint = link.joint
        assert joint is not None
        assumed.append(f"{link.name}: no mesh, a fingertip of 25 mm")
        ends = np.stack([joint.anchor + 0.008 * along, joint.anchor + 0.02 * along])
        return Capsule(ends=ends, radius=0.005, mean_error=0.0, largest_error=0.0)
    capsule = fit_capsule(link.surface, along)
    ends, radius = capsule.ends.copy(), max(capsule.radius - _RUBBER, 0.6 * capsule.radius)
    span = ends[1] - ends[0]
    if np.linalg.norm(span) > 0.01:
        ends[0] += 0.3 * span
    return dataclasses.replace(capsule, ends=ends, radius=radius)


if __name__ == "__main__":
    cli.run(main)
