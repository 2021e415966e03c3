"""The emulated hand's twelve drives: firmware servo, current, torque, friction, heat.

    command -> PD on the encoder -> current, limited -> torque on the rotor -> gear (in `scene`) -> joint

The firmware closes its loop at 1 kHz on what its encoder shows, which sits on the rotor's side of the gear. Its
gains have units that the maker does not publish; here 100, what the bridge sends by default, is the stiffness that
training calls nominal, 3 Nm/rad, on every joint. A kd of 0 leaves the winding's own damping (back-EMF), 0.1 Nm s/rad
in the middle of training's range; 100 of kd is as much again. The unit of `torque_max` is such that 300, the bridge's
default, allows 1 A, which is the stall torque: what the boards of real hands report when stalled at 300 lies between
0.8 and 1.5 A.
"""

import collections
import dataclasses

import numpy as np

from dexsim_real.twin.plant.parameters import EXCHANGE_COMMAND, TrialParameters
from dexsim_real.twin.plant.protocol import MotorCommands
from dexsim_real.wire.frames import Mode

STIFFNESS = 3.0 / 100  # Nm/rad per unit of kp
INTEGRAL = 0.3 / 100  # Nm/(rad s) per unit of ki
DAMPING = 0.1 / 100  # Nm s/rad per unit of kd
BACK_EMF = 0.1  # Nm s/rad, damping at kd = 0
STALL_CURRENT = 1.0  # A at torque_max = 300, cold
FULL_TORQUE_MAX = 300.0
PERIOD = 0.001  # s of the firmware's loop
_HEAT_STEPS = 10  # of them between two looks at the temperature
_SPEED_TIME = 0.002  # s, the firmware's filter on the encoder's speed
_FIELDS = ("position", "kp", "ki", "kd", "torque_max", "mode")
_AT_REST = 0.05  # rad/s, speed over which the no-load current turns round


@dataclasses.dataclass(frozen=True)
class Heat:
    """A motor as two bodies: winding and case, which the board's sensor sits on."""

    resistance: float = 6.0  # Ohm at `reference`
    rise: float = 0.0039  # 1/K of the resistance (copper)
    weakening: float = 0.001  # 1/K of the torque constant (magnets)
    to_case: float = 8.0  # K/W
    to_air: float = 14.0  # K/W
    winding: float = 2.0  # J/K
    case: float = 25.0  # J/K
    air: float = 26.0  # degC
    reference: float = 25.0  # degC at which resistance and torque constant are given

    def steady(self, current: float) -> tuple[float, float]:
        """Winding and case degC after a current A has flowed for ever; infinite where it runs away."""
        power, path = current**2 * self.resistance, self.to_case + self.to_air
        gain = power * self.rise * path
        if gain >= 1:
            return np.inf, np.inf
        cold = power * (1 + self.rise * (self.air - self.reference))
        heat = cold / (1 - gain)
        return self.air + heat * path, self.air + heat * self.to_air


class Drives:
    """State of the twelve drives; arrays [12] in the hand's order.

    Args:
      torque_limit: [12] Nm, nominal stall torque.
      speed_limit: [12] rad/s, nominal no-load speed.
    """

    def __init__(self, torque_limit: np.ndarray, speed_limit: np.ndarray, heat: Heat = Heat()):
        self._stall, self._fast, self.heat = torque_limit.astype(float), speed_limit.astype(float), heat
        joints = len(torque_limit)
        self.winding, self.case = np.full(joints, heat.air), np.full(joints, heat.air)
        zero = np.zeros(joints)
        self._board = np.zeros((len(_FIELDS), joints))  # what each joint's board was told last
        self.current = zero.copy()  # A, true
        self._queue: collections.deque[tuple[np.ndarray, np.ndarray]] = collections.deque()
        self._next = np.inf  # s, when the next of them reaches a board
        self._integral, self._speed = zero.copy(), zero.copy()
        self._last: np.ndarray | None = None
        self._on, self._limit, self._most = np.zeros(joints, bool), zero.copy(), zero.copy()

    def configure(self, parameters: TrialParameters) -> None:
        """Take a trial's parameters; heat and commands stay."""
        self.stiffness, self.emf = STIFFNESS * parameters.stiffness, BACK_EMF * parameters.damping
        self.constant = self._stall / STALL_CURRENT * parameters.torque  # Nm/A, cold
        self.no_load_speed = self._fast * parameters.speed
        self.efficiency, self.coulomb = parameters.efficiency, parameters.coulomb_friction * self._stall
        self.ripple, self.ripple_count = parameters.ripple, parameters.ripple_count
        self.bias, self.no_load_current = parameters.encoder_bias, float(parameters.no_load_current)
        self._loss = 1.0 - self.efficiency
        self.thermal = float(parameters.thermal)
        self._feel_heat()
        self.delay = np.maximum(float(parameters.latency) - EXCHANGE_COMMAND, 0.0) + parameters.latency_spread

    def order(self, time: float, motors: MotorCommands) -> None:
        """A command that the palm board has received at `time`; the joints' boards get it later."""
        there = time + self.delay - 1e-9
        self._queue.append((there, np.array([getattr(motors, name) for name in _FIELDS], float)))
        self._next = min(self._next, there.min())

    def step(self, time: float, rotor: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One firmware period.

        Args:
          time: s.
          rotor, speed: [12] rad, rad/s of the rotors, at the joint.

        Returns:
          Torque on the rotors and what dry friction can hold against it, both [12] Nm.
        """
        if time >= self._next:
            self._receive(time)
        self.current = current = self._current(rotor, speed)
        drag = self.no_load_current * np.minimum(np.maximum(speed / _AT_REST, -1.0), 1.0) * (current != 0.0)
        torque = self._warm * (1.0 + self.ripple * np.sin(self.ripple_count * rotor)) * (current - drag)
        self._squares += current * current
        self._steps += 1
        if self._steps == _HEAT_STEPS:
            self._warm_up()
        return torque, self.coulomb + self._loss * np.abs(torque)

    def _receive(self, time: float) -> None:
        """Each board in its turn takes the newest command that has had time to reach it."""
        for there, motors in self._queue:
            self._board = np.where(time >= there, motors, self._board)
        while self._queue and time >= self._queue[0][0].max():
            self._queue.popleft()
        waiting = [there[there > time].min() for there, _ in self._queue]
        self._next = min(waiting, default=np.inf)
        self._on = self._board[5] == Mode.POSITION
        self._limit = self._board[4] / FULL_TORQUE_MAX * STALL_CURRENT
        self._most = self._limit * self.constant

    def _current(self, rotor: np.ndarray, speed: np.ndarray) -> np.ndarray:
        if not self._on.any():
            self._integral[:], self._last = 0.0, None
            return np.zeros_like(speed)
        position, kp, ki, kd, _, _ = self._board
        shown = rotor + self.bias
        error = position - shown
        torque = self.stiffness * kp * error - self.emf * speed
        if ki.any():
            self._integral = np.clip(self._integral + PERIOD * INTEGRAL * ki * error, -self._most, self._most)
            torque += self._integral
        if kd.any():  # The firmware's damping acts on its own estimate, the back-EMF on the winding as it is.
            rate = speed if self._last is None else (shown - self._last) / PERIOD
            self._last = shown
            self._speed += PERIOD / (PERIOD + _SPEED_TIME) * (rate - self._speed)
            torque -= DAMPING * kd * self._speed
        # What the supply can drive against the back-EMF: less in the sense of motion, more against it.
        share = speed / self.no_load_speed
        highest = np.minimum(np.maximum(self._stalled * (1.0 - share), 0.0), self._limit)
        lowest = np.minimum(np.maximum(self._stalled * (1.0 + share), 0.0), self._limit)
        return np.where(self._on, np.minimum(np.maximum(torque / self.constant, -lowest), highest), 0.0)

    def _warm_up(self) -> None:
        """Heat since the last time, and what the new temperature does to the motors."""
        heat, time = self.heat, self._steps * PERIOD
        loss = self.thermal * self._squares / self._steps * heat.resistance
        loss *= 1 + heat.rise * (self.winding - heat.reference)
        across = (self.winding - self.case) / heat.to_case
        self.winding += time * (loss - across) / heat.winding
        self.case += time * (across - (self.case - heat.air) / heat.to_air) / heat.case
        self._feel_heat()

    def _feel_heat(self) -> None:
        warmer = self.thermal * np.maximum(self.winding - self.heat.reference, 0.0)
        self._warm = self.constant * (1.0 - np.minimum(self.heat.weakening * warmer, 0.5))
        self._stalled = STALL_CURRENT / (1.0 + self.heat.rise * warmer)
        self._squares, self._steps = np.zeros_like(self._stalled), 0
