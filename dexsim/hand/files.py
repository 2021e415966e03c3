"""The files of a hand: found by a path or a shipped hand's name, and their hash."""

import contextlib
import hashlib
import re
from pathlib import Path

from dexsim.core.assets import asset_path
from dexsim.core.errors import AssetError

DEFAULT = "xhand_right"


def find_hand(name: str | Path | None) -> Path:
    """The TOML of a hand that is named by a path, or by the name of a shipped one; None for the default one."""
    if not name:
        return asset_path(f"hand/{DEFAULT}.toml")
    text = str(name)
    if re.fullmatch(r"\w+", text) and not Path(text).is_file():  # a folder of that name is no hand
        for place in (f"hand/{text}.toml", f"hand/{text}/{text}.toml"):
            with contextlib.suppress(AssetError):
                return asset_path(place)
        what = "a folder" if Path(text).is_dir() else "no such file"
        raise AssetError(f"hand {text!r}: {what}, and no shipped hand has that name")
    return Path(text)


def shipped_name(path: Path) -> str:
    """The name of the shipped hand whose TOML this is; empty for others."""
    with contextlib.suppress(AssetError):
        return path.stem if path.resolve() == find_hand(path.stem).resolve() else ""
    return ""


def digest_of(*files: Path) -> str:
    """A hash of the content of a hand's files."""
    digest = hashlib.sha256()
    for path in files:
        data = path.read_bytes()
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()
