"""The press procedure on a simulated bench, for tests."""

import io
import queue

import numpy as np
from press_bench import Plate

from dexsim_real.calibrate import __main__ as calibrate
from dexsim_real.calibrate.bench import CalibrateArguments, Operator, PressConfig
from dexsim_real.calibrate.procedure import placements
from dexsim_real.sensors.hand import HardwareConfig
from dexsim_real.wire.frames import Mode

SHORT = PressConfig(cycles=3, seconds=4.0, approach_speed=0.3, first_speed=0.08)

QUICK = PressConfig(cycles=1, seconds=1.0, approach_speed=0.5, first_speed=0.2, pause=0.2)


def plates(hand, *names):
    """A spring before each named placement, which presses on twenty taxels or a dozen."""
    found = []
    for placement in placements(hand):
        if names and placement.name not in names:
            continue
        columns = (3, 4, 5, 6) if placement.name.endswith("pad") else (7, 8, 9)
        taxels = np.array([column * 12 + row for column in columns for row in range(3, 8)])
        share = np.exp(-0.5 * ((taxels % 12 - 5) / 1.2) ** 2)
        found.append(Plate(placement.finger, taxels, share / share.sum(), placement.posture, placement.joints))
    return found


def arguments(folder, **options):
    options = {
        "port": "bench",
        "output": folder / "hand.toml",
        "log": folder / "hand.log",
        "yes": True,
        "press": SHORT,
        "rate": 83.0 if options.get("identify") else 62.0,  # Fewer exchanges take less time.
        "fingers": () if options.get("identify") else ("index",),
        "realtime": False,
        "hardware": HardwareConfig(tare_sum=1000.0),  # The bench's taxels read 0 to 6 counts at rest.
    } | options
    return CalibrateArguments(**options)


def operator():
    return Operator(io.StringIO(), assume_yes=True)


class Typist(io.StringIO):
    """A terminal and who sits at it: presses Enter when told to, types what the scale shows, `force()` in N."""

    def __init__(self, force):
        super().__init__()
        self.force, self.lines, self.read = force, queue.SimpleQueue(), 0

    def write(self, text):
        if "Enter presses" in text:
            self.lines.put("\n")
        elif "reading of the gauge" in text:
            self.read += 1
            # A slip of the finger first: it is asked for again.
            self.lines.put("five\n" if self.read == 2 else f"{1e3 * self.force() / 9.80665:.2f} g\n")
        return super().write(text)

    def readline(self):
        return self.lines.get()

    def operator(self):
        return Operator(self, stream=self)


def record(bench, hand, options, who=None):
    return calibrate.record(options, hand, who or operator(), port=bench, clock=bench.clock, sleep=bench.sleep)


def off(bench):
    return np.all(bench.commands[-1]["mode"] == Mode.PASSIVE)


def on(bench):
    return np.array([np.all(command["mode"] == Mode.POSITION) for command in bench.commands])
