"""Paths: the files of `assets/` (beside the packages in a checkout, inside `dexsim` when installed), and the cache."""

import os
from pathlib import Path

from dexsim.core.errors import AssetError

_PACKAGE = Path(__file__).resolve().parents[1]


def assets_root() -> Path:
    """The folder that holds `hand/`, `policies/` and the other assets.

    Raises:
      AssetError: neither a checkout nor an installed copy with assets.
    """
    for root in (_PACKAGE / "_assets", _PACKAGE.parent / "assets"):
        if root.is_dir():
            return root.resolve()
    raise AssetError(f"no assets found in {_PACKAGE / '_assets'} or {_PACKAGE.parent / 'assets'}: install dexsim again")


def asset_path(name: str) -> Path:
    """Absolute path of an asset, from its name relative to `assets/`.

    Args:
      name: such as `"hand/xhand_right.xml"`; folders are allowed.

    Raises:
      AssetError: the name leads outside of `assets/`, or there is no such file.
    """
    root = assets_root()
    path = (root / name).resolve()
    if not path.is_relative_to(root):
        raise AssetError(f"asset {name!r} lies outside of {root}")
    if not path.exists():
        raise AssetError(f"no asset {name!r} in {root}")
    return path


def cache_path(name: str) -> Path:
    """The cache folder `name`, in `$DEXSIM_CACHE` or else `~/.cache/dexsim`. It may not exist yet.

    Everything in it can be deleted at any time and is then made again.
    """
    root = os.environ.get("DEXSIM_CACHE")
    return (Path(root) if root else Path.home() / ".cache" / "dexsim") / name
