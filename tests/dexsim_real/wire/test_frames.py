"""The wire format: layouts against `struct`, the checksum by one example, and a parser that
loses no intact frame and accepts no damaged one, whatever the line does."""

import struct

import numpy as np
from hypothesis import given, settings, strategies as st

from dexsim_real.wire import frames
from dexsim_real.wire.frames import HAND_REPLIES, HOST_REQUESTS, Command, Frame, Mode, Parser


def state_frame(rng):
    """A reply with random content and sound ids."""
    state = np.frombuffer(rng.bytes(2208), frames.STATE_BLOCK).copy()
    state["joint"]["id"] = np.arange(12)
    return Frame(0x80, frames.HOST, Command.EXCHANGE, state.tobytes())


def test_a_version_request_and_a_command_block_byte_for_byte():
    request = Frame(frames.HOST, frames.palm_address(0), Command.VERSION).encode()
    assert request == bytes.fromhex("55 AA FE 80 13 00 00 EF C3"), "with the CRC-16/XMODEM of its first seven bytes"
    block = frames.command_block(np.linspace(-1, 1, 12), kp=100, ki=-5, kd=12000, torque_max=300)
    block["mode"][3] = Mode.PASSIVE
    data = block.tobytes()
    assert len(data) == 288
    for joint, angle in enumerate(np.linspace(-1, 1, 12)):
        row = struct.unpack_from("<HhhhfhH4H", data, 24 * joint)
        assert row == (joint, 100, -5, 12000, np.float32(angle), 300, 0 if joint == 3 else 3, 0, 0, 0, 0)
    np.testing.assert_array_equal(frames.decode(data, frames.COMMAND_BLOCK), block)


def test_a_state_block_byte_for_byte():
    data = b"".join(
        struct.pack("<BBfhHHHHHhHH", i, 0, 0.1 * i, -100 * i, (i << 4) | 3, (40 << 8) | i, 1, 2, 3, -7 * i, 0, 0)
        for i in range(12)
    )
    for i in range(5):
        taxels = b"".join(struct.pack("<bbB", -t, t, 2 * t) for t in range(120))
        data += struct.pack("<bbB", -i, i, 200 + i) + taxels + bytes(range(20)) + bytes([30 + i])
    assert len(data) == 12 * 24 + 5 * 384 == 2208
    state, joints, taxels = frames.decode(data), np.arange(12), np.arange(120)
    joint, tip = state["joint"], state["tip"]
    for found, expected in (
        (joint["position"], (0.1 * joints).astype(np.float32)),
        (joint["current"], -100 * joints),
        (joint["raw_position"] >> 4, joints),
        (joint["temperature"] & 0xFF, joints),
        (joint["temperature"] >> 8, np.full(12, 40)),
        (joint["palm_error"] + 10 * joint["joint_error"] + 100 * joint["tip_error"], np.full(12, 321)),
        (joint["velocity"], -7 * joints),
        (tip["taxel"]["z"], np.tile(2 * taxels, (5, 1))),
        (tip["taxel"]["x"], np.tile(-taxels, (5, 1))),
        (tip["total"]["z"], 200 + np.arange(5)),
        (tip["temperature"], 30 + np.arange(5)),
    ):
        np.testing.assert_array_equal(found, expected)
    assert state.tobytes() == data


def test_a_host_does_not_take_its_own_echo_for_an_answer():
    requests = (Command.EXCHANGE, bytes(288)), (Command.VERSION, b""), (Command.READ_REGISTER, b"\x14\0")
    echo = b"".join(Frame(0xFE, 0x80, command, data).encode() for command, data in requests)
    assert Parser(HAND_REPLIES).feed(echo, final=True) == []
    assert len(Parser(HOST_REQUESTS).feed(echo)) == 3


HEADS = [bytes.fromhex(text) for text in ("55", "AA", "55AA", "55AAFE", "55AA80FE02A008", "55AA80FE021020")]


def damaged(rng, sent):
    """A frame with flipped bits, lost, doubled or strange bytes, or cut off."""
    at, size = int(rng.integers(len(sent))), int(rng.integers(1, 40))
    middle = {
        "flip": bytes([sent[at] ^ int(rng.integers(1, 256))]) + sent[at + 1 :],
        "lose": sent[at + size :],
        "double": sent[at : at + size] + sent[at:],
        "cut": b"",
        "strange": rng.bytes(size) + sent[at:],
    }
    data = sent[:at] + middle[rng.choice(list(middle))]
    return b"" if sent in data else data


@settings(max_examples=30)
@given(st.integers(0, 2**31))
def test_damage_costs_only_the_damaged_frames(seed):
    """Every intact frame comes out, in order, not much later than it was fed; nothing else does."""
    rng, parser, sent, received = np.random.default_rng(seed), Parser(HAND_REPLIES), [], []
    longest = frames.OVERHEAD + frames.STATE_BLOCK.itemsize
    for _ in range(40):
        frame = state_frame(rng)
        noise = (b"", rng.bytes(int(rng.integers(1, 30))), HEADS[rng.integers(len(HEADS))])[rng.integers(3)]
        intact = rng.random() < 0.6
        sent += [frame] * intact
        stream = noise + (frame.encode() if intact else damaged(rng, frame.encode()))
        size = int(rng.choice([7, 62, 512, 4096]))
        for at in range(0, len(stream), size):
            received += parser.feed(stream[at : at + size])
        assert len(parser.pending) < longest and received == sent[: len(received)]
    assert received + parser.feed(b"", final=True) == sent
