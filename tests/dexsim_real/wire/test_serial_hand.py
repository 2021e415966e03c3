"""The hand on a serial port: faults, late answers, reconnection, whose hand it is, and what is said of it."""

import dataclasses
import errno
import termios

import numpy as np
import pytest
from emulated_plant import motors
from pty_hand import QUICK, PtyHand, connect_in_memory
from virtual_time import VirtualTime

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.core.errors import HandError
from dexsim_real.loop import LoopThread
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.sensors.imu import Imu
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.wire.frames import Command, Frame, Mode, empty_state
from dexsim_real.wire.link import Identity, LinkCounts, SerialHand, check_identity, read_identity

serial = pytest.importorskip("serial")


def memory_port(monkeypatch, peer, config=QUICK):
    """A port to this hand over a line in memory, and the clock of both."""
    clock = VirtualTime()
    connect_in_memory(monkeypatch, peer, clock)
    port = SerialHand("loop://", config)
    port._open()
    return port, clock


def test_one_request_one_answer():
    seen = []

    def answer(index, block, state):
        state["joint"]["position"] = block["position"] + 0.25

    with PtyHand(answer) as peer:
        port = SerialHand(peer.port, QUICK)
        port.tap = lambda way, data: seen.append((way, bytes(data)))
        assert "firmware 1.3.9" in port.connect()
        reply = port.exchange(motors(0.5))
        np.testing.assert_array_equal(reply.state["joint"]["position"], np.full(12, 0.75, np.float32))
        assert 0 <= reply.received - reply.sent and reply.generation == 1
        np.testing.assert_array_equal(peer.commands[-1], motors(0.5))
        port.close()
    # The motors are off until the caller says otherwise.
    assert set(peer.commands[0]["mode"].tolist()) == {Mode.PASSIVE} and not peer.commands[0]["torque_max"].any()
    # Every frame is seen whole, in order: version, passive state, serial number, side, exchange.
    assert [way for way, _ in seen] == ["tx", "rx"] * 5
    assert seen[-2][1] == Frame(0xFE, 0x80, Command.EXCHANGE, motors(0.5).tobytes()).encode()
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
    (lambda state, whole: Frame(0x80, 0xFE, Command.ERROR, b"\xee" * 4).encode()): "refused",  # no known number
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
    # The flips; a cut frame never gets as far as its checksum.
    port.counts, expected = LinkCounts(), LinkCounts(sent=2 * len(plan), answered=len(plan), crc_errors=2)
    for index, fault in enumerate(plan):
        assert port.exchange(motors(0.5)) is None, index
        reply = port.exchange(motors(0.5))
        assert reply is not None and reply.state["joint"]["position"][0] == 2 * index + 2, index
        setattr(expected, FAULTS[fault], getattr(expected, FAULTS[fault]) + 1)
    assert port.counts == expected
    port.close()


def test_a_late_answer_is_thrown_away(monkeypatch):
    def answer(index, block, state):
        state["joint"]["position"], peer.delay = index, 0.25 if index == 1 else 0.001

    peer = PtyHand(answer)
    port, clock = memory_port(monkeypatch, peer)
    assert port.exchange(motors(0.5)) is not None
    assert port.exchange(motors(0.5)) is None
    clock.sleep(0.4)  # Now it is there, and must not pass for the answer to the next request.
    assert port.exchange(motors(0.5)).state["joint"]["position"][0] == 2
    assert (port.counts.silent, port.counts.late) == (1, 1)


def test_an_answer_sooner_than_the_wire_allows_is_to_an_earlier_request(monkeypatch):
    def answer(index, block, state):
        state["joint"]["position"], peer.delay = index, (0.57, 0.25)[index]

    peer = PtyHand(answer)
    # 2514 bytes take 0.218 s.
    port, _ = memory_port(monkeypatch, peer, dataclasses.replace(QUICK, baud=115200, margin=0.3, paced=True))
    assert port.exchange(motors(0.5)) is None
    assert port.exchange(motors(0.5)).state["joint"]["position"][0] == 1
    assert port.counts == LinkCounts(sent=2, answered=1, silent=1, late=1)


def test_of_two_answers_at_once_the_newer_is_taken(monkeypatch):
    def answer(index, block, state):
        state["joint"]["position"] = 1
        older = peer.whole()
        state["joint"]["position"] = 2
        return older + peer.whole()

    peer = PtyHand(answer)
    port, _ = memory_port(monkeypatch, peer)
    assert port.exchange(motors(0.5)).state["joint"]["position"][0] == 2
    assert port.counts == LinkCounts(sent=1, answered=1, late=1)


def test_a_line_that_never_falls_silent_does_not_hold_the_driver(monkeypatch):
    peer = PtyHand(lambda index, block, state: b"\x55" * 1_000_000)
    port, clock = memory_port(monkeypatch, peer)
    read, begin = port._serial.read, clock.now

    def babble(size):
        clock.sleep(0.0005)
        return read(min(size, 50))

    port._serial.read = babble
    assert port.exchange(motors(0.5)) is None and clock.now - begin < 0.3


ERROR = Frame(0x80, 0xFE, Command.ERROR, b"\x02").encode()
OTHER = Frame(0x81, 0xFE, Command.EXCHANGE, empty_state().tobytes()).encode()


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (b"", "no answer.*power"),
        (b"\x13\x37" * 40, "--link.baud .*3000000 baud"),
        (ERROR, "unknown command .1501002.; power-cycle"),
        (OTHER, "no valid state .* --link.hand-id"),
    ],
)
def test_why_a_hand_does_not_answer(answer, says):
    with PtyHand(lambda *_: answer, version=None) as peer, pytest.raises(HandError, match=says):
        SerialHand(peer.port, QUICK).connect()


def test_answers_that_come_too_soon_or_too_late_are_told(monkeypatch):
    """Of an emulated line without pace; or each so late that it meets the next request."""
    for version, delay in ((b"1", 0.0), (None, 0.113), (None, 0.15)):
        peer = PtyHand(version=version)
        peer.delay = delay
        connect_in_memory(monkeypatch, peer, VirtualTime())
        with pytest.raises(HandError, match="too late; raise --link.margin.*--link.no-paced"):
            SerialHand("loop://", dataclasses.replace(QUICK, paced=True, margin=0.1, handshake=0.6)).connect()


def test_a_hand_that_does_not_tell_its_version_is_still_a_hand():
    with PtyHand(version=None) as peer:
        port = SerialHand(peer.port, QUICK)
        assert "firmware unknown" in port.connect()
        with pytest.raises(HandError, match="another program has it open"):
            SerialHand(peer.port, QUICK).connect()
        port.close()


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (PermissionError(errno.EACCES, "denied"), "sudo usermod -aG .*log out"),
        (OSError(errno.EBUSY, "busy"), "another program has it open"),
        (termios.error(errno.EIO, "gone"), "cannot be opened"),  # It vanishes meanwhile.
    ],
)
def test_a_port_that_does_not_open_is_one_line(monkeypatch, error, says):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(serial, "serial_for_url", fail)
    for opening in (SerialHand("/dev/null", QUICK).connect, lambda: Imu("/dev/null")):
        with pytest.raises(HandError, match=f"^/dev/null: .*{says}[^\n]*$"):
            opening()


def test_the_latency_timer(tmp_path):
    timer = tmp_path / "ttyUSB7" / "latency_timer"
    timer.parent.mkdir()
    device = tmp_path / "by-id"
    device.symlink_to("/dev/ttyUSB7")
    timer.write_text("16\n")
    port = SerialHand(str(device))
    (text,) = port.warnings(tmp_path)
    assert f"echo 1 | sudo tee {timer}" in text and "16 ms" in text
    timer.write_text("1\n")
    assert port.warnings(tmp_path) == SerialHand("/dev/ttyACM0").warnings(tmp_path) == []


OURS = Identity("2R32A001", "right")


@pytest.mark.parametrize(
    ("serial", "side", "identity"),
    [
        (b"2R32A001" + bytes(24), b"right" + bytes(27), OURS),
        (b"2R32A001", b"L\0", Identity("2R32A001", "left")),
        (b"2L32A001", b"\1\0", Identity("2L32A001", "left")),
        (b"\xff" * 32, b"", Identity()),
    ],
)
def test_what_a_hand_tells(serial, side, identity):
    assert read_identity(serial, side) == identity


def calibration(hand, serial="2R32A001", handedness="right"):
    return dataclasses.replace(ideal_calibration(hand), serial=serial, handedness=handedness)


def test_another_hand_is_refused_in_one_line_and_what_is_unknown_is_told(hand):
    ours, unknown = calibration(hand), calibration(hand, "", "")
    for identity, known, says in (
        (Identity("2R32B002", "right"), ours, "this is hand 2R32B002, the calibration is of hand 2R32A001"),
        (Identity(), ours, "does not tell its serial number, the calibration is of hand 2R32A001"),
        (Identity("2L32A001", "left"), None, "this is a left hand .* the model a right one"),
    ):
        with pytest.raises(HandError, match=f"{says}[^\n]*$"):
            check_identity(identity, hand, known)
    assert check_identity(OURS, hand, ours) == check_identity(OURS, hand, None) == []
    assert "names no serial number" in check_identity(OURS, hand, unknown)[0]
    for known in (None, unknown):
        (note,) = check_identity(Identity(), hand, known)
        assert "does not tell its serial number" in note
    assert "code 1" in check_identity(Identity("A001", "code 1"), hand, None)[0]


@pytest.mark.parametrize(
    ("back", "says"),
    [(b"2R32A001", ""), (b"2R32B002", "2R32B002, not right, serial number 2R32A001"), (None, "unknown")],
)
def test_after_a_reconnection_only_the_same_hand_is_driven(hand, virtual_time, back, says):
    """Cable out while the motors are on; what comes back may be another hand, or not tell. Both end the run."""
    peer = PtyHand(registers={20: b"right", 21: b"2R32A001"})
    peer.state["joint"]["position"] = np.array([0.1] * 3 + [0.0] + [0.1] * 8)
    peer.open()
    port, safety = SerialHand(peer.port, QUICK), Safety(hand, SafetyConfig())
    loop = LoopThread(port, HandSensing(hand, HardwareConfig()), safety, 83.0, clock=virtual_time.monotonic)
    port.connect()
    for _ in range(10):  # A pose needs as many.
        loop.cycle()
    safety.engage()
    loop.cycle()
    assert np.all(peer.commands[-1]["mode"] == Mode.POSITION)
    peer.close()
    assert [loop.cycle() for _ in range(8)] == [None] * 8
    peer.commands.clear()
    peer.registers = {20: b"right", 21: back} if back else {}
    peer.open()
    until = virtual_time.now + 20
    while virtual_time.now < until and not (safety.latched or any(np.any(c["mode"]) for c in peer.commands)):
        loop.cycle()
    driven = any(np.any(command["mode"] != Mode.PASSIVE) for command in peer.commands)
    # The first answer of the new generation is from a passive hand: its pose may have changed.
    first = [command["mode"] for command in peer.commands[:2]]  # of the connection, and of the exchange after it
    assert not driven or not np.any(first) and loop.cycle().generation > 1
    assert not driven or port.counts.lost == port.counts.reconnects == 1
    port.close()
    peer.close()
    assert driven == (not says) and len(peer.commands) > 1
    assert not says or ("another hand is on" in safety.latched and says in safety.latched)
