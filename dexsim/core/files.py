"""Writing a file whole or not at all, and reading a TOML."""

import contextlib
import os
import secrets
import stat
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def write_atomic(path: Path, chunks: Iterable[bytes | memoryview]) -> None:
    """Write `chunks` one after another to `path`, and create its folder if needed.

    They go to a temporary file beside it, which is renamed once everything is on the disk. So neither a crash nor
    another program leaves or sees half a file, and an existing file stays until then. A device or a pipe, such as
    /dev/null, is written into, not replaced; a link to a file stays one, and an existing file's mode stays. Raises
    OSError, which names the file: it cannot be written; an existing file is untouched.
    """
    if is_device(path):
        with path.open("wb") as file:
            file.writelines(chunks)
        return
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_beside(path)
    # What replaces a private file is private from its first byte.
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if path.exists() else 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            file.writelines(chunks)
            file.flush()
            os.fsync(file.fileno())
            with contextlib.suppress(FileNotFoundError):  # A new file has the mode of every new file (umask).
                os.chmod(temporary, stat.S_IMODE(os.stat(path).st_mode))
            os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = error.filename or str(path)  # nothing is named where the disk is full
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def is_device(path: Path) -> bool:
    """Whether a device, a pipe or a socket is there: nothing that a file may take the place of."""
    return path.exists() and not path.is_file() and not path.is_dir()


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file, with or without a byte order mark. ValueError: no TOML. OSError: it cannot be read."""
    return tomllib.loads(path.read_text(encoding="utf-8-sig"))


def temporary_beside(path: Path) -> Path:
    """A hidden name beside `path` for what takes its place once it is whole; another one at each call."""
    return path.with_name(f".{path.name:.200}.{secrets.token_hex(4)}.dexsim-part")
