"""The emulated palm board: answers, quantisation, protection, watchdog."""

import math
import struct

import numpy as np
import pytest

pytest.importorskip("serial")
from twin_line import ask, command
from twin_plant import REST, ScriptedPlant

from dexsim_real.twin.plant.protocol import PlantMeasurement
from dexsim_real.twin.wire.command_check import CommandCheck, LimitsConfig
from dexsim_real.twin.wire.faults import Fault
from dexsim_real.twin.wire.firmware import ABANDONED, OVERHEATED, Firmware, FirmwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.frames import HAND_REPLIES, Command, Mode, Parser


def test_every_command_that_a_host_knows_is_answered_in_a_form_that_a_host_believes():
    board = Firmware(ScriptedPlant(), FirmwareConfig())
    requests = {
        Command.EXCHANGE: command().tobytes(),
        Command.VERSION: b"",
        Command.SET_MODE: b"\x03",
        Command.READ_MODE: b"",
        Command.CLEAR_PRESSURE: b"\x11",
        Command.RESET: b"",
        Command.READ_REGISTER: (21).to_bytes(2, "little"),
    }
    assert set(requests) == set(frames.HOST_REQUESTS)
    parser = Parser(HAND_REPLIES)
    for kind, data in requests.items():
        answer = ask(board, kind, data)
        (read,) = parser.feed(answer.encode())
        assert read == answer and (read.source, read.target) == (0x80, 0xFE)
        assert read.command == (Command.ACKNOWLEDGE if kind in (Command.SET_MODE, Command.RESET) else kind)
    assert ask(board, Command.VERSION).data.startswith(b"1.3.9")
    assert ask(board, Command.READ_REGISTER, b"\x15\x00").data.startswith(b"\x15\x00" + b"2R32")


def test_what_is_asked_wrongly_is_refused_with_the_hands_own_numbers():
    plant = ScriptedPlant()
    board = Firmware(plant, FirmwareConfig())
    ids = command()
    ids["id"][4] = 9
    broken = command()
    broken["position"][2] = np.nan
    for kind, data, number in (
        (Command.EXCHANGE, ids.tobytes(), 1),
        (Command.EXCHANGE, broken.tobytes(), 30),
        (Command.EXCHANGE, command(mode=7).tobytes(), 67),
        (Command.EXCHANGE, command(mode=5).tobytes(), 81),
        (Command.SET_MODE, b"\x09", 67),
        (Command.SET_MODE, b"\x03\x03", 30),
        (Command.CLEAR_PRESSURE, b"\x10", 1),
        (Command.READ_REGISTER, b"\x63\x00", 30),
    ):
        answer = ask(board, kind, data)
        assert answer.command == Command.ERROR
        assert int.from_bytes(answer.data, "little") == 1501000 + number
    assert not board.on and not plant.orders
    # What is for another hand is no business of this one; a broadcast is.
    assert ask(board, Command.VERSION, target=0x81) is None
    assert ask(board, Command.VERSION, target=0xFF) is not None


def test_the_state_in_the_wires_few_bits():
    board = Firmware(ScriptedPlant(), FirmwareConfig())
    rng = np.random.default_rng(0)
    angle, speed, current = rng.uniform(-0.7, 1.9, 12), rng.uniform(-20, 20, 12), rng.uniform(-900, 900, 12)
    current[0], speed[1] = 1e6, -1e6
    force = rng.uniform(-14, 14, (5, 120, 3))
    force[..., 2] = rng.uniform(-1, 27, (5, 120))
    force[0] = 0
    force[0, 0] = [0.149, -0.151, 25.449]
    force[0, 1] = [-13.0, 13.0, 25.6]
    quat, none = np.array([1.0, 0, 0, 0]), np.zeros(3)
    state = board.state(PlantMeasurement(0.0, angle, speed, current, np.full(12, 41.6), force, quat, none, none))
    data = state.tobytes()
    for joint in range(12):
        row = struct.unpack_from("<BBfhHHHHHhHH", data, 24 * joint)
        assert row[0] == joint
        assert abs(row[2] - angle[joint]) <= math.pi / 4096 + 1e-6  # half a step of 12 bits in a turn
        assert row[2] / (2 * math.pi / 4096) == pytest.approx(round(row[2] / (2 * math.pi / 4096)), abs=1e-3)
        assert row[3] == np.clip(round(current[joint]), -32768, 32767)
        assert row[5] == 38 << 8 | 42
        assert row[9] == np.clip(round(1000 * speed[joint]), -32768, 32767)
        assert row[4] & 0xF == Mode.PASSIVE
        assert ((row[4] >> 4) - 2048) * 2 * math.pi / 4096 == pytest.approx(row[2], abs=1e-6)
    taxel = state["tip"]["taxel"]
    assert taxel[0, 0].tolist() == (1, -2, 254) and taxel[0, 1].tolist() == (-128, 127, 255)
    for axis, low, high in (("x", -128, 127), ("y", -128, 127), ("z", 0, 255)):
        exact = force[..., "xyz".index(axis)] / 0.1
        assert np.all(np.abs(taxel[axis] - np.clip(exact, low, high)) <= 0.5 + 1e-9)
    total = state["tip"]["total"]
    assert total["z"][0] == 255  # 254 + 256 counts do not fit into a byte.
    assert total["x"][0] == np.clip(1 - 130, -128, 127)


def test_taxels_are_zeroed_by_tip_and_stick():
    plant = ScriptedPlant()
    plant.angle[:] = 4.0  # 10 counts on ten taxels of each tip
    board = Firmware(plant, FirmwareConfig())
    assert board.state(plant.measure())["tip"]["taxel"]["z"][:, 40].tolist() == [10] * 5
    ask(board, Command.CLEAR_PRESSURE, b"\x13")
    assert board.state(plant.measure())["tip"]["taxel"]["z"][:, 40].tolist() == [10, 10, 0, 10, 10]
    plant.angle[:] = 8.0
    assert board.state(plant.measure())["tip"]["taxel"]["z"][:, 40].tolist() == [20, 20, 10, 20, 20]
    ask(board, Command.CLEAR_PRESSURE)
    board.stuck[1, 7] = 33
    state = board.state(plant.measure())
    assert state["tip"]["taxel"]["z"][:, 40].tolist() == [0] * 5
    assert state["tip"]["taxel"]["z"][1, 7] == 33 == state["tip"]["taxel"]["z"].sum()
    ask(board, Command.RESET)
    assert board.state(plant.measure())["tip"]["taxel"]["z"][0, 40] == 20


def test_a_motor_that_is_too_hot_goes_off_until_it_has_cooled():
    plant = ScriptedPlant()
    board = Firmware(plant, FirmwareConfig(shutdown=90.0))

    def exchange():
        state = frames.decode_state(ask(board, Command.EXCHANGE, command().tobytes()).data)
        return plant.motors.mode.tolist(), state["joint"]["joint_error"].tolist(), state["joint"]["raw_position"] & 0xF

    assert exchange()[0] == [3] * 12
    for degrees, hot in ((60.0, True), (-11.0, True), (-5.0, False)):  # 95, 84 and 79 degrees
        plant.warm(4, degrees)
        modes, errors, shown = exchange()
        assert modes == [0 if hot and joint == 4 else 3 for joint in range(12)] == shown.tolist()
        assert errors == [OVERHEATED if hot and joint == 4 else 0 for joint in range(12)]


def test_without_an_exchange_the_motors_go_off():
    plant, notes = ScriptedPlant(), []
    board = Firmware(plant, FirmwareConfig(watchdog=0.09), notes.append)
    assert board.deadline == math.inf and not board.watch(1e6)
    ask(board, Command.EXCHANGE, command().tobytes(), now=5.0)
    assert board.deadline == pytest.approx(5.09) and not board.watch(5.0899) and board.on
    # Neither a request for the version nor a refused command keeps them on.
    ask(board, Command.VERSION, now=5.08)
    ask(board, Command.EXCHANGE, command(mode=7).tobytes(), now=5.08)
    assert board.watch(5.0901) and not board.on and plant.motors.mode.tolist() == [0] * 12
    assert board.trips == [5.0901] and "no exchange for 90 ms" in notes[-1] and not board.watch(6.0)
    state = ask(board, Command.EXCHANGE, command(mode=Mode.PASSIVE).tobytes(), now=7.0)
    assert not frames.decode_state(state.data)["joint"]["joint_error"].any()
    ask(board, Command.EXCHANGE, command().tobytes(), now=8.0)
    board.watch(8.2)
    assert (board.state(plant.measure())["joint"]["joint_error"] == ABANDONED).all()


def test_a_board_without_a_watchdog_keeps_the_last_command():
    """The default: what the real hand does is not known."""
    plant = ScriptedPlant()
    board = Firmware(plant, FirmwareConfig())
    ask(board, Command.EXCHANGE, command().tobytes(), now=5.0)
    assert board.deadline == math.inf and not board.watch(1e6) and board.on and board.trips == []


def test_a_wrong_angle_is_in_the_state_and_the_true_one_is_kept():
    plant = ScriptedPlant()
    board = Firmware(plant, FirmwareConfig())
    wrong = ((4, "offset", 1.3), (5, "stuck", 1.9), (6, "stuck", 1e30))
    board.faults = [Fault("angle", joint=joint, form=form, radians=angle) for joint, form, angle in wrong]
    answer = ask(board, Command.EXCHANGE, command().tobytes(), now=5.0)
    shown = frames.decode_state(answer.data)["joint"]["position"]
    np.testing.assert_allclose(board.angles, REST, atol=1e-3)
    np.testing.assert_allclose(shown, [*REST[:4], REST[4] + 1.3, 1.9, 1e30, *REST[7:]], atol=1e-3)


def test_commands_outside_limits_are_told_apart(hand):
    def found(*commands, angles=REST, step=0.012, **options):
        check = CommandCheck(hand.joint_lower, hand.joint_upper, LimitsConfig(slack=0.0, speed=8.0, **options))
        return [check.take(1.0 + step * k, block, angles) for k, block in enumerate(commands)][-1]

    moved = np.where(np.arange(12) == 5, 0.09, 0.0)
    off = command(position=np.full(12, 9.0), mode=Mode.PASSIVE)
    assert found(command()) == found(command(), command(REST + moved)) == found(off) == []
    assert found(command(), command(REST + 1.1 * moved)) == ["speed"]
    assert found(command(), command(REST + 1.1 * moved), step=0.014) == []
    assert found(command(REST + 3 * moved), command()) == ["speed"]  # Not even to where the joint is.
    assert found(off, command(REST + 0.04)) == [] and found(off, command(REST + 0.06)) == ["start"]
    assert found(command(REST - 0.01), command(np.where(np.arange(12) == 0, -0.01, REST)), step=1.0) == ["range"]
    beyond = hand.joint_upper + 2e-5
    assert found(command(hand.joint_upper), command(beyond), angles=hand.joint_upper) == ["range"]
    assert found(command(), command(REST + 0.8 * (np.arange(12) != 3)), step=1.0) == ["reach"]
    assert found(command(torque_max=500)) == ["current limit"]
    assert found(command(mode=4)) == ["mode"] and found(command(position=np.nan)) == ["not finite"]
    check = CommandCheck(hand.joint_lower, hand.joint_upper, LimitsConfig())
    check.take(0.0, command(), REST)
    check.take(0.012, command(torque_max=900), REST)
    assert check.report()["by_limit"] == {"current limit": 1} and check.report()["checked"] == 2
