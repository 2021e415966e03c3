"""The exchange loop with a hand: decide, send, sense, judge.

A run on a hand is this loop in a thread of its own (`LoopThread`), a calibration steps it from its procedure
(`calibrate.bench`), and a run in virtual time gives it a port whose waiting passes the time (`twin.virtual`).
"""

import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dexsim.core.config import Config, setting
from dexsim_real.control.guard import Guard
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import HandSample, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.process import EXCHANGE, change_priority, ignore_signals
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.frames import Mode, passive_command
from dexsim_real.wire.link import BRIEF, PATIENCE, HandPort, LinkConfig, Reply

TARE_SAMPLES = 30
_TARE = 5.0  # s in which they must arrive
_SMOOTH = 0.02  # s, time constant of the filter on differences of the joint angle
_BIN, _BINS = 1e-5, 5000  # s and number: the histogram ends at 50 ms
GRACE = 0.001  # s by which a cycle may begin late instead of being skipped


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoopConfig(Config):
    """Options of the exchange loop."""

    rate: float = setting(83.0, unit="Hz", low=1.0, high=1000.0)
    """Exchanges with the hand per second; a run adjusts it by up to 1 %, to compute during the wait for an answer."""
    link: LinkConfig = setting(LinkConfig())
    """The serial line."""
    hardware: HardwareConfig = setting(HardwareConfig())
    """Signs, scales and gains of the hand."""
    safety: SafetyConfig = setting(SafetyConfig())
    """Safety limits."""


@dataclasses.dataclass(eq=False)
class ExchangeLoop:
    """Exchanges commands and states with a hand, one `cycle` at a time.

    `retared` is called with the number of the exchange from which on another tare may hold, and with lines about it.
    """

    port: HandPort  # connected; used by this loop only
    sensing: HandSensing
    safety: Safety
    rate: float  # exchanges per second
    guard: Guard | None = None
    """Gets a sign of life before every exchange."""
    _: dataclasses.KW_ONLY
    track_taxels: bool = True
    """Follow the zeros of the taxels and mask stuck ones; not where the taxels themselves are measured."""
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep

    def __post_init__(self) -> None:
        self.pace = Pace(self.rate, self.clock, self.sleep)
        self.round_trip = Timing()
        self.command = passive_command(self.sensing.hand.num_joints)  # the newest that was sent
        self.driven = self._closed = False  # whether the motors may be on; whether the port is closed
        self.retared: Callable[[int, list[str]], None] = lambda sequence, lines: None
        self._engage = False

    def engage(self) -> None:
        """Turn the motors on at the next cycle; may be called from another thread."""
        self._engage = True

    def cycle(self) -> HandSample | None:
        """One exchange; None without an answer. `Safety.problem` tells whether the sample is a measurement."""
        if self.guard:
            self.guard.beat()
        if self._engage:
            self.safety.engage()
            self._engage = False
        decision = self.safety.decide(self.clock())
        on = decision.mode == Mode.POSITION
        self.driven |= on
        self.command = self.sensing.command(decision.position, decision.mode, decision.stiffness)
        reply = self.port.exchange(self.command)
        if reply is None:
            if self.port.refusal:
                self.safety.alarms.refuse(self.port.refusal)
            return None
        self.driven = on or reply.on
        self.round_trip.add(reply.received - reply.sent)
        sample = self._sample(reply)
        self.safety.update(sample)
        return sample

    def tare(self) -> list[str]:
        """Tare the taxels with the motors off; returns a line for each fingertip with stuck taxels.

        Raises HandError: the hand does not answer or refuses, or a fingertip touches something.
        """
        states, until = list[np.ndarray](), self.clock() + _TARE
        tracked, self.track_taxels = self.track_taxels, False  # Untared, a zero is a touch.
        while len(states) < TARE_SAMPLES and self.clock() < until:
            sample = self.cycle()
            if sample is not None:
                states.append(sample.state)
            elif (refusal := self.port.refusal) and refusal.serious:
                raise HandError(refusal.text)
        if len(states) < TARE_SAMPLES:
            raise HandError(f"only {len(states)} answers in {_TARE:g} s, cannot tare the taxels; check the cable")
        self.track_taxels = tracked
        return self.sensing.set_tare(states)

    def close(self) -> None:
        """Turn the motors off and close the port; `driven` remains True if the hand has not confirmed it."""
        ignore_signals()
        self._rest()

    def _rest(self) -> None:
        if self._closed:
            return
        off = self.sensing.command(self.sensing.hand.joint_lower, Mode.PASSIVE)
        self._closed, seconds = True, PATIENCE if self.driven else BRIEF
        if self.guard:
            self.guard.beat(seconds)
        try:
            if self.port.turn_off(off, seconds):
                self.driven = False
        finally:
            with contextlib.suppress(Exception):  # Of a driver from elsewhere; the hand has been told.
                self.port.close()

    def _sample(self, reply: Reply) -> HandSample:
        if self.track_taxels:
            limit = self.safety.config.finger_force
            changed, lines = self.sensing.follow_taxels(reply.received, reply.state, limit)
            if changed or lines:
                self.retared(reply.sequence, lines)
        measured = self.sensing.measure(reply.state)
        last, velocity = self.safety.sample, np.zeros(self.sensing.hand.num_joints, np.float32)
        if last is not None and last.generation == reply.generation:
            velocity, seconds = last.velocity, reply.received - last.time
            if seconds > 0:
                weight, moved = seconds / (seconds + _SMOOTH), measured.joint_position - last.measured.joint_position
                velocity = (velocity + weight * (moved / seconds - velocity)).astype(np.float32)
        return HandSample(reply.received, reply.sequence, reply.generation, measured, velocity, reply.state)


class LoopThread(ExchangeLoop):
    """The exchange loop in a thread, at absolute deadlines until stopped; made as `ExchangeLoop` is.

    The policy runs in another thread at a lower rate. If it dies, this thread continues and `Safety` reacts. Whatever
    ends this thread, it turns the motors off; unless the hand confirms it, the guard process does so again.
    """

    def __init__(self, *parts: Any, **options: Any):
        super().__init__(*parts, **options)
        self.error: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="exchange", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def engage(self) -> None:
        """Turn the motors on at the next cycle, under guard. HandError: the guard process did not start."""
        if self.guard:
            self.guard.arm()
        super().engage()

    def check(self) -> None:
        """Raises HandError: the thread has ended with an error, or the guard process does not respond."""
        if self.guard:
            self.guard.check()
        if self.error is not None:
            why = self.error if isinstance(self.error, HandError) else repr(self.error)
            raise HandError(f"the exchange thread failed: {why}")

    def free(self, now: float) -> float:
        """The next time s at which a request has just been sent and the interpreter is idle until its answer."""
        lead, period = 0.001, self.pace.period
        return now + (self.pace.next + lead - now) % period

    def stop(self) -> None:
        """End the thread, and turn the motors off."""
        ignore_signals()
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        else:
            self.close()
        if self.guard:
            self.guard.dismiss(off=not self.driven)

    def _run(self) -> None:
        change_priority(EXCHANGE)
        try:
            self.pace.next = self.clock() + self.pace.period
            while not self._stop.is_set():
                self.cycle()
                self.pace.wait()
        except BaseException as error:  # The main thread reports it.
            self.error = error
        finally:
            self._rest()


# --- deadlines --------------------------------------------------------------------------------------


class Timing:
    """Statistics of durations in constant memory."""

    def __init__(self) -> None:
        self._bins = np.zeros(_BINS + 1, np.int64)
        self.count, self.missed, self.worst = 0, 0, 0.0

    def add(self, seconds: float) -> None:
        self._bins[min(int(max(seconds, 0.0) / _BIN), _BINS)] += 1
        self.count += 1
        self.worst = max(self.worst, seconds)

    def summary(self) -> dict[str, float]:
        """Percentiles in ms, number of samples, number of missed deadlines."""
        ranks = np.searchsorted(np.cumsum(self._bins), self.count * np.array([0.5, 0.99]))
        p50, p99 = np.minimum((ranks + 1) * _BIN, self.worst).tolist()
        numbers = {"p50_ms": 1e3 * p50, "p99_ms": 1e3 * p99, "max_ms": 1e3 * self.worst}
        return {"count": self.count, "missed": self.missed, **numbers}


class Pace:
    """Absolute deadlines `start + k / rate`, rate in Hz, so a slow cycle does not shift the next one."""

    def __init__(
        self, rate: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ):
        self.period, self._clock, self._sleep = 1.0 / rate, clock, sleep
        self.jitter = Timing()
        self.next = clock() + self.period

    def wait(self) -> None:
        """Sleep until the next deadline. One that passed by at most `GRACE` is kept; older ones are missed."""
        now = self._clock()
        # An exchange fills most of its period: skipping a deadline over a fraction of a millisecond costs a whole one.
        behind = max(math.ceil((now - self.next - GRACE) / self.period), 0)
        self.jitter.missed += behind
        self.next += behind * self.period
        self._sleep(max(self.next - now, 0.0))
        self.jitter.add(self._clock() - self.next)
        self.next += self.period


def keep_phase(rate: float, other: float) -> float:
    """`rate` rounded to a multiple of half of `other`, if that changes it by at most 1 %.

    Two loops with such rates keep one or two fixed phases to each other.
    """
    near = max(round(2 * rate / other), 1) * other / 2
    return near if abs(near - rate) <= 0.01 * rate else rate
