"""The motors of a user's hand: the position servos of its MJCF, driven by the commands of the wire.

A kp of 100 and a kd of 0, the bridge's defaults, are the servo's own gains; the damping doubles with a kd of 100. There
is no integral gain. A `torque_max` of 300 allows the servo's own limit. The reported current is the joint's torque, as
a share of the hand's torque limit, times the stall current. The motors stay cold.
"""

import collections

import mujoco
import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.twin.plant.drives import FULL_TORQUE_MAX, STALL_CURRENT, Heat
from dexsim_real.twin.plant.foreign.model import ForeignModel
from dexsim_real.twin.plant.parameters import EXCHANGE_COMMAND, TrialParameters
from dexsim_real.twin.plant.protocol import MotorCommands
from dexsim_real.wire.frames import Mode

_FULL_GAIN = 100.0  # kp that is the servo's own stiffness; kd that doubles its damping
_AT_LIMIT = 0.999


class ForeignMotors:
    """State of the motors; arrays [J] in the order of the hand's joints."""

    def __init__(self, foreign: ForeignModel, hand: Hand):
        self._rows, joints = list(foreign.actuators), hand.num_joints
        self._per_torque = STALL_CURRENT / hand.torque_limit
        self.current = np.zeros(joints)  # A, true
        self.winding, self.case = np.full(joints, Heat.air), np.full(joints, Heat.air)  # degC
        self._on = self._limited = np.zeros(joints, bool)
        self._board: MotorCommands | None = None  # the last commands that arrived
        self._queue: collections.deque[tuple[float, MotorCommands]] = collections.deque()

    def configure(self, parameters: TrialParameters) -> None:
        """Set the parameters of a trial; commands are kept."""
        self.bias = parameters.encoder_bias
        self.delay = max(float(parameters.latency) - EXCHANGE_COMMAND, 0.0)

    def attach(self, model: mujoco.MjModel) -> None:
        """Take the servos of a new model; its motors are off until `step`."""
        rows = self._rows
        self._gear, self._force = model.actuator_gear[rows, 0], model.actuator_forcerange[rows, 1].copy()
        self._gain, self._bias = model.actuator_gainprm[rows, 0].copy(), model.actuator_biasprm[rows, 1:3].copy()
        self._set(model)

    def send(self, time: float, motors: MotorCommands) -> None:
        """Queue commands that the palm board received at a time in s."""
        self._queue.append((time + self.delay - 1e-9, motors))

    def step(self, time: float, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Take what has arrived by a time in s, and read the torques of the step before."""
        force = data.actuator_force[self._rows]
        self._limited = self._on & (np.abs(force) >= _AT_LIMIT * model.actuator_forcerange[self._rows, 1])
        self.current = force * self._gear * self._per_torque
        while self._queue and time >= self._queue[0][0]:
            _, self._board = self._queue.popleft()
            self._set(model)
        if self._board is not None:
            data.ctrl[self._rows] = self._gear * (self._board.position - self.bias)

    def at_limit(self) -> np.ndarray:
        """Which motors [J] bool are at their largest torque."""
        return self._limited

    def _set(self, model: mujoco.MjModel) -> None:
        """Write the gains and limits of the last commands into a model."""
        rows, board = self._rows, self._board
        zero = np.zeros(len(rows))
        self._on = zero > 0 if board is None else np.asarray(board.mode) == Mode.POSITION
        kp, kd, most = (zero, zero, zero) if board is None else (board.kp, board.kd, board.torque_max)
        stiffness, damping = self._on * kp / _FULL_GAIN, self._on * (1 + kd / _FULL_GAIN)
        model.actuator_gainprm[rows, 0] = self._gain * stiffness
        model.actuator_biasprm[rows, 1] = self._bias[:, 0] * stiffness
        model.actuator_biasprm[rows, 2] = self._bias[:, 1] * damping
        force = self._force * np.clip(most / FULL_TORQUE_MAX, 0.0, 1.0)
        model.actuator_forcerange[rows] = np.stack([-force, force], -1)
