"""Opening a port: messages for the usual problems, latency timer, deadlines."""

import dataclasses
import errno
import math
import os
import re
import termios

import numpy as np
import pytest
from pty_hand import QUICK, PtyHand

from dexsim_real.core.errors import (
    HandError,
    explain,
    latency_warnings,
)
from dexsim_real.sensors.imu import Imu
from dexsim_real.wire.frames import STATE_BLOCK, Command, Frame, empty_state
from dexsim_real.wire.link import LinkConfig, LinkCounts, Reply, checked, greet, refusal_of
from dexsim_real.wire.refusals import Refusal
from dexsim_real.wire.serial_hand import SerialHand, open_port


def test_a_silent_hand_and_a_wrong_baud_rate_are_told_apart():
    with PtyHand(lambda *_: b"", version=None) as peer, pytest.raises(HandError, match="no answer.*power"):
        SerialHand(peer.port, QUICK).connect()
    with PtyHand(lambda *_: b"\x13\x37" * 40, version=None) as peer, pytest.raises(HandError, match="3000000 baud"):
        SerialHand(peer.port, QUICK).connect()
    broken = Frame(0x80, 0xFE, Command.ERROR, b"\x02").encode()
    with PtyHand(lambda *_: broken) as peer, pytest.raises(HandError, match="unknown command .1501002.; power-cycle"):
        SerialHand(peer.port, QUICK).connect()


def test_an_emulated_line_without_pace_is_told_so():
    with PtyHand() as peer, pytest.raises(HandError, match="sooner than 3000000 baud.*--link.no-paced"):
        SerialHand(peer.port, dataclasses.replace(QUICK, paced=True)).connect()


def test_a_hand_that_does_not_tell_its_version_is_still_a_hand():
    with PtyHand(version=None) as peer:
        port = SerialHand(peer.port, QUICK)
        assert "firmware unknown" in port.connect()
        port.close()


def test_two_programs_do_not_share_a_port():
    with PtyHand() as peer:
        first = SerialHand(peer.port, QUICK)
        first.connect()
        with pytest.raises(HandError, match="another program has it open"):
            SerialHand(peer.port, QUICK).connect()
        first.close()


def test_messages_for_the_usual_troubles(tmp_path):
    with pytest.raises(HandError, match="there is no such port"):
        SerialHand(str(tmp_path / "none"), QUICK).connect()
    file = tmp_path / "port"
    file.touch()
    group = __import__("grp").getgrgid(os.stat(file).st_gid).gr_name
    text = explain(str(file), PermissionError(errno.EACCES, "Permission denied"))
    assert f"usermod -aG {group}" in text and "\n" not in text
    assert "another program" in explain("/dev/x", OSError(errno.EBUSY, "busy"))
    with pytest.raises(HandError, match="no_such_module"):
        open_port("sdk:no_such_module:f", QUICK)
    for spec in ("sdk:", "sdk::f", "sdk:.relative:f"):
        with pytest.raises(HandError, match=f"^{re.escape(spec)}: .*give sdk:MODULE:FUNCTION"):
            open_port(spec, QUICK)
    with pytest.raises(HandError, match="^sdk:math:pi: pi is no function; give sdk:MODULE:FUNCTION"):
        open_port("sdk:math:pi", QUICK)


def test_an_error_of_a_driver_is_its_own(tmp_path, monkeypatch):
    """Not a wrong name of the module."""
    (tmp_path / "broken_sdk.py").write_text("def open_hand(config):\n    return config.no_such_field\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(AttributeError, match="no_such_field"):
        open_port("sdk:broken_sdk", QUICK)


def test_a_port_that_vanishes_while_it_opens_is_a_hand_that_is_gone(monkeypatch):
    """pyserial lets `termios.error` pass, which is no OSError; a reconnection must not end with it."""
    import serial

    def vanish(*_, **__):
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(serial, "serial_for_url", vanish)
    with pytest.raises(HandError, match="^/dev/hand: cannot be opened .*check the name and the cable"):
        SerialHand("/dev/hand", QUICK).connect()
    monkeypatch.setattr(serial, "Serial", vanish)
    with pytest.raises(HandError, match="^/dev/imu: cannot be opened"):
        Imu("/dev/imu")


def test_a_url_whose_port_lacks_a_setting_is_refused_in_one_line(monkeypatch):
    """Such as rfc2217://, which has no limit on the time of writing."""
    import serial

    def lack(*_, **__):
        raise NotImplementedError("write_timeout is currently not supported")

    monkeypatch.setattr(serial, "serial_for_url", lack)
    with pytest.raises(HandError, match="^rfc2217://host:1: cannot be opened .write_timeout"):
        SerialHand("rfc2217://host:1", QUICK).connect()


def test_a_reply_is_checked_whoever_made_it():
    """A stamp of another clock would never grow old: `Safety` would not notice that the hand is silent."""
    good = Reply(empty_state(), 9.99, 10.0, 1, 1)
    same, later = checked(good, 10.0), checked(good, 12.0)
    assert dataclasses.replace(same, state=good.state) == good and same.state == good.state and later.received == 10.0
    assert checked(good, 9.9).received == 9.9, "a little ahead"
    for received, said in ((1.7e9, "1.7e.09 s ahead"), (np.inf, "inf s ahead"), (np.nan, "nan s ahead")):
        with pytest.raises(HandError, match=f"{said}.*time.monotonic"):
            checked(dataclasses.replace(good, received=received), 10.0)
    other = empty_state()
    other["joint"]["id"] = np.arange(12)[::-1]
    for state, said in (
        (None, "NoneType"),
        ([1.0, 2.0], "list"),
        (np.zeros(12), r"float64 \[12\]"),
        (np.zeros(2, STATE_BLOCK), r"\[2\]; expected one"),
        (other, r"joint ids \[11, 10"),
    ):
        with pytest.raises(HandError, match=said):
            checked(dataclasses.replace(good, state=state), 10.0)
    for answer, said in (([1, 2], "answered with list"), (True, "answered with bool"), (good.state, "with ndarray")):
        with pytest.raises(HandError, match=said):
            checked(answer, 10.0)
    for name, value in (
        ("sent", None),
        ("sent", math.nan),
        ("received", "now"),
        ("sequence", None),
        ("generation", [1]),
    ):
        with pytest.raises(HandError, match=f"has {name} {re.escape(repr(value))}; expected a number"):
            checked(dataclasses.replace(good, **{name: value}), 10.0)


def test_numbers_of_numpy_become_plain_ones():
    """A log would keep them as arrays, and the replay could not tell which frame a tick used."""
    reply = Reply(empty_state(), np.float64(1.0), np.float32(2.0), np.int64(3), np.uint8(1))
    found = [getattr(checked(reply, 2.5), name) for name in ("sent", "received", "sequence", "generation")]
    assert found == [1.0, 2.0, 3, 1] and [type(value) for value in found] == [float, float, int, int]


class Driver:
    """A driver that does nothing."""

    def __init__(self, **parts):
        vars(self).update(
            {"counts": LinkCounts(), "connect": lambda: "a hand", "exchange": print, "close": print} | parts
        )


def test_a_driver_may_reuse_its_buffer():
    state = empty_state()
    reply = checked(Reply(state, 0.0, 1.0, 0, 1), 2.0)
    state["joint"]["position"][:] = 1.0
    assert not reply.state["joint"]["position"].any()


def test_what_a_driver_tells_is_checked():
    for warnings in (lambda: ["slow"], ["slow"]):
        assert greet(Driver(warnings=warnings)) == ["a hand", "warning: slow"]
    assert greet(Driver()) == ["a hand"]
    for parts, said in (
        ({"connect": lambda: None}, "`connect` returned None"),
        ({"connect": lambda: (1, "a")}, r"`connect` returned \(1, 'a'\)"),
        ({"warnings": lambda: "slow"}, "`warnings` returned 'slow'; expected a list"),
        ({"warnings": lambda: None}, "`warnings` returned None"),
    ):
        with pytest.raises(HandError, match=said):
            greet(Driver(**parts))
    busy = Refusal("busy", serious=False)
    assert refusal_of(Driver()) is None and refusal_of(Driver(refusal=busy)) is busy
    with pytest.raises(HandError, match="`refusal` is 'busy'"):
        refusal_of(Driver(refusal="busy"))


def test_a_function_that_returns_no_driver_is_refused(tmp_path, monkeypatch):
    (tmp_path / "my_driver.py").write_text("made = None\ndef open_hand(config):\n    return made\n")
    monkeypatch.syspath_prepend(tmp_path)
    import my_driver

    lacking = Driver()
    del lacking.close
    for made, said in (
        (None, "returned NoneType without 'counts'"),
        (Driver, "returned type without 'counts'"),
        (lacking, "returned Driver without 'close'"),
        (Driver(counts={"sent": 1}), "`counts` is dict; expected `LinkCounts`"),
    ):
        monkeypatch.setattr(my_driver, "made", made)
        with pytest.raises(HandError, match=f"^sdk:my_driver: .*{said}"):
            open_port("sdk:my_driver", QUICK)


def test_the_latency_timer(tmp_path):
    timer = tmp_path / "ttyUSB7" / "latency_timer"
    timer.parent.mkdir()
    device = tmp_path / "by-id"
    device.symlink_to("/dev/ttyUSB7")
    timer.write_text("16\n")
    (text,) = latency_warnings(str(device), tmp_path)
    assert f"echo 1 | sudo tee {timer}" in text and "16 ms" in text
    timer.write_text("1\n")
    assert latency_warnings(str(device), tmp_path) == []
    assert latency_warnings("/dev/ttyACM0", tmp_path) == []


def test_the_deadline_follows_size_and_baud():
    # 297 + 2217 bytes of ten bits at 3 Mbaud are 8.38 ms.
    assert LinkConfig(margin=0.001).deadline(297, 2217) == pytest.approx(0.00838 + 0.001, abs=1e-5)
    assert LinkConfig(baud=115200, margin=0.001).deadline(297, 2217) == pytest.approx(0.2192, abs=1e-4)
