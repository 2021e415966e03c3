"""Errors of the bridge: one line that names the problem and the remedy, also of a port or a function of the user."""

import contextlib
import errno
import importlib
import os
import termios
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dexsim.core.install import install_line
from dexsim.errors import DexsimError


class HandError(DexsimError):
    """The hand or one of its sensors cannot be reached, or cannot do what was asked."""

    page = "docs/troubleshooting.md#bridge"


def open_serial(port: str, baud: int, **options: Any) -> Any:
    """The serial port at a device, by-id link, pseudo-terminal or pyserial URL, for nobody else meanwhile.

    Raises HandError: it cannot be opened, or pyserial is missing.
    """
    try:
        import serial
    except ImportError:
        raise HandError(f"pyserial is missing: {install_line('real')}") from None
    if "://" not in port:
        options["exclusive"] = True
    try:
        return serial.serial_for_url(port, baudrate=baud, **options)
    # It vanishes meanwhile (`termios.error`), or a URL's kind of port lacks a setting (`NotImplementedError`).
    except (OSError, ValueError, NotImplementedError, termios.error) as error:
        raise HandError(explain(port, error)) from None


def explain(port: str, error: Exception) -> str:
    """One line about a port that does not open: the reason and the remedy."""
    number = getattr(error, "errno", None)
    if number == errno.EACCES:
        group = str(os.stat(port).st_gid)
        with contextlib.suppress(KeyError):  # A container need not know the group of a device that it was given.
            group = Path(port).group()
        return f"{port}: permission denied; run `sudo usermod -aG {group} $USER`, then log out and in again"
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return f"{port}: another program has it open (`fuser -v {port}` names it). Close that program first"
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        ports = ", ".join(sorted(str(link) for link in Path("/dev/serial/by-id").glob("*")))
        return f"{port}: there is no such port; choose from: {ports or 'none found; check cable and power'}"
    return f"{port}: cannot be opened ({error}); check the name and the cable"


def find_function(name: str, given: str, form: str, default: str = "") -> Callable[..., Any]:
    """The user's function MODULE:FUNCTION, or `default` of MODULE; `given` is the option, `form` what to give.

    Raises HandError: no such module or function, or the module fails when it is imported.
    """
    module, _, function = name.partition(":")
    try:
        return getattr(importlib.import_module(module), function or default)
    except (Exception, SystemExit) as error:  # The module is the user's: importing it may raise anything.
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise HandError(f"{given}: {why:.200}; give {form}") from None
