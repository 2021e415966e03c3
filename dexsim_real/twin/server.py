"""The emulated hand at work: one thread that serves wire, IMU and camera, and brings the physics along.

Whatever is due on the wire comes first. Physics goes in slices of a millisecond between, and follows the wall
clock; a machine too slow for that lets time go, and says so.
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
    """The plant beside the wall clock.

    Args:
      start: s, the wall clock's time at which the plant's begins; `now` is where it has come to.
      note: called with one line when time is let go.
    """

    SLICE = 0.001  # s, simulated in one go
    BEHIND = 0.1  # s, beyond which time is let go

    def __init__(self, plant: Plant, start: float, note: Callable[[str], None] = lambda text: None):
        self.plant, self.now, self._note = plant, start, note
        self.let_go, self.simulated, self.spent = 0.0, 0.0, 0.0  # s
        self.cost = 0.0  # s, what a slice takes
        self._told = -1e9

    @property
    def due(self) -> float:
        """When the next slice may be computed."""
        return self.now + self.SLICE

    def catch_up(self, now: float, most: float = 0.01) -> None:
        """Bring the plant to this time, or nearer by `most` s."""
        behind = now - self.now
        if behind > self.BEHIND:
            self._let_go(now, behind - most)
        step = min(now - self.now, most)
        if step <= 0:
            return
        begun = time.monotonic()
        self.plant.advance(step)
        took = time.monotonic() - begun
        self.now += step
        self.simulated += step
        self.spent += took
        self.cost += 0.05 * (took * self.SLICE / max(step, 1e-4) - self.cost)

    def _let_go(self, now: float, seconds: float) -> None:
        self.now += seconds
        self.let_go += seconds
        if now > self._told + 5.0:
            self._told = now
            share = self.spent / self.simulated if self.simulated else 0.0
            self._note(
                f"this machine is too slow: {self.let_go:.2f} s of the physics let go so far "
                f"(a second of it takes {share:.2f} s)"
            )

    def report(self) -> dict[str, float]:
        """How well it kept up."""
        return {
            "simulated_s": round(self.simulated, 3),
            "slipped_s": round(self.let_go, 3),
            "cpu_per_simulated_s": round(self.spent / self.simulated, 4) if self.simulated else 0.0,
        }


class Twin:
    """Everything of one emulated hand.

    Args:
      folder: for the ports that have no name of their own.
      show: called with each event's line.

    Raises:
      HandError: a port or socket cannot be made.
    """

    HICCUP = 0.02  # s, the bridge's usual patience beyond the wire's own time

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
        self.world = PlantClock(plant, self.start, self.note)
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
            catch_up=self.world.catch_up,
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
        self.hiccups = 0  # times that this machine let nothing happen for `HICCUP`
        self._stop = False

    def stop(self) -> None:
        """End soon; safe to call from a signal."""
        self._stop = True

    def run(self) -> None:
        """Until all trials are over, or `stop`."""
        sides = [side for side in (self.imu, self.masks) if side]
        now = self.world.now = time.monotonic()
        while not self._stop:
            before, now = now, time.monotonic()
            self.hiccups += now - before > self.HICCUP
            self.line.serve(now)
            free = self.line.due() - now
            for side in sides:
                # A picture takes a millisecond or so: it waits while the wire wants something soon.
                if free > 0.002 or now > side.due + 0.01:
                    side.serve(now)
            if free > self.world.cost or now > self.world.due + 0.01:
                if now >= self.world.due:
                    self.world.catch_up(now, PlantClock.SLICE)
                until = min(self.world.due, *(side.due for side in sides))
            else:
                until = now + free
            if self.plant.trial != self._trial:
                self._trial = self.plant.trial
                done = self._trial - self._first
                end = self.plant.results()[done - 1].get("end", "")
                self.note(f"trial {done} of {self.arguments.trials} is over: {end}")
                self._stop |= done >= self.arguments.trials
            pause = min(until, self.line.due()) - time.monotonic()
            ports = [self.line.terminal] if self.line.terminal.plugged else []
            select.select(ports, [], [], max(pause, 0.0))

    def close(self) -> None:
        """Take the ports away."""
        for part in (self.line, self.imu, self.masks):
            if part:
                part.close()

    def note(self, text: str) -> None:
        """An event, for the report and whoever looks on."""
        now = time.monotonic()
        self.events.append((now, text))
        self._show(f"{now - self.start:9.3f} s  {text}")

    def report(self) -> dict[str, Any]:
        """Results of the trials, and everything that was counted."""
        arguments, firmware, line = self.arguments, self.firmware, self.line
        return {
            "task": arguments.task,
            "seed": arguments.seed,
            "draw": arguments.draw,
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
            "physics": self.world.report(),
            "slowest_exchange_ms": round(1e3 * line.slowest, 3),
            "late": line.lateness.summary(),
            "imu_frames": self.imu.sent if self.imu else 0,
            "masks": dict(self.masks.counts) if self.masks else {},
            "events": [list(event) for event in self.events],
        }
