"""Contacts of hand and object: their stiffness in MuJoCo's terms, and the rubber on the fingertips.

A spring of constant stiffness gives the same force on a face, over its rim and at its corner. Skin does not: at equal
depth the rim presses half as hard, the corner a quarter. So the stiffness of a fingertip's springs is computed at every
tick from the skin's law over the taxels (`Physics.tip_stiffness`), and the solver's force is that of the skin. For
this a fingertip is a row of spheres (`split_pads`). A sphere has exactly one contact point with a primitive, on every
engine, at a depth in closed form; a capsule has one or two points on a box.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.core.pytree import Array
from dexsim.errors import AssetError
from dexsim.hand.description import Hand

# One sphere's share of a fingertip's stiffness: two or three of a row touch at once.
ROW_SHARE = 0.5
# Links without rubber are stiffer: the palm bears the sum of the fingers' forces.
BARE_SHARE = 2.5
# N/m, nominal stiffness of a fingertip, which `ObjectParams.contact` scales; also that of the template.
NOMINAL = 1700.0
# How far the skin may make a fingertip's springs softer and stiffer than that. The floor keeps corners,
# which press next to no skin, from sinking in.
SOFTEST, STIFFEST = 0.25, 4.0
# m, depth below which springs are the nominal ones: there the skin's law is the lattice's coarseness.
BLEND_DEPTH = 0.0005
# s, time scale on which a contact resolves penetration: three of the longest time steps, below which it is unstable.
PERIOD = 0.03
# Spheres in a row that replace each capsule of a fingertip in contacts with the object.
_POINTS = 3


def spring(compliance: Array, stiffness: Array, ratio: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """MuJoCo's parameters for contacts that press with `stiffness` times depth at rest.

    MuJoCo's own parameters fix accelerations instead. With an elliptic cone the force at rest is
    N = k d^2 r / (A (1 - d)) for a depth r, an impedance d, a reference stiffness k and the inverse weights A
    of the two bodies (documentation, chapter Computation, section Constraint model). Here
    k = 1 / (PERIOD^2 d), and d follows from N = stiffness r.

    Args:
      compliance: [P] 1/kg, inverse weights A of the two bodies of each pair.
      stiffness: [P] N/m.
      ratio: [] damping ratio.

    Returns:
      solref [P, 2] (direct format) and solimp [P, 5].
    """
    load = stiffness * compliance * PERIOD**2
    impedance = jnp.clip(load / (1 + load), 1e-3, 0.9999)
    solref = jnp.stack([-impedance / PERIOD**2, -2 * ratio / PERIOD * impedance], -1)
    flat = jnp.broadcast_to(jnp.array([0.001, 0.5, 2.0]), (*impedance.shape, 3))
    return solref, jnp.concatenate([impedance[:, None], impedance[:, None], flat], -1)


def pairs_with(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Indices of the explicit pairs that one of `geoms` is part of."""
    return np.flatnonzero(np.isin(model.pair_geom1, geoms) | np.isin(model.pair_geom2, geoms))


def pair_constants(
    model: mujoco.MjModel, pairs: np.ndarray, tips: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse weights [P] 1/kg of pairs, their share of the stiffness [P], and whose they are [P].

    `tips` are the bodies [F] of the fingertips; -1 is what belongs to none of them.
    """
    both = np.stack([model.pair_geom1[pairs], model.pair_geom2[pairs]])
    bodies = model.geom_bodyid[both]
    ball = (np.isin(bodies, tips) & (model.geom_type[both] == mujoco.mjtGeom.mjGEOM_SPHERE)).any(0)
    finger = np.full(len(pairs), -1)
    for index, tip in enumerate(tips):
        finger[(bodies == tip).any(0)] = index
    share = np.where(finger < 0, BARE_SHARE, np.where(ball, ROW_SHARE, 1.0))
    return model.body_invweight0[bodies, 0].sum(0), share, finger


def thicken_tips(spec: mujoco.MjSpec, hand: Hand, thickness: float) -> None:
    """Enlarge the geoms of the fingertips that touch by `thickness` m of rubber. Raises AssetError: the size of one is
    not in the file, where rubber can be added to it."""
    tips = {hand.body_names[b] for b in hand.tip_body}
    for geom in spec.geoms:
        if geom.parent.name in tips and (geom.contype or geom.conaffinity):
            spanned = np.isfinite(geom.fromto[0]) and geom.type != mujoco.mjtGeom.mjGEOM_CAPSULE
            if geom.meshname or spanned:
                raise AssetError(
                    f"{hand.model_path}: geom {geom.name!r} of a fingertip has its size from "
                    f"{'fromto' if spanned else 'a mesh'}: rubber is added to it, give it as size, pos and quat"
                )
            geom.size = np.array(geom.size) + thickness * _growth(geom.type)


def rubber_geoms(model: mujoco.MjModel, pairs: np.ndarray, tips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Geoms [S] on bodies `tips` that are part of `pairs`, and the change [S, 3] of their sizes over the rubber's."""
    used = np.unique([model.pair_geom1[pairs], model.pair_geom2[pairs]])
    used = used[np.isin(model.geom_bodyid[used], tips)]
    return used, np.array([_growth(kind) for kind in model.geom_type[used]], float).reshape(-1, 3)


def _growth(kind: int) -> np.ndarray:
    """How much each of a geom's sizes [3] grows with the rubber on it."""
    round_ = int(kind) in (mujoco.mjtGeom.mjGEOM_SPHERE.value, mujoco.mjtGeom.mjGEOM_CAPSULE.value)
    return np.array([1.0, 0.0, 0.0]) if round_ else np.ones(3)


def split_pads(spec: mujoco.MjSpec, hand: Hand, touching: list[str]) -> list[str]:
    """Place a row of spheres in every capsule of a fingertip that touches.

    The capsules remain for contacts with anything but the object.

    Returns:
      The names of what meets the object: `touching` with the spheres in place of their capsules.
    """
    names = []
    placed = {geom.name: geom for geom in hand.geoms}
    for name in touching:
        geom, place = spec.geom(name), placed[name]
        if place.body not in hand.tip_body or place.kind != "capsule":
            names.append(name)
            continue
        for index, along in enumerate(np.linspace(-1.0, 1.0, _POINTS)):
            ball = geom.parent.add_geom(
                name=f"{name}/{index}",  # a hand may have pads called pad and pad_1
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                mass=0.0,
                group=geom.group,
                pos=place.position + along * place.size[1] * place.rotation[:, 2],
                size=[geom.size[0], 0, 0],
                rgba=geom.rgba,
            )
            names.append(ball.name)
    return names


def find_pads(model: mujoco.MjModel, pairs: np.ndarray, tips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The spheres on bodies `tips` [F] that are part of `pairs`: centres [F, S, 3] m in the frames of their links, and
    radii [F, S] m, 0 for fingers with fewer."""
    used = np.unique([model.pair_geom1[pairs], model.pair_geom2[pairs]])
    used = used[model.geom_type[used] == mujoco.mjtGeom.mjGEOM_SPHERE]
    rows = [used[model.geom_bodyid[used] == tip] for tip in tips]
    longest = max(map(len, rows))
    centre, radius = np.zeros((len(rows), longest, 3), np.float32), np.zeros((len(rows), longest), np.float32)
    for finger, row in enumerate(rows):
        centre[finger, : len(row)], radius[finger, : len(row)] = model.geom_pos[row], model.geom_size[row, 0]
    return centre, radius
