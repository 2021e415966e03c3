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

from dexsim.core.config import to_dict
from dexsim.hand.kinematics import Hand
from dexsim_real.twin.options import TwinArguments
from dexsim_real.twin.plant.protocol import Plant
from dexsim_real.twin.wire.command_check import CommandCheck
from dexsim_real.twin.wire.emulated_sensors import EmulatedCamera, EmulatedImu
from dexsim_real.twin.wire.faults import Injector
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.twin.wire.line import HandLine
from dexsim_real.twin.wire.terminal import Terminal

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

    def __init__(self, plant: Plant, start: float, note: Callable[[str], None] = lambda text: None):
        self.plant, self.now, self._note = plant, start, note
        self.slipped, self.simulated, self.spent = 0.0, 0.0, 0.0  # s
        self.cost = 0.0  # s, computing time of a slice
        self._noted_at = -1e9

    @property
    def due(self) -> float:
        """Time s from which the next slice may be computed."""
        return self.now + self.SLICE

    def catch_up(self, now: float, limit: float = 0.01) -> None:
        """Advance the plant to a time in s, by at most `limit` s."""
        lag = now - self.now
        if lag > self.MAX_LAG:
            self._slip(now, lag - limit)
        step = min(now - self.now, limit)
        if step <= 0:
            return
        start = time.monotonic()
        self.plant.advance(step)
        took = time.monotonic() - start
        self.now += step
        self.simulated += step
        self.spent += took
        self.cost += 0.05 * (took * self.SLICE / max(step, 1e-4) - self.cost)

    def _slip(self, now: float, seconds: float) -> None:
        self.now += seconds
        self.slipped += seconds
        if now > self._noted_at + 5.0:
            self._noted_at = now
            share = self.spent / self.simulated if self.simulated else 0.0
            self._note(
                f"this machine is too slow: simulated time slipped by {self.slipped:.2f} s so far "
                f"(a simulated second takes {share:.2f} s); close other programs"
            )

    def report(self) -> dict[str, float]:
        """Simulated time, slip and computing time; JSON-able."""
        return {
            "simulated_s": round(self.simulated, 3),
            "slipped_s": round(self.slipped, 3),
            "cpu_per_simulated_s": round(self.spent / self.simulated, 4) if self.simulated else 0.0,
        }


class Twin:
    """An emulated hand with its ports.

    Args:
      arguments: options of the command.
      hand: model of the hand.
      plant: the physics.
      folder: for ports that the options do not name.
      show: called with one line for every event.

    Raises:
      HandError: a port or socket cannot be created.
    """

    HICCUP = 0.02  # s, a longer interruption by the machine exceeds the bridge's default `--link.margin`

    def __init__(
        self,
        arguments: TwinArguments,
        hand: Hand,
        plant: Plant,
        folder: Path,
        show: Callable[[str], None] = lambda text: None,
    ):
        self.arguments, self.plant, self._show = arguments, plant, show
        self.events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)
        self.start, seed = time.monotonic(), arguments.seed
        self.clock = PlantClock(plant, self.start, self.note)
        self.firmware = Firmware(plant, arguments.firmware, self.note)
        self.injector = Injector(arguments.faults, seed)
        self.check = CommandCheck(hand.joint_lower, hand.joint_upper, arguments.limits)
        self.line = HandLine(
            Terminal(arguments.link or folder / "hand"),
            plant,
            self.firmware,
            self.check,
            self.injector,
            arguments.line,
            seed=seed,
            catch_up=self.clock.catch_up,
            note=self.note,
        )
        self.imu: EmulatedImu | None = None
        self.masks: EmulatedCamera | None = None
        try:
            if arguments.task == "rotate":
                self.imu = EmulatedImu(
                    arguments.imu_link or folder / "imu", plant, arguments.object, seed=seed, start=self.start
                )
            if arguments.task == "grasp" or arguments.mask_socket:
                self.masks = EmulatedCamera(
                    arguments.mask_socket or folder / "masks", plant, arguments.object, seed=seed, start=self.start
                )
        except BaseException:
            self.close()
            raise
        self._first = self._trial = plant.trial
        self.hiccups = 0  # number of interruptions by the machine longer than `HICCUP`
        self._stop = False

    def stop(self) -> None:
        """End soon; may be called from a signal handler."""
        self._stop = True

    def run(self) -> None:
        """Run until all trials have ended, or `stop` was called."""
        sides = [side for side in (self.imu, self.masks) if side]
        now = self.clock.now = time.monotonic()
        while not self._stop:
            before, now = now, time.monotonic()
            self.hiccups += now - before > self.HICCUP
            self.line.serve(now)
            free = self.line.due() - now
            for side in sides:
                # A picture takes about 1 ms to compute: postpone it when the port is due soon.
                if free > 0.002 or now > side.due + 0.01:
                    side.serve(now)
            if free > self.clock.cost or now > self.clock.due + 0.01:
                if now >= self.clock.due:
                    self.clock.catch_up(now, PlantClock.SLICE)
                until = min(self.clock.due, *(side.due for side in sides))
            else:
                until = now + free
            if self.plant.trial != self._trial:
                self._trial = self.plant.trial
                done = self._trial - self._first
                ended = self.plant.results()[done - 1 : done]
                end = ended[0].get("end", "") if ended else ""
                self.note(f"end of trial {done} of {self.arguments.trials}: {end}")
                if done >= self.arguments.trials:
                    self._stop = True
                    self.note("all trials are over: the hand's port closes")
            pause = min(until, self.line.due()) - time.monotonic()
            ports = [self.line.terminal] if self.line.terminal.connected else []
            select.select(ports, [], [], max(pause, 0.0))

    def close(self) -> None:
        """Close all ports."""
        for part in (self.line, self.imu, self.masks):
            if part:
                part.close()

    def note(self, text: str) -> None:
        """Record and show an event."""
        now = time.monotonic()
        self.events.append((now, text))
        self._show(f"{now - self.start:9.3f} s  {text}")

    def report(self) -> dict[str, Any]:
        """Results of the trials, and all statistics; JSON-able."""
        arguments, firmware, line = self.arguments, self.firmware, self.line
        return {
            "task": arguments.task,
            "seed": arguments.seed,
            "parameter_kind": arguments.parameters,
            "start": self.start,
            "seconds": round(time.monotonic() - self.start, 3),
            "trials": self.plant.results()[: arguments.trials],
            "line": dict(line.counts),
            "firmware": dict(firmware.counts),
            "faults": {
                "injected": dict(self.injector.injected),
                "expected": self.injector.expected(),
                "config": to_dict(arguments.faults),
            },
            "commands": self.check.report(),
            "stuck": [[*taxel, count] for taxel, count in firmware.stuck.items()],
            "watchdog": {
                "limit_s": arguments.firmware.watchdog,
                "longest_s": firmware.longest,
                "trips": firmware.trips,
            },
            "hiccups": self.hiccups,
            "physics": self.clock.report(),
            "slowest_exchange_ms": round(1e3 * line.slowest, 3),
            "late": line.lateness.summary(),
            "imu_frames": self.imu.sent if self.imu else 0,
            "masks": dict(self.masks.counts) if self.masks else {},
            "events": [list(event) for event in self.events],
        }
