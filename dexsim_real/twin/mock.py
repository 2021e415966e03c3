"""A mock of any hand, made from its folder: a driver around the emulated hand, in this process and in real time.

    python -m dexsim_real.run policy.msgpack --port sdk:dexsim_real.twin.mock --uncalibrated --fixed-object --yes

The hand is that of the policy. Its MJCF is the plant of `EmulatedHand`, with motors, taxels and an object that is let
go over the palm again and again. Currents and temperatures are those of the emulated motors.
"""

import time

import numpy as np

from dexsim.hand.description import Hand
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.wire.driver import WITHOUT, DriverState, HandDriver, JointTargets
from dexsim_real.wire.frames import Mode, command_block, passive_command
from dexsim_real.wire.link import LinkConfig

_SLIP = 0.1  # s that the plant may be behind the clock; what is more is let go, as after a breakpoint


class MockHand(HandDriver):
    """A driver whose hand is emulated. The plant advances to the clock's time at each call."""

    measures = frozenset(WITHOUT)

    def __init__(self, plant: EmulatedHand):
        self.plant, self._clock = plant, time.monotonic

    def connect(self) -> str:
        self._time = self._clock()
        self.motors = passive_command(self.plant.hand.num_joints)
        self.plant.drive(self.motors)
        return f"mock of {self.plant.hand.name}"

    def send(self, targets: JointTargets) -> None:
        self._advance()
        mode = Mode.POSITION if targets.on else Mode.PASSIVE
        gains = {name: getattr(targets, name) for name in ("kp", "ki", "kd")}
        self.motors = command_block(targets.position, mode, torque_max=np.round(1e3 * targets.current), **gains)
        self.plant.drive(self.motors)

    def read(self) -> DriverState:
        self._advance()
        now = self.plant.measure()
        return DriverState(
            position=now.joint_position,
            on=self.motors["mode"] == Mode.POSITION,
            current=1e-3 * now.current,
            temperature=now.temperature,
            taxel_force=np.maximum(now.taxel_force[..., 2], 0.0),
        )

    def close(self) -> None:
        """There is nothing to close."""

    def _advance(self) -> None:
        now = self._clock()
        self.plant.advance(min(now - self._time, _SLIP))
        self._time = now


def open_hand(hand: Hand, link: LinkConfig) -> MockHand:
    """For `--port sdk:dexsim_real.twin.mock`."""
    return MockHand(EmulatedHand(hand, "grasp", kind="nominal"))
