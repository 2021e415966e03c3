"""The twelve drives of the emulated hand: firmware servo, current, torque, friction, heat.

    command -> PD on the encoder -> current, limited -> torque on the rotor -> gear (in `scene`) -> joint

The firmware closes its loop at 1 kHz on the encoder, which is on the rotor's side of the gear. The units of its gains
are not published. Here a kp of 100, the bridge's default, is the nominal stiffness of training, 3 Nm/rad, on every
joint. The damping is that of the winding (back-EMF), 0.1 Nm s/rad, in the middle of training's range; ki and kd, which
the bridge leaves at 0, have no effect. A `torque_max` of 300, the bridge's default, allows 1 A, the stall current; real
hands stalled at 300 report 0.8 to 1.5 A.
"""

import collections

import numpy as np

from dexsim_real.twin.plant.parameters import EXCHANGE_COMMAND, TrialParameters
from dexsim_real.wire.frames import Mode

STIFFNESS = 3.0 / 100  # Nm/rad per unit of kp
BACK_EMF = 0.1  # Nm s/rad
STALL_CURRENT = 1.0  # A at torque_max = 300, cold
FULL_TORQUE_MAX = 300.0
PERIOD = 0.001  # s of the firmware's loop
_HEAT_STEPS = 10  # periods between two updates of the temperature
_FIELDS = ("position", "kp", "torque_max", "mode")
_AT_REST = 0.05  # rad/s, speed within which the no-load current changes its sign

# Thermal model of a motor with two bodies: winding, and case with the temperature sensor.
RESISTANCE = 6.0  # Ohm at `REFERENCE`
RISE = 0.0039  # 1/K, increase of the resistance (copper)
WEAKENING = 0.001  # 1/K, decrease of the torque constant (magnets)
TO_CASE, TO_AIR = 8.0, 14.0  # K/W, thermal resistances: from winding to case, from case to air
WINDING, CASE = 2.0, 25.0  # J/K, heat capacities
AIR = 26.0  # degC
REFERENCE = 25.0  # degC of `RESISTANCE` and of the torque constant


class Drives:
    """State of the twelve drives; arrays [12] in the order of the hand's joints.

    `torque_limit` [12] Nm and `speed_limit` [12] rad/s are the nominal torque at stall and speed without load.
    """

    def __init__(self, torque_limit: np.ndarray, speed_limit: np.ndarray):
        self._stall, self._fast = torque_limit.astype(float), speed_limit.astype(float)
        joints = len(torque_limit)
        self.winding, self.case = np.full(joints, AIR), np.full(joints, AIR)
        zero = np.zeros(joints)
        self._board = np.zeros((len(_FIELDS), joints))  # last command of each joint's board
        self.current = zero.copy()  # A, true
        self._queue: collections.deque[tuple[np.ndarray, np.ndarray]] = collections.deque()
        self._next = np.inf  # s, when the next command reaches a board
        self._on, self._limit = np.zeros(joints, bool), zero.copy()
        self._highest = self._lowest = zero  # A, of the last period

    def configure(self, parameters: TrialParameters) -> None:
        """Set the parameters of a trial; temperatures and commands are kept."""
        self.stiffness, self.emf = STIFFNESS * parameters.stiffness, BACK_EMF * parameters.damping
        self.constant = self._stall / STALL_CURRENT * parameters.torque  # Nm/A, cold
        self.no_load_speed = self._fast * parameters.speed
        self.efficiency, self.coulomb = parameters.efficiency, parameters.coulomb_friction * self._stall
        self.ripple, self.ripple_count = parameters.ripple, parameters.ripple_count
        self.bias, self.no_load_current = parameters.encoder_bias, parameters.no_load_current
        self._loss = 1.0 - self.efficiency
        self.thermal = parameters.thermal
        self._apply_heat()
        self.delay = max(parameters.latency - EXCHANGE_COMMAND, 0.0) + parameters.latency_spread

    def send(self, time: float, command: np.ndarray) -> None:
        """Queue a `frames.COMMAND_BLOCK` that the palm board has at a time in s; the joints' boards get it later."""
        there = time + self.delay - 1e-9
        self._queue.append((there, np.array([command[name] for name in _FIELDS], float)))
        self._next = min(self._next, there.min())

    def step(self, time: float, rotor: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Simulate one firmware period from a time in s, with angles and speeds [12] rad, rad/s of the rotors, seen at
        the joint. Returns the torque on the rotors and the largest dry friction, both [12] Nm."""
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

    def at_limit(self) -> np.ndarray:
        """Which drives [12] bool are at the largest torque that supply or `torque_max` allows."""
        return self._on & ((self.current >= self._highest) | (self.current <= -self._lowest))

    def _receive(self, time: float) -> None:
        """Each board takes the newest command that has reached it."""
        for there, command in self._queue:
            self._board = np.where(time >= there, command, self._board)
        while self._queue and time >= self._queue[0][0].max():
            self._queue.popleft()
        self._next = min((there[there > time].min() for there, _ in self._queue), default=np.inf)
        _, _, torque_max, mode = self._board
        self._on = mode == Mode.POSITION
        self._limit = torque_max / FULL_TORQUE_MAX * STALL_CURRENT

    def _current(self, rotor: np.ndarray, speed: np.ndarray) -> np.ndarray:
        if not self._on.any():
            return np.zeros_like(speed)
        position, kp, *_ = self._board
        torque = self.stiffness * kp * (position - (rotor + self.bias)) - self.emf * speed
        # Current that the supply can drive against the back-EMF: less in the direction of motion, more against it.
        share = speed / self.no_load_speed
        highest = np.minimum(np.maximum(self._stalled * (1.0 - share), 0.0), self._limit)
        lowest = np.minimum(np.maximum(self._stalled * (1.0 + share), 0.0), self._limit)
        self._highest, self._lowest = highest, lowest
        return np.where(self._on, np.minimum(np.maximum(torque / self.constant, -lowest), highest), 0.0)

    def _warm_up(self) -> None:
        """Update the temperatures and the motors' properties."""
        time = self._steps * PERIOD
        loss = self.thermal * self._squares / self._steps * RESISTANCE
        loss *= 1 + RISE * (self.winding - REFERENCE)
        across = (self.winding - self.case) / TO_CASE
        self.winding += time * (loss - across) / WINDING
        self.case += time * (across - (self.case - AIR) / TO_AIR) / CASE
        self._apply_heat()

    def _apply_heat(self) -> None:
        warmer = self.thermal * np.maximum(self.winding - REFERENCE, 0.0)
        self._warm = self.constant * (1.0 - np.minimum(WEAKENING * warmer, 0.5))
        self._stalled = STALL_CURRENT / (1.0 + RISE * warmer)
        self._squares, self._steps = np.zeros_like(self._stalled), 0
