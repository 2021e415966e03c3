"""The thread that owns the hand: one exchange a cycle, at absolute deadlines, through `Safety`.

The policy runs elsewhere and slower. If it dies, this thread goes on and `Safety` acts; when this
thread ends, for whatever reason, its last act is to turn the motors off.
"""

import math
import threading
import time
from collections.abc import Callable

import numpy as np

from dexsim_real.frames import Mode
from dexsim_real.hand import HandPort, Reply
from dexsim_real.realtime import come_first
from dexsim_real.safety import Safety, Sample
from dexsim_real.sensing import HandSensing, VelocityFilter


class Timing:
    """How late something was, in constant memory: a histogram of 10 us bins up to 50 ms."""

    _BIN, _BINS = 1e-5, 5000

    def __init__(self) -> None:
        self._bins = np.zeros(self._BINS + 1, np.int64)
        self.count, self.missed, self.worst = 0, 0, 0.0

    def add(self, seconds: float) -> None:
        """One more sample."""
        self._bins[min(int(max(seconds, 0.0) / self._BIN), self._BINS)] += 1
        self.count += 1
        self.worst = max(self.worst, seconds)

    def percentile(self, percent: float) -> float:
        """Seconds below which this share of the samples lies."""
        if not self.count:
            return float("nan")
        at = np.searchsorted(np.cumsum(self._bins), percent / 100 * self.count)
        return min((int(at) + 1) * self._BIN, self.worst)

    def summary(self) -> dict[str, float]:
        """Percentiles in ms, and counts."""
        return {
            "count": self.count,
            "missed": self.missed,
            "p50_ms": 1e3 * self.percentile(50),
            "p99_ms": 1e3 * self.percentile(99),
            "max_ms": 1e3 * self.worst,
        }


GRACE = 0.001  # s, how late a cycle may begin rather than be left out


class Pace:
    """Absolute deadlines `start + k / rate`: what one cycle takes does not shift the next."""

    def __init__(
        self, rate: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ):
        self.period, self._clock, self._sleep = 1.0 / rate, clock, sleep
        self.jitter = Timing()
        self.next = clock() + self.period

    def wait(self) -> None:
        """Sleep until the next deadline. One that has just passed is kept, late; earlier ones are missed."""
        now = self._clock()
        # An exchange fills most of its period: left out for a hair's breadth, the next would cost a whole one.
        behind = max(math.ceil((now - self.next - GRACE) / self.period), 0)
        self.jitter.missed += behind
        self.next += behind * self.period
        self._sleep(max(self.next - now, 0.0))
        self.jitter.add(self._clock() - self.next)
        self.next += self.period


def keep_phase(rate: float, other: float, share: float = 0.01) -> float:
    """`rate`, or the nearest multiple of half of `other` if that is no farther than this share of it.

    Two loops whose rates are in that ratio meet at the same one or two phases for ever.
    """
    near = max(round(2 * rate / other), 1) * other / 2
    return near if abs(near - rate) <= share * rate else rate


class Servo:
    """Runs exchanges until stopped.

    Args:
      port: connected; from now on only this thread touches it.
      rate: exchanges per second.
    """

    def __init__(self, port: HandPort, sensing: HandSensing, safety: Safety, rate: float):
        self.port, self.sensing, self.safety = port, sensing, safety
        self.pace = Pace(rate)
        self.round_trip = Timing()
        self.waited = 0  # deadlines missed because the hand was slow to answer
        self.error: BaseException | None = None
        self._filter = VelocityFilter(sensing.config.velocity_time)
        self._stop = threading.Event()
        self._engage = False
        self._fresh = threading.Event()
        self._thread = threading.Thread(target=self._run, name="servo", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def engage(self) -> None:
        """Turn the motors on at the next cycle."""
        self._engage = True

    def alive(self) -> bool:
        """Whether exchanges go on."""
        return self._thread.is_alive()

    def forget(self) -> None:
        """Measure times anew, without those of starting up."""
        self.pace.jitter, self.round_trip, self.waited = Timing(), Timing(), 0

    def free(self, now: float) -> float:
        """The next time at which an exchange has just gone out: the interpreter has nothing to do until its answer."""
        lead, period = 0.001, self.pace.period
        return now + (self.pace.next + lead - now) % period

    def wait_fresh(self, seconds: float) -> Sample | None:
        """The next sample that arrives, or None when none does in time."""
        self._fresh.clear()
        return self.safety.sample if self._fresh.wait(seconds) else None

    def stop(self) -> None:
        """Motors off, port closed; returns when both are done."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        else:
            self._rest()

    def _run(self) -> None:
        come_first()
        try:
            self.pace.next = time.monotonic() + self.pace.period
            while not self._stop.is_set():
                due = self.pace.next - self.pace.period
                took = self._cycle()
                own, missed = time.monotonic() - due - took, self.pace.jitter.missed
                self.pace.wait()
                missed = self.pace.jitter.missed - missed
                # Not ours if a usual answer would have left enough time.
                if missed and own + self.round_trip.percentile(50) < self.pace.period:
                    self.waited += missed
        except BaseException as error:  # Whatever it is, the motors go off; the main thread reports it.
            self.error = error
        finally:
            self._rest()

    def _cycle(self) -> float:
        """One exchange; the seconds that it took."""
        if self._engage:
            self.safety.engage()
            self._engage = False
        decision = self.safety.decide(time.monotonic())
        started = time.monotonic()
        reply = self.port.exchange(self.sensing.command(decision.position, decision.mode))
        took = time.monotonic() - started
        if reply is None:
            return took
        self.round_trip.add(reply.received - reply.sent)
        self.safety.see(self._sample(reply))
        self._fresh.set()
        return took

    def _sample(self, reply: Reply) -> Sample:
        measured = self.sensing.measure(reply.state)
        before = self.safety.sample
        if before is not None and before.generation != reply.generation:
            self._filter.reset()
        velocity = self.sensing.velocity(reply.state)
        if velocity is None:
            velocity = self._filter.update(reply.received, measured.joint_position)
        return Sample(reply.received, reply.sequence, reply.generation, measured, velocity)

    def _rest(self) -> None:
        """Motors off: until the hand has confirmed it, or ten times."""
        off = self.sensing.command(self.sensing.hand.joint_lower, Mode.PASSIVE)
        try:
            for _ in range(10):
                if self.port.exchange(off) is not None:
                    break
        finally:
            self.port.close()
