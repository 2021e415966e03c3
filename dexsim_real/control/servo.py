"""The exchange thread: one exchange with the hand per cycle, at absolute deadlines, through `Safety`.

The policy runs in another thread at a lower rate. If it dies, this thread continues and `Safety` reacts. Whatever ends
this thread, it turns the motors off.
"""

import contextlib
import threading
import time
from collections.abc import Callable

from dexsim_real.control.motors_off import patience, turn_off
from dexsim_real.control.safety import HandSample, Safety
from dexsim_real.core.process import ignore_signals, raise_priority
from dexsim_real.core.timing import Pace, Timing
from dexsim_real.sensors.hand import HandSensing, VelocityFilter
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import HandPort, Reply, checked, refusal_of


class Servo:
    """Exchanges commands and states with the hand until stopped.

    Args:
      port: connected; used by this thread only from now on.
      sensing: conversion to SI units.
      safety: decides the commands.
      rate: exchanges per second.
      beat: called before every exchange as a sign of life, with the time s by which the next call may be late.

    `retared` is called with the number of the exchange from which on another tare holds, and with lines that name
    taxels which it masks.
    """

    def __init__(
        self,
        port: HandPort,
        sensing: HandSensing,
        safety: Safety,
        rate: float,
        beat: Callable[[float], None] = lambda more: None,
    ):
        self.port, self.sensing, self.safety = port, sensing, safety
        self.pace, self._beat = Pace(rate), beat
        self.round_trip = Timing()
        self.waited = 0  # deadlines missed because of late answers
        self.error: BaseException | None = None
        self.driven = False  # whether the motors may be on
        self.retared: Callable[[int, list[str]], None] = lambda sequence, lines: None
        self._filter = VelocityFilter(sensing.config.velocity_time)
        self._generation = 0
        self._rested = False
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
        """Whether the thread runs."""
        return self._thread.is_alive()

    def forget(self) -> None:
        """Reset the timing statistics, to exclude the start."""
        self.pace.jitter, self.round_trip, self.waited = Timing(), Timing(), 0

    def free(self, now: float) -> float:
        """The next time s at which a request has just been sent and the interpreter is idle until its answer."""
        lead, period = 0.001, self.pace.period
        return now + (self.pace.next + lead - now) % period

    def wait_fresh(self, seconds: float) -> HandSample | None:
        """Wait for the next plausible sample; None when none arrives in time."""
        self._fresh.clear()
        return self.safety.sample if self._fresh.wait(seconds) else None

    def stop(self) -> None:
        """Turn the motors off and close the port; `driven` remains True if the hand has not confirmed it."""
        ignore_signals()
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        elif not self._rested:
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
                # A usual answer would have left enough time: the hand was late, not the bridge.
                if missed and own + self.round_trip.percentile(50) < self.pace.period:
                    self.waited += missed
        except BaseException as error:  # The main thread reports it.
            self.error = error
        finally:
            self._rest()

    def _cycle(self) -> float:
        """One exchange; returns its duration in s."""
        self._beat(0.0)
        if self._engage:
            self.safety.engage()
            self._engage = False
        decision = self.safety.decide(time.monotonic())
        self.driven |= decision.mode == Mode.POSITION
        started = time.monotonic()
        reply = self.port.exchange(self.sensing.command(decision.position, decision.mode, decision.stiffness))
        took = time.monotonic() - started
        if reply is None:
            self.safety.refuse(refusal_of(self.port))
            return took
        reply = checked(reply, time.monotonic())
        self.driven = decision.mode == Mode.POSITION
        self.round_trip.add(reply.received - reply.sent)
        sample = self._sample(reply)
        if self.safety.see(sample):
            self._filter.update(sample.time, sample.measured.joint_position)
            self._fresh.set()
        return took

    def _sample(self, reply: Reply) -> HandSample:
        lines = self.sensing.mask_stuck(reply.state, self.safety.config.finger_force)
        if self.sensing.track_zero(reply.received, reply.state) or lines:
            self.retared(reply.sequence, lines)
        measured = self.sensing.measure(reply.state)
        if reply.generation != self._generation:
            self._filter.reset()
        self._generation = reply.generation
        velocity = self.sensing.velocity(reply.state)
        if velocity is None:
            velocity = self._filter.estimate(reply.received, measured.joint_position)
        return HandSample(reply.received, reply.sequence, reply.generation, measured, velocity)

    def _rest(self) -> None:
        """Turn the motors off, and close the port."""
        off = self.sensing.command(self.sensing.hand.joint_lower, Mode.PASSIVE)
        self._rested = True
        self._beat(patience(self.driven))
        try:
            if turn_off(self.port, off, patience(self.driven)):
                self.driven = False
        finally:
            with contextlib.suppress(Exception):  # Of a driver from elsewhere; the hand has been told.
                self.port.close()
