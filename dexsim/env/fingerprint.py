"""What an environment's compiled program depends on, as one hash."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dexsim.core.config import to_dict
from dexsim.core.files import python_sources

_PACKAGE = Path(__file__).resolve().parents[1]


def fingerprint(env: Any) -> str | None:
    """A hash that changes with the environment's settings, hand, start states and this package's sources.

    None where that is not all of it: a task of the user's own, whose sources may be anywhere, and meshes.
    """
    parts = (env, getattr(env, "task", None))
    ours = all(type(part).__module__.partition(".")[0] == "dexsim" for part in parts)
    if not ours or env.config.objects.mesh:
        return None
    digest = hashlib.sha256(json.dumps([env.name, env.backend, to_dict(env.config)]).encode())
    for path in (*python_sources(_PACKAGE), env.hand.model_path):
        digest.update(path.read_bytes())
    for leaf in jax.tree.leaves(env.pool):
        digest.update(np.ascontiguousarray(leaf).data)
    _add(digest, env.hand)
    return digest.hexdigest()


def _add(digest: Any, value: Any) -> None:
    """Hash a description such as `Hand`, all that was read from its TOML: every field with its name and type."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            digest.update(field.name.encode())
            _add(digest, getattr(value, field.name))
    elif isinstance(value, tuple):
        digest.update(f"{len(value)} values".encode())
        for item in value:
            _add(digest, item)
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value).data)
    else:
        digest.update(repr(value).encode())
