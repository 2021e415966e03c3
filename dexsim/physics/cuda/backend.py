"""A control tick of physics as one CUDA kernel, a warp a world: the fastest engine on NVIDIA GPUs, without gradients.

The kernel is generated for the scene and for the motor law, which it evaluates at every sub-step, and compiled when a
program is traced. Its solver runs until it has converged, and its results repeat to the bit.
"""

from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.errors import ConfigError
from dexsim.objects.params import ObjectParams
from dexsim.physics.cuda import launch
from dexsim.physics.cuda.arguments import Settings
from dexsim.physics.cuda.contact_tables import contact_constants
from dexsim.physics.cuda.law import PrintedLaw, print_law
from dexsim.physics.cuda.program import compile_kernel, find_compiler, source
from dexsim.physics.cuda.scene import buffers, kernel_constants
from dexsim.physics.host.law import Recorded, one_by_one, record
from dexsim.physics.interface import ContactParams, PhysicsScene, PhysicsState, StepResult, TorqueLaw
from dexsim.physics.parameters import configured, values

# Newton's method stops at this decrement, and its line search at this share of it: forces are then as near to C
# MuJoCo's as float32 allows.
_TOLERANCE, _LINE_SEARCH_TOLERANCE = 1e-5, 0.01


class CudaBackend:
    """`dexsim.physics.interface.Backend` in CUDA."""

    def __init__(self, scene: PhysicsScene, num_envs: int = 1):
        """Every world has its own memory, so `num_envs` reserves nothing.

        Raises:
          AssetError: the scene has what the kernel lacks.
          ConfigError: the driver or the compiler is missing.
        """
        del num_envs
        self.scene = scene
        kernel_constants(scene), contact_constants(scene)
        find_compiler(), launch.architecture()
        self._loaded: dict[tuple[PrintedLaw, int], str] = {}
        self._tick = jax.custom_jvp(self._call, nondiff_argnums=(0,))
        self._tick.defjvp(_no_gradient)

    def configure(self, object: ObjectParams, contacts: ContactParams) -> dict[str, jax.Array]:
        """What the model of one environment has in place of the scene's, by the names of `mujoco.MjModel`."""
        return configured(self.scene, object, contacts)

    def advance(
        self,
        object: ObjectParams,
        contacts: ContactParams,
        state: PhysicsState,
        torque: TorqueLaw,
        push: jax.Array,
    ) -> StepResult:
        """One control tick in one launch, or one for each sub-step if the law cannot be printed."""
        given = self._inputs(object, contacts, push)

        def run(law: Recorded, state: PhysicsState, substeps: int) -> StepResult:
            name, moving = self._load(law, substeps), (state.qpos, state.qvel, state.warmstart)
            qpos, qvel, warmstart, force, _ = self._tick(name, *moving, *given, *map(jnp.asarray, law.constants))
            return StepResult(PhysicsState(qpos, qvel, warmstart), force)

        def substep(torque: TorqueLaw, state: PhysicsState) -> StepResult:
            law = self._record(torque)
            assert law is not None
            return run(law, state, 1)

        law = self._record(torque)
        if law is None:
            return one_by_one(self.scene, substep, torque, state)
        return run(law, state, self.scene.config.substeps)

    def _record(self, torque: TorqueLaw) -> Recorded | None:
        return record(torque, jnp.zeros(len(self.scene.joint_dof)))

    def _inputs(self, object: ObjectParams, contacts: ContactParams, push: jax.Array) -> list[jax.Array]:
        """What of a tick stays the same, in the order of the kernel's buffers."""
        found = values(self.scene, object, contacts) | {"push": push, "pair_friction": contacts.friction}
        if "geom_quat" not in found:
            found["geom_quat"] = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (len(self.scene.slots), 1))
        names = [buffer.name for buffer in buffers(self.scene, ()) if not buffer.output][3:]
        return [jnp.asarray(found[name], jnp.float32) for name in names]

    def _load(self, recorded: Recorded, substeps: int) -> str:
        """The name of the kernel with this law, compiled and loaded."""
        law = print_law(recorded, len(self.scene.joint_dof))
        if (law, substeps) not in self._loaded:
            code, option = compile_kernel(source(self.scene, law), launch.architecture()), self.scene.model.opt
            limits = int(option.iterations), int(option.ls_iterations)
            settings = Settings(substeps, *limits, _TOLERANCE, _LINE_SEARCH_TOLERANCE)
            self._loaded[law, substeps] = launch.load(code, settings, len(buffers(self.scene, law.buffers)))
        return self._loaded[law, substeps]

    def _call(self, name: str, *arguments: jax.Array) -> list[jax.Array]:
        shapes = [array.shape for array in arguments[:3]] + [(self.scene.hand.num_fingers, 3), (4,)]
        return launch.call(name, [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes], *arguments)


def _no_gradient(*_: Any) -> Any:
    raise ConfigError("backend 'cuda' has no gradient: make the environment with backend='jax'")
