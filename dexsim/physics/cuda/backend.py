"""A control tick of physics as one CUDA kernel, a warp a world: the fastest engine on NVIDIA GPUs, without gradients.

The kernel is generated for the scene and for the motor law, which it evaluates at every sub-step, and compiled when a
program is traced. Its solver runs until it has converged, and its results repeat to the bit.
"""

import jax
import jax.numpy as jnp

from dexsim.physics.cuda import launch
from dexsim.physics.cuda.program import PrintedLaw, compile_kernel, find_compiler, print_law, source
from dexsim.physics.cuda.scene import Settings, buffers, kernel_constants
from dexsim.physics.interface import Fields, ImplicitLaw, PhysicsScene, PhysicsState, StepResult
from dexsim.physics.law import record

# Newton's method stops at this decrement at least, and its line search at this share of it: forces are then as near to
# C MuJoCo's as float32 allows.
_TOLERANCE, _LINE_SEARCH_TOLERANCE = 1e-5, 0.01


class CudaBackend:
    """`dexsim.physics.interface.Backend` in CUDA."""

    def __init__(self, scene: PhysicsScene):
        """The kernel is compiled when a program is traced.

        Raises:
          AssetError: the scene has what the kernel lacks.
          ConfigError: the driver or the compiler is missing.
        """
        self.scene = scene
        kernel_constants(scene)
        find_compiler()
        launch.architecture()
        self._loaded: dict[PrintedLaw, str] = {}

    def advance(self, fields: Fields, state: PhysicsState, law: ImplicitLaw, push: jax.Array) -> StepResult:
        """One control tick in one launch."""
        joints = len(self.scene.joint_dof)
        recorded = record(law, jnp.zeros(joints))
        name, moving = self._load(print_law(recorded, joints)), (state.qpos, state.qvel, state.warmstart)
        inputs = fields | {"push": push, "pair_friction": fields["pair_friction"][:, 0]}
        names = [buffer.name for buffer in buffers(self.scene, ()) if not buffer.output][len(moving) :]
        given = [jnp.asarray(inputs[name], jnp.float32) for name in names]  # the same during the whole tick
        arguments = [*moving, *given, *map(jnp.asarray, recorded.constants)]
        shapes = [array.shape for array in moving] + [(self.scene.hand.num_fingers, 3), (4,)]
        results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        qpos, qvel, warmstart, force, _ = launch.call(name, results, *arguments)
        return StepResult(PhysicsState(qpos, qvel, warmstart), force)

    def _load(self, law: PrintedLaw) -> str:
        """The name of the kernel with this law, compiled and loaded."""
        if law not in self._loaded:
            model, code = self.scene.model, compile_kernel(source(self.scene, law), launch.architecture())
            # MuJoCo's tolerance is of the cost over (mean inertia) (degrees of freedom), of which Newton's decrement
            # p^T H p is twice what the next step would improve.
            tolerance = max(_TOLERANCE, 2 * float(model.opt.tolerance * model.stat.meaninertia * model.nv))
            settings = Settings(
                substeps=self.scene.config.substeps,
                iterations=int(model.opt.iterations),
                line_search=int(model.opt.ls_iterations),
                tolerance=tolerance,
                line_search_tolerance=_LINE_SEARCH_TOLERANCE,
            )
            self._loaded[law] = launch.load(code, settings, len(buffers(self.scene, law.buffers)))
        return self._loaded[law]
