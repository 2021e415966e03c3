"""The force of a finger, estimated from what a hand measures: its taxels, and the torque of its root joint.

Taxels miss what the skin beside them bears: they are a lower bound. A root joint's torque has it all, with the joint's
friction in it, and how much force it is depends on where the finger touches.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import Config, setting
from dexsim.hand.description import Hand


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceEstimate(Config):
    """How taxels and torque make an estimate."""

    torque_share: float = setting(0.4, unit="1", low=0.0, high=1.0)
    """Share of the torque's force beyond the taxels' that counts: 0 for the taxels alone, 1 for the larger of both."""
    touching: float = setting(0.1, unit="N", low=0.001, high=10.0)
    """Force on a finger's taxels from which it counts as touching."""


def estimate_force(estimate: ForceEstimate, hand: Hand, taxel_force: jax.Array, joint_torque: jax.Array) -> jax.Array:
    """Estimated force [F] N of each finger: the sum of its `taxel_force` [F, N] N and a share of what its
    `joint_torque` [J], over the torque limits, tells beyond it by the hand's `force_per_torque`; 0 without touch.
    """
    taxels = jnp.sum(taxel_force, -1)
    gain = hand.force_per_torque * hand.torque_limit[hand.root_joint]
    beyond = jnp.maximum(gain * jnp.abs(joint_torque[hand.root_joint]) - taxels, 0.0)
    return jnp.where(taxels > estimate.touching, taxels + estimate.torque_share * beyond, 0.0)
