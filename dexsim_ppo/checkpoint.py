"""The file format of checkpoints and policies.

    offset  size  content
    0       6     magic, b"DEXSIM"
    6       2     format version, little-endian like all integers
    8       8     length of the header, n
    16      32    SHA-256 of all other bytes
    48      n     header: msgpack map with "kind", "task", "content" (what the kind needs) and
                  "leaves" (path, dtype, shape, PRNG implementation)
    48 + n        payload: the leaves' bytes in C order, one after another

Nothing is executed on loading.
"""

import hashlib
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import msgpack
import numpy as np

from dexsim.core.errors import CheckpointError
from dexsim.core.files import write_whole

Tree = TypeVar("Tree")

MAGIC = b"DEXSIM"
FORMAT_VERSION = 2
_PREFIX = struct.Struct("<6sHQ")
_START = _PREFIX.size + hashlib.sha256().digest_size


@dataclass(frozen=True)
class Checkpoint:
    """A sound file's content."""

    path: Path
    kind: str
    """`"train"` (a whole `TrainState`) or `"policy"`."""
    task: str
    content: dict[str, Any]
    """Plain data: configurations, observation layout and the like."""
    leaves: dict[str, Any]
    """Arrays, and typed PRNG keys, by path."""


def save(path: str | Path, *, kind: str, task: str, content: Mapping[str, Any], tree: Any) -> None:
    """Write a pytree of arrays and what describes it, whole or not at all."""
    leaves, arrays = [], []
    for tree_path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        prng = ""
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            prng, leaf = str(jax.random.key_impl(leaf)), jax.random.key_data(leaf)
        array = np.asarray(jax.device_get(leaf), order="C")
        arrays.append(array.reshape(-1).view(np.uint8).data)
        name = jax.tree_util.keystr(tree_path)
        leaves.append({"path": name, "dtype": array.dtype.name, "shape": list(array.shape), "prng": prng})
    header = msgpack.packb({"kind": kind, "task": task, "content": dict(content), "leaves": leaves})
    prefix = _PREFIX.pack(MAGIC, FORMAT_VERSION, len(header))
    digest = hashlib.sha256(prefix + header)
    for part in arrays:
        digest.update(part)
    write_whole(Path(path), [prefix + digest.digest() + header, *arrays])


def load(path: str | Path, *, kind: str, task: str | None = None) -> Checkpoint:
    """Read and check a file.

    Args:
      kind: what the caller can use, `"train"` or `"policy"`.
      task: the task that the caller works on; None takes any.

    Raises:
      CheckpointError: missing, not of this format or version, cut short, altered, of another kind or of another task.
    """
    path = Path(path)
    try:
        data = memoryview(path.read_bytes())
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None
    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise CheckpointError(f"{path}: is not a dexsim checkpoint or policy")
    if len(data) < _START:
        raise CheckpointError(f"{path}: is cut short")
    _, version, size = _PREFIX.unpack_from(data)
    if version != FORMAT_VERSION:
        raise CheckpointError(f"{path}: has format version {version}, this dexsim reads {FORMAT_VERSION}")
    digest = hashlib.sha256(data[: _PREFIX.size])
    digest.update(data[_START:])
    if digest.digest() != bytes(data[_PREFIX.size : _START]):
        raise CheckpointError(f"{path}: is cut short or damaged (its checksum is wrong)")
    header = msgpack.unpackb(data[_START : _START + size])
    if header["kind"] != kind:
        raise CheckpointError(f"{path}: is a {header['kind']!r} file, not a {kind!r} file")
    if ":" in header["task"]:  # No file may say which module is imported: that is the user's to type.
        raise CheckpointError(f"{path}: invalid task {header['task']!r:.80}")
    if task is not None and header["task"] != task:
        raise CheckpointError(f"{path}: is of the task {header['task']!r}, not {task!r}")
    leaves, offset = {}, _START + size
    for leaf in header["leaves"]:
        count = math.prod(leaf["shape"])
        array = np.frombuffer(data, jnp.dtype(leaf["dtype"]), count, offset).reshape(leaf["shape"])
        offset += array.nbytes
        key = leaf["prng"]
        leaves[leaf["path"]] = jax.random.wrap_key_data(jnp.asarray(array), impl=key) if key else array
    return Checkpoint(path, header["kind"], header["task"], header["content"], leaves)


def restore(checkpoint: Checkpoint, like: Tree, prefix: str = "") -> Tree:
    """The leaves whose paths begin with `prefix` in the shape of `like`, arrays or `jax.ShapeDtypeStruct`s.

    Raises:
      CheckpointError: a leaf is missing, left over, or of another shape or type; names it.
    """
    paths, structure = jax.tree_util.tree_flatten_with_path(like)
    expected = {prefix + jax.tree_util.keystr(path): leaf for path, leaf in paths}
    leaves = {name: leaf for name, leaf in checkpoint.leaves.items() if name.startswith(prefix)}
    where = f"{checkpoint.path}: does not fit this configuration"
    for name in (*expected, *leaves):
        if (name in leaves) != (name in expected):
            raise CheckpointError(f"{where}: {name} is {'not expected' if name in leaves else 'missing'}")
    for name, leaf in expected.items():
        got = leaves[name]
        if got.shape != leaf.shape or got.dtype != leaf.dtype:
            raise CheckpointError(
                f"{where}: {name}: expected {leaf.dtype}{list(leaf.shape)}, got {got.dtype}{list(got.shape)}"
            )
    return jax.tree_util.tree_unflatten(structure, [leaves[name] for name in expected])
