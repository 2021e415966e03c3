"""The emulated palm board: answers, quantisation, protection."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("serial")
from twin_pair import command
from twin_plant import ScriptedPlant

from dexsim.hand.load import load_hand
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.emulated_hand import PlantMeasurement
from dexsim_real.twin.wire.firmware import OVERHEATED, Firmware
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode
from dexsim_real.wire.link import SERIAL_NUMBER, SIDE, check_identity, read_identity


def ask(board, kind, data=b"", target=0x80):
    return board.answer(Frame(0xFE, target, kind, data))


def test_what_is_asked_wrongly_is_refused_with_the_hands_own_numbers():
    plant = ScriptedPlant()
    board = Firmware(plant)
    ids = command()
    ids["id"][4] = 9
    broken = command()
    broken["position"][2] = np.nan
    for kind, data, number in (
        (Command.EXCHANGE, ids.tobytes(), 1),
        (Command.EXCHANGE, broken.tobytes(), 30),
        (Command.EXCHANGE, command(mode=7).tobytes(), 67),
        (Command.EXCHANGE, command(mode=5).tobytes(), 81),
        (Command.READ_REGISTER, b"\x63\x00", 30),
    ):
        answer = ask(board, kind, data)
        assert answer.command == Command.ERROR
        assert int.from_bytes(answer.data, "little") == 1501000 + number
    assert not board.on and plant.motors is None
    # What is for another hand is no business of this one; a broadcast is.
    assert ask(board, Command.VERSION, target=0x81) is None
    assert ask(board, Command.VERSION, target=0xFF) is not None


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
        state = frames.decode_state(ask(board, Command.EXCHANGE, command().tobytes()).data)["joint"]
        modes = [0 if hot and joint == 4 else 3 for joint in range(12)]
        assert plant.motors["mode"].tolist() == modes == (state["raw_position"] & 0xF).tolist()
        assert state["joint_error"].tolist() == [OVERHEATED if hot and joint == 4 else 0 for joint in range(12)]


def test_each_hand_tells_its_side_and_is_refused_with_the_model_of_the_other(hand):
    left = load_hand("xhand_left")
    for one, other in ((hand, left), (left, hand)):
        board = Firmware(SimpleNamespace(hand=one))
        registers = (register.to_bytes(2, "little") for register in (SERIAL_NUMBER, SIDE))
        told = read_identity(*(ask(board, Command.READ_REGISTER, name).data[2:] for name in registers))
        assert check_identity(told, one) == []
        with pytest.raises(HandError, match=f"this is a {one.side} hand .* the model a {other.side} one: see --hand"):
            check_identity(told, other)
