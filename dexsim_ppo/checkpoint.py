"""The file format of checkpoints and policies.

    offset  size  content
    0       6     magic, b"DEXSIM"
    6       2     format version, little-endian like all integers
    8       8     length of the header, n
    16      32    SHA-256 of bytes 0..15 and the header
    48      n     header: msgpack map with "kind", "task", "library", "content" (what the kind needs),
                  "leaves" (path, dtype, shape, PRNG implementation) and "sha256" of the payload
    48 + n        payload: the leaves' bytes in C order, one after another

Nothing is executed on loading. Any altered, missing or added byte is found by one of the two hashes.
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
FORMAT_VERSION = 1
LIBRARY_VERSION = "0.1.0"
_PREFIX = struct.Struct("<6sHQ32s")
_HASHED_PREFIX = struct.Struct("<6sHQ")


@dataclass(frozen=True)
class Checkpoint:
    """A sound file's content."""

    path: Path
    kind: str
    """`"train"` (a whole `TrainState`), `"reproducer"` (likewise) or `"policy"`."""
    task: str
    content: dict[str, Any]
    """Plain data: configurations, observation layout and the like."""
    leaves: dict[str, Any]
    """Arrays, and typed PRNG keys, by path."""


def save(path: str | Path, *, kind: str, task: str, content: Mapping[str, Any], tree: Any) -> None:
    """Write a pytree of arrays and what describes it.

    The file appears whole or not at all: it is written beside `path`, flushed to disk and renamed.
    """
    leaves, arrays, digest = [], [], hashlib.sha256()
    for tree_path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        prng = ""
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            prng, leaf = str(jax.random.key_impl(leaf)), jax.random.key_data(leaf)
        array = np.asarray(jax.device_get(leaf), order="C")
        arrays.append(array.reshape(-1).view(np.uint8).data)
        digest.update(arrays[-1])
        name = jax.tree_util.keystr(tree_path)
        leaves.append({"path": name, "dtype": array.dtype.name, "shape": list(array.shape), "prng": prng})
    header = msgpack.packb(
        {
            "kind": kind,
            "task": task,
            "library": LIBRARY_VERSION,
            "content": dict(content),
            "leaves": leaves,
            "sha256": digest.digest(),
        }
    )
    prefix = _HASHED_PREFIX.pack(MAGIC, FORMAT_VERSION, len(header))
    write_whole(Path(path), [prefix + hashlib.sha256(prefix + header).digest() + header, *arrays])


def load(path: str | Path, *, kind: str, task: str | None = None) -> Checkpoint:
    """Read and check a file.

    Args:
      kind: what the caller can use, `"train"`, `"reproducer"` or `"policy"`.
      task: the task that the caller works on; None takes any.

    Raises:
      CheckpointError: missing, not of this format, of a newer version, cut short, altered, of another
        kind or of another task.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:  # What does not begin as ours may have no end.
            head = file.read(len(MAGIC))
            data = memoryview(head + file.read() if head == MAGIC else head)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None
    header, payload = _open_envelope(path, data)
    if header["kind"] != kind:
        raise CheckpointError(f"{path}: is a {header['kind']!r} file, not a {kind!r} file")
    if ":" in header["task"]:  # No file may say which module is imported: that is the user's to type.
        raise CheckpointError(f"{path}: invalid task {header['task']!r:.80}")
    if task is not None and header["task"] != task:
        raise CheckpointError(f"{path}: is of the task {header['task']!r}, not {task!r}")
    leaves, offset = {}, 0
    for leaf in header["leaves"]:
        count = math.prod(leaf["shape"])
        array = np.frombuffer(payload, jnp.dtype(leaf["dtype"]), count, offset).reshape(leaf["shape"])
        offset += array.nbytes
        key = leaf["prng"]
        leaves[leaf["path"]] = jax.random.wrap_key_data(jnp.asarray(array), impl=key) if key else array
    return Checkpoint(path, header["kind"], header["task"], header["content"], leaves)


def restore(checkpoint: Checkpoint, like: Tree, *, part: bool = False) -> Tree:
    """The loaded leaves in the shape of `like`, a pytree of arrays or of `jax.ShapeDtypeStruct`s.

    With `part`, `like` may lack some of them.

    Raises:
      CheckpointError: a leaf is missing, left over, or of another shape or type; names it.
    """
    expected, structure = jax.tree_util.tree_flatten_with_path(like)
    paths, leaves = [jax.tree_util.keystr(tree_path) for tree_path, _ in expected], checkpoint.leaves
    where = f"{checkpoint.path}: does not fit this configuration"
    for name in paths if part else (*paths, *leaves):
        if (name in leaves) != (name in paths):
            raise CheckpointError(f"{where}: {name} is {'not expected' if name in leaves else 'missing'}")
    for name, (_, leaf) in zip(paths, expected, strict=True):
        got = leaves[name]
        if got.shape != leaf.shape or got.dtype != leaf.dtype:
            raise CheckpointError(
                f"{where}: {name}: expected {leaf.dtype}{list(leaf.shape)}, got {got.dtype}{list(got.shape)}"
            )
    return jax.tree_util.tree_unflatten(structure, [leaves[name] for name in paths])


def _open_envelope(path: Path, data: memoryview) -> tuple[dict[str, Any], memoryview]:
    """Header and payload of a file whose hashes are right."""
    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise CheckpointError(f"{path}: is not a dexsim checkpoint or policy")
    if len(data) < _PREFIX.size:
        raise CheckpointError(f"{path}: is cut short")
    _, version, size, digest = _PREFIX.unpack(data[: _PREFIX.size])
    if version > FORMAT_VERSION:
        raise CheckpointError(f"{path}: has format version {version}, newer than {FORMAT_VERSION}: update dexsim")
    packed, payload = data[_PREFIX.size : _PREFIX.size + size], data[_PREFIX.size + size :]
    if hashlib.sha256(bytes(data[: _HASHED_PREFIX.size]) + packed).digest() != digest:
        raise CheckpointError(f"{path}: is cut short or damaged (the header's checksum is wrong)")
    header = msgpack.unpackb(packed)
    if hashlib.sha256(payload).digest() != header["sha256"]:
        raise CheckpointError(f"{path}: is cut short or damaged (the arrays' checksum is wrong)")
    return header, payload
