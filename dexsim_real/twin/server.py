"""Runs an emulated hand in real time: one thread serves the hand's port, IMU and camera, and advances the physics.

The port has priority. In between, the physics advances in slices of a millisecond and follows the wall clock. On a slow
machine simulated time slips; the slip is reported.
"""

import select
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dexsim_real.twin.options import TwinArguments
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.wire.emulated_sensors import EmulatedCamera, EmulatedImu
from dexsim_real.twin.wire.faults import Injector
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.twin.wire.line import HandLine, Terminal

_EVENTS = 20_000  # kept for the report


class PlantClock:
    """Keeps the time of a plant at the wall clock.

    Args:
      plant: the physics.
      start: s, wall clock at the start of the plant; `now` is its current time.
      note: called with one line when simulated time slips.
    """

    SLICE = 0.001  # s, simulated at once
    MAX_LAG = 0.1  # s behind the wall clock above which simulated time slips

    def __init__(self, plant: EmulatedHand, start: float, note: Callable[[str], None]):
        self.plant, self.now, self._note = plant, start, note
        self.slipped, self.cost = 0.0, 0.0  # s; computing time s of a slice
        self._noted_at = -1e9

    @property
    def due(self) -> float:
        """Time s from which the next slice may be computed."""
        return self.now + self.SLICE

    def catch_up(self, now: float, limit: float = 0.01) -> None:
        """Advance the plant to a time in s, by at most `limit` s."""
        lag = now - self.now
        if lag > self.MAX_LAG:
            self.now += lag - limit
            self.slipped += lag - limit
            if now > self._noted_at + 5.0:
                self._noted_at = now
                self._note(f"this machine is too slow: simulated time slipped by {self.slipped:.2f} s so far")
        step = min(now - self.now, limit)
        if step > 0:
            start = time.monotonic()
            self.plant.advance(step)
            self.now += step
            self.cost += 0.05 * ((time.monotonic() - start) * self.SLICE / max(step, 1e-4) - self.cost)


class Twin:
    """An emulated hand with its ports.

    Args:
      arguments: options of the command.
      plant: the physics.
      folder: for ports that the options do not name.
      show: called with one line for every event.

    Raises:
      HandError: a port or socket cannot be created.
    """

    def __init__(
        self,
        arguments: TwinArguments,
        plant: EmulatedHand,
        folder: Path,
        show: Callable[[str], None] = lambda text: None,
    ):
        self.arguments, self.plant, self._show = arguments, plant, show
        self.events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)
        self.start, seed = time.monotonic(), arguments.seed
        self.clock = PlantClock(plant, self.start, self.note)
        self.firmware = Firmware(plant, self.note)
        self.injector = Injector(arguments.faults, seed)
        terminal = Terminal(arguments.link or folder / "hand")
        self.line = HandLine(
            terminal, self.firmware, self.injector, seed=seed, catch_up=self.clock.catch_up, note=self.note
        )
        self.imu: EmulatedImu | None = None
        self.masks: EmulatedCamera | None = None
        try:
            if arguments.task != "grasp":
                self.imu = EmulatedImu(arguments.imu_link or folder / "imu", plant, seed=seed, start=self.start)
            else:
                path = arguments.mask_socket or folder / "masks"
                self.masks = EmulatedCamera(path, plant, seed=seed, start=self.start)
        except BaseException:
            self.close()
            raise
        self._first = self._trial = plant.trial
        self._stop = False

    def stop(self) -> None:
        """End soon; may be called from a signal handler."""
        self._stop = True

    def run(self) -> None:
        """Run until all trials have ended, or `stop` was called."""
        sensors = [sensor for sensor in (self.imu, self.masks) if sensor]
        self.clock.now = time.monotonic()
        while not self._stop:
            now = time.monotonic()
            self.line.serve(now)
            free = self.line.due() - now
            for sensor in sensors:
                # A picture takes about 1 ms to compute: postpone it when the port is due soon.
                if free > 0.002 or now > sensor.due + 0.01:
                    sensor.serve(now)
            if free > self.clock.cost or now > self.clock.due + 0.01:
                if now >= self.clock.due:
                    self.clock.catch_up(now, PlantClock.SLICE)
                until = min(self.clock.due, *(sensor.due for sensor in sensors))
            else:
                until = now + free
            self._count_trials()
            pause = min(until, self.line.due()) - time.monotonic()
            ports = [self.line.terminal] if self.line.terminal.connected else []
            select.select(ports, [], [], max(pause, 0.0))

    def close(self) -> None:
        """Close all ports."""
        for part in (self.line.terminal, self.imu, self.masks):
            if part:
                part.close()

    def note(self, text: str) -> None:
        """Record and show an event."""
        now = time.monotonic()
        self.events.append((now, text))
        self._show(f"{now - self.start:9.3f} s  {text}")

    def report(self) -> dict[str, Any]:
        """Results of the trials, and all statistics; JSON-able."""
        arguments = self.arguments
        return {
            "task": arguments.task,
            "seed": arguments.seed,
            "start": self.start,
            "trials": self.plant.results()[: arguments.trials],
            "line": dict(self.line.counts),
            "exchanges": dict(self.firmware.counts),
            "injected_faults": dict(self.injector.injected),
            "slipped_s": round(self.clock.slipped, 3),
            "late": self.line.lateness.summary(),
            "events": [list(event) for event in self.events],
        }

    def _count_trials(self) -> None:
        if self.plant.trial == self._trial:
            return
        self._trial = self.plant.trial
        done = self._trial - self._first
        self.note(f"end of trial {done} of {self.arguments.trials}: {self.plant.results()[done - 1].get('end', '')}")
        if done >= self.arguments.trials:
            self._stop = True
            self.note("all trials are over: the hand's port closes")
