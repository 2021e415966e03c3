"""The emulated palm board, its line in virtual time, and the name of its terminal."""

import math
import os
from types import SimpleNamespace

import numpy as np
import pytest
from emulated_plant import motors
from hypothesis import given, strategies as st

pytest.importorskip("serial")
from twin_plant import REST, ScriptedPlant

from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.emulated_hand import PlantMeasurement
from dexsim_real.twin.wire import OVERHEATED, SERIALS, Firmware, HandLine, Terminal
from dexsim_real.wire import frames
from dexsim_real.wire.frames import HAND_REPLIES, Command, Frame, Mode, Parser
from dexsim_real.wire.link import SERIAL_NUMBER, SIDE, check_identity, read_identity


def ask(board, kind, data=b"", target=0x80):
    return board.answer(Frame(0xFE, target, kind, data))


def test_the_state_in_the_wires_few_bits():
    rng = np.random.default_rng(0)
    angle, speed, current = rng.uniform(-0.7, 1.9, 12), rng.uniform(-20, 20, 12), rng.uniform(-900, 900, 12)
    current[0], speed[1] = 1e6, -1e6
    force = rng.uniform(-14, 14, (5, 120, 3))
    force[..., 2] = rng.uniform(-1, 27, (5, 120))
    force[0] = 0
    force[0, 0] = [0.149, -0.151, 25.449]
    force[0, 1] = [-13.0, 13.0, 25.6]
    state = Firmware(ScriptedPlant()).state(PlantMeasurement(angle, speed, current, np.full(12, 41.6), force))
    joint, tick = state["joint"], 2 * math.pi / 4096  # 12 bits in a turn
    assert joint["position"] == pytest.approx(np.round(angle / tick) * tick, abs=1e-6)
    assert ((joint["raw_position"] >> 4) - 2048.0) * tick == pytest.approx(joint["position"], abs=1e-6)
    assert np.all(joint["raw_position"] & 0xF == Mode.PASSIVE) and np.all(joint["temperature"] == 38 << 8 | 42)
    for name, exact in (("current", current), ("velocity", 1000 * speed)):
        np.testing.assert_array_equal(joint[name], np.clip(np.round(exact), -32768, 32767))
    taxel, total = state["tip"]["taxel"], state["tip"]["total"]
    assert taxel[0, 0].tolist() == (1, -2, 254) and taxel[0, 1].tolist() == (-128, 127, 255)
    for axis, low, high in (("x", -128, 127), ("y", -128, 127), ("z", 0, 255)):
        exact = force[..., "xyz".index(axis)] / 0.1
        assert np.all(np.abs(taxel[axis] - np.clip(exact, low, high)) <= 0.5 + 1e-9)
    assert total["z"][0] == 255 and total["x"][0] == np.clip(1 - 130, -128, 127)  # Sums need not fit into a byte.


def test_a_motor_that_is_too_hot_goes_off_until_it_has_cooled():
    plant = ScriptedPlant()
    board = Firmware(plant)
    for degrees, hot in ((85.0, False), (100.0, True), (89.0, True), (84.0, False)):
        plant.heat[4] = degrees
        state = frames.decode(ask(board, Command.EXCHANGE, motors(REST).tobytes()).data)["joint"]
        modes = [0 if hot and joint == 4 else 3 for joint in range(12)]
        assert plant.motors["mode"].tolist() == modes == (state["raw_position"] & 0xF).tolist()
        assert state["joint_error"].tolist() == [OVERHEATED if hot and joint == 4 else 0 for joint in range(12)]


def test_each_hand_tells_its_side_and_serial_number(hand, left):
    for one in (hand, left):
        board = Firmware(SimpleNamespace(hand=one))
        registers = (register.to_bytes(2, "little") for register in (SERIAL_NUMBER, SIDE))
        told = read_identity(*(ask(board, Command.READ_REGISTER, name).data[2:] for name in registers))
        assert check_identity(told, one) == [] and told.serial_number == SERIALS[one.side]


# --- the line ---------------------------------------------------------------------------------------


REQUEST = Frame(0xFE, 0x80, Command.EXCHANGE, motors(REST).tobytes()).encode()  # of an exchange


class Cable:
    """Both ends of a cable in memory: a `Terminal` for the hand, bytes for the host, and their clock."""

    def __init__(self):
        self.now, self.plant = 1000.0, ScriptedPlant()
        self.to_hand, self.to_host = bytearray(), bytearray()
        self.line = HandLine(self, Firmware(self.plant), self._catch_up)

    def _catch_up(self, now):
        self.plant.advance(max(now - 1000.0 - self.plant.time, 1e-6))

    def read(self):
        data = bytes(self.to_hand)
        self.to_hand.clear()
        return data

    def write(self, data):
        self.to_host += data
        return len(data)

    def ask(self, data, seconds=0.03):
        """The pieces that come after sending these bytes, with their times; time passes only here."""
        self.to_hand += data
        self.line.serve(self.now)
        until, pieces = self.now + seconds, []
        while self.now < until:
            self.now = min(max(self.line.due(), self.now + 1e-6), until)
            self.line.serve(self.now)
            if self.to_host:
                pieces.append((self.now, bytes(self.to_host)))
                self.to_host.clear()
        return pieces


def test_an_exchange_takes_what_it_takes_on_the_hand_and_comes_in_pieces():
    """On a hand: mean 9.59 to 9.60 ms, 95 % below 9.62 to 9.63 ms, at most 10.7 ms, of 1773 exchanges."""
    cable, times = Cable(), []
    for _ in range(700):
        start = cable.now
        pieces = cable.ask(REQUEST, 0.012)
        (frame,) = Parser(HAND_REPLIES).feed(b"".join(data for _, data in pieces))
        assert frame.command == Command.EXCHANGE
        times.append(1e3 * (pieces[-1][0] - start))
    assert np.mean(times) == pytest.approx(9.59, abs=0.02) and np.percentile(times, 95) < 9.64
    assert 10.2 < max(times) < 10.8 and min(times) > 9.4
    pieces = cable.ask(REQUEST + REQUEST)
    ends = np.cumsum([len(data) for _, data in pieces])
    assert ends.tolist() == [510, 1020, 1530, 2040, 2217]  # A request while the board is at work is ignored.
    np.testing.assert_allclose(np.diff([when for when, _ in pieces]), np.diff(ends) * 10 / 3e6, atol=1e-9)


@given(st.binary(max_size=600))
def test_noise_on_the_line_is_answered_with_silence(noise):
    cable = Cable()
    answered = cable.ask(noise, 0.05) != []
    assert answered <= (Parser(frames.HOST_REQUESTS).feed(noise) != [])
    assert cable.ask(REQUEST, 0.05) != []


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
