"""A pseudo-terminal under a name that outlives it: the emulated hand's end of a cable."""

import contextlib
import os
import termios
import tty
from pathlib import Path

from dexsim_real.core.errors import HandError

_RATES = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}


class Terminal:
    """Opens and closes like a plug; `name` is a link to whatever terminal is there at the moment.

    Args:
      link: path of that link.

    Raises:
      HandError: something else lies at that path, or no terminal can be had.
    """

    def __init__(self, link: Path):
        self.name = Path(link)
        self._master = self._slave = -1
        if self.name.exists() and not self.name.is_symlink():
            raise HandError(f"{link}: is there already, and is no link")
        self.open()

    def open(self) -> None:
        """Make a terminal, then the link to it."""
        try:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            # Renamed into place, so that the name is never half there.
            fresh = self.name.with_name(f".{self.name.name}.{os.getpid()}")
            fresh.symlink_to(os.ttyname(self._slave))
            fresh.replace(self.name)
        except OSError as error:
            self.close()
            raise HandError(f"{self.name}: no pseudo-terminal under this name ({error.strerror})") from None

    def close(self) -> None:
        """Pull the plug: whoever has it open gets an error."""
        if self._master < 0:
            return
        with contextlib.suppress(OSError):
            if self.name.is_symlink() and os.readlink(self.name) == os.ttyname(self._slave):
                self.name.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1

    @property
    def plugged(self) -> bool:
        """Whether there is a terminal."""
        return self._master >= 0

    @property
    def baud(self) -> int | None:
        """Rate that the other side has set; None where it cannot be told."""
        return _RATES.get(termios.tcgetattr(self._slave)[5])

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        """What has come; empty when nothing has."""
        try:
            return os.read(self._master, 65536)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        """Send; returns how many bytes found room in the other side's buffer."""
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0
