"""A driver of a hand, its port and the exchange loop, in their own time."""

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.loop import ExchangeLoop
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.driver import DriverPort
from dexsim_real.wire.link import LinkConfig


class DriverBench:
    """Connected and tared, with the motors off; `hardware` are fields of `HardwareConfig`."""

    def __init__(self, hand, driver, **hardware):
        self.hand, self.driver, self.time = hand, driver, 0.0
        driver._clock = self.clock  # of a mock, whose plant it moves
        self.port = DriverPort(driver, hand, LinkConfig(), clock=self.clock)
        self.safety, sensing = Safety(hand, SafetyConfig()), HandSensing(hand, HardwareConfig(**hardware))
        self.loop = ExchangeLoop(self.port, sensing, self.safety, 83.0, clock=self.clock, sleep=self.sleep)
        self.port.connect()
        self.loop.tare()

    def clock(self):
        return self.time

    def sleep(self, seconds):
        self.time += seconds

    def run(self, seconds, target=None, before=lambda: None):
        """Exchange for this long, with a joint target from the policy and a call before each exchange."""
        until = self.time + seconds
        while self.time < until:
            if target is not None:
                self.safety.set_target(target, self.time)
            before()
            self.loop.cycle()
            self.loop.pace.wait()

    def engage(self):
        self.loop.engage()
        self.run(0.05)
        assert self.safety.anchor, "the motors are on"
