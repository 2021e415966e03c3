"""What the commands share: options from dataclasses, one-line errors, compilation caches."""

import contextlib
import errno
import importlib.metadata
import json
import math
import os
import platform
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from dexsim.core.assets import cache_path
from dexsim.core.files import is_device, write_atomic
from dexsim.core.install import DISTRIBUTION
from dexsim.core.lazy_loading import restore_interrupt
from dexsim.errors import ConfigError, DexsimError, DexsimWarning

T = TypeVar("T")


def run(main: Callable[[Sequence[str] | None], int]) -> None:
    """Run a command and exit: 2 and one line on standard error for whatever the user can mend."""
    warnings.showwarning = _show_warning
    restore_interrupt()
    try:
        code = main(None)
    except DexsimError as error:
        page = f" ({error.page} helps)" if error.page else ""
        print(f"error: {' '.join(str(error).split())}{page}", file=sys.stderr)
        code = 2
    except BrokenPipeError:  # The reader of a pipe, such as `head`, has seen enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 141
    except OSError as error:  # A file, a folder or a disk.
        where = f"{error.filename}: " if error.filename else ""
        print(f"error: {where}{error.strerror or error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)


def _show_warning(message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
    """Our own warnings as one line; others as Python has them."""
    if issubclass(category, DexsimWarning):
        print(f"warning: {message}", file=sys.stderr)
    else:
        sys.stderr.write(warnings.formatwarning(message, category, *place[:2]))


def parse(
    cls: type[T],
    argv: Sequence[str] | None,
    *,
    prog: str = "",
    description: str | None = None,
    default: T | None = None,
) -> T:
    """Parse options into a dataclass with tyro, which handles `--help` and invalid values; None: this process's `argv`.
    By default the command is the class's module, and described by the class's docstring. Raises ConfigError: a value is
    out of range; names the option's class and field."""
    import tyro

    kwargs: dict[str, Any] = {} if default is None else {"default": default}
    if not prog:
        module: Any = sys.modules[cls.__module__]  # by its own name where it is run as a command
        prog = f"python -m {module.__spec__.name.removesuffix('.__main__')}"
    return tyro.cli(cls, args=argv, prog=prog, description=description, **kwargs)


def announce_loading() -> None:
    """Say that imports take seconds; nothing above a help page. Off GPUs silence XLA's banner on slow compilation."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "1" if Path("/dev/nvidiactl").exists() else "3")
    if not wants_help(sys.argv):
        print("loading JAX and MuJoCo", file=sys.stderr, flush=True)


def wants_help(argv: Sequence[str]) -> bool:
    """Whether a command line asks for help, which needs no device."""
    return "-h" in argv or "--help" in argv


def enable_caches() -> None:
    """Keep compiled programs between runs, in `$DEXSIM_CACHE` or else `~/.cache/dexsim`."""
    import jax

    path = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(cache_path("xla"))
    jax.config.update("jax_compilation_cache_dir", path)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def environment_report() -> dict[str, Any]:
    """Hardware and library versions, for reports."""
    import jax

    versions = {"python": platform.python_version()}
    for name in (DISTRIBUTION, "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    devices = jax.devices()
    return {
        "versions": versions,
        "hardware": {
            "platform": devices[0].platform,
            "device": devices[0].device_kind,
            "devices": len(devices),
            "cpu_cores": os.cpu_count(),
            "machine": platform.machine(),
        },
    }


def check_writable(path: Path) -> None:
    """Check, before long work, that a file can be written after it; make its folder. Raises OSError: it cannot be
    written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    place = path if is_device(path) else path.resolve().parent
    if not os.access(place, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(place))


def check_no_overwrite(outputs: Mapping[str, Path | None], inputs: Mapping[str, str | Path | None]) -> None:
    """Check that a command writes (files by option) neither a file that it reads (files by meaning) nor one file twice.
    Raises ConfigError: it does."""
    taken = {os.path.realpath(path): f"is the {what}" for what, path in inputs.items() if path and Path(path).is_file()}
    for option, path in outputs.items():
        if path and not is_device(path):
            if clash := taken.get(place := os.path.realpath(path)):
                raise ConfigError(f"{option} {path}: {clash}; name another file")
            taken[place] = f"is the file of {option}, too"


def write_json(path: Path, data: Any) -> None:
    """Write JSON, whole or not at all; numbers that are not finite become null."""
    text = json.dumps(plain(data), indent=1)
    # A list without lists on one line; the text of a JSON string has no line breaks.
    flat = re.compile(r"\[\n\s+([^][{}]*?)\n\s+\]")
    text = flat.sub(lambda found: "[" + re.sub(r"\n\s+", " ", found[1]) + "]", text)
    write_atomic(path, [(text + "\n").encode()])


def plain(value: Any) -> Any:
    """Nested data as JSON has it: numbers of NumPy as Python's, NaN and infinities as None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
