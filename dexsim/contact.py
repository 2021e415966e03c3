"""Contacts of hand and object: their stiffness in MuJoCo's terms, and the rubber on the fingertips."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.hand import Hand

# A face meets a fingertip in up to two points, an edge in one: each is a little softer.
BOX_SHARE = 0.7
# What wears no rubber is stiffer: the palm carries the sum of the fingers.
BARE_SHARE = 2.5


def spring(compliance: jax.Array, stiffness: jax.Array, ratio: jax.Array, friction: jax.Array, *,
           period: float, edges: int = 0) -> tuple[jax.Array, jax.Array]:
    """MuJoCo's parameters for contacts that press with `stiffness` times depth at rest.

    MuJoCo's own parameters fix accelerations instead. The force at rest is N = k d^2 r / (A (1 - d))
    for a depth r, an impedance d, a reference stiffness k and the inverse weights A of the two bodies;
    with a pyramid of E edges instead of the elliptic cone it is N = E k d^2 r / (2 mu^2 (1 + mu^2) A
    (1 - d)) (documentation, chapter Computation, section Constraint model; mj_diagApprox and
    mj_makeImpedance): at one solref it changes sevenfold between a friction of 0.6 and 1.2. Here
    k = 1 / (period^2 d), and d follows from N = stiffness r.

    Args:
      compliance: [P] 1/kg, inverse weights A of the two bodies of each pair.
      stiffness: [P] N/m.
      ratio: [] damping ratio.
      friction: [] sliding.
      period: s, time scale on which a contact pushes out what lies in it.
      edges: of the friction pyramid; 0 for an elliptic cone, and without friction.

    Returns:
      solref [P, 2] (direct format) and solimp [P, 5].
    """
    cone = 2 * friction**2 * (1 + friction**2) / edges if edges else 1.0
    load = stiffness * cone * compliance * period**2
    impedance = jnp.clip(load / (1 + load), 1e-3, 0.9999)
    solref = jnp.stack([-impedance / period**2, -2 * ratio / period * impedance], -1)
    flat = jnp.broadcast_to(jnp.array([0.001, 0.5, 2.0]), (*impedance.shape, 3))
    return solref, jnp.concatenate([impedance[:, None], impedance[:, None], flat], -1)


def pairs_with(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Indices of the explicit pairs that one of `geoms` is part of."""
    return np.flatnonzero(np.isin(model.pair_geom1, geoms) | np.isin(model.pair_geom2, geoms))


def pair_constants(model: mujoco.MjModel, pairs: np.ndarray, geoms: np.ndarray,
                   tips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse weights [P] 1/kg of pairs with one of `geoms`, and their share of the stiffness [P].

    `tips` are the bodies of the fingertips.
    """
    both = np.stack([model.pair_geom1[pairs], model.pair_geom2[pairs]])
    bodies = model.geom_bodyid[both]
    box = np.isin(both, geoms) & (model.geom_type[both] == mujoco.mjtGeom.mjGEOM_BOX)
    on_tip = np.where(box.any(0), BOX_SHARE, 1.0)
    share = np.where(np.isin(bodies, tips).any(0), on_tip, BARE_SHARE)
    return model.body_invweight0[bodies, 0].sum(0), share


def cover_tips(spec: mujoco.MjSpec, hand: Hand, cover: float) -> None:
    """Let the geoms of the fingertips that touch stand out by `cover` m."""
    tips = {hand.body_names[b] for b in hand.tip_body}
    for geom in spec.geoms:
        if geom.parent.name in tips and (geom.contype or geom.conaffinity):
            round_ = geom.type in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
            size = np.array(geom.size)
            size[:1 if round_ else 3] += cover
            geom.size = size
