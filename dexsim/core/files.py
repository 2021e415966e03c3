"""Source files of a package, and writing a file whole or not at all."""

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path


def python_sources(package: Path) -> Iterable[Path]:
    """The Python files below a folder, sorted."""
    return sorted(package.rglob("*.py"))


def write_whole(path: Path, chunks: Iterable[bytes | memoryview]) -> None:
    """Write `chunks` one after another to `path`, and create its folder if needed.

    They go to a temporary file, which is renamed once everything is on the disk. So neither a crash nor
    another program leaves or sees half a file, and an existing file stays until then.

    Raises:
      OSError: the file cannot be written; an existing file is untouched.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            for chunk in chunks:
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
