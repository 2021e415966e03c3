"""The file format of checkpoints and policies, and how a file that is not sound is turned away.

    offset  size  content
    0       6     magic, b"DEXSIM"
    6       2     format version, little-endian like all integers
    8       8     length of the header, n
    16      32    SHA-256 of bytes 0..15 and the header
    48      n     header: msgpack map with "kind", "task", "library", "content" (what the kind needs),
                  "leaves" (path, dtype, shape, PRNG implementation) and "sha256" of the payload
    48 + n        payload: the leaves' bytes in C order, one after another

Nothing is executed on loading, and no array is made before its shape, dtype and size have been checked
against the file's true length. Any altered, missing or added byte is found by one of the two hashes.
"""

import hashlib
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import msgpack
import numpy as np

from dexsim.core.errors import CheckpointError
from dexsim.core.files import write_whole
from dexsim_ppo.retired import migrate_leaves

Tree = TypeVar("Tree")

MAGIC = b"DEXSIM"
FORMAT_VERSION = 1
LIBRARY_VERSION = "0.1.0"
_DEPTH = 100  # of what a file says; an average of averages adds two
_DIMENSIONS = 16  # of an array; ours have four at most, and NumPy's limit is 64
_PREFIX = struct.Struct("<6sHQ32s")
_HASHED_PREFIX = struct.Struct("<6sHQ")
_DTYPES = (
    "bool",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
    "float16",
    "bfloat16",
    "float32",
    "float64",
)


@dataclass(frozen=True)
class Checkpoint:
    """A sound file's content."""

    path: Path
    kind: str
    """`"train"` (a whole `TrainState`) or `"policy"`."""
    task: str
    library: str
    """Version of dexsim that wrote it."""
    content: dict[str, Any]
    """Plain data: configurations, observation layout and the like."""
    leaves: dict[str, Any]
    """Arrays, and typed PRNG keys, by path."""


def save(path: str | Path, *, kind: str, task: str, content: Mapping[str, Any], tree: Any) -> None:
    """Write a pytree of arrays and what describes it.

    The file appears whole or not at all: it is written beside `path`, flushed to disk and renamed.
    """
    leaves, arrays = [], []
    for tree_path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        prng = ""
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            prng, leaf = str(jax.random.key_impl(leaf)), jax.random.key_data(leaf)
        array = np.asarray(jax.device_get(leaf))
        arrays.append(array if array.flags.c_contiguous else array.copy(order="C"))
        leaves.append(
            {
                "path": jax.tree_util.keystr(tree_path),
                "dtype": array.dtype.name,
                "shape": list(array.shape),
                "prng": prng,
            }
        )
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(_bytes(array))
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
    head = prefix + hashlib.sha256(prefix + header).digest() + header
    write_whole(Path(path), [head, *map(_bytes, arrays)])


def load(path: str | Path, *, kind: str, task: str | None = None) -> Checkpoint:
    """Read and check a file.

    Args:
      kind: what the caller can use, `"train"` or `"policy"`.
      task: the task that the caller works on; None takes any.

    Raises:
      CheckpointError: missing, not of this format, of a newer version, cut short, altered, of another
        kind or of another task.
    """
    path = Path(path)
    try:
        data = memoryview(_read(path))
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None
    header, payload = _open_envelope(path, data)
    if header["kind"] != kind:
        raise CheckpointError(f"{path}: is a {header['kind']!r} file, not a {kind!r} file")
    if task is not None and header["task"] != task:
        raise CheckpointError(f"{path}: is of the task {header['task']!r}, not {task!r}")
    return Checkpoint(
        path,
        header["kind"],
        header["task"],
        header["library"],
        header["content"],
        _read_leaves(path, header["leaves"], payload),
    )


def check_content(file: Checkpoint, kinds: Mapping[str, Any]) -> None:
    """Check a file's content before it is used.

    Args:
      kinds: the type of each value that it must have; of a mapping, those of its values.

    Raises:
      CheckpointError: something is missing or of another type; names it.
    """

    def check(found: dict[str, Any], kinds: Mapping[str, Any], above: str) -> None:
        for name, kind in kinds.items():
            value, inside = found.get(name), isinstance(kind, Mapping)
            if not isinstance(value, dict if inside else kind) or isinstance(value, bool):
                raise CheckpointError(f"{file.path}: is no sound {file.kind!r} file: {above}{name} = {value!r:.80}")
            if inside:
                check(cast(dict, value), kind, f"{above}{name}.")

    check(file.content, kinds, "")


def restore(checkpoint: Checkpoint, like: Tree, *, part: bool = False) -> Tree:
    """The loaded leaves in the shape of `like`, a pytree of arrays or of `jax.ShapeDtypeStruct`s.

    Leaves of older versions go where today's are (`dexsim_ppo.retired`). With `part`, `like` may lack some of them.

    Raises:
      CheckpointError: a leaf is missing, left over, or of another shape or type; names it.
    """
    wanted, structure = jax.tree_util.tree_flatten_with_path(like)
    paths = [jax.tree_util.keystr(tree_path) for tree_path, _ in wanted]
    leaves = migrate_leaves(checkpoint.leaves, set(paths))
    for name in paths if part else (*paths, *leaves):
        if (name in leaves) != (name in set(paths)):
            raise CheckpointError(
                f"{checkpoint.path}: does not fit this configuration: {name} is "
                f"{'not expected' if name in leaves else 'missing'}"
            )
    for name, (_, leaf) in zip(paths, wanted, strict=True):
        found = leaves[name]
        if found.shape != leaf.shape or found.dtype != leaf.dtype:
            raise CheckpointError(
                f"{checkpoint.path}: does not fit this configuration: {name} is "
                f"{found.dtype}{list(found.shape)}, expected {leaf.dtype}{list(leaf.shape)}"
            )
    return jax.tree_util.tree_unflatten(structure, [leaves[name] for name in paths])


def _bytes(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _read(path: Path) -> bytes:
    """The whole file if it begins as ours do; else its beginning, since what is not ours may have no end."""
    with path.open("rb") as file:
        head = file.read(len(MAGIC))
        return head + file.read() if head == MAGIC else head


def _open_envelope(path: Path, data: memoryview) -> tuple[dict[str, Any], memoryview]:
    """Header and payload of a file whose hashes are right."""
    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise CheckpointError(f"{path}: is not a dexsim checkpoint or policy")
    if len(data) < _PREFIX.size:
        raise CheckpointError(f"{path}: is cut short")
    _, version, header_size, digest = _PREFIX.unpack(data[: _PREFIX.size])
    if version > FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: has format version {version}, and this dexsim reads up to {FORMAT_VERSION}: update dexsim"
        )
    if header_size > len(data) - _PREFIX.size:
        raise CheckpointError(f"{path}: is cut short")
    header_bytes = data[_PREFIX.size : _PREFIX.size + header_size]
    if hashlib.sha256(bytes(data[: _HASHED_PREFIX.size]) + header_bytes).digest() != digest:
        raise CheckpointError(f"{path}: is damaged (the header's checksum is wrong)")
    try:
        header = msgpack.unpackb(header_bytes)
        size = sum(_leaf_size(leaf) for leaf in header["leaves"])
        for name, kind in (("kind", str), ("task", str), ("library", str), ("content", dict), ("sha256", bytes)):
            if not isinstance(header[name], kind):
                raise TypeError(f"{name} is not a {kind.__name__}")
        if ":" in header["task"]:  # Which module is imported, and which function is called, is for the user to say.
            raise ValueError(f"task = {header['task']!r:.80}: must be a word")
        _check_plain(header["content"])
    except Exception as error:  # Hashed, so a faulty writer rather than damage.
        raise CheckpointError(f"{path}: has a header that makes no sense ({error})") from None
    payload = data[_PREFIX.size + header_size :]
    if len(payload) != size:
        raise CheckpointError(
            f"{path}: is {'cut short' if len(payload) < size else 'too long'}: "
            f"{len(payload)} bytes of arrays, expected {size}"
        )
    if hashlib.sha256(payload).digest() != header["sha256"]:
        raise CheckpointError(f"{path}: is damaged (the arrays' checksum is wrong)")
    return header, payload


def _check_plain(value: Any, depth: int = 0) -> None:
    """Raises TypeError, ValueError: it has what JSON has not, such as bytes, or is nested too deep to walk."""
    if depth > _DEPTH:
        raise ValueError("its content is nested too deep")
    if isinstance(value, dict | list):
        for item in (*value, *value.values()) if isinstance(value, dict) else value:
            _check_plain(item, depth + 1)
    elif not isinstance(value, str | int | float | None):
        raise TypeError(f"its content holds {type(value).__name__}")


def _leaf_size(leaf: dict[str, Any]) -> int:
    shape, dtype = leaf["shape"], leaf["dtype"]
    if dtype not in _DTYPES or not isinstance(leaf["path"], str) or not isinstance(leaf["prng"], str):
        raise ValueError(f"leaf {str(leaf):.100}")
    if not isinstance(shape, list) or len(shape) > _DIMENSIONS:
        raise ValueError(f"shape {str(shape):.100}")
    if not all(type(n) is int and 0 <= n < 2**40 for n in shape):
        raise ValueError(f"shape {str(shape):.100}")
    return math.prod(shape) * jnp.dtype(dtype).itemsize


def _read_leaves(path: Path, specs: list[dict[str, Any]], payload: memoryview) -> dict[str, Any]:
    leaves, offset = {}, 0
    for spec in specs:
        dtype = jnp.dtype(spec["dtype"])
        count = math.prod(spec["shape"])
        try:  # Without elements there is nothing to read, and NumPy bounds the product of the other dimensions.
            flat = np.frombuffer(payload, dtype, count, offset) if count else np.zeros(0, dtype)
            array = flat.reshape(spec["shape"])
        except ValueError as error:
            raise CheckpointError(f"{path}: {spec['path']} has an impossible shape ({error})") from None
        offset += array.nbytes
        try:
            leaves[spec["path"]] = (
                jax.random.wrap_key_data(jnp.asarray(array), impl=spec["prng"]) if spec["prng"] else array
            )
        except Exception as error:
            raise CheckpointError(f"{path}: {spec['path']} is no PRNG key ({error})") from None
    return leaves
