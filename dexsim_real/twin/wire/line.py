"""The emulated hand's end of the line: bytes with the timing of RS485, and injected faults.

An exchange takes as long as on the real hand: the bytes of the request at 3 Mbaud, a delay in the palm board, and the
bytes of the answer, forwarded in chunks like a USB adapter does. With the default delay that is 9.6 ms.
"""

import dataclasses
from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from dexsim.core.config import setting, validate
from dexsim_real.core.timing import Timing
from dexsim_real.twin.plant.protocol import Plant
from dexsim_real.twin.wire.command_check import CommandCheck
from dexsim_real.twin.wire.faults import BYTES, Fault, Injector
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.twin.wire.terminal import Terminal
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Parser
from dexsim_real.wire.link import BITS_PER_BYTE

_SILENCE = 0.003  # s without a byte after which an incomplete request is dropped


@dataclasses.dataclass(frozen=True, kw_only=True)
class LineConfig:
    """Timing of the line. The defaults are measured on a hand (mean 9.60 ms, 95 % below 9.63 ms, maximum 10.7 ms)."""

    baud: int = setting(3_000_000, unit="1/s", low=1200, high=20_000_000)
    """Bits per second."""
    processing: float = setting(0.00120, unit="s", low=0.0, high=1.0)
    """Mean delay from the last byte of a request to the first byte of its answer."""
    jitter: float = setting(0.00002, unit="s", low=0.0, high=0.1)
    """Standard deviation of the delay."""
    extra_delay: float = setting(0.0011, unit="s", low=0.0, high=0.1)
    """Largest extra delay of an exchange."""
    extra_delay_probability: float = setting(0.01, unit="1", low=0.0, high=1.0)
    """Probability of an extra delay, per exchange."""
    chunk: int = setting(510, unit="byte", low=1, high=4096)
    """Number of bytes that the adapter forwards at once."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True)
class _Request:
    since: float  # s, last time that the terminal was read before
    read: float  # s, when it was read
    heard: float  # s, when its last byte has arrived over the wire
    delay: float  # s, until its answer
    frame: bytes


class HandLine:
    """Serves one terminal. It has no clock: call `serve` with the time, often, and whenever `due` has passed.

    Args:
      terminal: the hand's end of the cable.
      plant: the physics.
      firmware: executes the requests.
      check: checks every complete command.
      injector: decides the faults.
      config: timing.
      seed: of the delays.
      catch_up: called with a time s before the hand acts, to advance the plant to that time.
      note: called with one line for every event.
    """

    def __init__(
        self,
        terminal: Terminal,
        plant: Plant,
        firmware: Firmware,
        check: CommandCheck,
        injector: Injector,
        config: LineConfig,
        *,
        seed: int = 0,
        catch_up: Callable[[float], None] = lambda now: None,
        note: Callable[[str], None] = lambda text: None,
    ):
        self.terminal, self.config = terminal, config
        self.firmware, self.check, self.injector = firmware, check, injector
        self.counts: Counter[str] = Counter()
        self.slowest = 0.0  # s, longest exchange without a fault
        self.lateness = Timing()  # of the chunks of answers
        self._plant, self._catch_up, self._note = plant, catch_up, note
        self._rng = np.random.default_rng(seed)
        self._tap = Parser(frames.HOST_REQUESTS)  # Receives what the host sent, undamaged.
        self._parser = Parser(frames.HOST_REQUESTS)  # Receives what the palm board gets.
        self._requests: deque[_Request] = deque()
        self._answers: deque[tuple[float, bytes]] = deque()  # when due (s), chunk
        self._back: float | None = None  # s, end of a disconnection
        self._deaf = -np.inf  # s, end of a time in which requests are ignored
        self._heard_all = self._said_all = -np.inf  # s, end on the wire of the last request and answer
        self._heard = self._acted = self._looked = -np.inf
        self._cooling: list[tuple[float, Fault]] = []
        self._lasting: list[tuple[float, Fault]] = []  # until when (s), fault of the board
        self._host_baud: int | None = None

    def due(self) -> float:
        """Time s at which `serve` must be called at the latest; infinite while it can only wait for a request."""
        times = [self._answers[0][0]] if self._answers else [self._turn(one) for one in self._requests]
        times += [self._back] if self._back is not None else []
        times += [when for when, _ in self._cooling]
        times += [] if self._requests else [self.firmware.deadline]
        return min(times, default=self.firmware.deadline)

    def serve(self, now: float) -> None:
        """Do what is due."""
        for entry in [entry for entry in self._cooling if entry[0] <= now]:
            self._cooling.remove(entry)
            self._plant.warm(entry[1].joint, -entry[1].degrees)
        if self._back is not None and now >= self._back:
            self._back = None
            self.terminal.open()
            self._note("reconnected")
        if self._back is None:
            self._listen(now)
        self._looked = now
        if not self._requests:  # A request that has arrived counts, even if this machine is late to serve it.
            self.firmware.watch(now)
        # In order: no request is served while an answer is being sent.
        while self._requests and not self._answers and self._turn(self._requests[0]) <= now:
            self._act(now, self._requests.popleft())
        while self._answers and self._answers[0][0] <= now:
            due, chunk = self._answers.popleft()
            self.lateness.add(now - due)
            taken = self.terminal.write(chunk)
            self.counts["bytes without room"] += len(chunk) - taken  # Nobody reads them: they are lost, as on a wire.

    def close(self) -> None:
        self.terminal.close()

    # --- pieces ---------------------------------------------------------------------------------

    def _listen(self, now: float) -> None:
        data = self.terminal.read()
        if not data:
            if now - self._heard > _SILENCE:
                self._tap.expire()
            return
        self._heard = now
        if self.terminal.baud not in (self.config.baud, None):
            self.counts["bytes at another baud"] += len(data)
            if self._host_baud != self.terminal.baud:
                self._host_baud = self.terminal.baud
                self._note(f"the host sends at {self._host_baud} baud, the hand at {self.config.baud}: set --link.baud")
            return
        for frame in self._tap.feed(data):
            self.counts["requests"] += 1
            if now < self._deaf:
                self.counts["ignored"] += 1
                continue
            data = frame.encode()
            self._heard_all = max(self._heard_all, now) + self._on_wire(len(data))
            self._requests.append(_Request(self._looked, now, self._heard_all, self._delay(), data))

    def _turn(self, request: _Request) -> float:
        """Time s at which a request is answered."""
        return max(request.heard, self._said_all) + request.delay

    def _act(self, now: float, request: _Request) -> None:
        """Execute a request at the time at which the palm board has received it."""
        exchange = request.frame[4] == Command.EXCHANGE
        fault = self.injector.sample(now) if exchange else None
        if fault and fault.kind == "disconnect":
            self._disconnect(now, fault)
            return
        if fault and fault.kind == "stall":
            self.counts["ignored"] += 1
            self._deaf = now + fault.seconds
            self._note(f"fault stall: {fault.seconds:.2f} s")
            return
        self._end_hand_faults(now)
        self._apply_hand_fault(now, fault)
        damaged = fault is not None and fault.on_request
        self._catch_up(now)
        if now - self._acted > _SILENCE:
            self._parser.expire()  # An incomplete request from before the silence.
        self._acted = now
        answers = []
        data = self.injector.damage(fault, request.frame) if fault and damaged else request.frame
        for frame in self._parser.feed(data):
            if frame.command == Command.EXCHANGE:
                self._inspect(request, frame)
            answers.append(self.firmware.answer(frame, now))
        self.counts["damaged requests"] += damaged
        for answer in filter(None, answers):
            self._reply(now, request, answer.encode(), fault)

    def _inspect(self, request: _Request, frame: Frame) -> None:
        try:
            command = frames.decode_command(frame.data)
        except frames.FrameError:
            return
        known = len(self.check.first)
        violations = self.check.take(request.read, command, self.firmware.angles, request.since)
        if violations and known < CommandCheck.MAX_LISTED:
            self._note(f"command outside limits ({', '.join(violations)})")

    def _reply(self, now: float, request: _Request, answer: bytes, fault: Fault | None) -> None:
        # From when it was due: a late machine catches up during the transfer.
        start = max(self._turn(request), now - self._on_wire(len(answer)) / 2)
        if fault and fault.kind == "late":
            start += fault.seconds
            self._note(f"fault late: {fault.seconds:.2f} s")
            self._deaf = start + self._on_wire(len(answer))
        elif not fault:
            self.slowest = max(self.slowest, start + self._on_wire(len(answer)) - request.read)
        damaged = fault is not None and fault.kind in BYTES and not fault.on_request
        data = self.injector.damage(fault, answer) if fault and damaged else answer
        self.counts["damaged answers" if damaged else "answers"] += 1
        for at in range(0, len(data), self.config.chunk):
            chunk = data[at : at + self.config.chunk]
            self._answers.append((start + self._on_wire(at + len(chunk)), chunk))
        self._said_all = start + self._on_wire(len(data))

    def _apply_hand_fault(self, now: float, fault: Fault | None) -> None:
        """Begin a fault of the hand itself."""
        if fault is None or fault.kind in (*BYTES, "late"):
            return
        if fault.kind == "stuck":
            self.firmware.stuck[fault.taxel] = fault.count
            return
        self._note(f"fault {fault.describe()}")
        if fault.kind == "heat":
            self._plant.warm(fault.joint, fault.degrees)
            self._cooling.append((now + fault.seconds, fault))
            return
        if fault.kind == "jam":  # Where it is now.
            fault = dataclasses.replace(fault, radians=float(self.firmware.angles[fault.joint]))
        self.firmware.faults.append(fault)
        self._lasting.append((now + fault.seconds, fault))

    def _end_hand_faults(self, now: float) -> None:
        for entry in [entry for entry in self._lasting if entry[0] <= now]:
            self._lasting.remove(entry)
            self.firmware.faults.remove(entry[1])

    def _disconnect(self, now: float, fault: Fault) -> None:
        self._requests.clear()
        self._answers.clear()
        self._tap.expire()
        self._parser.expire()
        self._deaf = self._heard_all = self._said_all = -np.inf
        self._back = now + fault.seconds
        self.terminal.close()
        self._note(f"fault disconnect: {fault.seconds:.2f} s")

    def _on_wire(self, size: int) -> float:
        return size * BITS_PER_BYTE / self.config.baud

    def _delay(self) -> float:
        config, rng = self.config, self._rng
        extra = rng.uniform(0.0, config.extra_delay) if rng.random() < config.extra_delay_probability else 0.0
        return max(config.processing + config.jitter * rng.standard_normal(), 0.0) + extra
