"""Public names of a package that are imported at first use (PEP 562), and Ctrl-C while modules load."""

import ast
import importlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dexsim.core.install import install_line


def lazy_exports(package: str) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """A package's `__all__`, `__getattr__` and `__dir__`, from its `__name__`. The public names and their modules are
    those that its source imports under the same name (`Env as Env`), for type checkers only."""
    source = Path(str(sys.modules[package].__file__)).read_text()
    imports = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names if alias.asname}

    def getattribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            return getattr(importlib.import_module(homes[name]), name)
        except ModuleNotFoundError as error:
            if error.name != "jax":
                raise
            raise ImportError(f"{package}.{name} needs jax: {install_line('train')}") from None

    return sorted(homes), getattribute, lambda: sorted(homes)


def exit_on_interrupt() -> None:
    """From now on Ctrl-C ends the program with one line: modules that load abort, or show pages of their insides."""
    main_thread = threading.current_thread() is threading.main_thread()
    if main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def restore_interrupt() -> None:
    """From now on Ctrl-C raises KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(number: int, frame: Any) -> None:
    os.write(2, b"interrupted\n")
    os._exit(128 + number)


if sys.argv[:1] == ["-m"]:  # `python -m` with one of our modules, which is still to be found.
    exit_on_interrupt()
