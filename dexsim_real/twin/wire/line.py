"""The emulated hand's end of the wire: bytes in and out at the pace of RS485, and what goes wrong on it.

One exchange takes as long as on the hand: the request's bytes at 3 Mbaud, a pause in the palm board, the
answer's bytes, handed on in pieces as a USB adapter does. With the default pause that is 9.6 ms.
"""

import dataclasses
from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from dexsim.core.config import setting, validate
from dexsim_real.core.timing import Timing
from dexsim_real.twin.types import Plant
from dexsim_real.twin.wire.check import CommandCheck
from dexsim_real.twin.wire.faults import Fault, Injector
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.twin.wire.terminal import Terminal
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Parser
from dexsim_real.wire.link import BITS_PER_BYTE

_SILENCE = 0.003  # s without a byte, after which half a request is none


@dataclasses.dataclass(frozen=True, kw_only=True)
class LineConfig:
    """Timing of the line, as measured on a hand (mean 9.60 ms, 95 % below 9.63 ms, at most 10.7 ms)."""

    baud: int = setting(3_000_000, unit="1/s", low=1200, high=20_000_000)
    """Bits per second."""
    processing: float = setting(0.00120, unit="s", low=0.0, high=1.0)
    """From the last byte of a request to the first of its answer."""
    jitter: float = setting(0.00002, unit="s", low=0.0, high=0.1)
    """Standard deviation of that."""
    pause: float = setting(0.0011, unit="s", low=0.0, high=0.1)
    """Longest extra delay of an answer."""
    pauses: float = setting(0.01, unit="1", low=0.0, high=1.0)
    """Share of the exchanges that have an extra delay."""
    piece: int = setting(510, unit="byte", low=1, high=4096)
    """Bytes that the adapter hands on at once."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True)
class _Request:
    since: float  # s, when the terminal had been looked at before
    read: float  # s, when it was found there
    heard: float  # s, when its last byte has come over the wire
    pause: float  # s, until its answer
    whole: bytes


class HandLine:
    """Serves one terminal. Owns no clock: `serve` is called often, with the time, and whenever `due` has come.

    Args:
      terminal: its own end of the cable.
      check: takes every command that arrives whole.
      catch_up: called with a time s before the hand acts, to bring the plant there.
      note: called with one line for what a user should know.
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
        self.lateness = Timing()  # of the answers' pieces
        self._plant, self._catch_up, self._note = plant, catch_up, note
        self._rng = np.random.default_rng(seed)
        self._tap = Parser(frames.HOST_REQUESTS)  # What the host sent, before any damage.
        self._parser = Parser(frames.HOST_REQUESTS)  # What the palm board gets.
        self._requests: deque[_Request] = deque()
        self._answers: deque[tuple[float, bytes]] = deque()  # when due, piece
        self._back: float | None = None  # s, when the plug is put in again
        self._deaf = -np.inf  # s, until when nothing is heard
        self._heard_all = self._said_all = -np.inf  # s, end on the wire of the last request and answer
        self._heard = self._acted = self._looked = -np.inf
        self._cooling: list[tuple[float, Fault]] = []
        self._strange: int | None = None

    def due(self) -> float:
        """When `serve` must be called at the latest; infinity while only a new request could matter."""
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
            self._note("plugged in again")
        if self._back is None:
            self._listen(now)
        self._looked = now
        if not self._requests:  # One that has come is an exchange, even if this machine is late to see to it.
            self.firmware.watch(now)
        # One thing after the other: no request is looked at while an answer is on its way.
        while self._requests and not self._answers and self._turn(self._requests[0]) <= now:
            self._act(now, self._requests.popleft())
        while self._answers and self._answers[0][0] <= now:
            due, piece = self._answers.popleft()
            self.lateness.add(now - due)
            taken = self.terminal.write(piece)
            self.counts["bytes without room"] += len(piece) - taken  # Nobody reads: as on a wire they are gone.

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
            if self._strange != self.terminal.baud:
                self._strange = self.terminal.baud
                self._note(f"the host speaks at {self._strange} baud, the hand at {self.config.baud}: not understood")
            return
        for frame in self._tap.feed(data):
            self.counts["requests"] += 1
            if now < self._deaf:
                self.counts["ignored"] += 1
                continue
            whole = frame.encode()
            self._heard_all = max(self._heard_all, now) + self._on_wire(len(whole))
            self._requests.append(_Request(self._looked, now, self._heard_all, self._pause(), whole))

    def _turn(self, request: _Request) -> float:
        """When a request is answered."""
        return max(request.heard, self._said_all) + request.pause

    def _act(self, now: float, request: _Request) -> None:
        """What a request does, at the time that the palm board has it."""
        exchange = request.whole[4] == Command.EXCHANGE
        fault = self.injector.draw(now) if exchange else None
        if fault and fault.kind == "disconnect":
            self._unplug(now, fault)
            return
        if fault and fault.kind == "stall":
            self.counts["ignored"] += 1
            self._deaf = now + fault.seconds
            return
        self._bodily(now, fault)
        damaged = fault is not None and fault.on_request
        self._catch_up(now)
        if now - self._acted > _SILENCE:
            self._parser.expire()  # Half a request from before the silence.
        self._acted = now
        answers = []
        for frame in self._parser.feed(self.injector.damage(fault, request.whole) if damaged else request.whole):
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
        found = self.check.take(request.read, command, self.firmware.reported, request.since)
        if found and known < CommandCheck.WORDS:
            self._note(f"command outside limits ({', '.join(found)})")

    def _reply(self, now: float, request: _Request, whole: bytes, fault: Fault | None) -> None:
        # From when it was due: what this machine has lost is caught up while the bytes flow.
        start = max(self._turn(request), now - self._on_wire(len(whole)) / 2)
        if fault and fault.kind == "late":
            start += fault.seconds
            self._deaf = start + self._on_wire(len(whole))
        elif not fault:
            self.slowest = max(self.slowest, start + self._on_wire(len(whole)) - request.read)
        damaged = fault is not None and fault.kind in ("flip", "drop", "duplicate") and not fault.on_request
        data = self.injector.damage(fault, whole) if damaged else whole
        self.counts["damaged answers" if damaged else "answers"] += 1
        for at in range(0, len(data), self.config.piece):
            piece = data[at : at + self.config.piece]
            self._answers.append((start + self._on_wire(at + len(piece)), piece))
        self._said_all = start + self._on_wire(len(data))

    def _bodily(self, now: float, fault: Fault | None) -> None:
        """Faults of the hand itself."""
        if fault and fault.kind == "heat":
            self._plant.warm(fault.joint, fault.degrees)
            self._cooling.append((now + fault.seconds, fault))
            self._note(f"joint {fault.joint} is {fault.degrees:.0f} K hotter")
        elif fault and fault.kind == "stuck":
            self.firmware.stuck[fault.taxel] = fault.count

    def _unplug(self, now: float, fault: Fault) -> None:
        self._requests.clear()
        self._answers.clear()
        self._tap.expire()
        self._parser.expire()
        self._deaf = self._heard_all = self._said_all = -np.inf
        self._back = now + fault.seconds
        self.terminal.close()
        self._note(f"unplugged for {fault.seconds:.2f} s")

    def _on_wire(self, size: int) -> float:
        return size * BITS_PER_BYTE / self.config.baud

    def _pause(self) -> float:
        config, rng = self.config, self._rng
        extra = rng.uniform(0.0, config.pause) if rng.random() < config.pauses else 0.0
        return max(config.processing + config.jitter * rng.standard_normal(), 0.0) + extra
