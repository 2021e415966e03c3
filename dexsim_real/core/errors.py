"""What to tell the user when the hand cannot be reached: one line, with what helps."""

import errno
import grp
import os
from pathlib import Path

from dexsim.core.errors import DexsimError


class HandError(DexsimError):
    """The hand cannot be reached, or not used as asked."""


def explain(port: str, error: Exception) -> str:
    """One line about a port that does not open: the reason, and what helps."""
    number = getattr(error, "errno", None)
    if number == errno.EACCES:
        return (
            f"{port}: permission denied. It belongs to the group {_group(port)!r}: run "
            f"`sudo usermod -aG {_group(port)} $USER`, then log out and in again"
        )
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return f"{port}: another program has it open (`fuser -v {port}` names it): close that first"
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        found = sorted(str(link) for link in Path("/dev/serial/by-id").glob("*"))
        return f"{port}: there is no such port; found {', '.join(found) if found else 'no serial port at all'}"
    return f"{port}: cannot be opened ({error})"


def latency_warnings(port: str, sysfs: Path = Path("/sys/bus/usb-serial/devices")) -> list[str]:
    """An FTDI adapter's latency timer above 1 ms: at its usual 16 ms the loop runs at half its rate."""
    name = os.path.basename(os.path.realpath(port))
    timer = sysfs / name / "latency_timer"
    try:
        value = int(timer.read_text())
    except (OSError, ValueError):
        return []
    if value <= 1:
        return []
    return [
        f"{port}: the adapter waits {value} ms before it passes on short packets. Now: "
        f"`echo 1 | sudo tee {timer}`. For good, as /etc/udev/rules.d/99-dexsim.rules: "
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'
    ]


def _group(port: str) -> str:
    try:
        return grp.getgrgid(os.stat(port).st_gid).gr_name
    except (OSError, KeyError):
        return "dialout"
