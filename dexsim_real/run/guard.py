"""A second process that turns the motors off when the runner dies, whatever killed it.

    python -m dexsim_real.run.guard PORT LINK

`python -m dexsim_real.run` starts it. A pipe connects the two: while the motors may be on, its content ends with "on".
The kernel closes the pipe at the runner's death, even by SIGKILL. Only then the guard opens the port, so that never two
processes talk on the line. It ignores signals and has a session of its own, so Ctrl-C and a closed terminal do not end
it. A runner that is suspended (SIGSTOP) has not died: the hand keeps its last command.
"""

import contextlib
import dataclasses
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from dexsim_real.control.motors_off import UNCONFIRMED, turn_off
from dexsim_real.core.errors import HandError
from dexsim_real.wire.link import LinkConfig
from dexsim_real.wire.serial_hand import SerialHand, passive_command

_ON, _OFF = b"on ", b"off "
_STARTUP = 20.0  # s, longest start of the guard
_PATIENCE = 60.0  # s for which it tries
_BACKOFF = (0.005, 0.1)  # s between attempts to open the port
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGPIPE")


class Guard:
    """The runner's end: starts the process.

    Args:
      port: serial port of the hand.
      link: of the serial line.
    """

    def __init__(self, port: str, link: LinkConfig):
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")]))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "dexsim_real.run.guard", port, json.dumps(dataclasses.asdict(link))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": path},
        )
        assert self._process.stdin and self._process.stdout
        self._input, self._output = self._process.stdin, self._process.stdout

    def arm(self) -> None:
        """Wait until the process is ready; from now on it acts when this process ends.

        Raises:
          HandError: it did not start.
        """
        if not select.select([self._output], [], [], _STARTUP)[0] or self._output.readline() != b"ready\n":
            raise HandError("the guard process did not start; --no-guard runs without it")
        self._tell(_ON)

    def check(self) -> None:
        """Check that the process runs.

        Raises:
          HandError: it has ended.
        """
        if self._process.poll() is not None:
            raise HandError("the guard process has ended")

    def dismiss(self, off: bool) -> None:
        """End of the run. Unless the motors are confirmed to be `off`, the process turns them off."""
        if self._input.closed:
            return
        try:
            if off:
                self._tell(_OFF)
            self._input.close()
        except OSError:
            pass  # It has ended before.
        self._output.close()
        if off:
            self._process.wait(_STARTUP)

    def _tell(self, word: bytes) -> None:
        try:
            self._input.write(word)
            self._input.flush()
        except OSError:
            raise HandError("the guard process has ended") from None


def main(argv: Sequence[str]) -> int:
    """The process. Returns its exit code: 1 if the motors were on and the hand did not confirm that they are off."""
    for name in _SIGNALS:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    port, options = argv[0], json.loads(argv[1])
    link = LinkConfig(**options | {"settle": 0.0, "backoff": _BACKOFF})
    hand, off = SerialHand(port, link), passive_command()
    import serial  # noqa: F401  # Now, so that nothing must be loaded when it counts.

    with contextlib.suppress(OSError):  # The runner may have ended already.
        os.write(1, b"ready\n")
    if not sys.stdin.buffer.read().endswith(_ON):
        return 0
    done = turn_off(hand, off, _PATIENCE)
    hand.close()
    text = "motors off" if done else f"{UNCONFIRMED}; press the emergency stop"
    print(f"guard: the runner has ended without turning the motors off: {text}", file=sys.stderr, flush=True)
    return 0 if done else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
