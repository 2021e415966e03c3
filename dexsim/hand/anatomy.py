"""Which links are a thumb and which fingers, where the palm faces, and which way joints close.

The palm frame of the library: fingers +z, palm normal +x, and so the thumb of a right hand on the side of +y. Positive
angles close the fingers. A `Description` has neither; `orient` brings it into both.
"""

import dataclasses
import re

import numpy as np

from dexsim.core.errors import AssetError
from dexsim.hand.vendor import Description, Joint, Link

FLEXION = 0.7
"""Cosine to the axis of a finger's last joint above which another joint flexes, too."""
_NAMES = ("index", "middle", "ring", "pinky", "sixth")
_THUMB = re.compile(r"thumb|(^|[^a-z])th([^a-z]|[jmdpb]|$)", re.IGNORECASE)
_SNAP = np.cos(np.radians(10.0))  # a frame this near to the file's axes is meant to be along them


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finger:
    """A chain of links from the palm's child to the one at the tip."""

    name: str
    links: tuple[int, ...]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Anatomy:
    """A hand in the palm frame, thumb first."""

    description: Description
    fingers: tuple[Finger, ...]
    rotation: np.ndarray  # [3, 3], palm axes x, y, z in the file's, in rows
    reversed: tuple[str, ...]  # joints whose sign was turned round
    doubts: tuple[str, ...]

    @property
    def side(self) -> str:
        """left where the thumb is on the side of -y, else right."""
        links = self.description.links
        thumb, *others = (_aside(links, finger.links) for finger in self.fingers)
        return "left" if thumb < np.mean(others) else "right"


def orient(
    description: Description, *, thumb: str = "", along: np.ndarray | None = None, normal: np.ndarray | None = None
) -> Anatomy:
    """Find fingers, palm frame and signs.

    Args:
      thumb: a link or joint of the thumb; empty to find it.
      along, normal: [3] where the fingers point and the palm faces, in the file's axes; None to find them.

    Raises:
      AssetError: fewer than two fingers, or no side on which they close.
    """
    links = description.links
    parents = {link.parent for link in links}
    chains = [_chain(links, at) for at in range(1, len(links)) if at not in parents]
    if not 2 <= len(chains) <= 6:
        raise AssetError(
            f"{description.name}: expected 2 to 6 fingers, got {len(chains)} chains of hinges; --palm BODY chooses a "
            "hand, --freeze JOINT fixes a hinge that is no finger's"
        )
    first, doubts = _find_thumb(links, chains, thumb)
    others = [chain for index, chain in enumerate(chains) if index != first]
    rotation = _find_frame(links, others, along, normal)
    links = tuple(_turned(link, rotation) for link in links)
    order = sorted(others, key=lambda chain: _aside(links, chain))
    if _aside(links, chains[first]) > np.mean([_aside(links, chain) for chain in others]):
        order.reverse()  # from the thumb's side on
    fingers = [Finger(name="thumb", links=tuple(chains[first]))]
    fingers += [Finger(name=name, links=tuple(chain)) for name, chain in zip(_NAMES, order, strict=False)]
    links, changed = _close_positive(links, fingers)
    anatomy = Anatomy(
        description=dataclasses.replace(description, links=links),
        fingers=tuple(fingers),
        rotation=rotation,
        reversed=changed,
        doubts=tuple(doubts),
    )
    side, other = anatomy.side, "right" if anatomy.side == "left" else "left"
    names = " ".join([description.name, *(link.name for link in links)]).lower()
    if other in names and side not in names:
        doubt = f"the file's names say {other}, the thumb is where a {side} hand has it: check the palm frame"
        anatomy = dataclasses.replace(anatomy, doubts=(*doubts, doubt))
    return anatomy


def tip_of(links: tuple[Link, ...], chain: tuple[int, ...] | list[int]) -> np.ndarray:
    """Where [3] a chain ends: the point of its last link that is farthest from that link's hinge, in the middle of the
    link's end."""
    link = links[chain[-1]]
    joint = _joint(link)
    if link.surface is None:
        return joint.anchor + 0.02 * _unit(joint.anchor - _joint(links[chain[0]]).anchor + 1e-9)
    points = np.asarray(link.surface.vertices)
    # The hinge may be anywhere on its axis.
    arms = points - joint.anchor
    arms = arms - np.outer(arms @ joint.axis, joint.axis)
    reach = np.linalg.norm(arms, axis=1)
    return points[reach > reach.max() - 2e-3].mean(0)


def _aside(links: tuple[Link, ...], chain: tuple[int, ...] | list[int]) -> float:
    """y m of a finger: the mean of its hinges and its tip."""
    return float(np.mean([*(_joint(links[at]).anchor[1] for at in chain), tip_of(links, chain)[1]]))


def flexion_links(links: tuple[Link, ...], chain: tuple[int, ...] | list[int]) -> list[int]:
    """Links of a chain whose hinges are parallel to its last one's."""
    last = _joint(links[chain[-1]]).axis
    return [at for at in chain if abs(_joint(links[at]).axis @ last) > FLEXION]


def _joint(link: Link) -> Joint:
    assert link.joint is not None
    return link.joint


def _chain(links: tuple[Link, ...], at: int) -> list[int]:
    chain = []
    while at > 0:
        chain.append(at)
        at = links[at].parent
    return chain[::-1]


def _find_thumb(links: tuple[Link, ...], chains: list[list[int]], given: str) -> tuple[int, list[str]]:
    """The thumb's place in `chains`: by its name, or else the chain whose last axis and root are least like others'."""
    named = []
    for index, chain in enumerate(chains):
        names = [name for at in chain for name in (links[at].name, _joint(links[at]).name)]
        if given and given in names or not given and any(_THUMB.search(name) for name in names):
            named.append(index)
    if len(named) == 1:
        return named[0], []
    if given:
        raise AssetError(f"--thumb {given}: no link or joint of one finger has that name")
    axes = np.array([_joint(links[chain[-1]]).axis for chain in chains])
    roots = np.array([_joint(links[chain[0]]).anchor for chain in chains])
    alike = np.abs(axes @ axes.T)
    scores = []
    for index in range(len(chains)):
        rest = np.delete(np.arange(len(chains)), index)
        apart = np.linalg.norm(roots[index] - roots[rest].mean(0))
        width = np.linalg.norm(roots[rest] - roots[rest].mean(0), axis=1).mean() + 0.02
        scores.append(alike[np.ix_(rest, rest)].mean() - alike[index, rest].mean() + 0.3 * apart / width)
    best = int(np.argmax(scores))
    return best, [f"no link is named thumb: taken for it is {links[chains[best][-1]].name}; --thumb NAME changes it"]


def _find_frame(
    links: tuple[Link, ...], fingers: list[list[int]], along: np.ndarray | None, normal: np.ndarray | None
) -> np.ndarray:
    """The palm's axes [3, 3] in rows, from the fingers but the thumb."""
    axes = np.array([_joint(links[chain[-1]]).axis for chain in fingers])
    values, vectors = np.linalg.eigh(axes.T @ axes)
    across = vectors[:, -1]
    if values[-1] < 0.8 * len(fingers) and (along is None or normal is None):
        raise AssetError(
            "the fingers' last joints are not parallel, so no palm side is found: give --fingers and --normal, axes of "
            "the file along which the fingers point and the palm faces, as +z or 0,0.5,1"
        )
    roots = [_joint(links[chain[0]]).anchor for chain in fingers]
    tips = [tip_of(links, chain) for chain in fingers]
    z = np.mean([_unit(tip - root) for root, tip in zip(roots, tips, strict=True)], 0) if along is None else along
    x = np.zeros(3)
    for chain, tip in zip(fingers, tips, strict=True):
        for at in flexion_links(links, chain):
            joint = _joint(links[at])
            # Fingers bend farther to the front than to the back.
            x += (joint.low + joint.high) * np.cross(joint.axis, tip - joint.anchor)
    if normal is None:
        z = _unit(z - across * (across @ z))
        x = _unit(np.cross(across, z)) * np.sign(np.cross(across, z) @ x)
    else:
        x = normal
    z = _unit(z)
    x = _unit(x - z * (z @ x))
    rotation = np.stack([x, np.cross(z, x), z])
    rounded = np.round(rotation)
    if along is None and normal is None and np.all(np.abs(rotation[rounded != 0]) > _SNAP) and _is_rotation(rounded):
        rotation = rounded
    return rotation


def _is_rotation(matrix: np.ndarray) -> bool:
    return bool(np.allclose(matrix @ matrix.T, np.eye(3)) and np.linalg.det(matrix) > 0)


def _turned(link: Link, rotation: np.ndarray) -> Link:
    """The link in turned axes."""
    joint, surface = link.joint, link.surface
    if joint is not None:
        joint = dataclasses.replace(joint, axis=rotation @ joint.axis, anchor=rotation @ joint.anchor)
    if surface is not None:
        surface = surface.copy()
        surface.vertices = np.asarray(surface.vertices) @ rotation.T
    return dataclasses.replace(
        link,
        joint=joint,
        surface=surface,
        centre=rotation @ link.centre,
        inertia=rotation @ link.inertia @ rotation.T,
    )


def _close_positive(links: tuple[Link, ...], fingers: list[Finger]) -> tuple[tuple[Link, ...], tuple[str, ...]]:
    """Turn the sign of joints that open with positive angles: of fingers, those that flex and take the tip away from
    the palm's normal; of the thumb, those that flex and bend farther to the negative side."""
    wrong = set()
    for finger in fingers:
        tip = tip_of(links, finger.links)
        bends = sum(
            (j.low + j.high) * np.cross(j.axis, tip - j.anchor)
            for j in (_joint(links[at]) for at in flexion_links(links, finger.links))
        )
        toward = np.array([1.0, 0.0, 0.0]) if finger.name != "thumb" else bends
        wrong |= {
            _joint(links[at]).name
            for at in flexion_links(links, finger.links)
            if np.cross(_joint(links[at]).axis, tip - _joint(links[at]).anchor) @ toward < 0
        }
    changed = []
    for link in links:
        joint = link.joint
        if joint is not None:
            sign, leads = (-1.0 if name in wrong else 1.0 for name in (joint.name, joint.leader))
            low, high = (-joint.high, -joint.low) if sign < 0 else (joint.low, joint.high)
            joint = dataclasses.replace(
                joint, axis=sign * joint.axis, low=low, high=high,
                ratio=sign * leads * joint.ratio, offset=sign * joint.offset,
            )  # fmt: skip
        changed.append(dataclasses.replace(link, joint=joint))
    return tuple(changed), tuple(sorted(wrong))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
