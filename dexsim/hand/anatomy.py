"""Which links are a thumb and which fingers, where the palm faces, and which way joints close.

The palm frame of the library: fingers +z, palm normal +x, and so the thumb of a right hand on the side of +y. Positive
angles close the fingers. A maker's file has neither; `orient` brings a `Draft` into both.
"""

import re
from collections.abc import Sequence

import numpy as np

from dexsim.errors import AssetError
from dexsim.hand.description import unit
from dexsim.hand.vendor import Direction, Draft, ImportConfig, Link

_FLEXION = 0.7  # cosine to the axis of a finger's last joint above which another joint flexes, too
_NAMES = ("index", "middle", "ring", "pinky", "sixth")
_THUMB = re.compile(r"thumb|(^|[^a-z])th([^a-z]|[jmdpb]|$)", re.IGNORECASE)
_SNAP = np.cos(np.radians(10.0))  # a frame this near to the file's axes is meant to be along them


def orient(draft: Draft, options: ImportConfig) -> None:
    """Find fingers, palm frame, signs and side, and turn the links into them. Raises AssetError: fewer than two
    fingers, or no side on which they close."""
    links = draft.links
    parents = {link.parent for link in links}
    chains = [_chain(links, at) for at in range(1, len(links)) if at not in parents]
    if not 2 <= len(chains) <= 6:
        raise AssetError(f"{draft.name}: expected 2 to 6 fingers, got {len(chains)}; see --palm BODY, --freeze JOINT")
    first = chains.pop(_find_thumb(draft, chains, options.thumb))
    rotation = _find_frame(links, chains, options.fingers, options.normal)
    for link in links:
        link.axis, link.anchor, link.centre = (rotation @ vector for vector in (link.axis, link.anchor, link.centre))
        link.inertia = rotation @ link.inertia @ rotation.T
        if link.surface is not None:
            link.surface.vertices = np.asarray(link.surface.vertices) @ rotation.T
    chains.sort(key=lambda chain: _aside(links, chain))
    thumb_side = _aside(links, first) - np.mean([_aside(links, chain) for chain in chains])
    if thumb_side > 0:
        chains.reverse()  # from the thumb's side on
    draft.fingers = {"thumb": first, **dict(zip(_NAMES, chains, strict=False))}
    draft.side, other = ("left", "right") if thumb_side < 0 else ("right", "left")
    wrong = _close_positive(draft)
    fingers = ", ".join(f"{name} ({links[chain[-1]].name})" for name, chain in draft.fingers.items())
    facing, _, upward = (" ".join(f"{x:.3g}" for x in axis.round(3) + 0.0) for axis in rotation)
    draft.findings += [
        f"{draft.name}: {len(draft.motors)} motors, {len(links) - 1 - len(draft.motors)} joints that follow them",
        f"palm         body {links[0].name}",
        f"fingers      {fingers}",
        f"palm frame   in the file's axes fingers point along {upward}, the palm faces {facing}; a {draft.side} hand",
    ]
    if wrong:
        draft.findings.append(f"reversed     {', '.join(wrong)}: positive opens in the file, closes here")
    names = " ".join([draft.name, *(link.name for link in links)]).lower()
    if other in names and draft.side not in names:
        draft.findings.append(
            f"note         the file's names say {other}, the thumb is where a {draft.side} hand has it: check the frame"
        )


def tip_of(links: Sequence[Link], chain: Sequence[int]) -> np.ndarray:
    """Where [3] a chain ends: the point of its last link that is farthest from that link's hinge, in the middle of the
    link's end."""
    link = links[chain[-1]]
    if link.surface is None:
        return link.anchor + 0.02 * unit(link.anchor - links[chain[0]].anchor + 1e-9)
    points = np.asarray(link.surface.vertices)
    # The hinge may be anywhere on its axis.
    arms = points - link.anchor
    arms = arms - np.outer(arms @ link.axis, link.axis)
    reach = np.linalg.norm(arms, axis=1)
    return points[reach > reach.max() - 2e-3].mean(0)


def flexion_links(links: Sequence[Link], chain: Sequence[int]) -> list[int]:
    """Links of a chain whose hinges are parallel to its last one's."""
    last = links[chain[-1]].axis
    return [at for at in chain if abs(links[at].axis @ last) > _FLEXION]


def _aside(links: Sequence[Link], chain: Sequence[int]) -> float:
    """y m of a finger: the mean of its hinges and its tip."""
    return float(np.mean([*(links[at].anchor[1] for at in chain), tip_of(links, chain)[1]]))


def _chain(links: Sequence[Link], at: int) -> list[int]:
    chain = []
    while at > 0:
        chain.append(at)
        at = links[at].parent
    return chain[::-1]


def _find_thumb(draft: Draft, chains: list[list[int]], given: str) -> int:
    """The thumb's place in `chains`: by its name, or else the chain whose last axis and root are least like others'."""
    links, named = draft.links, []
    for index, chain in enumerate(chains):
        names = [name for at in chain for name in (links[at].name, links[at].joint)]
        if given and given in names or not given and any(_THUMB.search(name) for name in names):
            named.append(index)
    if len(named) == 1:
        return named[0]
    if given:
        raise AssetError(f"--thumb {given}: no link or joint of one finger has that name")
    axes = np.array([links[chain[-1]].axis for chain in chains])
    roots = np.array([links[chain[0]].anchor for chain in chains])
    alike = np.abs(axes @ axes.T)
    scores = []
    for index in range(len(chains)):
        rest = np.delete(np.arange(len(chains)), index)
        distance = np.linalg.norm(roots[index] - roots[rest].mean(0))
        width = np.linalg.norm(roots[rest] - roots[rest].mean(0), axis=1).mean() + 0.02
        scores.append(alike[np.ix_(rest, rest)].mean() - alike[index, rest].mean() + 0.3 * distance / width)
    best = int(np.argmax(scores))
    taken = links[chains[best][-1]].name
    draft.findings.append(f"note         no link is named thumb: taken for it is {taken}; --thumb NAME changes it")
    return best


def _find_frame(
    links: list[Link], fingers: list[list[int]], along: Direction | None, normal: Direction | None
) -> np.ndarray:
    """The palm's axes [3, 3] in rows, from the fingers but the thumb."""
    axes = np.array([links[chain[-1]].axis for chain in fingers])
    values, vectors = np.linalg.eigh(axes.T @ axes)
    across, given = vectors[:, -1], along is not None or normal is not None
    if values[-1] < 0.8 * len(fingers) and (along is None or normal is None):
        raise AssetError("no palm side found, the fingers' last joints are not parallel: give --fingers and --normal")
    arms = [unit(tip_of(links, chain) - links[chain[0]].anchor) for chain in fingers]
    z = unit(np.mean(arms, 0) if along is None else np.asarray(along))
    x = np.asarray(normal)
    if normal is None:
        z = unit(z - across * (across @ z))
        x = np.cross(across, z)
        x = x * np.sign(np.round(x @ sum(_bend(links, chain) for chain in fingers), 9))
    x = unit(x - z * (z @ x))
    rotation = np.stack([x, np.cross(z, x), z])
    if np.linalg.det(rotation) < 0.5:
        which = "--normal is along the fingers" if given else "fingers bend as far to both sides"
        raise AssetError(f"no palm side found, {which}: give --fingers and --normal across them")
    rounded = np.round(rotation)
    snaps = np.all(np.abs(rotation[rounded != 0]) > _SNAP) and np.linalg.det(rounded) == 1
    return rounded if snaps and not given else rotation


def _bend(links: Sequence[Link], chain: Sequence[int]) -> np.ndarray:
    """Which way [3] a finger's tip moves when it bends: farther to the front than to the back."""
    tip, flexing = tip_of(links, chain), [links[at] for at in flexion_links(links, chain)]
    return np.sum([(link.low + link.high) * np.cross(link.axis, tip - link.anchor) for link in flexing], 0)


def _close_positive(draft: Draft) -> list[str]:
    """Turn the sign of joints that open with positive angles, and name them: of fingers, those that flex and take the
    tip away from the palm's normal; of the thumb, those that flex and bend farther to the negative side."""
    links, wrong = draft.links, set()
    for name, chain in draft.fingers.items():
        tip = tip_of(links, chain)
        toward = _bend(links, chain) if name == "thumb" else np.array([1.0, 0.0, 0.0])
        for link in (links[at] for at in flexion_links(links, chain)):
            if np.cross(link.axis, tip - link.anchor) @ toward < 0:
                wrong.add(link.joint)
    for link in links:
        sign, leads = (-1.0 if name in wrong else 1.0 for name in (link.joint, link.leader))
        link.axis, link.ratio, link.offset = sign * link.axis, sign * leads * link.ratio, sign * link.offset
        if sign < 0:
            link.low, link.high = -link.high, -link.low
    return sorted(wrong)
