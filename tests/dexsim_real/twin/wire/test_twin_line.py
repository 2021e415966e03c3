"""The emulated line: timing in virtual time, and the name of its terminal."""

import os

import numpy as np
import pytest
from hypothesis import given, strategies as st

pytest.importorskip("serial")
from twin_pair import Cable, request

from dexsim_real.core.errors import HandError
from dexsim_real.twin.wire import Terminal
from dexsim_real.wire import frames
from dexsim_real.wire.frames import HAND_REPLIES, Command, Parser


def test_an_exchange_takes_what_it_takes_on_the_hand_and_comes_in_pieces():
    """On a hand: mean 9.59 to 9.60 ms, 95 % below 9.62 to 9.63 ms, at most 10.7 ms, of 1773 exchanges."""
    cable, times = Cable(), []
    for _ in range(700):
        start = cable.now
        pieces = cable.ask(request(), 0.012)
        (frame,) = Parser(HAND_REPLIES).feed(b"".join(data for _, data in pieces))
        assert frame.command == Command.EXCHANGE
        times.append(1e3 * (pieces[-1][0] - start))
    assert np.mean(times) == pytest.approx(9.59, abs=0.02) and np.percentile(times, 95) < 9.64
    assert 10.2 < max(times) < 10.8 and min(times) > 9.4
    assert cable.line.counts == {"requests": 700, "answers": 700}
    pieces = cable.ask(request() + request())
    ends = np.cumsum([len(data) for _, data in pieces])
    assert ends.tolist() == [510, 1020, 1530, 2040, 2217]  # A request while the board is at work is ignored.
    np.testing.assert_allclose(np.diff([when for when, _ in pieces]), np.diff(ends) * 10 / 3e6, atol=1e-9)
    assert cable.line.counts["ignored"] == 1


@given(st.binary(max_size=600))
def test_noise_on_the_line_is_answered_with_silence(noise):
    cable = Cable()
    answered = cable.ask(noise, 0.05) != []
    assert answered <= (Parser(frames.HOST_REQUESTS).feed(noise) != [])
    assert cable.ask(request(), 0.05) != []


def test_a_terminal_has_its_name_until_it_closes_and_takes_nobody_elses(tmp_path):
    name = tmp_path / "port"
    name.symlink_to("/dev/pts/999999")  # of a program that was killed
    for _ in range(2):
        terminal = Terminal(name)
        file = os.open(name, os.O_RDWR | os.O_NOCTTY)
        terminal.write(b"a")
        os.write(file, b"b")
        assert (os.read(file, 10), terminal.read(), terminal.read()) == (b"a", b"b", b"")
        terminal.close()
        assert not name.is_symlink()
        with pytest.raises(OSError):
            os.write(file, b"x")
        os.close(file)
    (tmp_path / "file").touch()
    (tmp_path / "mine").symlink_to(tmp_path / "file")
    for taken in ("file", "none/port", "mine"):
        with pytest.raises(HandError, match=taken):
            Terminal(tmp_path / taken)
    assert (tmp_path / "mine").resolve() == tmp_path / "file"
