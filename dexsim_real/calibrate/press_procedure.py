"""The press procedure: check and tare at rest, then press each fingertip on something firm, slowly.

Every exchange is logged with its press and phase. `dexsim_real.calibrate.press_fit` reads the log, so an immediate fit
and a later one give the same result.
"""

import dataclasses
import itertools
import math
from typing import Any

import numpy as np

from dexsim_real.calibrate.gauge import Gauge
from dexsim_real.calibrate.hand_loop import HandLoop, Operator
from dexsim_real.calibrate.options import CalibrateArguments
from dexsim_real.calibrate.plan import Placement
from dexsim_real.calibrate.taxel_check import RestReport, check_answered, check_release, check_rest, raw_sensing
from dexsim_real.control.safety import Reaction
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind
from dexsim_real.loop import Exchange

LOADING, UNLOADING, RELEASED, REST = "loading", "unloading", "released", "rest"
"""Phases of a press; "level K" is a force held for the gauge."""

_ANSWERED = 0.5  # share of the exchanges at rest that must be answered
_LAST = 12  # samples at the end of a press that are averaged
_STALL = 0.02  # share of the peak force by which the force must grow in a second, or the motors stall
_ATTEMPTS = 3  # at a press, with nobody to ask
_LEAST_MOTION = 0.004  # rad that each joint should move in a press
_LEAN = (0.5, -0.5, 0.0)  # more motion of the first joints or the last: presses with different shear


class MissedPress(HandError):
    """A press that brought nothing and can be made again, such as one beside the pen."""


class PressProcedure:
    """All presses of a session.

    A press advances the joint targets along a direction in joint space. The direction in which every joint moves
    forward depends on the unpublished stiffness of the drives. It is therefore taken from the press before: the
    distance by which each joint lagged its target, plus the same small motion for all.

    Args:
      loop: connected, motors off.
      arguments: options of the command.
      operator: holds the object to press on.
      gauge: None when the taxels are the reference.
    """

    def __init__(self, loop: HandLoop, arguments: CalibrateArguments, operator: Operator, gauge: Gauge | None):
        self.loop, self.arguments, self.operator, self.gauge = loop, arguments, operator, gauge
        self.config = arguments.press
        self.hand = loop.sensing.hand
        self._advance = 0.0  # rad past the posture
        self._touch = self.config.touch  # N
        self._counter = raw_sensing(self.hand, loop.sensing.config)

    def check(self, fingers: tuple[int, ...]) -> RestReport:
        """Check and tare the taxels, with the motors off and nothing touching them.

        Args:
          fingers: indices of the fingers that will be pressed.

        Raises:
          HandError: too few answers, or something touches a fingertip.
        """
        self.operator.tell("checking the taxels: do not touch the fingertips")
        seconds = self.arguments.check.seconds
        exchanges = self._record("", REST, seconds)
        if len(exchanges) < _ANSWERED * self.arguments.rate * seconds:
            raise HandError(f"only {len(exchanges)} answers in {seconds:g} s; check the cable, or close other programs")
        counts = np.array([self._raw(exchange) for exchange in exchanges])
        current = np.array([exchange.state["joint"]["current"] for exchange in exchanges], float)
        report = check_rest(self.hand, counts, current, self.arguments.check, self.loop.sensing.config, fingers)
        for note in report.notes:
            self.operator.tell(f"  {note}")
        self._set_tare(report.tare)
        self.loop.step()  # The measurements that `Safety` has seen so far were not tared.
        return report

    def press(self, placement: Placement) -> bool:
        """All presses of one placement, again when they are missed; False when the user skips it.

        Raises:
          HandError: they were missed three times with nobody to ask, or `Safety` ended the press.
        """
        for attempt in itertools.count(1):
            self._begin_recording(placement)
            try:
                return self._press(placement)
            except MissedPress as missed:
                self._begin_recording(placement)  # Drops what was recorded of it.
                if self.operator.assume_yes and attempt >= _ATTEMPTS:
                    raise
                self.operator.tell(f"  {missed}; again")
        raise AssertionError("the attempts have no end")

    # --- pieces ---------------------------------------------------------------------------------

    def _begin_recording(self, placement: Placement) -> None:
        self.loop.log.add(Kind.META, {"placement": placement_record(placement)})

    def _press(self, placement: Placement) -> bool:
        self._start_from(placement)
        self.loop.move(self._target())
        self.operator.tell(f"{placement.name}: {placement.task}")
        if not self.operator.assume_yes:
            answer = self.operator.ask("  Enter presses, s skips:", self._wait)
            if answer.lower() in ("s", "skip"):
                return False
        self._tare_in_air()
        self._approach()
        speed = self.config.first_speed
        for cycle in range(self.config.cycles):
            self._load(speed)
            speed = max(self._advance, 0.01) / self.config.seconds
            self._unload(speed)
            self._aim(_LEAN[cycle % len(_LEAN)])
        # Typing readings takes long, so the sides use the scale of the pads.
        if self.gauge is not None and (self.gauge.automatic or placement.name.endswith("pad")):
            self._climb(speed)
        self._back_off()
        return True

    def _tare_in_air(self) -> None:
        """Tare in the air where the press begins: gravity and the last press have moved the zero.

        Raises:
          HandError: the hand did not answer, something touches a fingertip, or a taxel is stuck.
        """
        pause = self.config.pause
        self.loop.collect(pause, self._target())
        exchanges = check_answered(self.loop.collect(pause, self._target()), pause)
        if stuck := self.loop.sensing.set_tare([exchange.state for exchange in exchanges]):
            raise HandError(f"{'; '.join(stuck)}; power-cycle the hand")
        self._set_tare(self.loop.sensing.tare)
        exchanges = check_answered(self.loop.collect(pause, self._target()), pause)
        free = [self._force(exchange) for exchange in exchanges]
        self._touch = max(self.config.touch, float(np.mean(free) + 6 * np.std(free)))

    def _set_tare(self, tare: np.ndarray) -> None:
        self.loop.sensing.tare = np.asarray(tare, np.float32)
        self.loop.log.add(Kind.META, {"tare": self.loop.sensing.tare})

    def _approach(self) -> None:
        """Advance until contact, where the advance is set to zero."""
        speed, name = self.config.approach_speed, self._placement.name
        while True:
            exchange = self._step(self._advance + speed * self.loop.pace.period, "")
            if exchange is None:
                continue
            if self._force(exchange) >= self._touch:
                break
            if self._current(exchange) >= self.config.current:
                raise MissedPress(
                    f"{name}: {self._current(exchange):.2f} A and no taxel feels it; press on "
                    "the taxels, and check that their sensor is connected"
                )
            if self._advance >= self.config.travel:
                raise MissedPress(f"{name}: met nothing within {self.config.travel:g} rad; hold the object closer")
        self._base, self._advance = self._target(), 0.0

    def _load(self, speed: float) -> None:
        """Press until peak force, current or travel is reached, or the motors stall."""
        begin = self.loop.pose()
        forces: list[float] = []
        positions: list[np.ndarray] = []
        first = self._target()
        while True:
            exchange = self._step(min(self._advance + speed * self.loop.pace.period, self.config.travel), LOADING)
            if exchange is None:
                forces.clear()  # After an interruption a constant force does not mean that the motors stall.
                continue
            forces.append(self._force(exchange))
            positions.append(exchange.sample.measured.joint_position.astype(float))
            back = round(self.arguments.rate)
            stalled = (
                len(forces) > 2 * back
                and np.mean(forces[-_LAST:]) - np.mean(forces[-back - _LAST : -back]) < _STALL * self.config.peak
            )
            if forces[-1] >= self.config.peak or self._current(exchange) >= self.config.current:
                break
            if self._advance >= self.config.travel or stalled:
                if forces[-1] < 4 * self._touch:
                    raise MissedPress(
                        f"{self._placement.name}: the force stays at {forces[-1]:.1f} N; press on something "
                        "firmer, or raise --hardware.torque-max"
                    )
                break
        self._held = (self._target() - first, np.mean(positions[-_LAST:], 0) - begin)

    def _aim(self, lean: float) -> None:
        """Set the direction so that every joint moves forward in the next press, the first ones by `lean` more."""
        joints = list(self._placement.joints)
        way = np.sign(self._placement.direction[joints])
        commanded, moved = (part[joints] * way for part in self._held)
        share = np.abs(self._placement.direction[joints])
        motion = max(float(share @ moved / share.sum()), _LEAST_MOTION)
        advance = np.maximum(commanded - moved, 0.0) + motion * np.linspace(1 + lean, 1 - lean, len(joints))
        self._base = self._target()
        self._advance = 0.0
        self._direction = np.zeros(self.hand.num_joints)
        self._direction[joints] = way * advance / advance.max()

    def _unload(self, speed: float) -> None:
        """Retract until the fingertip is almost free."""
        while True:
            exchange = self._step(self._advance - speed * self.loop.pace.period, UNLOADING)
            if exchange is not None and self._force(exchange) <= self._touch:
                return
            if self._advance <= -self.config.clearance:
                return

    def _climb(self, speed: float) -> None:
        """Hold rising and falling forces, and read the gauge at each."""
        assert self.gauge is not None, "levels are for the gauge"
        shares = np.linspace(1 / self.arguments.levels, 1.0, self.arguments.levels)
        for number, share in enumerate([*shares, *shares[-2::-1]]):
            rising = number < len(shares)
            self._seek(share * self.config.peak, speed if rising else -speed)
            self._record(self._placement.name, "", self.config.pause)
            held = self._record(self._placement.name, f"level {number}", self.config.pause)
            if held:
                mean = np.mean([self._force(exchange) for exchange in held])
                self.operator.tell(f"  holding; the taxels read {mean:.1f} N")
            force = self.gauge.read(lambda: self._step(self._advance, f"level {number}"))  # noqa: B023
            if force is not None:
                self.loop.mark({"press": self._placement.name, "phase": f"level {number}", "gauge": force})

    def _seek(self, force: float, speed: float) -> None:
        """Advance or retract until the force is passed, or a limit is reached."""
        low, high = -self.config.clearance, self.config.travel
        while True:
            exchange = self._step(self._advance + speed * self.loop.pace.period, "")
            if exchange is None:
                continue
            over = (self._force(exchange) - force) * math.copysign(1.0, speed)
            if over >= 0 or self._current(exchange) >= self.config.current or not low < self._advance < high:
                return

    def _back_off(self) -> None:
        """Free the fingertip, and check that it reads about zero."""
        self.loop.recording = False
        self._start_from(self._placement)
        self.loop.move(self._target())
        self.loop.collect(self.config.pause, self._target())
        exchanges = self._record(self._placement.name, RELEASED, self.config.pause)
        finger = self._placement.finger
        sums = np.array([(self._raw(m) - self.loop.sensing.tare)[finger].sum() for m in exchanges])
        try:
            check_release(self._placement.name, sums, self.arguments.check)
        except HandError as error:
            raise MissedPress(str(error)) from None

    def _step(self, advance: float, phase: str) -> Exchange | None:
        """One exchange at this advance in rad, logged as a sample of the phase unless that is empty.

        None when the hand did not answer or `Safety` held it; the advance then stays as it was.
        """
        before, self._advance = self._advance, advance
        self.loop.recording = bool(phase)
        exchange = self.loop.step(self._target())
        if exchange is None or exchange.decision.reaction > Reaction.CLIP:
            self._advance = before
            return None
        if phase:
            self.loop.mark({"press": self._placement.name, "phase": phase})
        return exchange

    def _record(self, press: str, phase: str, seconds: float) -> list[Exchange]:
        """Record the phase for a time in s without moving; without a press the motors stay as they are."""
        target = self._target() if press else None
        until, exchanges = self.loop.clock() + seconds, []
        self.loop.recording = bool(phase)
        while self.loop.clock() < until:
            exchange = self.loop.step(target)
            if exchange is not None:
                exchanges.append(exchange)
                if phase:
                    self.loop.mark({"press": press, "phase": phase})
        self.loop.recording = False
        return exchanges

    def _wait(self) -> None:
        self.loop.recording = False
        self.loop.step(self._target())

    def _start_from(self, placement: Placement) -> None:
        self._placement, self._base, self._direction = placement, placement.posture, placement.direction
        self._advance = -self._clearance()

    def _target(self) -> np.ndarray:
        return self._base + self._advance * self._direction

    def _clearance(self) -> float:
        """The configured clearance in rad, as far as the joint ranges allow."""
        joints = list(self._placement.joints)
        posture, way = self._placement.posture[joints], self._placement.direction[joints]
        ends = np.where(way > 0, self.hand.joint_lower[joints], self.hand.joint_upper[joints])
        return float(min(self.config.clearance, np.min((posture - ends) / way)))

    def _force(self, exchange: Exchange) -> float:
        return float(exchange.sample.measured.finger_force[self._placement.finger])

    def _current(self, exchange: Exchange) -> float:
        return float(exchange.sample.measured.current.max())

    def _raw(self, exchange: Exchange) -> np.ndarray:
        return self._counter.measure(exchange.state).taxel_force


def placement_record(placement: Placement) -> dict[str, Any]:
    """A placement as a log record."""
    return {**dataclasses.asdict(placement), "joints": list(placement.joints), "taxels": list(placement.taxels)}
