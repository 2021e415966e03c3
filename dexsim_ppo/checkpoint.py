"""Files of pytrees with what describes them: checkpoints and policies, in the format of `dexsim_ppo.portable`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import msgpack
import numpy as np

from dexsim.core.files import write_atomic
from dexsim.errors import CheckpointError
from dexsim_ppo.portable import FORMAT_VERSION, MAGIC, PREFIX, digest, read_file

Tree = TypeVar("Tree")


@dataclass(frozen=True)
class Checkpoint:
    """A sound file's content."""

    path: Path
    task: str
    content: dict[str, Any]  # plain data: configurations, observation layout and the like
    leaves: dict[str, Any]  # arrays, and typed PRNG keys, by path


def save(path: str | Path, *, kind: str, task: str, content: Mapping[str, Any], tree: Any) -> None:
    """Write a pytree of arrays and what describes it, whole or not at all; `kind` is `"policy"` or, for a whole
    `TrainState`, `"train"`."""
    leaves, parts = [], []
    for tree_path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        prng = ""
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            prng, leaf = str(jax.random.key_impl(leaf)), jax.random.key_data(leaf)
        array = np.asarray(jax.device_get(leaf), order="C")
        parts.append(array.reshape(-1).view(np.uint8).data)
        name = jax.tree_util.keystr(tree_path)
        leaves.append({"path": name, "dtype": array.dtype.name, "shape": list(array.shape), "prng": prng})
    header = msgpack.packb({"kind": kind, "task": task, "content": dict(content), "leaves": leaves})
    prefix = PREFIX.pack(MAGIC, FORMAT_VERSION, len(header))
    write_atomic(Path(path), [prefix, digest(prefix, header, *parts), header, *parts])


def load(path: str | Path, *, kind: str, task: str | None = None) -> Checkpoint:
    """Read and check a file of this kind, `"train"` or `"policy"`, and task; None takes any task. Raises
    CheckpointError: missing, not of this format or version, cut short, altered, of another kind or of another task."""
    try:
        header, leaves = read_file(path, kind)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from None
    if ":" in header["task"]:  # No file may say which module is imported: that is the user's to type.
        raise CheckpointError(f"{path}: invalid task {header['task']!r:.80}")
    if task is not None and header["task"] != task:
        raise CheckpointError(f"{path}: is of the task {header['task']!r}, not {task!r}")
    for leaf in header["leaves"]:
        if leaf["prng"]:
            leaves[leaf["path"]] = jax.random.wrap_key_data(jnp.asarray(leaves[leaf["path"]]), impl=leaf["prng"])
    return Checkpoint(Path(path), header["task"], header["content"], leaves)


def restore(checkpoint: Checkpoint, like: Tree) -> Tree:
    """The leaves in the shape of `like`, arrays or `jax.ShapeDtypeStruct`s. Raises CheckpointError with the name of a
    leaf that is missing, left over, or of another shape or type."""
    paths, structure = jax.tree_util.tree_flatten_with_path(like)
    expected = {jax.tree_util.keystr(path): leaf for path, leaf in paths}
    kind = lambda leaf: "nothing" if leaf is None else f"{leaf.dtype}{list(leaf.shape)}"  # noqa: E731
    for name in expected.keys() | checkpoint.leaves.keys():
        needed, got = (kind(leaves.get(name)) for leaves in (expected, checkpoint.leaves))
        if needed != got:
            where = f"{checkpoint.path}: does not fit this configuration"
            raise CheckpointError(f"{where}: {name}: expected {needed}, got {got}")
    return jax.tree_util.tree_unflatten(structure, [checkpoint.leaves[name] for name in expected])
