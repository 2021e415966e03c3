"""From reported values to SI units: calibration, and the zeros of the taxels.

The skin spreads every load over adjacent taxels. So a taxel that reads much while the rest of its fingertip reads next
to nothing is stuck, and one that stays near its zero beside neighbours that do so bears nothing.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from scipy import ndimage

from dexsim.calibration.maps import Calibration, normalised_torque
from dexsim.core.config import Config, setting
from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode

_WANDERED = 30.0  # counts by which a fingertip's zero may move before a new tare is advised: 3 N by the vendor's 0.1 N

_HIGH = 40.0  # counts above which a taxel cannot be tared: alone it is stuck, several adjacent ones touch something
_ADJACENT = 2  # neighbours above the limit that make it a touch: three taxels in a patch
_MANY = 6  # stuck taxels of a fingertip with which it is of no use
_QUIET = 5.0  # counts up to which the other taxels of a fingertip read next to nothing
_ANSWERS = 20  # in which a stuck taxel reads the same
_SAME = 1.0  # counts
_WINDOW = 2.0  # s since a taxel was last pressed, over which its readings are averaged
_NEAR = 1.5  # counts above its zero up to which a taxel may be free: one count, and a zero between two counts
_RATE = 0.06  # counts/s by which the zeros of a fingertip may rise, together; 60 counts were seen in half an hour
_FIRST = 2.0  # counts of rise that are allowed from the beginning
_AT_ONCE = 10.0  # counts of rise that may have been saved up while the fingertip was pressed
_NEIGHBOURS = np.array([[[1, 1, 1], [1, 0, 1], [1, 1, 1]]])


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


class HandSensing:
    """Converts the hand's state blocks to SI units, and joint angles to command blocks.

    `tare` [F, N] holds the taxel counts that read as no force; infinite for stuck taxels, which never read one. Without
    a calibration of this hand the scales of `config` count. HandError: `config` is for another number of joints.
    """

    def __init__(self, hand: Hand, config: HardwareConfig, calibration: Calibration | None = None):
        self.hand, self.config, self.calibration = hand, config, calibration
        self.block = frames.driver_block(hand.num_joints, hand.num_fingers, hand.num_taxels)  # of a driver's states
        given = {name: getattr(config, name) for name in ("joint_sign", "joint_offset", "kp", "ki", "kd")}
        for name, values in given.items():
            if len(values) not in (1, hand.num_joints):
                raise HandError(f"HardwareConfig.{name}: {len(values)} values for {hand.num_joints} joints")
        sign, offset, *self._gains = (np.broadcast_to(np.array(values), hand.num_joints) for values in given.values())
        self._sign, self._offset = sign.astype(np.float32), offset.astype(np.float32)
        self.tare = np.zeros((hand.num_fingers, hand.num_taxels), np.float32)
        self._tared, self._advised = self.tare, np.zeros(hand.num_fingers, bool)
        self._tracker = TaxelTracker(hand, config.tare_sum)
        if calibration is None:
            self._per_count = np.full((hand.num_fingers, 1), config.force_per_count, np.float32)
            scale = np.float32(config.current_sign / config.current_scale)
            self._torque = lambda counts: counts * scale
        else:
            self._per_count = np.asarray(calibration.force_per_count, np.float32)[:, None]
            self._torque = jax.jit(lambda milliamperes: normalised_torque(calibration, milliamperes * np.float32(1e-3)))

    def decode(self, data: bytes) -> np.ndarray:
        """A logged state: of the XHand's wire, or of a driver. HandError: it is of another hand."""
        for block in (self.block, frames.STATE_BLOCK):
            if len(data) == block.itemsize:
                return frames.decode(data, block)
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
        high, most = counts > _HIGH, self.config.tare_sum
        beside = around(self.hand, high)
        total = np.where(high, 0.0, counts).sum(1)  # Stuck taxels do not add to it.
        for finger, name in enumerate(self.hand.finger_names):
            patch = high[finger] & (beside[finger] > 0)
            if np.any(high[finger] & (beside[finger] >= _ADJACENT)):
                what = f"{patch.sum()} adjacent taxels of the {name} read above {_HIGH:.0f} counts"
                raise HandError(f"cannot tare the taxels: {what}: something touches it; free the fingertips")
            if total[finger] > most:
                what = f"those of the {name} read {total[finger]:.0f} counts together, limit {most:.0f}"
                todo = "free the fingertips; if they read as much untouched, raise --hardware.tare-sum"
                raise HandError(f"cannot tare the taxels: {what}: something touches it; {todo}")
        lines = self._say_masked(high, high)
        self.tare = self._tared = np.where(high, np.float32(np.inf), counts)
        self._advised[:] = False
        return lines

    def follow_taxels(self, time: float, state: np.ndarray, limit: float) -> tuple[bool, list[str]]:
        """Mask taxels that have got stuck and follow the zeros of those that touch nothing, by every answer of a run.

        `limit` N is the largest force of a finger. Returns whether `tare` has changed, and lines about masked taxels
        and zeros that have moved far. Raises HandError: many taxels of a fingertip are stuck.
        """
        before = self.tare
        self.tare = self._tracker.update(time, self.counts(state), before, limit / self._per_count)
        new = np.isinf(self.tare) & np.isfinite(before)
        lines = self._say_masked(np.isinf(self.tare), new) if new.any() else []
        return not np.array_equal(self.tare, before), lines + self._say_wandered()

    def _say_masked(self, masked: np.ndarray, new: np.ndarray) -> list[str]:
        """A line for each fingertip with newly masked taxels. HandError: one has so many masked taxels that no limit
        would follow its force."""
        lines = list[str]()
        for name, every, fresh in zip(self.hand.finger_names, masked, new, strict=True):
            if every.sum() > _MANY:
                text = f"{every.sum()} taxels are stuck: {taxel_names(self.hand, every)}"
                raise HandError(f"{name}: {text}; power-cycle the hand")
            if fresh.any():
                lines.append(f"{name}: stuck and read as 0 from now on: taxel {taxel_names(self.hand, fresh)}")
        return lines

    def _say_wandered(self) -> list[str]:
        """A line, once, for each fingertip whose zeros have moved far since they were tared."""
        tared = np.isfinite(self.tare) & np.isfinite(self._tared)
        moved = np.where(tared, self.tare, 0.0).sum(1) - np.where(tared, self._tared, 0.0).sum(1)
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
        block = frames.command_block(reported, mode, kp=kp * share, ki=ki * share, kd=kd * on, torque_max=current * on)
        if not np.isfinite(block["position"]).all():
            raise HandError("a command is not finite; it was not sent")
        return block

    def counts(self, state: np.ndarray) -> np.ndarray:
        """Raw taxel counts [F, N], neither tared nor scaled."""
        taxel = state["tip"]["taxel"]
        if self.config.taxel_axes == "z":
            return taxel["z"].astype(np.float32)
        return np.sqrt(sum(taxel[axis].astype(np.float32) ** 2 for axis in "xyz"))


# --- taxels in a run --------------------------------------------------------------------------------


def taxel_names(hand: Hand, which: np.ndarray) -> str:
    """ "column 3 row 7, ..." of a mask [N], counted from 0 as in the layout file."""
    rows = hand.taxel_grid[1]
    named = [f"column {i // rows} row {i % rows}" for i in np.flatnonzero(which)]
    return ", ".join(named[:6]) + (f" and {len(named) - 6} more" if len(named) > 6 else "")


def around(hand: Hand, values: np.ndarray) -> np.ndarray:
    """Sums [F, N] over the eight neighbours of each taxel, given values [F, N]; there are none beyond the lattice."""
    lattice = values.astype(float).reshape(-1, *hand.taxel_grid)
    return ndimage.convolve(lattice, _NEIGHBOURS, mode="constant").reshape(values.shape)


class TaxelTracker:
    """Follows the zeros of a run's taxels, which wander over minutes, as the fingertips warm up, and finds stuck ones.

    What a free taxel reads on average is its new zero. Light touches look the same to a single taxel, so the zeros of a
    fingertip rise together no faster than they wander with temperature, and to `most` counts: the largest load that
    they can hide.

    A taxel is stuck that reads more than a finger may press, the same for 20 answers, while nothing else on the
    fingertip reads anything. Beside a load it may also saturate. A real load of that size makes `Safety` ease it, which
    changes the reading; what is stuck stays until the fingertip is free.
    """

    def __init__(self, hand: Hand, most: float):
        self._hand, self._most = hand, most
        self._time: float | None = None  # s, of the last answer
        self._budget = np.full(hand.num_fingers, _FIRST)  # counts by which the zeros of a fingertip may rise now
        self._sum = np.zeros((hand.num_fingers, hand.num_taxels), np.float32)
        self._answers, self._begin = np.zeros(self._sum.shape, int), np.zeros(self._sum.shape)
        self._first, self._same = np.zeros_like(self._sum), np.zeros_like(self._answers)  # tared counts; answers

    def update(self, time: float, counts: np.ndarray, zero: np.ndarray, limit: np.ndarray) -> np.ndarray:
        """Update with raw counts [F, N] at a time in s; the zeros [F, N], infinite for stuck taxels, which stay so.
        `limit` [F, 1] is how many tared counts a finger may press."""
        tared = np.maximum(counts - zero, 0.0)
        same = (tared > limit) & (np.abs(tared - self._first) <= _SAME)
        self._first = np.where(same, self._first, tared)
        others = np.where(same, 0.0, tared).max(1, keepdims=True)
        self._same = np.where(same & (others <= _QUIET), self._same + 1, 0)
        zero = np.where(self._same >= _ANSWERS, np.float32(np.inf), zero)
        if self._time is None:
            self._begin[:], self._time = time, time
        self._budget = np.minimum(self._budget + _RATE * (time - self._time), _AT_ONCE)
        self._time = time
        pressed = counts > zero + _NEAR
        if pressed.any():
            self._restart(pressed | (around(self._hand, pressed) > 0), time)
        self._sum, self._answers = self._sum + counts, self._answers + 1
        due = np.isfinite(zero) & (time - self._begin >= _WINDOW)
        if not due.any():
            return zero
        before = np.where(np.isfinite(zero), zero, np.float32(0))
        change = np.where(due, self._sum / self._answers - before, 0.0)
        rise = np.maximum(change, 0.0).sum(1)
        allowed = np.clip(self._most - before.sum(1), 0.0, self._budget)
        share = np.minimum(1.0, allowed / np.maximum(rise, 1e-9))
        self._budget -= share * rise
        self._restart(due, time)
        return (zero + np.where(change > 0, change * share[:, None], change)).astype(np.float32)

    def _restart(self, which: np.ndarray, time: float) -> None:
        self._sum[which], self._answers[which], self._begin[which] = 0.0, 0, time
