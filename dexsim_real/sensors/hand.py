"""From reported values to SI units: calibration, tare, masked taxels, filtered velocities."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from dexsim.calibration.maps import Calibration, normalised_torque
from dexsim.core.config import Config, setting
from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.taxels import StuckTaxels, ZeroTracker, judge_rest, taxel_names
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode

_VELOCITY_TIME = 0.02  # s, time constant of the filter on differences of the joint angle
_WANDERED = 30.0  # counts by which a fingertip's zero may move before a new tare is advised: 3 N by the vendor's 0.1 N


@dataclasses.dataclass(frozen=True, kw_only=True)
class HardwareConfig(Config):
    """Signs, scales and gains of a hand, most of them unconfirmed by public sources.

    Check them on your own hand before you turn the motors on (docs/hardware.md).
    """

    joint_sign: tuple[float, ...] = setting((1.0,), unit="1", low=-1.0, high=1.0)
    """Direction of each joint relative to the model: 1 or -1; one value is for all joints, here and below. Public
    descriptions disagree about joint 3 of the XHand (splay of the index finger); in the model positive is toward the
    thumb."""
    joint_offset: tuple[float, ...] = setting((0.0,), unit="rad", low=-1.0, high=1.0)
    """Added to the reported angle after the sign."""
    kp: tuple[int, ...] = setting((100,), unit="1", low=0, high=5000)
    """Position gain, in an unpublished unit on the XHand, where 80 to 225 are in use."""
    ki: tuple[int, ...] = setting((0,), unit="1", low=-3000, high=3000)
    """Integral gain, likewise."""
    kd: tuple[int, ...] = setting((0,), unit="1", low=0, high=12000)
    """Damping gain, likewise; sources give a range of 0 to 5000 and use 12000."""
    torque_max: int = setting(300, unit="mA", low=0, high=1200)
    """Current limit sent with every command. Hands have reported currents far above it, so `--safety.current` limits
    the current as well."""
    force_per_count: float = setting(0.1, unit="N", low=1e-4, high=10.0)
    """Force of one taxel count without a calibration. The vendor's 0.1 N has not been confirmed by a measurement."""
    taxel_axes: str = setting("z", choices=("z", "norm"))
    """Force of a taxel: its normal component (z), or the norm of all three components (norm)."""
    taxel_floor: float = setting(1.0, unit="count", low=0.0, high=255.0)
    """Tared counts below this read as zero."""
    tare_sum: float = setting(50.0, unit="count", low=0.0, high=30600.0)
    """Largest sum of a fingertip's counts when it is tared, and of its zeros afterwards: the largest load that they can
    hide, 5 N by the vendor's 0.1 N."""
    current_sign: float = setting(-1.0, unit="1", low=-1.0, high=1.0)
    """Sign of the current without a calibration: -1 when a positive current opens the hand."""
    current_scale: float = setting(1000.0, unit="mA", low=1.0, high=20000.0)
    """Current that reads as torque 1 without a calibration (not measured)."""

    def __post_init__(self):
        super().__post_init__()
        if any(abs(sign) != 1.0 for sign in self.joint_sign):
            raise HandError("HardwareConfig.joint_sign: every value must be 1 or -1")

    def per_joint(self, name: str, joints: int) -> np.ndarray:
        """A setting for each joint [J]. HandError: it has neither one value nor one a joint."""
        values = getattr(self, name)
        if len(values) not in (1, joints):
            raise HandError(f"HardwareConfig.{name}: {len(values)} values for {joints} joints")
        return np.broadcast_to(np.array(values), joints)


@dataclasses.dataclass(frozen=True)
class HandMeasurement:
    """One state block in SI units; float32 throughout."""

    joint_position: np.ndarray  # [J] rad
    joint_torque: np.ndarray  # [J] 1, relative to the stall torque
    taxel_force: np.ndarray  # [F, N] N
    current: np.ndarray  # [J] A, magnitude; NaN where the hand measures none
    temperature: np.ndarray  # [J + F + 1] degC, joint boards, tips and palm board; 0 where it measures none
    errors: np.ndarray  # [J, 3] error bits of palm, joint and tip board
    mode: np.ndarray  # [J] control mode that the hand reports, `frames.Mode`

    @property
    def finger_force(self) -> np.ndarray:
        """Force [F] N of each fingertip."""
        return self.taxel_force.sum(-1)

    def finite(self) -> bool:
        """Whether angles, torques and forces are finite."""
        return all(np.isfinite(part).all() for part in (self.joint_position, self.joint_torque, self.taxel_force))


class HandSensing:
    """Converts the hand's state blocks to SI units, and joint angles to command blocks.

    `tare` [F, N] holds the taxel counts that read as no force; infinite for stuck taxels, which never read one. Without
    a calibration of this hand the scales of `config` count. HandError: `config` is for another number of joints.
    """

    def __init__(self, hand: Hand, config: HardwareConfig, calibration: Calibration | None = None):
        self.hand, self.config, self.calibration = hand, config, calibration
        names, joints = ("joint_sign", "joint_offset", "kp", "ki", "kd"), hand.num_joints
        sign, offset, *self._gains = (config.per_joint(name, joints) for name in names)
        self._sign, self._offset = sign.astype(np.float32), offset.astype(np.float32)
        self.tare = np.zeros((hand.num_fingers, hand.num_taxels), np.float32)
        self._tared, self._advised = self.tare, np.zeros(hand.num_fingers, bool)
        self._stuck, self._zero = StuckTaxels(hand), ZeroTracker(hand, config.tare_sum)
        if calibration is None:
            self._per_count = np.full((hand.num_fingers, 1), config.force_per_count, np.float32)
            scale = np.float32(config.current_sign / config.current_scale)
            self._torque = lambda counts: counts * scale
        else:
            self._per_count = np.asarray(calibration.force_per_count, np.float32)[:, None]
            self._torque = jax.jit(lambda milliamperes: normalised_torque(calibration, milliamperes * np.float32(1e-3)))

    @property
    def block(self) -> np.dtype:
        """The state block of this hand with a driver of its own."""
        return frames.driver_block(self.hand.num_joints, self.hand.num_fingers, self.hand.num_taxels)

    def decode(self, data: bytes) -> np.ndarray:
        """A logged state: of the XHand's wire, or of a driver. HandError: it is of another hand."""
        for block in (self.block, frames.STATE_BLOCK):
            if len(data) == block.itemsize:
                return frames.decode_state(data, block)
        raise HandError(f"expected states of {self.hand.name}, got {len(data)} bytes: give the log's hand with --hand")

    def measure(self, state: np.ndarray) -> HandMeasurement:
        """A `frames.STATE_BLOCK` or `frames.driver_block` in SI units."""
        joint, tip = state["joint"], state["tip"]
        counts = np.maximum(self.counts(state) - self.tare, 0.0)
        counts = np.where(counts < self.config.taxel_floor, np.float32(0), counts)
        board, palm = joint["temperature"] & 0xFF, joint["temperature"] >> 8
        current = joint["current"].astype(np.float32)
        return HandMeasurement(
            joint_position=self.angles(joint["position"]),
            joint_torque=np.nan_to_num(np.asarray(self._torque(current), np.float32)),
            taxel_force=counts * self._per_count,
            current=np.abs(current) * np.float32(1e-3),
            temperature=np.concatenate([board, tip["temperature"], [palm.max()]]).astype(np.float32),
            errors=np.stack([joint["palm_error"], joint["joint_error"], joint["tip_error"]], -1),
            mode=(joint["raw_position"] & 0xF).astype(np.uint8),
        )

    def angles(self, reported: np.ndarray) -> np.ndarray:
        """Angles [..., J] rad of the model, given those that the hand counts."""
        return reported * self._sign + self._offset

    def set_tare(self, states: Sequence[np.ndarray]) -> list[str]:
        """Tare the taxels: their mean counts over these states of an untouched hand read as no force.

        Stuck taxels are masked; returns a line for each fingertip with some. Raises HandError: a fingertip touches
        something, or has many stuck taxels.
        """
        counts = np.asarray(np.mean([self.counts(state) for state in states], axis=0, dtype=np.float32))
        stuck = judge_rest(self.hand, counts, self.config.tare_sum)
        self.tare = self._tared = np.where(stuck, np.float32(np.inf), counts)
        self._advised[:] = False
        return self._say_masked(stuck)

    def follow_taxels(self, time: float, state: np.ndarray, limit: float) -> tuple[bool, list[str]]:
        """Mask taxels that have got stuck and follow the zeros of those that touch nothing, by every answer of a run.

        `limit` N is the largest force of a finger. Returns whether `tare` has changed, and lines about masked taxels
        and zeros that have moved far.
        """
        before, lines, counts = self.tare, list[str](), self.counts(state)
        stuck = self._stuck.find(np.maximum(counts - before, 0.0), limit / self._per_count)
        if stuck.any():
            self.tare = np.where(stuck, np.float32(np.inf), before)
            lines = self._say_masked(stuck)
        self.tare = self._zero.update(time, counts, self.tare)
        return not np.array_equal(self.tare, before), lines + self._say_wandered()

    def _say_masked(self, stuck: np.ndarray) -> list[str]:
        return [
            f"{name}: stuck and read as 0 from now on: taxel {taxel_names(self.hand, which)}"
            for name, which in zip(self.hand.finger_names, stuck, strict=True)
            if which.any()
        ]

    def _say_wandered(self) -> list[str]:
        """A line, once, for each fingertip whose zeros have moved far since they were tared."""
        known = np.isfinite(self.tare) & np.isfinite(self._tared)
        moved = np.where(known, self.tare, 0.0).sum(1) - np.where(known, self._tared, 0.0).sum(1)
        new = (np.abs(moved) > _WANDERED) & ~self._advised
        self._advised |= new
        return [
            f"{self.hand.finger_names[finger]}: its zero has moved by {moved[finger]:.0f} counts since it was tared; "
            "end the run, and start another with nothing touching the fingertips"
            for finger in np.flatnonzero(new)
        ]

    def command(self, position: np.ndarray, mode: Mode, stiffness: float = 1.0) -> np.ndarray:
        """Joint commands (`frames.command_block`) for joint angles [J] rad of the model.

        Gains are 0 in all modes but `POSITION`. `stiffness` is a share of the gains kp and ki in [0, 1]; those of
        damping are always whole. Raises HandError: an angle is not finite.
        """
        on, (kp, ki, kd), current = mode == Mode.POSITION, self._gains, self.config.torque_max
        reported, share = (np.asarray(position) - self._offset) * self._sign, stiffness * on
        block = frames.command_block(
            reported, kp=kp * share, ki=ki * share, kd=kd * on, torque_max=current * on, mode=mode
        )
        if not np.isfinite(block["position"]).all():
            raise HandError("a command is not finite; it was not sent")
        return block

    def counts(self, state: np.ndarray) -> np.ndarray:
        """Raw taxel counts [F, N], neither tared nor scaled."""
        taxel = state["tip"]["taxel"]
        if self.config.taxel_axes == "z":
            return taxel["z"].astype(np.float32)
        return np.sqrt(sum(taxel[axis].astype(np.float32) ** 2 for axis in "xyz"))


class VelocityFilter:
    """Joint velocities [J] rad/s: differences of the joint angles through a first-order filter."""

    def __init__(self, joints: int):
        self._last: tuple[float, np.ndarray] | None = None
        self.velocity = np.zeros(joints, np.float32)

    def estimate(self, time: float, position: np.ndarray) -> np.ndarray:
        """Velocities [J] rad/s if this measurement [J] rad at a time in s were kept."""
        if self._last is None or time <= self._last[0]:
            return self.velocity
        step = time - self._last[0]
        weight = step / (step + _VELOCITY_TIME)
        rate = (position - self._last[1]) / step
        return (self.velocity + weight * (rate - self.velocity)).astype(np.float32)

    def update(self, time: float, position: np.ndarray) -> np.ndarray:
        """Keep a measurement [J] rad at a time in s; returns the velocities [J] rad/s after it."""
        self.velocity = self.estimate(time, position)
        self._last = time, position
        return self.velocity
