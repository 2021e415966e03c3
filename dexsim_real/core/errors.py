"""Errors of the bridge: one line that names the problem and the remedy."""

import errno
import grp
import os
import termios
from pathlib import Path

from dexsim.core.errors import DexsimError

PORT_ERRORS = (OSError, ValueError, NotImplementedError, termios.error)
"""What opening a serial port raises; the last, no `OSError`, when the port vanishes meanwhile, and the one before for a
URL whose kind of port lacks a setting, such as rfc2217://."""


class HandError(DexsimError):
    """The hand or one of its sensors cannot be reached, or cannot do what was asked."""

    page = "docs/troubleshooting.md#bridge"


def explain(port: str, error: Exception) -> str:
    """One line about a port that does not open: the reason and the remedy."""
    number = getattr(error, "errno", None)
    if number == errno.EACCES:
        group = grp.getgrgid(os.stat(port).st_gid).gr_name
        return f"{port}: permission denied; run `sudo usermod -aG {group} $USER`, then log out and in again"
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return f"{port}: another program has it open (`fuser -v {port}` names it). Close that program first"
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        ports = sorted(str(link) for link in Path("/dev/serial/by-id").glob("*"))
        known = f"choose from {', '.join(ports)}" if ports else "no serial port was found; check cable and power"
        return f"{port}: there is no such port; {known}"
    return f"{port}: cannot be opened ({error}); check the name and the cable"


def latency_warnings(port: str, sysfs: Path = Path("/sys/bus/usb-serial/devices")) -> list[str]:
    """Warn of an FTDI adapter whose latency timer exceeds 1 ms: at the usual 16 ms the loop runs at half its rate."""
    timer = sysfs / os.path.basename(os.path.realpath(port)) / "latency_timer"
    value = int(timer.read_text()) if timer.is_file() else 0
    if value <= 1:
        return []
    return [
        f"{port}: the adapter waits {value} ms before it forwards short packets. Set 1 ms now: "
        f"`echo 1 | sudo tee {timer}`. Set it permanently in /etc/udev/rules.d/99-dexsim.rules: "
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'
    ]
