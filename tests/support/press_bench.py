"""A hand of known truth on a bench, in its own time: motors with losses, plates to press on, taxels that count.

Written apart from what it is used to test: levers are C MuJoCo's `mj_jac`, motors are quasi-static, and nothing is
shared with the calibration but the wire's blocks.
"""

import dataclasses

import mujoco
import numpy as np

from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import HandPort, Identity, LinkCounts, Reply

EXCHANGE = 0.0096  # s


@dataclasses.dataclass
class Plate:
    """A spring in front of a fingertip: contact begins when the joints have come to `contact`."""

    finger: int
    taxels: np.ndarray  # [K]
    share: np.ndarray  # [K] of the force
    contact: np.ndarray  # [12] rad
    joints: tuple[int, ...]  # that press; it is held there while the targets of the others stand as at contact
    stiffness: float = 1500.0  # N/m
    arms: np.ndarray | None = None  # [12] m, as the hand is now


class BenchHand(HandPort):
    """`HandPort` with a clock of its own.

    Truth, one entry a joint: Nm/A, efficiency pressing and giving way, no-load A, zero error A.
    """

    def __init__(self, hand, plates, *, seed=0, taxel_gain=None, dead=(), noise=0.15, current_noise=0.006):
        self.hand, self.plates = hand, plates
        self.rng = np.random.default_rng(seed)
        self.constant = self.rng.uniform(0.6, 1.1, 12)
        self.efficiency = self.rng.uniform(0.75, 0.95, 12)
        self.back = self.rng.uniform(0.7, 0.95, 12)
        self.idle = self.rng.uniform(0.01, 0.03, 12)
        self.bias = self.rng.uniform(-0.01, 0.01, 12)
        self.taxel_gain = np.ones(5) if taxel_gain is None else np.asarray(taxel_gain)
        self.left = self.rng.uniform(0, 6, (5, 120))  # counts at rest
        self.dead, self.noise, self.current_noise = dead, noise, current_noise
        self.time, self.position = 0.0, np.full(12, 0.05)
        self.position[3] = 0.0
        self.current = np.zeros(12)
        self.force = np.zeros(5)  # N, true
        self.touched = np.zeros((5, 120))  # N, by somebody else
        self.counts, self.commands, self.closed, self.sequence = LinkCounts(), [], False, 0
        self.temperature = 31
        self.model = mujoco.MjModel.from_xml_path(str(hand.model_path))
        self.data = mujoco.MjData(self.model)
        self.dofs = [self.model.joint(name).dofadr[0] for name in hand.joint_names]
        self.qpos = [self.model.joint(name).qposadr[0] for name in hand.joint_names]
        for plate in plates:
            plate.arms = plate.first = self._arms(plate, plate.contact)
        self.held = []
        self._load()

    # --- the port -------------------------------------------------------------------------------

    identity = Identity("2R32BENCH", "right")

    def connect(self):
        return "bench: hand 0, firmware none"

    def exchange(self, command):
        self.commands.append(command)
        sent = self.time
        on = np.all(command["mode"] == Mode.POSITION)
        self.held = [
            plate
            for plate in self.plates
            if on and np.all(np.abs(np.delete(command["position"] - plate.contact, plate.joints)) < 0.03)
        ]
        for plate in self.held:
            if self.force[plate.finger] > 0:
                plate.arms = self._arms(plate, self.position)
        self.advance(command, EXCHANGE)
        self.sequence += 1
        self.counts.sent += 1
        self.counts.answered += 1
        return Reply(self.state(), sent, self.time, self.sequence, 1)

    def close(self):
        self.closed = True

    # --- time -------------------------------------------------------------------------------------

    def clock(self):
        return self.time

    def sleep(self, seconds):
        self.advance(self.commands[-1] if self.commands else None, seconds)

    def advance(self, command, seconds, step=0.005):
        until = self.time + seconds
        while self.time < until - 1e-9:
            size = min(step, until - self.time)
            self._move(command, size)
            self.time += size

    def _move(self, command, size):
        on = np.zeros(12) if command is None else (command["mode"] == Mode.POSITION).astype(float)
        if on.any():
            wanted = command["kp"] * 0.048 * (command["position"] - self.position)  # 4.8 A/rad at kp 100
            limit = command["torque_max"] * 5e-3
            self.current = on * np.clip(wanted, -limit, limit)
        else:
            self.current = np.zeros(12)
        load = self._load()
        ahead, behind = (self._torque(way) for way in (1.0, -1.0))
        speed = np.where(ahead > load, ahead - load, np.where(behind < load, behind - load, 0.0)) / 0.4
        self.position = np.clip(
            self.position + size * np.clip(speed, -8, 8), self.hand.joint_lower, self.hand.joint_upper
        )

    def _torque(self, way):
        """On the joints, if they move this way: losses are against the motion."""
        ideal = self.current - self.idle * way
        loss = np.where(ideal * way > 0, self.efficiency, 1 / self.back)
        return ideal * self.constant * loss

    def _load(self):
        torque, self.force = np.zeros(12), np.zeros(5)
        self.pressed = np.zeros((5, 120))
        for plate in self.held:
            depth = float((plate.arms + plate.first) / 2 @ (self.position - plate.contact))
            force = plate.stiffness * max(depth, 0.0)
            torque += force * plate.arms
            self.force[plate.finger] += force
            self.pressed[plate.finger, plate.taxels] += force * plate.share
        return torque

    def _arms(self, plate, position):
        """J^T n [12] m at the centre of the plate's taxels, n their mean normal: the skin lies flat on the plate."""
        model, data = self.model, self.data
        data.qpos[self.qpos] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        body = model.body(self.hand.body_names[self.hand.tip_body[plate.finger]]).id
        turn, jacobian = data.xmat[body].reshape(3, 3), np.zeros((3, model.nv))
        place, normal = (
            plate.share @ part[plate.finger, plate.taxels]
            for part in (self.hand.taxel_position, self.hand.taxel_normal)
        )
        mujoco.mj_jac(model, data, jacobian, None, data.xpos[body] + turn @ place, body)
        return (jacobian.T @ (turn @ normal / np.linalg.norm(normal)))[self.dofs]

    # --- what it reports ----------------------------------------------------------------------------

    def state(self):
        block = frames.empty_state()
        joint, taxel = block["joint"], block["tip"]["taxel"]
        joint["position"] = self.position
        reading = -(self.current + self.bias) + self.current_noise * self.rng.standard_normal(12)
        joint["current"] = np.round(1e3 * reading)
        joint["temperature"] = self.temperature
        newton = self.pressed + self.touched
        counts = 10 * self.taxel_gain[:, None] * newton + self.left + self.noise * self.rng.standard_normal((5, 120))
        for finger, index in self.dead:
            counts[finger, index] = 0.0
        taxel["z"] = np.clip(np.round(counts), 0, 255)
        return block
