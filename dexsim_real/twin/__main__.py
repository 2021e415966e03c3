"""Emulates a hand on a pseudo-terminal: the wire format of the real hand, and physics that no policy was trained on.

    python -m dexsim_real.twin --task rotate

It prints the command that runs a policy on it, and ends after its trials or with Ctrl-C. One thread serves the hand's
port, IMU and camera, and advances the physics. The port has priority. In between, the physics advances in slices of a
millisecond and follows the wall clock. On a slow machine simulated time slips; the slip is reported.
"""

import dataclasses
import functools
import math
import select
import shlex
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from dexsim.calibration.maps import save_calibration
from dexsim.core import cli
from dexsim.core.config import Config, setting
from dexsim.hand.load import load_hand
from dexsim_real.core.process import use_realtime
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.parameters import KINDS, TASKS
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.twin.wire import SERIALS, EmulatedCamera, EmulatedImu, Firmware, HandLine, Terminal
from dexsim_real.wire.driver import check_wire

_BUSY = 0.002  # s, longest that a slice of the physics or a picture takes
SLICE = 0.001  # s, simulated at once
MAX_LAG = 0.1  # s behind the wall clock above which simulated time slips


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwinArguments(Config):
    """Emulate a hand on a pseudo-terminal."""

    task: str = setting("rotate", choices=TASKS)
    """Task: `rotate` mounts the hand palm up with a cube, `grasp` upside down with various objects."""
    hand: str = ""
    """The TOML of a hand of your own, with the joints and taxels that the wire format has; empty for the XHand."""
    seed: int = setting(0, unit="1", low=0, high=2**31 - 1)
    """Seed of all random numbers: parameters, objects, noise."""
    trials: int = setting(10, unit="1", low=1, high=100_000)
    """Number of trials, with one object each."""
    first: int = setting(0, unit="1", low=0, high=100_000)
    """Number of the first trial. A trial does not depend on the trials before it."""
    seconds: float | None = setting(None, unit="s", low=0.1, high=86400.0)
    """Time limit of a trial; None for that of the task (grasp 8 s, rotate 120 s)."""
    axis: tuple[float, ...] = setting((), unit="1", low=-1.0, high=1.0)
    """Axis of rotation, as given to the run; empty: that of the task."""
    parameters: str = setting("outside", choices=KINDS)
    """Parameters of hand and object: just outside the ranges of training, inside them, or nominal."""
    folder: Path | None = None
    """Folder for the ports `hand` and `imu` (rotate) and the socket `masks` (grasp); None for a new temporary one."""
    output: Path | None = None
    """JSON file for the results of the trials, written at the end; None writes no file."""
    realtime: bool = True
    """Request real-time priority; continue without it if not permitted."""
    plant_model: Path | None = None
    """Third-party MJCF of the hand, which takes the place of the emulated hand's body and contacts
    (docs/emulated_hand.md). Its motors are left out: the emulated hand's drive its joints. None for the emulated hand's
    own."""


class Twin:
    """An emulated hand with its ports, in a folder; `show` is called with one line for every event.

    Raises HandError or OSError: a port or socket cannot be created.
    """

    def __init__(self, arguments: TwinArguments, plant: EmulatedHand, folder: Path, show: Callable[[str], None]):
        self.arguments, self.plant, self._show = arguments, plant, show
        self.start = self.now = time.monotonic()  # s; the plant's time by the wall clock
        self.slipped, self._noted_at = 0.0, -math.inf  # s
        terminal = Terminal(folder / "hand")
        self.line = HandLine(terminal, Firmware(plant), self.catch_up, arguments.seed)
        try:
            kind, name = (EmulatedCamera, "masks") if arguments.task == "grasp" else (EmulatedImu, "imu")
            self.sensor: EmulatedImu | EmulatedCamera = kind(folder / name, plant, arguments.seed, self.start)
        except BaseException:
            terminal.close()
            raise
        self._stop = False

    def stop(self) -> None:
        """End soon; may be called from a signal handler."""
        self._stop = True

    def run(self) -> None:
        """Run until all trials have ended, or `stop` was called."""
        first, done, trials = self.plant.trial, 0, self.arguments.trials
        self.now = time.monotonic()
        while not self._stop and done < trials:
            now = time.monotonic()
            self.line.serve(now)
            # What takes long waits when the port is due soon, but not for ever.
            due = min(self.now + SLICE, self.sensor.due)
            free = self.line.due() - now > _BUSY
            if now >= due and (free or now > due + 0.01):
                self.catch_up(now, SLICE)
                if now >= self.sensor.due:
                    self.sensor.serve(now)
            if self.plant.trial > first + done:
                done = self.plant.trial - first
                self.note(f"end of trial {done} of {trials}: {self.plant.results()[done - 1].get('end', '')}")
            pause = (min(due, self.line.due()) if free else self.line.due()) - time.monotonic()
            select.select([self.line.terminal], [], [], max(pause, 0.0))
        if done >= trials:
            self.note("all trials are over: the hand's port closes")

    def catch_up(self, now: float, limit: float = 0.01) -> None:
        """Advance the plant to a time in s, by at most `limit` s; on a slow machine its time slips."""
        lag = now - self.now
        if lag > MAX_LAG:
            self.now += lag - limit
            self.slipped += lag - limit
            if now > self._noted_at + 5.0:
                self._noted_at = now
                self.note(f"this machine is too slow: simulated time slipped by {self.slipped:.2f} s so far")
        step = min(now - self.now, limit)
        if step > 0:
            self.plant.advance(step)
            self.now += step

    def close(self) -> None:
        self.line.terminal.close()
        self.sensor.close()

    def note(self, text: str) -> None:
        self._show(f"{time.monotonic() - self.start:9.3f} s  {text}")


def main(argv: Sequence[str] | None = None) -> int:
    arguments = cli.parse(TwinArguments, argv)
    if arguments.output:
        cli.check_writable(arguments.output)
    hand = load_hand(arguments.hand or None)
    check_wire(hand)
    with tempfile.TemporaryDirectory(prefix="dexsim-twin-") as temporary:
        folder = arguments.folder or Path(temporary)
        show = functools.partial(print, flush=True)
        options = {name: getattr(arguments, name) for name in ("trials", "first", "seconds", "axis", "plant_model")}
        plant = EmulatedHand(hand, arguments.task, arguments.seed, kind=arguments.parameters, **options)
        twin = Twin(arguments, plant, folder, show)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: twin.stop())
        calibration = Path(temporary) / "calibration.toml"  # for nominal motors, from which those of a trial deviate
        nominal = dataclasses.replace(ideal_calibration(hand), serial=SERIALS[hand.side], handedness=hand.side)
        save_calibration(calibration, nominal)
        port = str(twin.line.terminal.name)
        command = ["python", "-m", "dexsim_real.run", arguments.task, "--port", port]
        command += ["--calibration", str(calibration), "--yes", *twin.sensor.option]
        command += ["--hand", arguments.hand] if arguments.hand else []
        command += ["--axis", *map(str, arguments.axis)] if arguments.axis else []
        try:
            show(f"{arguments.task}: the emulated hand is at {port}. Run a policy on it with")
            show(f"    {shlex.join(command)}")
            if arguments.realtime and not use_realtime():
                twin.note("without real-time priority: expect jitter on a busy machine (docs/hardware.md)")
            twin.run()
        finally:
            twin.close()
            if arguments.output:
                trials = plant.results()[: arguments.trials]
                cli.write_json(arguments.output, {"trials": trials, "slipped_s": round(twin.slipped, 3)})
    return 0


if __name__ == "__main__":
    cli.run(main)
