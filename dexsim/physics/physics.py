"""`Physics`: the hand, an object and their contacts in one compiled scene, on the engine of choice.

`advance` runs the scene for one control tick. Backends are `c` (C MuJoCo on the CPU's cores), `cuda` (one kernel for a
tick, on NVIDIA GPUs) and `mjx` (MuJoCo's `mjx.step`: any device).
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.install import install_line
from dexsim.core.pytree import choose
from dexsim.errors import ConfigError
from dexsim.geometry import rotations, sdf
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import HandPose
from dexsim.objects.params import ObjectParams, bounding_radius
from dexsim.physics import contact
from dexsim.physics.c_backend import CBackend
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.cuda.backend import CudaBackend
from dexsim.physics.interface import Backend, Fields, PhysicsScene, PhysicsState, StepResult, TorqueLaw
from dexsim.physics.law import implicit
from dexsim.physics.model import build_scene
from dexsim.touch.skin import Skin


def _mjx(scene: PhysicsScene) -> Backend:
    from dexsim.physics.mjx_backend import MjxBackend  # MJX takes seconds to import

    return MjxBackend(scene)


BACKENDS: dict[str, Callable[[PhysicsScene], Backend]] = {"c": CBackend, "cuda": CudaBackend, "mjx": _mjx}


def choose_backend(backend: str) -> str:
    """The name of a backend. `auto`: c on a CPU, cuda on an NVIDIA GPU, else mjx. Raises ConfigError: no such backend,
    or its device is missing."""
    if backend not in ("auto", *BACKENDS):
        raise ConfigError(f"backend {backend!r}: choose from auto, {', '.join(BACKENDS)}")
    device = jax.default_backend()
    if backend == "auto":
        return "c" if device == "cpu" else "cuda" if _on_nvidia() else "mjx"
    if backend == "cuda" and not _on_nvidia():
        raise ConfigError(f"backend 'cuda' needs an NVIDIA GPU, and JAX for it: {install_line('cuda')}")
    if backend == "c" and device != "cpu":
        raise ConfigError("backend 'c' runs on the CPU's cores: set JAX_PLATFORMS=cpu")
    return backend


def _on_nvidia() -> bool:
    return jax.default_backend() == "gpu" and "cuda" in jax.devices()[0].client.platform_version.lower()


class Physics:
    """The compiled scene. Immutable; its methods are pure and written for one environment."""

    def __init__(
        self,
        hand: Hand,
        slots: tuple[str, ...],
        largest: np.ndarray,
        config: PhysicsConfig,
        *,
        gravity: tuple[float, float, float],
        backend: str = "auto",
        pad_thickness: float = Skin.margin,
    ):
        """Compile.

        Args:
          slots: kinds of the object's primitives.
          largest: [K, 3] m, the largest size of each slot (broad phase bounds).
          gravity: m/s^2 in the palm frame, which is the world's.
          backend: "auto", "c", "cuda" or "mjx".
          pad_thickness: m, of the rubber over the fingertips, by which their geoms are enlarged (`Skin.margin`).

        Raises:
          AssetError: the model uses what the backend ignores or lacks.
          ConfigError: see `choose_backend`.
        """
        self.backend = choose_backend(backend)
        self.hand, self.config, self.pad_thickness = hand, config, pad_thickness
        self.scene = scene = build_scene(hand, slots, largest, config, gravity, self.backend, pad_thickness)
        self.engine = BACKENDS[self.backend](scene)
        self.mj_model = scene.model
        self.joint_qpos, self.joint_dof = scene.joint_qpos, scene.joint_dof
        self.object_qpos, self.object_dof = scene.object_qpos, scene.object_dof
        self._compliance, self._share, self._finger_of_pair = contact.pair_constants(
            scene.model, scene.object_pairs, scene.tip_bodies
        )
        self._pad_centre, self._pad_radius = contact.find_pads(scene.model, scene.object_pairs, scene.tip_bodies)

    def advance(
        self, law: TorqueLaw, fields: Fields, state: PhysicsState, push: jax.Array, held: jax.Array | None = None
    ) -> StepResult:
        """Run one control tick; see `Backend.advance`.

        Args:
          fields: of the environment (`fields`).
          held: [] bool, whether somebody holds the object: weightless, it is where it was at the end; None for no.
        """
        if held is not None:
            weight = fields["body_mass"] * jnp.asarray(self.mj_model.opt.gravity, jnp.float32)
            push = jnp.where(held, -weight, push)
        result = self.engine.advance(fields, state, implicit(law, self.config.timestep), push)
        if held is None:
            return result
        still = dataclasses.replace(
            result.state,
            qpos=result.state.qpos.at[self.object_qpos].set(state.qpos[self.object_qpos]),
            qvel=result.state.qvel.at[self.object_dof].set(0.0),
        )
        return result._replace(state=choose(held, still, result.state))

    def fields(
        self,
        object: ObjectParams,
        tip_stiffness: jax.Array | None = None,
        pad_thickness_delta: jax.Array | float = 0.0,
    ) -> Fields:
        """What one environment has in place of the scene's.

        Args:
          tip_stiffness: [F] the fingertips' stiffness over the nominal one (`tip_stiffness`); None for 1.
          pad_thickness_delta: [] m, change of the thickness of their rubber.
        """
        scene, delta = self.scene, self._delta(pad_thickness_delta)
        friction = jnp.where(self._finger_of_pair >= 0, object.friction, object.link_friction)
        share = jnp.asarray(self._share)
        if tip_stiffness is not None:
            share *= jnp.append(tip_stiffness, 1.0)[self._finger_of_pair]  # -1, no finger's: the last
        solref, solimp = contact.spring(self._compliance, share * object.contact[0], object.contact[1])
        tips = scene.model.geom_size[scene.tip_geoms] + delta * scene.tip_growth
        # The broad phase leaves out what is farther away. Of thinner rubber the sphere round it may stay.
        around = scene.model.geom_rbound[scene.tip_geoms]
        around = around + jnp.maximum(delta, 0.0) * np.linalg.norm(scene.tip_growth, axis=-1)
        aligned = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (len(scene.slots), 1))
        return {
            "geom_size": jnp.concatenate([object.size, tips]),
            "geom_rbound": jnp.concatenate([bounding_radius(object.size, scene.slots), around]),
            "geom_pos": object.position,
            "geom_quat": aligned if object.quat is None else object.quat,
            "body_mass": object.mass,
            "body_inertia": object.inertia,
            "body_ipos": object.com,
            "pair_friction": jnp.stack([friction] * 2, -1),
            "pair_solref": solref,
            "pair_solimp": solimp,
        }

    def tip_stiffness(
        self,
        object: ObjectParams,
        pose: HandPose,
        position: jax.Array,
        rotation: jax.Array,
        skin_force: jax.Array,
        pad_thickness_delta: jax.Array | float = 0.0,
    ) -> jax.Array:
        """How much stiffer [F] than nominal a fingertip's springs are for their sum to be the skin's force.

        The springs of a finger press with stiffness times the sum D of their depths, its skin with S: the ratio is
        S / (NOMINAL ROW_SHARE D), and 1 where nothing touches yet. The first half millimetre blends.

        Args:
          pose: of the hand; `position` [3] and `rotation` [3, 3] are the object's, in the palm frame.
          skin_force: [F] N, S: what the skin presses with there (`dexsim.touch.skin`).
          pad_thickness_delta: [] m, see `fields`.
        """
        shape, radius = object.shape(), jnp.asarray(self._pad_radius)
        radius = jnp.where(radius > 0, radius + self._delta(pad_thickness_delta), 0.0)
        centre = pose.body_position[self.hand.tip_body][:, None] + rotations.rotate(
            pose.tip_rotation[:, None], jnp.asarray(self._pad_centre)
        )
        local = sdf.to_local(centre, position, rotation)
        depth: jax.Array | float = 0.0
        for k, kind in enumerate(shape.kinds):  # one spring for every primitive that a sphere is in
            here = sdf.to_local(local, shape.position[k], shape.rotation[k])
            gap = sdf.DISTANCE[kind](here, shape.size[k])
            depth += jnp.where(shape.active[k], jnp.maximum(radius - gap, 0.0), 0.0)
        nominal = contact.NOMINAL * contact.ROW_SHARE
        blend = nominal * contact.BLEND_DEPTH
        ratio = (skin_force + blend) / (nominal * (jnp.sum(depth, -1) + contact.BLEND_DEPTH))
        has = jnp.asarray(self._pad_radius.any(-1))  # a fingertip that is no row of spheres keeps its stiffness
        return jnp.where(has, jnp.clip(ratio, contact.SOFTEST, contact.STIFFEST), 1.0)

    def _delta(self, pad_thickness_delta: jax.Array | float) -> jax.Array:
        # No rubber is the least.
        return jnp.maximum(jnp.asarray(pad_thickness_delta, jnp.float32), -self.pad_thickness)


def revert_if_diverged(result: StepResult, before: PhysicsState, valid: jax.Array) -> tuple[StepResult, jax.Array]:
    """A tick's result and whether it is sound [] bool.

    A world that has diverged ends its episode: it stays as it was `before`, and its forces are zero, since NaNs
    must not propagate. `valid` [] bool is false where the action was not finite.
    """
    after, force = result.state, result.finger_force
    # A diverging solver passes through speeds that are finite and square to 1e27 in the reward.
    finite = (
        valid & jnp.all(jnp.isfinite(after.qpos)) & jnp.all(jnp.abs(after.qvel) < 1e3) & jnp.all(jnp.isfinite(force))
    )
    return StepResult(choose(finite, after, before), jnp.where(finite, force, 0.0)), finite
