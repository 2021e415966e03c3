"""The files of a hand: found by a path or a shipped hand's name, and their hash."""

import hashlib
import re
from pathlib import Path

from dexsim.core.assets import asset_path
from dexsim.core.errors import AssetError

DEFAULT = "xhand_right"


def find_hand(name: str | Path | None) -> Path:
    """The TOML of a hand that is named by a path, or by the name of a shipped one; None for the default one."""
    text = str(name or DEFAULT)
    if re.fullmatch(r"\w+", text) and not Path(text).exists():
        try:
            return asset_path(f"hand/{text}.toml")
        except AssetError:
            raise AssetError(f"hand {text!r}: no such file, and no shipped hand has that name") from None
    return Path(text)


def digest_of(*files: Path) -> str:
    """A hash of the content of a hand's files, and of the files that its MJCF includes."""
    digest = hashlib.sha256()
    for path in files:
        data = path.read_bytes()
        digest.update(len(data).to_bytes(8, "little") + data)
        if path.suffix == ".xml":
            for name in re.findall(rb'<include\s+file\s*=\s*"([^"]+)"', data):
                included = path.parent / name.decode(errors="replace")
                digest.update(included.read_bytes() if included.is_file() else b"")
    return digest.hexdigest()
