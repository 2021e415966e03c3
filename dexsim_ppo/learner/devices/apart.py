"""Training on several devices with environments that XLA cannot compile for all of them at once.

MuJoCo Warp's calls crash XLA's compiler in a program of several devices (JAX 0.11.2). So each device resets and
collects in programs of its own, and one program of all devices learns from what they have collected. The parts draw
the random numbers of the whole: training is the same up to the order of sums.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

from dexsim.core.compilation import jit
from dexsim_ppo.learner.devices.sharding import AXIS, Part, copied, shardings, start_on

ENGINES = ("warp",)
"""Physics that needs it."""

# Experience is [T, B, ...], all else [B, ...].
_AXES = (0, 1, 0)


class ApartStep:
    """A training step `step(state) -> (state, metrics [iterations])` of several programs. Donates its argument.

    It is lowered and compiled as a step of one program is: `step.lower(shapes).compile()`.

    Args:
      collect: `(state with a part of the environments, part) -> ((env_state, memory), rollout, tally)`.
      learn: `(state, rollout, tally) -> (state, metrics)`, of all environments.
      iterations: in a call.
      backend: of the physics.
    """

    def __init__(
        self,
        collect: Callable[[Any, Part], Any],
        learn: Callable[[Any, Any, Any], Any],
        mesh: Mesh,
        iterations: int,
        backend: str,
    ):
        self._mesh, self._iterations, self._numbers = mesh, iterations, own_numbers(mesh)
        self._lowered, self._programs = list[Any](), list[Any]()
        # A device's kernels are launched by the thread that calls its program: one thread would start them in turn.
        self._threads = ThreadPoolExecutor(mesh.size)

        def collect_part(environments: Any, learner: Any, number: jax.Array) -> Any:
            return collect(_with(learner, environments), Part(number, mesh.size))

        def learn_from_all(environments: Any, learner: Any, rollout: Any, tally: Any) -> Any:
            state, metrics = learn(_with(learner, environments), rollout, tally)
            return jax.lax.with_sharding_constraint(state, shardings(state, mesh)), copied(metrics, mesh)

        self._collect = jit(collect_part, backend=backend, donate_argnums=0)
        self._learn = jit(learn_from_all, backend=backend, donate_argnums=(0, 1))

    def lower(self, shapes: Any) -> "ApartStep":
        """Trace the programs for a state of these shapes and shardings."""
        learner, environments = _without(shapes), (shapes.env_state, shapes.memory)
        self._lowered = []
        for device, number in self._numbers.items():
            where = SingleDeviceSharding(device)
            here = lambda x, where=where: jax.ShapeDtypeStruct(  # noqa: E731
                x.sharding.shard_shape(x.shape), x.dtype, sharding=where
            )
            self._lowered.append(
                self._collect.lower(jax.tree.map(here, environments), jax.tree.map(here, learner), number)
            )
        collected = [
            _shapes_of_all(tree, self._mesh, axis) for tree, axis in zip(self._lowered[0].out_info, _AXES, strict=True)
        ]
        self._lowered.append(self._learn.lower(collected[0], learner, *collected[1:]))
        return self

    def compile(self) -> "ApartStep":
        """Compile them at the same time."""
        self._programs = list(self._threads.map(lambda lowered: lowered.compile(), self._lowered))
        self._lowered = []
        return self

    @property
    def parts(self) -> list[Any]:
        """The compiled programs that a device runs, one after the other."""
        return [self._programs[0], self._programs[-1]]

    def as_text(self) -> str:
        """The program that communicates, once an iteration."""
        return self._programs[-1].as_text()

    def __call__(self, state: Any) -> tuple[Any, dict[str, jax.Array]]:
        if not self._programs:
            self.lower(jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), state))
            self.compile()
        found = []
        for _ in range(self._iterations):
            state, metrics = self._iterate(state)
            found.append(metrics)
        return state, jax.tree.map(lambda *x: jnp.stack(x), *found)

    def _iterate(self, state: Any) -> tuple[Any, dict[str, jax.Array]]:
        learner, environments = _without(state), (state.env_state, state.memory)
        del state
        # All before the first program runs: it donates its part, with which the whole is gone.
        given = [(_on(device, environments), _on(device, learner), number) for device, number in self._numbers.items()]
        collected = list(self._threads.map(lambda program, one: program(*one), self._programs[:-1], given))
        del environments, given
        environments, rollout, tally = (
            join([part[i] for part in collected], self._mesh, axis) for i, axis in enumerate(_AXES)
        )
        del collected
        return self._programs[-1](environments, learner, rollout, tally)


def start_apart(
    mesh: Mesh, learner: Callable[[jax.Array], Any], environments: Callable[[jax.Array, Part], Any]
) -> Callable[[jax.Array], Any]:
    """`init(key) -> TrainState` of several programs.

    Args:
      learner: `key -> TrainState` without environments.
      environments: `(key, part) -> env_state`.
    """
    start = jit(lambda key, number: environments(key, Part(number, mesh.size)), once=True)

    def begin(key: jax.Array) -> Any:
        parts = [start(jax.device_put(key, device), number) for device, number in own_numbers(mesh).items()]
        state = start_on(mesh, learner, functools.partial(jax.eval_shape, learner))(key)
        return dataclasses.replace(state, env_state=join(parts, mesh, 0))

    return begin


def own_numbers(mesh: Mesh) -> dict[jax.Device, jax.Array]:
    """The mesh's devices of this process, and on each its place in the mesh, int32 []."""
    return {
        device: jax.device_put(np.int32(number), device)
        for number, device in enumerate(mesh.devices.flat)
        if device.process_index == jax.process_index()
    }


def join(parts: Sequence[Any], mesh: Mesh, axis: int) -> Any:
    """Trees of arrays on this process's devices as one of arrays over all, split along `axis`."""
    where = _split(mesh, axis)

    def one(*parts: jax.Array) -> jax.Array:
        return jax.make_array_from_single_device_arrays(_times(parts[0].shape, mesh.size, axis), where, list(parts))

    return jax.tree.map(one, *parts)


def _shapes_of_all(tree: Any, mesh: Mesh, axis: int) -> Any:
    """The shapes over all devices of what has these on each."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(_times(x.shape, mesh.size, axis), x.dtype, sharding=_split(mesh, axis)), tree
    )


def _split(mesh: Mesh, axis: int) -> NamedSharding:
    return NamedSharding(mesh, PartitionSpec(*[None] * axis, AXIS))


def _times(shape: tuple[int, ...], count: int, axis: int) -> tuple[int, ...]:
    return (*shape[:axis], count * shape[axis], *shape[axis + 1 :])


def _on(device: jax.Device, tree: Any) -> Any:
    """What a device has of arrays over several."""
    return jax.tree.map(lambda x: next(s.data for s in x.addressable_shards if s.device == device), tree)


def _with(learner: Any, environments: tuple[Any, Any]) -> Any:
    return dataclasses.replace(learner, env_state=environments[0], memory=environments[1])


def _without(state: Any) -> Any:
    return dataclasses.replace(state, env_state=None, memory=None)
