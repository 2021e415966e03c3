"""Makes a hand's folder from a maker's URDF or MJCF: palm frame, capsules, pads, limits and a first grasp.

    python -m dexsim.import_hand maker/hand.urdf --out my_hand
    python -m dexsim.import_hand my_hand/my_hand.toml --mirror --out my_left

It prints what it found and what it assumed, and checks the result (`dexsim.check_hand`).
"""

import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
import tyro

from dexsim.calibration.press import fingertip_strength
from dexsim.check_hand import SPEEDS, TORQUES, report
from dexsim.core import cli
from dexsim.errors import AssetError, ConfigError
from dexsim.hand.anatomy import orient, tip_of
from dexsim.hand.fit import Capsule, fit_capsule, fit_palm
from dexsim.hand.folder import write_hand
from dexsim.hand.load import find_hand, load_hand
from dexsim.hand.mirror import check_new, swap_sides, write_mirror
from dexsim.hand.posture import find_grasp
from dexsim.hand.vendor import LEAST_MASS, Draft, ImportConfig, Link, read_hand

_TORQUE, _SPEED = 1.0, 8.0  # Nm and rad/s, where a file says nothing
_SMALLEST = 0.008  # m, extent of a link that can touch
_RUBBER = 0.003  # m, by which the environment enlarges fingertips (`Skin.margin`)
_GAPS = (0.006, 0.010, 0.015, 0.020)  # m, between ball and links; the first that leaves room for boxes is taken
_PRESSING = 2.75  # fingers that oppose the thumb at once: gives the XHand's highest target, 4.8 N, of its 13.2 N
_CARRYING = 1.0  # N, of each of two fingers that carry 0.2 kg, the heaviest of the default objects
_DENSITY = 1000.0  # kg/m^3, of links without a mass


@dataclass(frozen=True, kw_only=True)
class ImportArguments(ImportConfig):
    """Make a hand's folder from a maker's URDF or MJCF."""

    file: Annotated[Path, tyro.conf.Positional]
    """The maker's URDF or MJCF; with --mirror also a hand's TOML, or the name of a shipped one. Meshes may be missing:
    their links get no capsule, fingertips an assumed one."""
    out: Path
    """Folder to write, without a hand of its name."""
    mirror: bool = False
    """Write the mirror image: a left hand of a right one, or the other way round."""
    yes: bool = False
    """Take the palm frame as found, without a question."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns 0 if the hand passes its checks, else 1."""
    arguments = cli.parse(ImportArguments, argv)
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
    name = re.sub(r"\W", "_", arguments.out.resolve().name)  # the folder's
    name = swap_sides(name) if arguments.mirror else name
    check_new(folder / f"{name}.toml", folder / f"{name}.xml")
    draft = read_hand(arguments.file, arguments)
    orient(draft, arguments)
    print("\n".join(draft.findings))
    if not arguments.yes:
        if not sys.stdin.isatty():
            raise ConfigError("not a terminal: --yes accepts the palm frame above, --fingers and --normal give another")
        if input("Is this palm frame right? [y/N] ").strip().lower() not in ("y", "yes"):
            raise ConfigError("give --fingers, --normal, --thumb or --palm")
    said = len(draft.findings)
    fit_links(draft, arguments)
    remarks = [f"Imported from {arguments.file.name} by dexsim import-hand.", *draft.findings]
    hand = load_hand(write_hand(draft, name, remarks, folder))
    for gap in _GAPS:
        posture, centre, gaps = find_grasp(hand, gap)
        # A finger's highest target is the thumb's strength, shared by the fingers that press at once, or the weakest
        # finger's; the lowest is a quarter of it, as on the XHand, or what carries an object.
        thumb, *others = fingertip_strength(hand, posture)
        highest = float(np.clip(min(thumb / min(_PRESSING, len(others)), *others), 0.05, 40.0))
        lowest = min(max(highest / 4, _CARRYING), highest)
        grasp: dict[str, Any] = {"posture": posture, "centre": centre, "finger_force": [lowest, highest]}
        path = write_hand(draft, name, remarks, folder, grasp)
        checks, passed = report(path)
        if not any("free of overlap" in line for line in checks):
            break
    lines = [
        *fit_lines(draft),
        f"force        targets of {lowest:.1f} to {highest:.1f} N a finger: what the thumb can oppose",
        f"grasp        ball at {', '.join(f'{1e3 * x:.0f}' for x in centre)} mm, fingertips "
        f"{', '.join(f'{1e3 * x:.0f}' for x in gaps)} mm from it",
    ]
    print("\n".join([*lines, *draft.findings[said:], *checks]))
    return path, passed


def fit_links(draft: Draft, options: ImportConfig) -> None:
    """Limits, masses and capsules of all links, and the palm's box. Raises AssetError: a finger has no motor."""
    links = draft.links
    for name, chain in draft.fingers.items():
        if not any(links[at].is_motor for at in chain):
            raise AssetError(f"finger {name!r} ({links[chain[-1]].name}) has no motor of its own")
    _assume_limits(draft, "torque", options.torque, TORQUES, _TORQUE, "Nm")
    _assume_limits(draft, "speed", options.speed, SPEEDS, _SPEED, "rad/s")
    motors = {motor.joint: motor for motor in draft.motors}
    for link in links:
        if link.leader:  # its range is where its motor takes it
            ends = (link.offset + link.ratio * end for end in (motors[link.leader].low, motors[link.leader].high))
            link.low, link.high = sorted(map(float, ends))
    _assume_masses(draft)
    if links[0].surface is None:
        roots = np.array([link.anchor for link in links if link.parent == 0])
        box = trimesh.creation.box(np.ptp(roots, axis=0) + 0.015)
        links[0].surface = box.apply_translation((roots.max(0) + roots.min(0)) / 2)
        draft.findings.append("assumed      palm: no mesh, a box of 15 mm round the fingers' roots")
    tips = {chain[-1] for chain in draft.fingers.values()}
    for at, link in enumerate(links[1:], 1):
        if at in tips:
            link.capsule = _fit_pad(draft, at)
        elif link.surface is not None and np.max(link.surface.extents) >= _SMALLEST:
            link.capsule = fit_capsule(link.surface, _along(links, at))
    draft.palm = fit_palm(links[0].surface)


def _assume_limits(draft: Draft, what: str, given: float, span: tuple[float, float], usual: float, unit: str) -> None:
    """Set a limit of all motors to the `given` one, or implausible ones to the median of the others."""
    values = [getattr(motor, what) for motor in draft.motors]
    good = [value for value in values if span[0] <= value <= span[1]]
    best = given or (float(np.median(good)) if good else usual)
    odd = [value for value in values if value not in good]
    for motor, value in zip(draft.motors, values, strict=True):
        setattr(motor, what, best if given or value in odd else value)
    if odd and not given:
        wrong = ", ".join(sorted({f"{value:g}" for value in odd if value})) or "nothing"
        draft.findings.append(
            f"assumed      {what} {best:g} {unit} at {len(odd)} motors: the file says {wrong}; --{what} gives it"
        )


def _assume_masses(draft: Draft) -> None:
    """Links without a mass get that of water in their hull."""
    names = []
    for link in draft.links:
        if link.mass < LEAST_MASS and link.surface is not None:
            hull = link.surface.convex_hull
            hull.density = _DENSITY
            link.mass, link.centre, link.inertia = hull.mass, hull.center_mass, hull.moment_inertia
            names.append(link.name)
        link.mass, link.inertia = max(link.mass, LEAST_MASS), link.inertia + 1e-9 * np.eye(3)
    if names:
        draft.findings.append(f"assumed      mass by volume: {', '.join(names)}")


def _along(links: Sequence[Link], at: int) -> np.ndarray:
    """Direction [3] of a link: from its hinge to the next one's, or to its tip."""
    ends = [link.anchor for link in links if link.parent == at] or [tip_of(links, [at])]
    arm = max((end - links[at].anchor for end in ends), key=np.linalg.norm)
    length = np.linalg.norm(arm)
    return arm / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])


def _fit_pad(draft: Draft, at: int) -> Capsule:
    """The capsule of a fingertip, without the rubber, which the environment adds, and not back to the hinge."""
    link, along = draft.links[at], _along(draft.links, at)
    if link.surface is None:
        draft.findings.append(f"assumed      {link.name}: no mesh, a fingertip of 25 mm")
        ends = np.stack([link.anchor + 0.008 * along, link.anchor + 0.02 * along])
        return Capsule(ends=ends, radius=0.005)
    capsule = fit_capsule(link.surface, along)
    span = capsule.ends[1] - capsule.ends[0]
    if np.linalg.norm(span) > 0.01:
        capsule.ends[0] += 0.3 * span
    return capsule._replace(radius=max(capsule.radius - _RUBBER, 0.6 * capsule.radius))


def fit_lines(draft: Draft) -> list[str]:
    """A line for each capsule and the palm."""
    lines = ["capsule                 of joint                radius, fit's mean and largest error [mm]"]
    for link in draft.links:
        if link.capsule:
            radius, mean, most = (1e3 * x for x in (link.capsule.radius, *link.capsule.error))
            lines.append(f"  {link.name[:20]:21} {link.joint[:20]:21} {radius:8.1f} {mean:8.1f} {most:8.1f}")
    centre, half, beyond = draft.palm
    sides, face, beyond = " x ".join(f"{2e3 * x:.0f}" for x in half), 1e3 * (centre[0] + half[0]), 1e3 * beyond
    lines.append(f"palm         box of {sides} mm, face at x = {face:.0f} mm; it reaches {beyond:.0f} mm beyond it")
    return lines


if __name__ == "__main__":
    cli.run(main)
