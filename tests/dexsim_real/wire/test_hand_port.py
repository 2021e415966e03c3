"""Opening a port: messages for the usual problems, latency timer, deadlines; and what a driver of the user's gives."""

import dataclasses
import time

import numpy as np
import pytest
from pty_hand import QUICK, PtyHand

from dexsim_real.core.errors import HandError
from dexsim_real.wire.frames import Command, Frame, empty_state
from dexsim_real.wire.link import Reply, checked
from dexsim_real.wire.serial_hand import SerialHand

serial = pytest.importorskip("serial")
ERROR = Frame(0x80, 0xFE, Command.ERROR, b"\x02").encode()
OTHER = Frame(0x81, 0xFE, Command.EXCHANGE, empty_state().tobytes()).encode()


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (b"", "no answer.*power"),
        (b"\x13\x37" * 40, "--link.baud .*3000000 baud"),
        (ERROR, "unknown command .1501002.; power-cycle"),
        (OTHER, "no hand with the id 0; check --link.hand-id"),
    ],
)
def test_why_a_hand_does_not_answer(answer, says):
    with PtyHand(lambda *_: answer, version=None) as peer, pytest.raises(HandError, match=says):
        SerialHand(peer.port, QUICK).connect()


def test_answers_that_come_too_soon_or_too_late_are_told_apart():
    """Of an emulated line without pace; or each so late that it meets the next request."""
    with PtyHand() as peer, pytest.raises(HandError, match="sooner than 3000000 baud.*--link.no-paced"):
        SerialHand(peer.port, dataclasses.replace(QUICK, paced=True)).connect()
    config = dataclasses.replace(QUICK, paced=True, margin=0.1, handshake=0.6)
    with (
        PtyHand(lambda *_: time.sleep(0.15), version=None) as peer,
        pytest.raises(HandError, match="too late; raise --link.margin"),
    ):
        SerialHand(peer.port, config).connect()


def test_a_hand_that_does_not_tell_its_version_is_still_a_hand():
    with PtyHand(version=None) as peer:
        port = SerialHand(peer.port, QUICK)
        assert "firmware unknown" in port.connect()
        with pytest.raises(HandError, match="another program has it open"):
            SerialHand(peer.port, QUICK).connect()
        port.close()


GOOD = Reply(empty_state(), 9.99, 10.0, 1, 1)
SHUFFLED = empty_state()
SHUFFLED["joint"]["id"] = np.arange(12)[::-1]


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        ([1, 2], "answered with list"),
        (dataclasses.replace(GOOD, received=1.7e9), "1.7e.09 s ahead.*time.monotonic"),
        (dataclasses.replace(GOOD, sent=np.nan), "time.monotonic"),
        (dataclasses.replace(GOOD, state=np.zeros(12)), r"float64 \[12\]"),
        (dataclasses.replace(GOOD, state=SHUFFLED), r"joint ids \[11, 10"),
    ],
)
def test_a_reply_of_a_driver_is_checked(reply, says):
    """A stamp of another clock would never grow old: `Safety` would not notice that the hand is silent."""
    with pytest.raises(HandError, match=says):
        checked(reply, 10.0)


def test_a_reply_becomes_plain_and_does_not_change_afterwards():
    """A log would keep NumPy's numbers as arrays; a driver may reuse its buffer."""
    state = empty_state()
    reply = checked(Reply(state, np.float64(1.0), np.float32(2.6), np.int64(3), np.uint8(1)), 2.5)
    state["joint"]["position"][:] = 1.0
    assert not reply.state["joint"]["position"].any()
    values = [reply.sent, reply.received, reply.sequence, reply.generation]
    assert values == [1.0, 2.5, 3, 1] and [type(value) for value in values] == [float, float, int, int]
