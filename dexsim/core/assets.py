"""Paths: the files of `assets/` (beside the packages in a checkout, inside `dexsim` when installed), and the cache."""

import contextlib
import hashlib
import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.files import write_atomic
from dexsim.errors import AssetError

_PACKAGE = Path(__file__).resolve().parents[1]


def asset_path(name: str) -> Path:
    """Absolute path of an asset, from its name relative to `assets/`, such as `"hand/xhand_right.xml"`. Raises
    AssetError: there is no such file or folder."""
    installed = _PACKAGE / "_assets"
    root = installed if installed.is_dir() else _PACKAGE.parent / "assets"
    if not (root / name).exists():
        raise AssetError(f"no asset {name!r} in {root}")
    return root / name


def cache_path(name: str) -> Path:
    """The cache folder `name`, in `$DEXSIM_CACHE` or else `~/.cache/dexsim`. It may not exist yet.

    Everything in it can be deleted at any time and is then made again.
    """
    root = os.environ.get("DEXSIM_CACHE")
    return (Path(root) if root else Path.home() / ".cache" / "dexsim") / name


def cached_arrays(folder: str, key: str, make: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
    """Arrays by name that `make` computes the first time, and a file in this folder of the cache has afterwards; `key`
    says all that they depend on."""
    path = cache_path(folder) / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.npz"
    try:
        with np.load(path) as file:
            return dict(file)
    except Exception:  # missing, damaged, or of an older program: make it anew
        arrays = make()
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    with contextlib.suppress(OSError):  # a cache that cannot be written is no error
        write_atomic(path, [buffer.getbuffer()])
    return arrays
