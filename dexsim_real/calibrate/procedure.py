"""The presses: their plan, and the procedure that makes them slowly, after a check and a tare at rest.

A press loads the joints with a lever arm at the contact. Targets advance in proportion to these lever arms: joints with
equal gains then push along the skin's normal, with little shear. The pads load the flexing joints of a finger; the
joints that spread thumb and index finger are loaded by the sides. A finger presses almost straight: its pad is then
close to the line through its joints, so a shear force, which the taxels may not show, has a short lever arm.

Samples are logged with their press and phase. `dexsim_real.calibrate.press_fit` reads the log, so an immediate fit and
a later one give the same result.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from dexsim.calibration.press import lever_arms
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import flexion_joints
from dexsim_real.calibrate.bench import Bench
from dexsim_real.control.alarms import finger_joints
from dexsim_real.control.safety import HandSample, Reaction
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind

LOADING, UNLOADING, RELEASED, REST = "loading", "unloading", "released", "rest"
"""Phases of a press; "level K" is a force held for the gauge."""
TOUCHED = 20.0
"""Counts that a fingertip's sum may be off zero after a press."""

_OPEN = 0.1  # rad, of the joints that do not press
_SHARE = 0.3  # of the longest lever arm, above which a joint takes part
_SPREADS = "index_bend"  # joint of the XHand: other hands are pressed on their pads alone
# Its fingers with a joint that spreads them: angles rad of the joints that are not open, and what the user holds.
_SIDES: dict[int, tuple[dict[int, float], str]] = {
    0: ({0: 0.4}, "the pen, 3 mm in front of the side that faces the palm's normal"),
    1: ({3: -0.1, 4: 0.35, 5: 0.1}, "the pen, 3 mm in front of the side that faces the thumb"),
}
_BENT = (0.3, 0.3, 0.2), (0.35, 0.2)  # rad, joints of the pressing thumb, and of another finger, from the root on

_REST = 2.0  # s, recording with the motors off
_ANSWERED = 0.5  # share of the samples at rest that must be answered
_TOUCH = 0.4  # N above which a fingertip touches
_CLEARANCE = 0.2  # rad from the start of a press to the posture of contact
_TRAVEL = 0.8  # rad, largest travel of a joint target past contact
_LAST = 12  # samples at the end of a press that are averaged
_STALL = 0.02  # share of the peak force by which the force must grow in a second, or the motors stall
_LEVELS = 6  # forces at which the gauge is read, rising and then falling
_ATTEMPTS = 3  # at a press, with nobody to ask
_LEAST_MOTION = 0.004  # rad that each joint should move in a press
_LEAN = (0.5, -0.5, 0.0)  # more motion of the first joints or the last: presses with different shear


@dataclasses.dataclass(frozen=True)
class Placement:
    """One press: a fingertip, and the place on it."""

    name: str  # "index pad"
    finger: int
    taxels: tuple[int, ...]  # at the middle of the contact
    joints: tuple[int, ...]  # joints that press
    posture: np.ndarray  # [J] rad, at the expected contact
    direction: np.ndarray  # [J] rad of targets for each rad of advance; the largest is 1
    task: str  # what the user holds, and where


def placements(hand: Hand, fingers: tuple[str, ...] = (), sides: bool = True) -> list[Placement]:
    """All presses of these fingers (all by default): pads, the thumb's last; then, if `sides`, the sides of thumb and
    index finger. HandError: no such finger."""
    if unknown := sorted(set(fingers) - set(hand.finger_names)):
        raise HandError(f"no finger {unknown[0]!r}; choose from {', '.join(hand.finger_names)}")
    selected = [i for i, name in enumerate(hand.finger_names) if name in (fingers or hand.finger_names)]
    columns, plan = hand.taxel_grid[0], list[Placement]()
    for finger in sorted(selected, key=lambda i: i == 0):
        # Bent a little more than the others.
        joints = finger_joints(hand, 0) if finger == 0 else flexion_joints(hand, range(finger, finger + 1)).tolist()
        bent, task = dict(zip(joints, _BENT[finger > 0], strict=False)), "a round pen, backed by foam, 1 cm in front"
        plan.append(_placement(hand, finger, "pad", (columns // 2 - 1, columns // 2), bent, task))
    for finger in [i for i in selected if sides and i in _SIDES and _SPREADS in hand.joint_names]:
        # The index finger of a left hand has the sensor of a right one: its first columns face the thumb.
        column = 1 if finger == 1 and hand.side == "left" else columns - 2
        bent, task = _SIDES[finger]
        plan.append(_placement(hand, finger, "side", (column,), bent, task))
    return plan


def _placement(
    hand: Hand, finger: int, part: str, columns: tuple[int, ...], bent: dict[int, float], task: str
) -> Placement:
    """A press in the middle of these columns of taxels; `bent` gives the angles rad of the joints that are not open."""
    rows = hand.taxel_grid[1]
    taxels = tuple(column * rows + row for column in columns for row in (rows // 2 - 2, rows // 2 - 1))
    posture = np.where(np.array(hand.joint_names) == _SPREADS, 0.0, _OPEN)
    posture = np.clip(posture, hand.joint_lower, hand.joint_upper)
    posture[list(bent)] = list(bent.values())
    arms = lever_arms(hand, posture, finger, np.isin(np.arange(hand.num_taxels), taxels) / len(taxels))
    share = arms / np.max(np.abs(arms))
    direction = np.where(np.abs(share) > _SHARE, share, 0.0)
    joints = tuple(np.flatnonzero(direction).tolist())
    return Placement(f"{hand.finger_names[finger]} {part}", finger, taxels, joints, posture, direction, task)


class MissedPress(HandError):
    """A press that brought nothing and can be made again, such as one beside the pen."""


class PressProcedure:
    """All presses of a session.

    A press advances the joint targets along a direction in joint space. The direction in which every joint moves
    forward depends on the unpublished stiffness of the drives. It is therefore taken from the press before: the
    distance by which each joint lagged its target, plus the same small motion for all. The bench is connected, with the
    motors off.
    """

    def __init__(self, bench: Bench):
        self.bench, self.operator = bench, bench.operator
        self.config, self.hand = bench.arguments.press, bench.sensing.hand
        self._advance = 0.0  # rad past the posture
        self._touch = _TOUCH  # N

    def check(self) -> None:
        """Check and tare the taxels, with the motors off and nothing touching them.

        Raises HandError: too few answers, something touches a fingertip, or a taxel is stuck.
        """
        self.operator.tell("checking the taxels: do not touch the fingertips")
        samples = self.bench.collect(_REST, mark={"press": "", "phase": REST})
        if len(samples) < _ANSWERED * self.bench.arguments.rate * _REST:
            raise HandError(f"only {len(samples)} answers in {_REST:g} s; check the cable, or close other programs")
        self.bench.set_zero(samples)

    def press(self, placement: Placement) -> bool:
        """All presses of one placement, again when they are missed; False when the user skips it.

        Raises HandError: they were missed three times with nobody to ask, or `Safety` ended the press.
        """
        record, attempts = {"placement": dataclasses.asdict(placement)}, 0
        while True:
            self.bench.log.add(Kind.META, record)
            try:
                return self._press(placement)
            except MissedPress as missed:
                attempts += 1
                self.bench.log.add(Kind.META, record)  # Drops what was recorded of it.
                if self.operator.assume_yes and attempts >= _ATTEMPTS:
                    raise
                self.operator.tell(f"  {missed}; again")

    def _press(self, placement: Placement) -> bool:
        self._placement = placement
        self._start()
        self.operator.tell(f"{placement.name}: hold {placement.task}")
        if self.operator.ask("  Enter presses, s skips:", lambda: self.bench.step(self._target())) is None:
            return False
        self._tare_in_air()
        self._approach()
        speed = self.config.first_speed
        for cycle in range(self.config.cycles):
            self._load(speed)
            speed = max(self._advance, 0.01) / self.config.seconds
            self._seek(self._touch, -speed, UNLOADING)  # until it is almost free
            self._aim(_LEAN[cycle % len(_LEAN)])
        # Typing readings takes long, so the sides use the scale of the pads.
        if self.bench.arguments.gauge and placement.name.endswith("pad"):
            self._climb(speed)
        self._back_off()
        return True

    def _start(self) -> None:
        """Move to where the press begins: before the contact, as far as the joint ranges allow."""
        posture, self._direction = self._placement.posture, self._placement.direction
        joints = list(self._placement.joints)
        ends = np.where(self._direction > 0, self.hand.joint_lower, self.hand.joint_upper)[joints]
        room = np.min((posture[joints] - ends) / self._direction[joints])
        self._base, self._advance = posture, -min(_CLEARANCE, float(room))
        self.bench.move(self._target())

    def _tare_in_air(self) -> None:
        """Tare in the air where the press begins: gravity and the last press have moved the zero."""
        pause, target = self.config.pause, self._target()
        self.bench.collect(pause, target)
        self.bench.set_zero(self.bench.collect(pause, target))
        free = [self._force(sample) for sample in self.bench.collect(pause, target)]
        self._touch = max(_TOUCH, float(np.mean(free) + 6 * np.std(free)))

    def _approach(self) -> None:
        """Advance until contact, where the advance is set to zero."""
        name = self._placement.name
        for sample in self._advancing(self.config.approach_speed):
            if self._force(sample) >= self._touch:
                self._base, self._advance = self._target(), 0.0
                return
            if self._overloaded(sample):
                current = f"{sample.measured.current.max():.2f} A"
                raise MissedPress(f"{name}: {current} and no taxel feels it; press on the taxels, check their sensor")
        raise MissedPress(f"{name}: met nothing within {_TRAVEL:g} rad; hold the object closer")

    def _load(self, speed: float) -> None:
        """Press until peak force, current or travel is reached, or the motors stall."""
        assert self.bench.safety.sample is not None, "the approach has read the pose"
        before, first = self.bench.safety.sample, self._target()
        begin, second = before.measured.joint_position.astype(float), round(self.bench.arguments.rate)
        forces, positions = list[float](), list[np.ndarray]()
        for sample in self._advancing(speed, LOADING):
            if sample.sequence != before.sequence + 1:
                forces.clear()  # After an interruption a constant force does not mean that the motors stall.
            before = sample
            forces.append(self._force(sample))
            positions.append(sample.measured.joint_position.astype(float))
            earlier = np.mean(forces[-second - _LAST : -second]) if len(forces) > 2 * second else -np.inf
            ended = forces[-1] >= self.config.peak or self._overloaded(sample)
            if ended or np.mean(forces[-_LAST:]) - earlier < _STALL * self.config.peak:
                break
        if not ended and forces[-1] < 4 * self._touch:
            why = f"the force stays at {forces[-1]:.1f} N; press on something firmer, or raise --hardware.torque-max"
            raise MissedPress(f"{self._placement.name}: {why}")
        self._held = (self._target() - first, np.mean(positions[-_LAST:], 0) - begin)

    def _aim(self, lean: float) -> None:
        """Set the direction so that every joint moves forward in the next press, the first ones by `lean` more."""
        joints = list(self._placement.joints)
        way, share = np.sign(self._placement.direction[joints]), np.abs(self._placement.direction[joints])
        commanded, moved = (part[joints] * way for part in self._held)
        motion = max(float(share @ moved / share.sum()), _LEAST_MOTION)
        advance = np.maximum(commanded - moved, 0.0) + motion * np.linspace(1 + lean, 1 - lean, len(joints))
        self._base, self._advance = self._target(), 0.0
        self._direction = np.zeros(self.hand.num_joints)
        self._direction[joints] = way * advance / advance.max()

    def _climb(self, speed: float) -> None:
        """Hold rising and falling forces, and ask for the gauge's reading at each."""
        pause, shares = self.config.pause, np.linspace(1 / _LEVELS, 1.0, _LEVELS)
        for number, share in enumerate([*shares, *shares[-2::-1]]):
            self._seek(share * self.config.peak, speed if number < _LEVELS else -speed)
            self.bench.collect(pause, self._target())
            phase = f"level {number}"
            mark = {"press": self._placement.name, "phase": phase}
            held = self.bench.collect(pause, self._target(), mark)
            mean = np.mean([self._force(sample) for sample in held])
            self.operator.tell(f"  holding; the taxels read {mean:.1f} N")
            force = self.operator.ask_force(lambda: self._step(0.0, phase))  # noqa: B023
            if force is not None:
                self.bench.annotate({**mark, "gauge": force})

    def _seek(self, force: float, speed: float, phase: str = "") -> None:
        """Advance or retract until the force is passed, or a limit is reached."""
        for sample in self._advancing(speed, phase):
            over = (self._force(sample) - force) * math.copysign(1.0, speed)
            if over >= 0 or (speed > 0 and self._overloaded(sample)):
                return

    def _advancing(self, speed: float, phase: str = "") -> Iterator[HandSample]:
        """Steps until the end of the travel; those without a sample, or held by `Safety`, are tried again."""
        end = _TRAVEL if speed > 0 else -_CLEARANCE
        while (end - self._advance) * speed > 0:
            if (sample := self._step(speed, phase)) is not None:
                yield sample

    def _back_off(self) -> None:
        """Free the fingertip, and check that it does not read far below zero: it was touched when it was tared."""
        self._start()
        self.bench.collect(self.config.pause, self._target())
        name, finger, sensing = self._placement.name, self._placement.finger, self.bench.sensing
        samples = self.bench.collect(self.config.pause, self._target(), {"press": name, "phase": RELEASED})
        left = np.median([(sensing.counts(sample.state) - sensing.tare)[finger].sum() for sample in samples])
        if left < -TOUCHED:
            raise MissedPress(f"{name}: reads {left:.0f} counts after the press: it was touched while it was tared")

    def _step(self, speed: float, phase: str = "") -> HandSample | None:
        """One exchange, advanced at this speed in rad/s, logged as a sample of the phase unless that is empty.

        None when the hand did not answer or `Safety` held it; the advance then stays as it was.
        """
        before, self._advance = self._advance, min(self._advance + speed * self.bench.pace.period, _TRAVEL)
        sample = self.bench.step(self._target())
        if sample is None or self.bench.safety.last[0] > Reaction.CLIP:
            self._advance = before
            return None
        if phase:
            self.bench.annotate({"press": self._placement.name, "phase": phase})
        return sample

    def _target(self) -> np.ndarray:
        return self._base + self._advance * self._direction

    def _force(self, sample: HandSample) -> float:
        return float(sample.measured.finger_force[self._placement.finger])

    def _overloaded(self, sample: HandSample) -> bool:
        return float(sample.measured.current.max()) >= self.config.current
