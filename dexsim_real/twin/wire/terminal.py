"""A pseudo-terminal in place of the hand's end of a cable."""

import contextlib
import os
import termios
import tty
from pathlib import Path

from dexsim_real.core.errors import HandError

_RATES = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}


class Terminal:
    """A pseudo-terminal that can be disconnected and reconnected. `name` is a link to the current terminal.

    Args:
      link: path of the link.

    Raises:
      HandError: the path exists and is not a link to a terminal like this one, or no terminal can be created.
    """

    def __init__(self, link: Path):
        self.name = Path(link)
        self._master = self._slave = -1
        ours = self.name.is_symlink() and os.path.realpath(self.name).startswith("/dev/pts/")
        if self.name.exists() and not ours:
            raise HandError(f"{link}: already exists and is not a link to a pseudo-terminal; choose another path")
        self.open()

    def open(self) -> None:
        """Connect: create a terminal and the link to it."""
        try:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            # Renamed into place, so that the link changes atomically.
            fresh = self.name.with_name(f".{self.name.name}.{os.getpid()}")
            fresh.symlink_to(os.ttyname(self._slave))
            fresh.replace(self.name)
        except OSError as error:
            self.close()
            raise HandError(
                f"{self.name}: no pseudo-terminal can be created here ({error.strerror}); choose another path"
            ) from None

    def close(self) -> None:
        """Disconnect: programs that have the terminal open get an error."""
        if self.connected:
            with contextlib.suppress(OSError):
                if os.readlink(self.name) == os.ttyname(self._slave):
                    self.name.unlink()
            os.close(self._master)
            os.close(self._slave)
        self._master = self._slave = -1

    @property
    def connected(self) -> bool:
        return self._master >= 0

    @property
    def baud(self) -> int | None:
        """Baud rate set by the other side; None if unknown."""
        return _RATES.get(termios.tcgetattr(self._slave)[5])

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        """Received bytes; empty if there are none."""
        try:
            return os.read(self._master, 65536)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        """Send bytes; what nobody reads is lost, as on a wire."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)
