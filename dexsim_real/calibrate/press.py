"""The press procedure: rest, check, zero; then each fingertip against something firm, slowly, up and down.

Everything goes into the log, marked with what it means; `dexsim_real.calibrate.fit` reads it from there, so that
a fit at once and one from the log are the same.
"""

import dataclasses
import math
from typing import Any

import numpy as np

from dexsim_real.calibrate.check import RestReport, check_release, check_rest, raw_sensing
from dexsim_real.calibrate.gauge import Gauge
from dexsim_real.calibrate.loop import HandLoop, Moment, Operator
from dexsim_real.calibrate.options import CalibrateArguments
from dexsim_real.calibrate.plan import Placement
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind

LOADING, UNLOADING, RELEASED, REST = "loading", "unloading", "released", "rest"
"""Phases that samples are marked with; "level K" is a force held for the gauge."""


_ANSWERED = 0.5  # share of the exchanges that must be, at rest
_LAST = 12  # samples that make an end of a press
_STALL = 0.02  # of the peak force, by which force must grow in a second, or the motors give no more
_LEAST_MOTION = 0.004  # rad that each joint should move in a press
_LEAN = (0.5, -0.5, 0.0)  # more from the first joints, or from the last: presses that differ in their shear


class PressProcedure:
    """All presses of one session.

    A press advances the targets along a direction in joint space. Which direction makes every joint move forward
    depends on the drives' stiffness, which nobody has published; so it is taken from the press before: as much as
    each joint was held back, and the same little bit more for all.

    Args:
      loop: connected, motors off.
      gauge: None where the taxels themselves are the reference.
    """

    def __init__(self, loop: HandLoop, arguments: CalibrateArguments, operator: Operator, gauge: Gauge | None):
        self.loop, self.arguments, self.operator, self.gauge = loop, arguments, operator, gauge
        self.config = arguments.press
        self.hand = loop.sensing.hand
        self._advance = 0.0  # rad past the posture
        self._touch = self.config.touch  # N
        self._counter = raw_sensing(self.hand, loop.sensing.config)

    def check(self, fingers: tuple[int, ...]) -> RestReport:
        """Motors off, nothing touched: check the taxels and take their zero.

        Raises:
          HandError: too few answers, or a fingertip under load.
        """
        self.operator.tell("resting: let nothing touch the fingertips")
        seconds = self.arguments.check.seconds
        moments = self._record("", REST, seconds)
        if len(moments) < _ANSWERED * self.arguments.rate * seconds:
            raise HandError(
                f"only {len(moments)} answers in {seconds:g} s: the line loses too much, or this machine is too busy"
            )
        counts = np.array([self._raw(moment) for moment in moments])
        current = np.array([moment.state["joint"]["current"] for moment in moments], float)
        report = check_rest(
            self.hand, counts, current, self.arguments.check, self.loop.sensing.config.tare_limit, fingers
        )
        for note in report.notes:
            self.operator.tell(f"  {note}")
        self._tare(report.tare)
        self.loop.step()  # What `Safety` has seen until now was not zeroed.
        return report

    def press(self, placement: Placement) -> bool:
        """One fingertip, from its clearance to all its presses and back; False where the user skips it.

        Raises:
          HandError: it met nothing, felt nothing, or `Safety` ended it.
        """
        self._start_from(placement)
        self.loop.move(self._target())
        self.operator.tell(f"{placement.name}: {placement.task}")
        if not self.operator.silent:
            answer = self.operator.ask("  Enter presses, s skips:", self._still)
            if answer.lower() in ("s", "skip"):
                return False
        self._zero()
        self._approach()
        speed = self.config.first_speed
        for cycle in range(self.config.cycles):
            self._load(speed)
            speed = max(self._advance, 0.01) / self.config.seconds
            self._unload(speed)
            self._aim(_LEAN[cycle % len(_LEAN)])
        # Nobody likes to type in more than they must: the sides go by the pads' scale.
        if self.gauge is not None and (self.gauge.tireless or placement.name.endswith("pad")):
            self._climb(speed)
        self._back_off()
        return True

    # --- pieces ---------------------------------------------------------------------------------

    def _zero(self) -> None:
        """In the air, where the press begins: gravity and the last press have moved the zero."""
        self.loop.collect(self.config.pause, self._target())
        moments = self.loop.collect(self.config.pause, self._target())
        self.loop.sensing.zero([moment.state for moment in moments])
        self._tare(self.loop.sensing.tare)
        free = [self._force(moment) for moment in self.loop.collect(self.config.pause, self._target())]
        self._touch = max(self.config.touch, float(np.mean(free) + 6 * np.std(free)))

    def _tare(self, tare: np.ndarray) -> None:
        self.loop.sensing.tare = np.asarray(tare, np.float32)
        self.loop.log.add(Kind.META, {"tare": self.loop.sensing.tare})

    def _approach(self) -> None:
        """Advance until contact, from where advances count from then on."""
        speed, name = self.config.approach_speed, self._placement.name
        while True:
            moment = self._step(self._advance + speed * self.loop.pace.period, "")
            if moment is None:
                continue
            if self._force(moment) >= self._touch:
                break
            if self._current(moment) >= self.config.current:
                raise HandError(
                    f"{name}: {self._current(moment):.2f} A and no taxel feels it: it does not press "
                    "with the taxels, or their sensor is not connected"
                )
            if self._advance >= self.config.travel:
                raise HandError(f"{name}: met nothing within {self.config.travel:g} rad: put it closer")
        self._base, self._advance = self._target(), 0.0

    def _load(self, speed: float) -> None:
        """Press on until peak force, current or travel, or until the motors give no more."""
        begin, forces, positions = self.loop.pose(), [], []
        first = self._target()
        while True:
            moment = self._step(min(self._advance + speed * self.loop.pace.period, self.config.travel), LOADING)
            if moment is None:
                forces.clear()  # What stops now does not show where the motors give no more.
                continue
            forces.append(self._force(moment))
            positions.append(moment.sample.measured.joint_position.astype(float))
            back = round(self.arguments.rate)
            stalled = (
                len(forces) > 2 * back
                and np.mean(forces[-_LAST:]) - np.mean(forces[-back - _LAST : -back]) < _STALL * self.config.peak
            )
            if forces[-1] >= self.config.peak or self._current(moment) >= self.config.current:
                break
            if self._advance >= self.config.travel or stalled:
                if forces[-1] < 4 * self._touch:
                    raise HandError(
                        f"{self._placement.name}: no more than {forces[-1]:.1f} N: what it presses on "
                        "gives way, or --hardware.torque-max is too low"
                    )
                break
        self._held = (self._target() - first, np.mean(positions[-_LAST:], 0) - begin)

    def _aim(self, lean: float) -> None:
        """Turn the direction so that in the next press every joint moves forward, the first ones by `lean` more."""
        joints = list(self._placement.joints)
        way = np.sign(self._placement.direction[joints])
        asked, moved = (part[joints] * way for part in self._held)
        share = np.abs(self._placement.direction[joints])
        motion = max(float(share @ moved / share.sum()), _LEAST_MOTION)
        wanted = np.maximum(asked - moved, 0.0) + motion * np.linspace(1 + lean, 1 - lean, len(joints))
        self._base = self._target()
        self._advance = 0.0
        self._direction = np.zeros(self.hand.num_joints)
        self._direction[joints] = way * wanted / wanted.max()

    def _unload(self, speed: float) -> None:
        """Give way until the fingertip is all but free."""
        while True:
            moment = self._step(self._advance - speed * self.loop.pace.period, UNLOADING)
            if moment is not None and self._force(moment) <= self._touch:
                return
            if self._advance <= -self.config.clearance:
                return

    def _climb(self, speed: float) -> None:
        """Hold forces, up and down, and read the gauge at each."""
        shares = np.linspace(1 / self.arguments.levels, 1.0, self.arguments.levels)
        for number, share in enumerate([*shares, *shares[-2::-1]]):
            rising = number < len(shares)
            self._seek(share * self.config.peak, speed if rising else -speed)
            self._record(self._placement.name, "", self.config.pause)
            held = self._record(self._placement.name, f"level {number}", self.config.pause)
            if held:
                mean = np.mean([self._force(moment) for moment in held])
                self.operator.tell(f"  holding; the taxels say {mean:.1f} N")
            force = self.gauge.read(lambda: self._step(self._advance, f"level {number}"))  # noqa: B023
            if force is not None:
                self.loop.mark({"press": self._placement.name, "phase": f"level {number}", "gauge": force})

    def _seek(self, force: float, speed: float) -> None:
        """Advance or give way until this force is passed, or cannot be."""
        low, high = -self.config.clearance, self.config.travel
        while True:
            moment = self._step(self._advance + speed * self.loop.pace.period, "")
            if moment is None:
                continue
            over = (self._force(moment) - force) * math.copysign(1.0, speed)
            if over >= 0 or self._current(moment) >= self.config.current or not low < self._advance < high:
                return

    def _back_off(self) -> None:
        """Free the fingertip, and see whether it then reads zero."""
        self.loop.recording = False
        self._start_from(self._placement)
        self.loop.move(self._target())
        self.loop.collect(self.config.pause, self._target())
        moments = self._record(self._placement.name, RELEASED, self.config.pause)
        finger = self._placement.finger
        sums = np.array([(self._raw(m) - self.loop.sensing.tare)[finger].sum() for m in moments])
        check_release(self._placement.name, sums, self.arguments.check)

    def _step(self, advance: float, phase: str) -> Moment | None:
        """One exchange at this advance; in a phase it becomes a sample. None, and no advance, where the hand did not
        answer or `Safety` had it wait."""
        before, self._advance = self._advance, advance
        self.loop.recording = bool(phase)
        moment = self.loop.step(self._target())
        if moment is None or not moment.command_applied:
            self._advance = before
            return None
        if phase:
            self.loop.mark({"press": self._placement.name, "phase": phase})
        return moment

    def _record(self, press: str, phase: str, seconds: float) -> list[Moment]:
        """Samples without moving; at rest with the motors as they are."""
        target = self._target() if press else None
        until, found = self.loop.clock() + seconds, []
        self.loop.recording = bool(phase)
        while self.loop.clock() < until:
            moment = self.loop.step(target)
            if moment is not None:
                found.append(moment)
                if phase:
                    self.loop.mark({"press": press, "phase": phase})
        self.loop.recording = False
        return found

    def _still(self) -> None:
        self.loop.recording = False
        self.loop.step(self._target())

    def _start_from(self, placement: Placement) -> None:
        self._placement, self._base, self._direction = placement, placement.posture, placement.direction
        self._advance = -self._clearance()

    def _target(self) -> np.ndarray:
        return self._base + self._advance * self._direction

    def _clearance(self) -> float:
        """As far back as the joints' ranges allow."""
        joints = list(self._placement.joints)
        posture, way = self._placement.posture[joints], self._placement.direction[joints]
        ends = np.where(way > 0, self.hand.joint_lower[joints], self.hand.joint_upper[joints])
        return float(min(self.config.clearance, np.min((posture - ends) / way)))

    def _force(self, moment: Moment) -> float:
        return float(moment.sample.measured.finger_force[self._placement.finger])

    def _current(self, moment: Moment) -> float:
        return float(moment.sample.measured.current.max())

    def _raw(self, moment: Moment) -> np.ndarray:
        return self._counter.measure(moment.state).taxel_force


def placement_record(placement: Placement) -> dict[str, Any]:
    """A placement for the log."""
    return {**dataclasses.asdict(placement), "joints": list(placement.joints), "taxels": list(placement.taxels)}
