"""A second process that turns the motors off when the runner dies or freezes, whatever killed or stopped it.

    python -m dexsim_real.control.guard PORT LINK HAND

`python -m dexsim_real.run` starts it. A pipe connects the two. While the motors may be on, the exchange thread writes
signs of life to it, each with the seconds until the next one; the kernel closes it at the runner's death, even by
SIGKILL. A runner whose sign is overdue, such as one suspended by SIGSTOP, is killed. Only then the guard opens the
port, so that never two processes talk on the line. It ignores signals and has a session of its own, so Ctrl-C and a
closed terminal do not end it. It answers each sign: a runner without answers ends its run.
"""

import contextlib
import dataclasses
import importlib
import json
import math
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from dexsim.hand.description import Hand
from dexsim.hand.load import load_hand
from dexsim_real.core.errors import HandError
from dexsim_real.wire import frames
from dexsim_real.wire.driver import open_port
from dexsim_real.wire.frames import passive_command
from dexsim_real.wire.link import UNCONFIRMED, LinkConfig

_OFF = b"off"
_STARTUP = 20.0  # s, longest start of the guard
_PATIENCE = 60.0  # s for which it tries
_ATTEMPT = 5.0  # s after which it opens the port again
_BACKOFF = (0.005, 0.1)  # s between attempts to open the port
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGPIPE)
_EVERY = 0.1  # s between two signs of life
_FREEZE = 1.5  # s without a sign of life that count as frozen, besides the exchanges below
_EXCHANGES = 10  # exchanges with a silent hand that may pass between two signs, when the port is opened again
_MOMENT = 0.3  # s for a process whose word is overdue: when the whole machine paused, it has to wake too
_ANSWER = 0.6  # s without an answer after which the guard counts as suspended
_DEATH = 5.0  # s in which a process that is told to end has ended
_ENDED = "the runner has ended without turning the motors off"
_FROZEN = "the runner stood still, and was killed"


class Guard:
    """The runner's end: starts the process for a port, as for `open_port`."""

    def __init__(self, port: str, link: LinkConfig, hand: Hand):
        root = str(Path(__file__).resolve().parents[2])
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, port, json.dumps(dataclasses.asdict(link)), hand.source],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            # The path of this process: it has the module of an `sdk:` port.
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [root, *sys.path]))},
        )
        assert self._process.stdin and self._process.stdout
        self._input, self._output = self._process.stdin, self._process.stdout
        os.set_blocking(self._input.fileno(), False)  # The exchange thread must not wait for the guard.
        longest = frames.OVERHEAD + frames.STATE_BLOCK.itemsize
        self._allowed = _FREEZE + _EXCHANGES * link.deadline(longest, longest)
        self._armed, self._due = False, 0.0
        self._asked: float | None = None  # s, of the oldest sign of life without an answer

    def arm(self) -> None:
        """Wait until the process is ready; from now on it acts when this one ends, or `beat` is not called.

        Raises HandError: it did not start.
        """
        if not self._answered(_STARTUP):
            raise HandError("the guard process did not start; --no-guard runs without it")
        self._tell(b"%.3f" % self._allowed)
        self._armed = True

    def beat(self, more: float = 0.0) -> None:
        """A sign of life of the thread that exchanges commands with the hand; it never blocks.

        The next one may be later than usual by `more` s.
        """
        now = time.monotonic()
        if self._armed and (now >= self._due or more):
            self._due = now + _EVERY
            self._asked = self._asked or now
            self._tell(b"%.3f" % (self._allowed + more))

    def check(self) -> None:
        """Raises HandError: the process has ended, or is suspended."""
        if self._process.poll() is not None:
            raise HandError("the guard process has ended")
        late = self._asked is not None and time.monotonic() - self._asked > _ANSWER
        if self._armed and self._answered(_MOMENT if late else 0.0):  # `arm` waits for the first answer.
            self._asked = None
        elif late:
            raise HandError("the guard process does not respond; start the run again")

    def dismiss(self, off: bool) -> None:
        """End of the run. Unless the motors are confirmed to be `off`, the process turns them off."""
        if self._input.closed:
            return
        self._armed = False
        if off:
            self._tell(_OFF)
        self._input.close()
        self._output.close()
        if off:
            try:
                self._process.wait(_DEATH)
            except subprocess.TimeoutExpired:  # It is suspended, and there is nothing left to do for it.
                self._process.kill()

    def _answered(self, seconds: float) -> bool:
        """Wait for a word of the process; whether one has come."""
        output = self._output.fileno()
        return bool(select.select([output], [], [], seconds)[0] and os.read(output, 4096))

    def _tell(self, word: bytes) -> None:
        with contextlib.suppress(OSError):  # `check` notices a process that has ended, or reads nothing.
            os.write(self._input.fileno(), word + b"\n")


def main(argv: Sequence[str]) -> int:
    """The process. Returns its exit code: 1 if the motors were on and the hand did not confirm that they are off."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    runner, port, options = os.getppid(), argv[0], json.loads(argv[1])
    # What a driver prints must not be taken for an answer, nor fail once the runner is gone.
    answers = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    link, hand = LinkConfig(**options | {"settle": 0.0, "backoff": _BACKOFF}), load_hand(argv[2] or None)
    # Now, so that nothing must be loaded when it counts.
    module = port.removeprefix("sdk:").partition(":")[0] if port.startswith("sdk:") else "serial"
    with contextlib.suppress(ImportError):  # The runner says so.
        importlib.import_module(module)
    why = _watch(sys.stdin.fileno(), answers)
    if not why:
        return 0
    if why == _FROZEN:
        _kill(runner, sys.stdin.fileno())
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):  # The terminal may be gone, too.
        done = _stop(port, link, hand)
    text = "motors off" if done else f"{UNCONFIRMED}; press the emergency stop"
    print(f"guard: {why}: {text}", file=sys.stderr, flush=True)
    return 0 if done else 1


def _watch(pipe: int, answers: int) -> str:
    """Wait until the motors must be turned off; returns why, or nothing after an orderly end.

    `pipe` has the runner's signs of life; each gets one of the `answers`, and so does the start.
    """
    rest, on, until = b"", False, math.inf
    while True:
        with contextlib.suppress(OSError):  # The runner may have ended already.
            os.write(answers, b".")
        pause = None if until == math.inf else max(until - time.monotonic(), 0.0)
        ready = select.select([pipe], [], [], pause)[0] or select.select([pipe], [], [], _MOMENT)[0]
        if not ready:
            return _FROZEN
        data = os.read(pipe, 4096)
        if not data:
            return _ENDED if on else ""
        *words, rest = (rest + data).split(b"\n")
        if words:
            on = words[-1] != _OFF
            until = time.monotonic() + float(words[-1]) if on else math.inf


def _kill(runner: int, pipe: int) -> None:
    """Kill the runner, and wait until the kernel has closed its files."""
    if os.getppid() == runner:  # Otherwise it has just ended, and the number may be another's.
        os.kill(runner, signal.SIGKILL)
    until = time.monotonic() + _DEATH
    while select.select([pipe], [], [], max(until - time.monotonic(), 0.0))[0] and os.read(pipe, 4096):
        pass


def _stop(port: str, link: LinkConfig, hand: Hand) -> bool:
    """Turn the motors off; returns whether the hand has confirmed it."""
    done, until, pause = False, time.monotonic() + _PATIENCE, _BACKOFF[0]
    while time.monotonic() < until:
        # Whatever somebody's own port does here, the next attempt may succeed.
        with contextlib.suppress(Exception, SystemExit), contextlib.closing(open_port(port, hand, link)) as line:
            line.connect()
            done = line.turn_off(passive_command(hand.num_joints), _ATTEMPT)
        if done:  # Also where the port could not be closed.
            return True
        time.sleep(pause)
        pause = min(2 * pause, _BACKOFF[1])
    return False


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
