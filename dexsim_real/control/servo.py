"""The thread that owns the hand: one exchange a cycle, at absolute deadlines, through `Safety`.

The policy runs elsewhere and slower. If it dies, this thread goes on and `Safety` acts; when this
thread ends, for whatever reason, its last act is to turn the motors off.
"""

import threading
import time

from dexsim_real.control.safety import Safety, Sample
from dexsim_real.core.process import raise_priority
from dexsim_real.core.timing import Pace, Timing
from dexsim_real.sensors.hand import HandSensing, VelocityFilter
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import HandPort, Reply


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
        raise_priority()
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
