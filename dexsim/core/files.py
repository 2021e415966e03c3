"""Source files of a package, writing a file whole or not at all, reading TOML within bounds, private folders."""

import contextlib
import fcntl
import os
import re
import secrets
import stat
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_TEMPORARY = ".dexsim-part"
_SMALL = 128 * 1024  # bytes; a hand's calibration has 20,000
_TOML_PARTS = 16  # of a dotted key; the reader's time and memory grow with their square
_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.){0,200}+"|'[^'\n]{0,200}+')"""  # Of longer parts few fit into the file.
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{_TOML_PARTS},}}")


def python_sources(package: Path) -> Iterable[Path]:
    """The Python files below a folder, sorted."""
    return sorted(package.rglob("*.py"))


def write_whole(path: Path, chunks: Iterable[bytes | memoryview]) -> None:
    """Write `chunks` one after another to `path`, and create its folder if needed.

    They go to a temporary file, which is renamed once everything is on the disk. So neither a crash nor
    another program leaves or sees half a file, and an existing file stays until then. Temporary files that a
    killed program left in the folder are removed. A device or a pipe, such as /dev/null, is written into, not replaced;
    a link to a file stays one, and an existing file's mode stays.

    Raises:
      OSError: the file cannot be written; an existing file is untouched.
    """
    if is_device(path):
        with path.open("wb") as file:
            file.writelines(chunks)
        return
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_stale(path.parent)
    handle, temporary = _locked_temporary(path)
    try:
        with os.fdopen(handle, "wb") as file:
            for chunk in chunks:
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
            with contextlib.suppress(FileNotFoundError):  # A new file has the mode of every new file (umask).
                os.chmod(temporary, stat.S_IMODE(os.stat(path).st_mode))
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def is_device(path: Path) -> bool:
    """Whether a device, a pipe or a socket is there: nothing that a file may take the place of."""
    return path.exists() and not path.is_file() and not path.is_dir()


def remove_stale(folder: Path) -> None:
    """Remove the temporary files of `write_whole` whose writer is gone: a writer holds a lock on its file."""
    for path in folder.glob(f".*{_TEMPORARY}"):
        with contextlib.suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # BlockingIOError: somebody is writing
            path.unlink()


def read_bounded(path: Path) -> bytes:
    """Read a small file that anybody may have written, such as a calibration.

    Raises:
      ValueError: larger than 128 KiB.
      OSError: it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(_SMALL + 1)
    if len(data) > _SMALL:
        raise ValueError(f"larger than {_SMALL // 1024} KiB")
    return data


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file that anybody may have written, in bounded time and memory.

    Raises:
      ValueError: too large, keys with too many parts, nested too deep, or no TOML.
      OSError: it cannot be read.
    """
    text = read_bounded(path).decode("utf-8-sig").replace("\r\n", "\n")
    if match := _LONG_KEY.search(text):
        line = text.count("\n", 0, match.start()) + 1
        raise ValueError(f"a key with more than {_TOML_PARTS} parts (at line {line})")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


def temporary_beside(path: Path) -> Path:
    """A hidden name beside `path` for what takes its place once it is whole; another one at each call."""
    return path.with_name(f".{path.name:.200}.{secrets.token_hex(4)}{_TEMPORARY}")


def _locked_temporary(path: Path) -> tuple[int, Path]:
    """An open, locked temporary file beside `path`."""
    while True:
        temporary = temporary_beside(path)
        # What replaces a private file is private from its first byte.
        handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600 if path.exists() else 0o666)
        with contextlib.suppress(OSError):  # A file system without locks.
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with contextlib.suppress(FileNotFoundError):  # Another program took it for stale before it was locked.
            if os.stat(temporary).st_ino == os.fstat(handle).st_ino:
                return handle, temporary
        os.close(handle)


def make_private(folder: Path) -> None:
    """Make a folder (0700) that only this user may write to, or check that an existing one is such a folder.

    Raises:
      PermissionError: it is somebody else's, or others may write to it.
      OSError: it cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    check_private(folder, os.stat(folder))


def check_private(path: Path, status: os.stat_result) -> None:
    """Check owner and mode of a file or folder.

    Raises:
      PermissionError: it is somebody else's, or others may write to it.
    """
    if status.st_uid != os.geteuid():
        raise PermissionError(f"{path} belongs to another user")
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"{path} can be written by others (chmod go-w)")


def read_private(path: Path) -> bytes:
    """Read a file that only this user may have written.

    Raises:
      PermissionError: it is somebody else's, a link, or others may write to it.
      OSError: it cannot be read.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError as error:
        if path.is_symlink():
            raise PermissionError(f"{path} is a link") from error
        raise
    with os.fdopen(handle, "rb") as file:
        check_private(path, os.fstat(file.fileno()))  # of what was opened, not of what may be there by now
        return file.read()
