"""A cache of compiled training steps, so that a second run skips tracing as well.

JAX's own cache needs a traced and lowered program to look up, and for a training step that takes longer than
loading the compiled one. This cache looks up a hash of everything that tracing depends on (`key`).

Its files are pickles of compiled code: whoever can write one can run code here. So only files and a folder that belong
to this user, and that nobody else may write to, are used.
"""

import functools
import hashlib
import json
import os
import pickle
import platform
import re
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import jax
import jax.monitoring
import jax.numpy as jnp
from jax.experimental import serialize_executable

from dexsim.core.assets import cache_path
from dexsim.core.cli import environment_report
from dexsim.core.compilation import jit
from dexsim.core.errors import DexsimWarning
from dexsim.core.files import make_private, python_sources, read_private, write_whole

KEPT = 8  # newest programs, about 10 MB each
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
    """A compiled `step(state) -> (state, metrics)`. The state may hold typed random keys."""

    def __init__(
        self, compiled: Callable, like: Any, names: list[str], fallback: Callable[[], "Program"] | None = None
    ):
        """`fallback` compiles the program again if a cached one does not run."""
        self._compiled, self._names, self._fallback = compiled, names, fallback
        self._leaves = _Leaves(like)

    def memory_analysis(self) -> Any:
        """What the compiled program needs, in bytes; None where the runtime does not say."""
        try:
            return cast(Any, self._compiled).memory_analysis()
        except (AttributeError, NotImplementedError, jax.errors.JaxRuntimeError):
            return None

    def __call__(self, state: Any) -> tuple[Any, dict[str, jax.Array]]:
        leaves = self._leaves.of(state)
        if self._fallback:
            try:  # on a copy, since the program donates its arguments
                done = jax.block_until_ready(self._compiled([jnp.copy(leaf) for leaf in leaves]))
            except jax.errors.JaxRuntimeError:
                program = self._fallback()
                self._compiled, self._names = program._compiled, program._names
                done = self._compiled(leaves)
            self._fallback = None
        else:
            done = self._compiled(leaves)
        return self._leaves.back(done[0]), dict(zip(self._names, done[1], strict=True))


def compile_step(
    step: Callable, shapes: Any, identity: Any, on_traced: Callable[[], None], backend: str = "jax"
) -> Callable:
    """Compile a training step, or load it from the cache.

    Args:
      step: state to (state, metrics), not yet compiled; the compiled step donates the state.
      shapes: the state's shapes.
      identity: JSON data that identifies the program; None to cache nothing.
      on_traced: called after tracing, if the program had to be traced.
      backend: of the physics in it.
    """
    if identity is None or jax.default_backend() != "cpu":  # Warp's kernels are not part of the program.
        lowered = jit(step, backend=backend, donate_argnums=0).lower(shapes)
        on_traced()
        return lowered.compile()
    path = cache_path("programs") / f"{key(identity, shapes)}.pkl"
    compile_again = functools.partial(_compile, path, step, shapes, on_traced, backend)
    return _load(path, shapes, compile_again) or compile_again()


def key(identity: Any, shapes: Any) -> str:
    """A program's hash: its identity, this package's sources, versions, machine and JAX options."""
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
    """Converts a tree to a list of plain arrays and back. Compiled programs over such lists can be pickled."""

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


def _compile(path: Path, step: Callable, shapes: Any, on_traced: Callable[[], None], backend: str) -> Program:
    leaves = _Leaves(shapes)
    names: list[str] = []

    def flat(values: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        state, metrics = step(leaves.back(values))
        names[:] = sorted(metrics)
        return leaves.of(state), [metrics[name] for name in names]

    lowered = jit(flat, backend=backend, donate_argnums=0).lower(jax.eval_shape(leaves.of, shapes))
    on_traced()
    found = _HITS.count()
    compiled = lowered.compile()
    if _HITS.count() == found:  # A program from JAX's cache lacks its functions and cannot be serialised.
        _save(path, compiled, names)
    return Program(compiled, shapes, names)


def _save(path: Path, compiled: Any, names: list[str]) -> None:
    """Cache a program, if the disk has room and may be written to."""
    try:
        make_private(path.parent)
        write_whole(path, [pickle.dumps((serialize_executable.serialize(compiled), names))])
        newest = sorted(path.parent.glob("*.pkl"), key=lambda p: p.stat().st_mtime, reverse=True)
        for old in newest[KEPT:]:
            old.unlink(missing_ok=True)
    except (OSError, ValueError, TypeError, jax.errors.JaxRuntimeError):  # `_load` has said who else may write there
        return


def _load(path: Path, shapes: Any, compile_again: Callable[[], Program]) -> Program | None:
    try:
        make_private(path.parent)
        content = read_private(path)
    except PermissionError as error:
        warnings.warn(f"compiled programs are not cached: {error}", DexsimWarning, stacklevel=2)
        return None
    except OSError:
        return None
    try:
        serialized, names = pickle.loads(content)  # our own file: see above
        program = Program(serialize_executable.deserialize_and_load(*serialized), shapes, names, compile_again)
        path.touch()
    except Exception:  # truncated, or of another runtime: compile again
        return None
    return program


class _CacheHits:
    """Counts the hits of JAX's own cache per thread."""

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
    """The processor's instruction sets."""
    try:
        flags = re.search(r"^(flags|Features)\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        flags = None
    return flags[2] if flags else platform.processor()
