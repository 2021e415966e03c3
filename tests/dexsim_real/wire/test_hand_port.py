"""Opening a port: messages for the usual problems, latency timer, deadlines, and what a port may tell."""

import dataclasses
import errno
import os
import re
import termios

import memory_line
import pytest
from pty_hand import QUICK, PtyHand

from dexsim import load_hand
from dexsim_real.core.errors import HandError, explain
from dexsim_real.sensors.imu import Imu
from dexsim_real.wire.frames import Command, Frame, empty_state
from dexsim_real.wire.serial_hand import SerialHand, open_port

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


def test_answers_that_come_too_soon_or_too_late_are_told(monkeypatch):
    """Of an emulated line without pace; or each so late that it meets the next request."""
    for version, delay in ((b"1", 0.0), (None, 0.113), (None, 0.15)):
        peer = PtyHand(version=version)
        peer.delay = delay
        memory_line.connect(monkeypatch, peer, memory_line.Clock())
        with pytest.raises(HandError, match="too late; raise --link.margin.*--link.no-paced"):
            SerialHand("loop://", dataclasses.replace(QUICK, paced=True, margin=0.1, handshake=0.6)).connect()


def test_a_hand_that_does_not_tell_its_version_is_still_a_hand():
    with PtyHand(version=None) as peer:
        port = SerialHand(peer.port, QUICK)
        assert "firmware unknown" in port.connect()
        with pytest.raises(HandError, match="another program has it open"):
            SerialHand(peer.port, QUICK).connect()
        port.close()


def test_messages_for_the_usual_troubles(hand, tmp_path):
    with pytest.raises(HandError, match="there is no such port"):
        SerialHand(str(tmp_path / "none"), QUICK).connect()
    file = tmp_path / "port"
    file.touch()
    group = __import__("grp").getgrgid(os.stat(file).st_gid).gr_name
    text = explain(str(file), PermissionError(errno.EACCES, "Permission denied"))
    assert f"usermod -aG {group}" in text and "\n" not in text
    assert "another program" in explain("/dev/x", OSError(errno.EBUSY, "busy"))
    for spec in ("sdk:no_such_module:f", "sdk:", "sdk:math:no_such_function"):
        with pytest.raises(HandError, match=f"^{re.escape(spec)}: .*give sdk:MODULE:FUNCTION"):
            open_port(spec, hand, QUICK)
    with pytest.raises(HandError, match="leap_like: 16 joints and 4 x 48 taxels.*--port sdk:MODULE"):
        open_port("/dev/hand", load_hand("leap_like"), QUICK)


@pytest.mark.parametrize("error", [termios.error(errno.EIO, "gone"), NotImplementedError("no write_timeout")])
def test_a_port_that_does_not_open_is_one_line(monkeypatch, error):
    """One that vanishes meanwhile, and a URL whose kind of port lacks a setting: pyserial raises no OSError."""

    def fail(*_, **__):
        raise error

    monkeypatch.setattr(serial, "serial_for_url", fail)
    with pytest.raises(HandError, match="^/dev/hand: cannot be opened .*check the name and the cable"):
        SerialHand("/dev/hand", QUICK).connect()
    with pytest.raises(HandError, match="^/dev/imu: cannot be opened"):
        Imu("/dev/imu")


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
