"""Compiled training steps kept between runs, so that a second start need not even trace.

JAX's own cache is asked for a program that was traced and lowered already, which in a training step takes
longer than loading the program. Here the question is a hash of all that tracing depends on (`key`).
"""

import contextlib
import functools
import hashlib
import json
import os
import pickle
import platform
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.monitoring
import jax.numpy as jnp
from jax.experimental import serialize_executable

from dexsim.core.assets import cache_path
from dexsim.core.cli import environment_report
from dexsim.core.compilation import jit
from dexsim.core.files import python_sources

KEPT = 8  # of some 10 MB each, the newest
_OPTIONS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_disable_jit",
    "jax_numpy_dtype_promotion",
    "jax_threefry_partitionable",
)


class Program:
    """A compiled `step(state) -> (state, metrics)`, whose state may hold typed keys."""

    def __init__(self, compiled: Callable, like: Any, names: list[str], instead: Callable[[], "Program"] | None = None):
        """`instead` makes the program anew, should one that was kept not run."""
        self._compiled, self._names, self._instead = compiled, names, instead
        self._leaves = _Leaves(like)

    def __call__(self, state: Any) -> tuple[Any, dict[str, jax.Array]]:
        leaves = self._leaves.of(state)
        if self._instead:
            try:  # on a copy, since the program takes over its arguments' memory
                done = jax.block_until_ready(self._compiled([jnp.copy(leaf) for leaf in leaves]))
            except jax.errors.JaxRuntimeError:
                program = self._instead()
                self._compiled, self._names = program._compiled, program._names
                done = self._compiled(leaves)
            self._instead = None
        else:
            done = self._compiled(leaves)
        return self._leaves.back(done[0]), dict(zip(self._names, done[1], strict=True))


def compile_step(step: Callable, shapes: Any, identity: Any, on_traced: Callable[[], None]) -> Callable:
    """Compile a training step, or load it where it was compiled before.

    Args:
      step: state to (state, metrics), not jitted; it takes over the state's memory.
      shapes: the state's shapes.
      identity: what says which program this is, as JSON; None to keep nothing.
      on_traced: called when tracing is over, where it was needed.
    """
    if identity is None or jax.default_backend() != "cpu":  # Warp's kernels are not in the program itself.
        lowered = jit(step, donate_argnums=0).lower(shapes)
        on_traced()
        return lowered.compile()
    path = cache_path("programs") / f"{key(identity, shapes)}.pkl"
    anew = functools.partial(_compile, path, step, shapes, on_traced)
    return _load(path, shapes, anew) or anew()


def key(identity: Any, shapes: Any) -> str:
    """The hash of a program: its identity, this package, versions, machine, and options of JAX."""
    parts = [
        identity,
        environment_report(),
        _cpu_features(),
        os.environ.get("XLA_FLAGS", ""),
        {name: str(getattr(jax.config, name, None)) for name in _OPTIONS},
        [f"{path} {leaf.shape} {leaf.dtype}" for path, leaf in jax.tree.leaves_with_path(shapes)],
    ]
    digest = hashlib.sha256(json.dumps(parts, default=str).encode())
    for source in python_sources(Path(__file__).resolve().parents[1]):
        digest.update(source.read_bytes())
    return digest.hexdigest()


class _Leaves:
    """A tree as a list of plain arrays, which can be pickled where trees of our own classes cannot."""

    def __init__(self, like: Any):
        leaves, self._tree = jax.tree.flatten(like)
        self._is_key = [jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves]

    def of(self, tree: Any) -> list[jax.Array]:
        return [
            jax.random.key_data(leaf) if is_key else leaf
            for leaf, is_key in zip(jax.tree.leaves(tree), self._is_key, strict=True)
        ]

    def back(self, leaves: list[jax.Array]) -> Any:
        return jax.tree.unflatten(
            self._tree,
            [
                jax.random.wrap_key_data(leaf) if is_key else leaf
                for leaf, is_key in zip(leaves, self._is_key, strict=True)
            ],
        )


def _compile(path: Path, step: Callable, shapes: Any, on_traced: Callable[[], None]) -> Program:
    leaves, names = _Leaves(shapes), []

    def flat(values: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        state, metrics = step(leaves.back(values))
        names[:] = sorted(metrics)
        return leaves.of(state), [metrics[name] for name in names]

    lowered = jit(flat, donate_argnums=0).lower(jax.eval_shape(leaves.of, shapes))
    on_traced()
    found = _HITS.count()
    compiled = lowered.compile()
    if _HITS.count() == found:  # What comes from JAX's cache cannot be serialised again: it lacks its functions.
        _save(path, compiled, names)
    return Program(compiled, shapes, names)


def _save(path: Path, compiled: Any, names: list[str]) -> None:
    """Keep a program; without room or leave to write, do without."""
    part = path.with_suffix(f".{os.getpid()}")
    try:
        content = pickle.dumps((serialize_executable.serialize(compiled), names))
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        part.write_bytes(content)
        part.replace(path)
        newest = sorted(path.parent.glob("*.pkl"), key=lambda p: p.stat().st_mtime, reverse=True)
        for old in newest[KEPT:]:
            old.unlink(missing_ok=True)
    except (OSError, ValueError, TypeError, jax.errors.JaxRuntimeError):
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _load(path: Path, shapes: Any, anew: Callable[[], Program]) -> Program | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    try:
        serialized, names = pickle.loads(content)  # our own file, as JAX's cache is
        program = Program(serialize_executable.deserialize_and_load(*serialized), shapes, names, anew)
        path.touch()
    except Exception:  # cut short, or of a runtime that we cannot name: compile again
        return None
    return program


class _CacheHits:
    """Counts, by thread, what JAX's own cache has answered."""

    def __init__(self):
        self._found = threading.local()
        jax.monitoring.register_event_listener(self._listen)

    def count(self) -> int:
        return getattr(self._found, "count", 0)

    def _listen(self, event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            self._found.count = self.count() + 1


_HITS = _CacheHits()


def _cpu_features() -> str:
    """What compiled code may use of this processor."""
    try:
        flags = re.search(r"^(flags|Features)\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        flags = None
    return flags[2] if flags else platform.processor()
