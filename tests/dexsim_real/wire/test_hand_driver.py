"""The driver with a scripted hand on a pseudo-terminal: faults, late answers, reconnection."""

import dataclasses
import time

import memory_line
import numpy as np
import pytest
from pty_hand import QUICK, PtyHand

from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode
from dexsim_real.wire.link import LinkCounts
from dexsim_real.wire.serial_hand import SerialHand

serial = pytest.importorskip("serial")


def command(position=0.5):
    return frames.command_block(np.full(12, position), kp=100, ki=0, kd=0, torque_max=300)


def memory_port(monkeypatch, peer, config=QUICK):
    """A port to this hand over a line in memory, and the clock of both."""
    clock = memory_line.Clock()
    memory_line.connect(monkeypatch, peer, clock)
    port = SerialHand("loop://", config)
    port._open()
    return port, clock


def outcomes(counts):
    return {name: getattr(counts, name) for name in ("answered", "corrupt", "silent", "refused", "lost")}


def test_one_request_one_answer():
    seen = []

    def answer(index, block, state):
        state["joint"]["position"] = block["position"] + 0.25

    with PtyHand(answer) as peer:
        port = SerialHand(peer.port, QUICK, tap=lambda way, data: seen.append((way, bytes(data))))
        assert "firmware 1.3.9" in port.connect()
        reply = port.exchange(command(0.5))
        np.testing.assert_array_equal(reply.state["joint"]["position"], np.full(12, 0.75, np.float32))
        assert 0 <= reply.received - reply.sent and reply.generation == 1
        np.testing.assert_array_equal(peer.commands[-1], command(0.5))
        port.close()
    # The motors are off until the caller says otherwise.
    assert set(peer.commands[0]["mode"].tolist()) == {Mode.PASSIVE} and not peer.commands[0]["torque_max"].any()
    # Every frame is seen whole, in order: version, passive state, serial number, side, exchange.
    assert [way for way, _ in seen] == ["tx", "rx"] * 5
    assert seen[-2][1] == Frame(0xFE, 0x80, Command.EXCHANGE, command(0.5).tobytes()).encode()
    assert seen[-1][1] == peer.whole()
    assert port.counts.sent == 5 == port.counts.answered


def flipped(state, whole):
    return whole[:1000] + bytes([whole[1000] ^ 4]) + whole[1001:]


def misnumbered(state, whole):
    state["joint"]["id"][5] = 4
    return Frame(0x80, 0xFE, Command.EXCHANGE, state.tobytes()).encode()


FAULTS = {
    flipped: "corrupt",
    misnumbered: "corrupt",
    (lambda state, whole: whole[:700] + whole[760:]): "corrupt",
    (lambda state, whole: b"\x55\xaa" * 50): "corrupt",
    (lambda state, whole: b""): "silent",
    (lambda state, whole: Frame(0x80, 0xFE, Command.ERROR, b"\x46\x00").encode()): "refused",
    (lambda state, whole: Frame(0x81, 0xFE, Command.EXCHANGE, state.tobytes()).encode()): "corrupt",  # another hand's
}


def test_every_fault_is_counted_as_what_it_is_and_the_next_answer_is_sound(monkeypatch):
    plan = [fault for fault in FAULTS for _ in range(2)]

    def answer(index, block, state):
        if index % 2 == 0:
            state["joint"]["position"] = index
            return None
        return plan[index // 2](state.copy(), peer.whole())

    peer = PtyHand(answer)
    port, _ = memory_port(monkeypatch, peer)
    port.connect()
    before = outcomes(port.counts)
    expected = dict.fromkeys(before, 0)
    for index, fault in enumerate(plan):
        assert port.exchange(command()) is None, index
        reply = port.exchange(command())
        assert reply is not None and reply.state["joint"]["position"][0] == 2 * index + 2, index
        expected[FAULTS[fault]] += 1
        expected["answered"] += 1
    after = outcomes(port.counts)
    assert {name: after[name] - before[name] for name in after} == expected
    assert port.counts.sent == sum(after.values())
    assert port.counts.crc_errors == 2  # The flips; a cut frame never gets as far as its checksum.
    port.close()


def test_a_late_answer_is_thrown_away(monkeypatch):
    def answer(index, block, state):
        state["joint"]["position"], peer.delay = index, 0.25 if index == 1 else 0.001

    peer = PtyHand(answer)
    port, clock = memory_port(monkeypatch, peer)
    assert port.exchange(command()) is not None
    assert port.exchange(command()) is None
    clock.sleep(0.4)  # Now it is there, and must not pass for the answer to the next request.
    assert port.exchange(command()).state["joint"]["position"][0] == 2
    assert (port.counts.silent, port.counts.late) == (1, 1)


def test_an_answer_sooner_than_the_wire_allows_is_to_an_earlier_request(monkeypatch):
    def answer(index, block, state):
        state["joint"]["position"], peer.delay = index, (0.57, 0.25)[index]

    peer = PtyHand(answer)
    # 2514 bytes take 0.218 s.
    port, _ = memory_port(monkeypatch, peer, dataclasses.replace(QUICK, baud=115200, margin=0.3, paced=True))
    assert port.exchange(command()) is None
    assert port.exchange(command()).state["joint"]["position"][0] == 1
    assert port.counts == LinkCounts(sent=2, answered=1, silent=1, late=1)


def test_of_two_answers_at_once_the_newer_is_taken(monkeypatch):
    def answer(index, block, state):
        state["joint"]["position"] = 1
        older = peer.whole()
        state["joint"]["position"] = 2
        return older + peer.whole()

    peer = PtyHand(answer)
    port, _ = memory_port(monkeypatch, peer)
    assert port.exchange(command()).state["joint"]["position"][0] == 2
    assert port.counts == LinkCounts(sent=1, answered=1, late=1)


def test_a_line_that_never_falls_silent_does_not_hold_the_driver(monkeypatch):
    peer = PtyHand(lambda index, block, state: b"\x55" * 1_000_000)
    port, clock = memory_port(monkeypatch, peer)
    read, begin = port._serial.read, clock.now

    def babble(size):
        clock.sleep(0.0005)
        return read(min(size, 50))

    port._serial.read = babble
    assert port.exchange(command()) is None and clock.now - begin < 0.3


def test_the_hand_goes_and_comes_back():
    peer = PtyHand()
    peer.open()
    port = SerialHand(peer.port, QUICK)
    port.connect()
    assert port.exchange(command()).generation == 1
    peer.close()
    start = time.monotonic()
    for _ in range(8):
        assert port.exchange(command()) is None
    assert port.counts.lost == 1
    peer.commands.clear()
    peer.open()
    reply = None
    while reply is None and time.monotonic() - start < 20:
        reply = port.exchange(command())
    # The first answer of the new generation is from a passive hand: its pose may have changed.
    assert reply.generation > 1 and port.counts.reconnects == 1
    assert all(np.all(block["mode"] == Mode.PASSIVE) for block in peer.commands)
    assert port.exchange(command()) is not None
    np.testing.assert_array_equal(peer.commands[-1], command())
    port.close()
    peer.close()
