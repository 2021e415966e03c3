"""What crosses between the environment and a physics engine, and the interface that every engine offers.

The state is Markov: positions, velocities and the solver's warm start. Everything derived is recomputed, so that an
episode restarts by selecting arrays, with every engine.

A new engine is one module with a class that follows `Backend`, and one line in `dexsim.physics.physics`.
Shapes: J joints, H hinges (`Hand.num_hinges`), F fingers, K primitives of the object, P pairs of a hand geom and an
object geom.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.core.pytree import pytree_dataclass
from dexsim.hand.description import Hand
from dexsim.physics.config import PhysicsConfig

TorqueLaw = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
"""(sub-step [], joint position [J] rad, joint velocity [J] rad/s) to joint torque [J] Nm, before every sub-step."""

ImplicitLaw = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""As `TorqueLaw`, to the torque [J] Nm and the inertia [J] kg m^2 that an engine adds to the joints' (`implicit`)."""

Fields = dict[str, jax.Array]
"""What one environment has in place of the scene's constants (`places`): its object, contacts and fingertips."""


@pytree_dataclass
class PhysicsState:
    """The Markov state: the hand's hinges first, in the order of its MJCF, then the object's free joint."""

    qpos: jax.Array  # [H + 7] rad; m and unit quaternion
    qvel: jax.Array  # [H + 6] rad/s; m/s (palm frame) and rad/s (object frame)
    warmstart: jax.Array  # [H + 6] last accelerations, the solver's first guess


class StepResult(NamedTuple):
    """The world after a control tick."""

    state: PhysicsState
    finger_force: jax.Array  # [F, 3] N, of the object on the finger tips at the last sub-step, palm frame


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PhysicsScene:
    """The compiled template that an engine runs, with the addresses of what changes in it."""

    hand: Hand
    config: PhysicsConfig
    slots: tuple[str, ...]  # kinds of the object's primitives
    model: mujoco.MjModel
    joint_qpos: np.ndarray  # [J] addresses in qpos
    joint_dof: np.ndarray  # [J] addresses in qvel
    object_qpos: np.ndarray  # [7]
    object_dof: np.ndarray  # [6]
    object_body: int
    object_geoms: np.ndarray  # [K]
    object_pairs: np.ndarray  # [P]
    tip_bodies: np.ndarray  # [F]
    tip_geoms: np.ndarray  # [S] of the fingertips that meet the object
    tip_growth: np.ndarray  # [S, 3] change of `geom_size` over the rubber's


class Backend(Protocol):
    """A physics engine on one scene. Its methods are pure and written for one environment; the caller vmaps them.

    The constructor takes the scene, and raises AssetError for one that the engine cannot run.
    """

    def advance(self, fields: Fields, state: PhysicsState, law: ImplicitLaw, push: jax.Array) -> StepResult:
        """Run one control tick of `PhysicsConfig.substeps` sub-steps.

        Args:
          fields: of the model, during the whole tick.
          state: where to start from.
          law: of the motors, evaluated before every sub-step.
          push: [3] N, force on the object's centre of mass during the whole tick.

        Returns:
          The world after the tick. Forces are NaN where the engine could not keep all contacts.
        """


def places(scene: PhysicsScene) -> dict[str, Any]:
    """Fields of `mujoco.MjModel` that differ between environments, and where in them.

    `body_invweight0` is not among them: the contact's parameters are worked out from it, and stiffness must not change
    with the mass of what is touched.
    """
    geoms, body, pairs = scene.object_geoms, scene.object_body, scene.object_pairs
    return {
        "geom_size": np.concatenate([geoms, scene.tip_geoms]),
        "geom_rbound": np.concatenate([geoms, scene.tip_geoms]),
        "geom_pos": geoms,
        "geom_quat": geoms,
        "body_mass": body,
        "body_inertia": body,
        "body_ipos": body,
        "pair_friction": (pairs, slice(0, 2)),
        "pair_solref": pairs,
        "pair_solimp": pairs,
    }


def configured(scene: PhysicsScene, fields: Fields) -> dict[str, jax.Array]:
    """The whole fields of one environment's model, the scene's with `fields` in their `places`."""
    where = places(scene)
    return {
        name: jnp.asarray(getattr(scene.model, name), jnp.float32).at[where[name]].set(value)
        for name, value in fields.items()
    }
