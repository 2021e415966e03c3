"""Nobody's hand moves unasked: the question before the motors come on."""

import contextlib
import sys
import termios

from dexsim_real.core.errors import HandError

_QUESTION = (
    "The motors come on at this pose, then the hand moves to its start posture.\n"
    "Is the power switch within reach, and the hand's room clear? [y/N] "
)


def check_terminal() -> None:
    """Raises HandError: nobody can be asked, since input or error output is no terminal."""
    if not all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stderr)):
        raise HandError("no terminal, so nobody can be asked before the motors come on; give --yes or --motors-off")


def ask() -> None:
    """Ask on the terminal whether the motors may come on.

    Raises:
      HandError: the answer is not yes.
    """
    with contextlib.suppress(OSError, ValueError, termios.error):
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)  # What was typed before the question is no answer to it.
    print(_QUESTION, end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise HandError("the answer was not yes: the motors stayed off")
