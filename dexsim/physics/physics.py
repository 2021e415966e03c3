"""`Physics`: the hand, an object and their contacts in one compiled scene, on the engine of choice.

`advance` runs the scene for one control tick. Backends are `jax` (differentiable, any device), `cuda` (one kernel for a
tick, many times faster on NVIDIA GPUs), `warp` (MuJoCo's own for those) and `c` (C MuJoCo on the CPU's cores);
`mujoco.mjx` is not imported before a scene is compiled.
"""

import importlib.util
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.compilation import is_deterministic
from dexsim.core.errors import AssetError, ConfigError, DexsimWarning
from dexsim.core.install import install_line
from dexsim.geometry import rotations
from dexsim.hand.kinematics import Hand, forward_kinematics
from dexsim.objects.params import ObjectParams
from dexsim.physics import contact
from dexsim.physics.c_backend import CBackend
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.cuda.backend import CudaBackend
from dexsim.physics.jax_backend import JaxBackend
from dexsim.physics.model import build_scene
from dexsim.physics.seam import Backend, ContactParams, PhysicsScene, PhysicsState, TorqueLaw
from dexsim.physics.warp_backend import WarpBackend
from dexsim.touch.skin import Skin
from dexsim.touch.surface import skin_surface

BACKENDS: dict[str, Callable[..., Backend]] = {
    "jax": JaxBackend,
    "cuda": CudaBackend,
    "warp": WarpBackend,
    "c": CBackend,
}


def choose_backend(backend: str) -> str:
    """The name of a backend. `auto`: c on a CPU, cuda on an NVIDIA GPU, else jax.

    Raises:
      ConfigError: no such backend, or its library or device is missing.
    """
    if backend not in ("auto", *BACKENDS):
        raise ConfigError(f"backend {backend!r}: choose from auto, {', '.join(BACKENDS)}")
    device = jax.default_backend()
    if backend == "auto":
        return "c" if device == "cpu" else "cuda" if _on_nvidia() else "jax"
    if backend == "cuda" and not _on_nvidia():
        raise ConfigError(f"backend 'cuda' needs an NVIDIA GPU, and JAX for it: {install_line('cuda')}")
    if backend == "warp" and importlib.util.find_spec("warp") is None:
        raise ConfigError(f"backend 'warp' needs the extra: {install_line('warp')}")
    if backend == "warp" and is_deterministic():
        # Warp has a mode for it (1.18), in which contacts get lost: mujoco_warp, issue 1635.
        raise ConfigError("backend 'warp' does not repeat to the last bit: choose cuda, or leave out --deterministic")
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
        num_envs: int = 1,
        skin: Skin | None = None,
        rotor_share: float = 0.0,
    ):
        """Compile.

        Args:
          hand: the hand; its MJCF is read again here.
          slots: kinds of the object's primitives.
          largest: [K, 3] m, the largest size of each slot (broad phase bounds).
          config: solver and contact model.
          gravity: m/s^2 in the palm frame, which is the world's.
          backend: "auto", "jax", "cuda", "warp" or "c". `auto` leaves scenes that do not fit into the kernel to jax.
          num_envs: batch size that a backend reserves memory for.
          skin: of the fingertips, whose stiffness it sets; without one it is constant.
          rotor_share: share of the joints' armature that is left out of the scene.

        Raises:
          AssetError: the model uses what the backend ignores or lacks.
          ConfigError: see `choose_backend`.
        """
        self.backend = choose_backend(backend)

        def start(backend: str) -> tuple[PhysicsScene, Backend]:
            scene = build_scene(hand, slots, largest, config, gravity, backend, rotor_share=rotor_share)
            return scene, BACKENDS[backend](scene, num_envs)

        try:
            scene, self.engine = start(self.backend)
        except AssetError as error:
            if (backend, self.backend) != ("auto", "cuda"):
                raise
            warnings.warn(f"{error}; backend jax instead, which is slower", DexsimWarning, stacklevel=2)
            self.backend = "jax"
            scene, self.engine = start("jax")
        self.hand, self.config, self.skin, self.scene = hand, config, skin, scene
        self.mj_model = scene.model
        self.joint_qpos, self.joint_dof = scene.joint_qpos, scene.joint_dof
        self.object_qpos, self.object_dof = scene.object_qpos, scene.object_dof
        self._compliance, self._share, self._finger_of_pair = contact.pair_constants(
            scene.model, scene.object_pairs, scene.tip_bodies
        )
        self._pads = contact.find_pads(scene.model, scene.object_pairs, scene.tip_bodies)
        self._surface = None if skin is None else skin_surface(hand, skin)

    def tip_stiffness(self, object: ObjectParams, qpos: jax.Array, cover: jax.Array | float = 0.0) -> jax.Array:
        """How much stiffer [F] than nominal the fingertips are where they press now; `cover` as in `contact_params`."""
        assert self.skin is not None and self._surface is not None, "without a skin, springs are constant"
        place = qpos[self.object_qpos]
        turn = rotations.quat_to_matrix(place[3:] / jnp.linalg.norm(place[3:]))
        pose = forward_kinematics(self.hand, qpos[self.joint_qpos])
        return contact.follow_skin(
            self.hand, self._pads, self.skin, self._surface, pose, object, place[:3], turn, self._change(cover)
        )

    def contact_params(
        self, object: ObjectParams, tips: jax.Array | None = None, cover: jax.Array | float = 0.0
    ) -> ContactParams:
        """Contact parameters of an object.

        Args:
          object: the object.
          tips: [F] the fingertips' stiffness over the nominal one.
          cover: [] m, change of the thickness of their rubber from `PhysicsConfig.cover`.
        """
        friction = object.pair_friction(self._finger_of_pair >= 0)
        share = jnp.asarray(self._share)
        if tips is not None:
            share *= jnp.append(tips, 1.0)[self._finger_of_pair]  # -1, no finger's: the last
        solref, solimp = contact.spring(
            self._compliance, share * object.contact[0], object.contact[1], period=self.config.contact_period
        )
        return ContactParams(friction, solref, solimp, self._change(cover))

    def _change(self, cover: jax.Array | float) -> jax.Array:
        return jnp.maximum(jnp.asarray(cover, jnp.float32), -self.config.cover)  # no rubber is the least

    def configure(self, object: ObjectParams, tips: jax.Array | None = None, cover: jax.Array | float = 0.0) -> Any:
        """The engine's model of one environment (`Backend.configure`); arguments as in `contact_params`."""
        return self.engine.configure(object, self.contact_params(object, tips, cover))

    def advance(
        self,
        object: ObjectParams,
        state: PhysicsState,
        torque: Callable[[jax.Array, jax.Array, jax.Array], jax.Array],
        push: jax.Array,
        cover: jax.Array | float = 0.0,
    ) -> tuple[PhysicsState, jax.Array]:
        """Run one control tick with motors that remember nothing: `advance_motors` for all others.

        Args:
          torque: (sub-step, joint position [J], joint velocity [J]) to joint torque [J] Nm,
            called before every sub-step.
        """
        after, force, _ = self.advance_motors(
            object,
            state,
            lambda index, position, velocity, memory: (torque(index, position, velocity), memory),
            None,
            push,
            cover,
        )
        return after, force

    def advance_motors(
        self,
        object: ObjectParams,
        state: PhysicsState,
        motors: TorqueLaw,
        memory: Any,
        push: jax.Array,
        cover: jax.Array | float = 0.0,
    ) -> tuple[PhysicsState, jax.Array, Any]:
        """Run one control tick; `cover` as in `contact_params`, the rest as in `Backend.advance`."""
        tips = None if self.skin is None else self.tip_stiffness(object, state.qpos, cover)
        return self.engine.advance(object, self.contact_params(object, tips, cover), state, motors, memory, push)
