"""Drivers of hands other than the XHand: the protocol that a driver implements, and the port made of it.

A driver reads and writes SI units and knows nothing of policies or limits. `DriverPort` does the rest: reconnection,
statistics, and the blocks of `dexsim_real.wire.frames`, so that loop, safety, log and replay are those of every hand.
`dexsim_real.wire.dynamixel` is an example, `dexsim_real.twin.mock` emulates any hand. docs/bridge.md has the steps.
"""

import dataclasses
from typing import Protocol

import numpy as np

from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError, find_function
from dexsim_real.wire import frames
from dexsim_real.wire.frames import HOST, Command, Frame, Mode, driver_block, palm_address, passive_command
from dexsim_real.wire.link import HandPort, LinkConfig, Refusal, Reply, SerialHand

NEWTONS_PER_COUNT = 0.1  # of the blocks' taxel counts; the default of `--hardware.force-per-count`
WITHOUT = {
    "taxels": "no taxels: policies cannot observe contact_force, contact_centre or finger_force; --safety.finger-force"
    " and --safety.total-force are off; calibrate has only --identify",
    "currents": "no currents: policies cannot observe joint_torque and finger_force; --safety.current, "
    "--safety.stall-current and the check that joints follow their commands are off; calibrate has only --identify, "
    "and finds no torques",
    "temperatures": "no temperatures: --safety.temperature is off",
}
"""What the bridge cannot do without a measurement, by its name in `HandDriver.measures`."""


@dataclasses.dataclass(frozen=True)
class JointTargets:
    """What the motors are to do; angles as the motors count them (`--hardware.joint-sign` and `joint-offset`)."""

    position: np.ndarray  # [J] rad
    on: bool  # False: motors off, whatever else is said here
    kp: np.ndarray  # [J] position gain in the motors' own unit (`--hardware.kp`); it grows from 0 at the start
    ki: np.ndarray  # [J] integral gain (`--hardware.ki`)
    kd: np.ndarray  # [J] damping gain (`--hardware.kd`)
    current: np.ndarray  # [J] A, current limit (`--hardware.torque-max`)


@dataclasses.dataclass(frozen=True)
class DriverState:
    """What a hand measures at one time; None where it has no such sensor."""

    position: np.ndarray  # [J] rad, as the motors count
    on: np.ndarray  # [J] bool, whether each motor is on, as the hand reports it
    current: np.ndarray | None = None  # [J] A; `--hardware.current-sign` is its sign when a joint closes
    temperature: np.ndarray | None = None  # [J] degC, of the motors
    taxel_force: np.ndarray | None = None  # [F, N] N, pressing into the fingertip
    errors: np.ndarray | None = None  # [J] error bits, 0 for none: they hold the hand, then turn the motors off


class HandDriver(Protocol):
    """A hand with J joints and F fingers of N taxels, in the order of its TOML. Called from one thread.

    The limits of angles and speeds are those of the hand's MJCF and TOML: `Safety` sends no target beyond them.
    `connect`, `send` and `read` raise OSError when the line fails; the port then connects again. Each returns within
    0.3 s, also while the hand is gone: the guard process takes a runner that does not move for dead.
    """

    measures: frozenset[str]  # of "currents", "temperatures", "taxels": what every `read` gives besides the angles

    def connect(self) -> str:
        """Open the line and turn the motors off; returns a line that describes the hand.

        Raises HandError: the hand does not answer, or is another one.
        """

    def send(self, targets: JointTargets) -> None:
        """Send joint targets, or turn the motors off."""

    def read(self) -> DriverState | None:
        """A state measured after the last `send`; None when no valid answer arrived in time."""

    def close(self) -> None:
        """Close the line; no error where it is closed already."""


class DriverPort(HandPort):
    """`HandPort` of a hand that has a driver; `hand` gives the number of joints, fingers and taxels."""

    def __init__(self, driver: HandDriver, hand: Hand, config: LinkConfig):
        super().__init__(config, passive_command(hand.num_joints))
        self.driver, self._hand = driver, hand
        self._block = driver_block(hand.num_joints, hand.num_fingers, hand.num_taxels)

    @property
    def missing(self) -> list[str]:  # A driver may learn at `connect` what its hand measures.
        return [name for name in WITHOUT if name not in self.driver.measures]

    def warnings(self) -> list[str]:
        """One line for each thing that this hand does not measure."""
        return [WITHOUT[name] for name in self.missing]

    def close(self) -> None:
        self._connected = False
        self.driver.close()

    def _connect(self, again: bool = False) -> str:
        line = self.driver.connect()
        self._connected = True
        self._generation += 1
        return line

    def _exchange(self, command: np.ndarray) -> Reply | None:
        self.counts.sent += 1
        sent, on = self._clock(), bool(np.all(command["mode"] == Mode.POSITION))
        self.tap("tx", Frame(HOST, palm_address(0), Command.EXCHANGE, command.tobytes()).encode())
        kp, ki, kd = (command[name].astype(float) for name in ("kp", "ki", "kd"))
        targets = JointTargets(command["position"].astype(float), on, kp, ki, kd, command["torque_max"] * 1e-3)
        try:
            self.driver.send(targets)
            state = self.driver.read()
        except OSError:
            self.counts.lost += 1
            raise
        received = self._clock()
        if state is None:
            self.counts.silent += 1
            return None
        block = self._pack(state)
        self.tap("rx", Frame(palm_address(0), HOST, Command.EXCHANGE, block.tobytes()).encode())
        if not on and np.any(state.on):
            self.counts.refused += 1
            self.refusal = Refusal("motors are on that were told to go off", serious=False)
            return None
        self.counts.answered += 1
        return Reply(block, sent, received, self.counts.sent, self._generation)

    def _pack(self, state: DriverState) -> np.ndarray:
        """The block of a state. HandError: an array has another shape, or is missing."""
        hand, measures = self._hand, self.driver.measures
        joints, taxels = (hand.num_joints,), (hand.num_fingers, hand.num_taxels)
        # What should be measured and is not would turn off a limit that the user counts on.
        current = _checked("current", state.current, joints, "currents" in measures, np.nan)
        heat = _checked("temperature", state.temperature, joints, "temperatures" in measures)
        force = _checked("taxel_force", state.taxel_force, taxels, "taxels" in measures)
        on = _checked("on", state.on, joints)
        block = np.zeros((), self._block)
        joint = block["joint"]
        joint["id"] = np.arange(hand.num_joints)
        joint["position"] = _checked("position", state.position, joints)
        joint["raw_position"] = np.where(on, Mode.POSITION, Mode.PASSIVE)
        joint["current"] = 1e3 * current
        joint["temperature"] = np.clip(heat, 0, 255)
        errors = _checked("errors", state.errors, joints, state.errors is not None)
        # Whatever does not fit must not read as no error; a driver's 8 bits cannot hold 0xFFFF (NumPy 2.5 raises).
        joint["joint_error"] = np.where(errors == (errors.astype(int) & 0xFFFF), errors.astype(int), 0xFFFF)
        block["tip"]["taxel"]["z"] = force / NEWTONS_PER_COUNT
        return block


def _checked(
    name: str, value: np.ndarray | None, shape: tuple[int, ...], measured: bool = True, absent: float = 0.0
) -> np.ndarray:
    """An array of a `DriverState`; `absent` in every place of one that the hand does not measure."""
    if not measured:
        return np.full(shape, absent)
    array = np.asarray(value)
    if array.shape != shape:
        raise HandError(f"the driver's {name} has the shape {list(array.shape)}, expected {list(shape)}")
    if not np.isfinite(array).all():
        raise HandError(f"the driver's {name} is not finite; `read` returns None where it has no whole state")
    return array


def check_wire(hand: Hand) -> None:
    """Raises HandError: the hand has other joints or taxels than the frames carry."""
    if (hand.num_joints, hand.num_fingers, hand.num_taxels) != (frames.JOINTS, frames.TIPS, frames.TAXELS):
        has = f"{hand.num_joints} joints and {hand.num_fingers} x {hand.num_taxels} taxels"
        raise HandError(f"{hand.name}: {has}, unlike the XHand: give a driver, --port sdk:MODULE (docs/bridge.md)")


def open_port(spec: str, hand: Hand, config: LinkConfig) -> HandPort:
    """The hand at a port: an XHand's serial port, or `sdk:MODULE:FUNCTION` for a function that takes the `Hand` and a
    `LinkConfig` and returns a `HandDriver`.

    Raises HandError: the module or function cannot be found, or the serial port is for another hand.
    """
    if not spec.startswith("sdk:"):
        check_wire(hand)
        return SerialHand(spec, config)
    form = "sdk:MODULE:FUNCTION of an importable module"
    driver = find_function(spec.removeprefix("sdk:"), spec, form, default="open_hand")(hand, config)
    return DriverPort(driver, hand, config)
