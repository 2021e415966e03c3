"""The emulated hand's wire: what it answers and when, in virtual time; that the bridge's own driver, IMU reader and
camera understand it; and that it goes to its safe state by itself."""

import json
import math
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paths import ROOT

pytest.importorskip("serial")

from twin_plant import REST, ScriptedPlant

from dexsim.calibration.maps import current_from_counts, load_calibration, normalised_torque
from dexsim.core.errors import DexsimError
from dexsim_real.core.errors import HandError
from dexsim_real.sensors import imu
from dexsim_real.sensors.camera import CameraConfig, HeightSensor, height_of, open_masks
from dexsim_real.twin import __main__ as twin_command
from dexsim_real.twin.options import TwinArguments
from dexsim_real.twin.plant.protocol import PlantMeasurement
from dexsim_real.twin.plant.shapes import ObjectShape, Primitive
from dexsim_real.twin.server import PlantClock, Twin
from dexsim_real.twin.wire import emulated_sensors
from dexsim_real.twin.wire.command_check import CommandCheck, LimitsConfig
from dexsim_real.twin.wire.faults import FaultConfig, Injector
from dexsim_real.twin.wire.firmware import ABANDONED, OVERHEATED, Firmware, FirmwareConfig
from dexsim_real.twin.wire.line import HandLine, LineConfig
from dexsim_real.twin.wire.terminal import Terminal
from dexsim_real.wire import frames
from dexsim_real.wire.frames import HAND_REPLIES, Command, Frame, Mode, Parser
from dexsim_real.wire.link import LinkConfig
from dexsim_real.wire.serial_hand import SerialHand


def command(position=REST, mode=Mode.POSITION, **changes):
    block = frames.command_block(position, kp=100, ki=0, kd=0, torque_max=300, mode=mode)
    for name, value in changes.items():
        block[name] = value
    return block


def ask(board, kind, data=b"", now=0.0, target=0x80):
    return board.answer(Frame(0xFE, target, kind, data), now)


# --- the palm board ------------------------------------------------------------------------------


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


# --- commands within limits ----------------------------------------------------------------------


def test_commands_outside_limits_are_told_apart(hand):
    def found(*commands, reported=REST, step=0.012, **options):
        check = CommandCheck(hand.joint_lower, hand.joint_upper, LimitsConfig(slack=0.0, speed=8.0, **options))
        return [check.take(1.0 + step * k, block, reported) for k, block in enumerate(commands)][-1]

    moved = np.where(np.arange(12) == 5, 0.09, 0.0)
    off = command(position=np.full(12, 9.0), mode=Mode.PASSIVE)
    assert found(command()) == found(command(), command(REST + moved)) == found(off) == []
    assert found(command(), command(REST + 1.1 * moved)) == ["speed"]
    assert found(command(), command(REST + 1.1 * moved), step=0.014) == []
    assert found(command(REST + 3 * moved), command()) == []  # It may always stop.
    assert found(off, command(REST + 0.04)) == [] and found(off, command(REST + 0.06)) == ["start"]
    assert found(command(REST - 0.01), command(np.where(np.arange(12) == 0, -0.01, REST)), step=1.0) == ["range"]
    beyond = hand.joint_upper + 2e-5
    assert found(command(hand.joint_upper), command(beyond), reported=hand.joint_upper) == ["range"]
    assert found(command(), command(REST + 0.8 * (np.arange(12) != 3)), step=1.0) == ["reach"]
    assert found(command(torque_max=500)) == ["current limit"]
    assert found(command(mode=4)) == ["mode"] and found(command(position=np.nan)) == ["not finite"]
    check = CommandCheck(hand.joint_lower, hand.joint_upper, LimitsConfig())
    check.take(0.0, command(), REST)
    check.take(0.012, command(torque_max=900), REST)
    assert check.report()["by_limit"] == {"current limit": 1} and check.report()["checked"] == 2


# --- timing, in virtual time ---------------------------------------------------------------------


class Bench:
    """A line, and a host that writes and reads in virtual time."""

    def __init__(self, folder, hand, *, line=None, seed=0):
        self.plant, self.notes = ScriptedPlant(), []
        self.board = Firmware(self.plant, FirmwareConfig(), self.notes.append)
        self.line = HandLine(
            Terminal(folder / "hand"),
            self.plant,
            self.board,
            CommandCheck(hand.joint_lower, hand.joint_upper, LimitsConfig()),
            Injector(FaultConfig(), seed),
            line or LineConfig(),
            seed=seed,
            note=self.notes.append,
        )
        self.now = 100.0
        import serial

        self.port = serial.Serial(str(self.line.terminal.name), 3_000_000, timeout=0)

    def send(self, data):
        self.port.write(data)
        self.line.serve(self.now)

    def run(self, seconds):
        """Bytes that come, with their times."""
        until, got = self.now + seconds, []
        while (due := self.line.due()) <= until:
            self.now = max(self.now, due)
            self.line.serve(self.now)
            if data := self.port.read(10_000):
                got.append((self.now, data))
        self.now = until
        self.line.serve(self.now)
        return got

    def exchange(self, block=None, period=0.012):
        """Answer and when its last byte came; None for silence."""
        start = self.now
        self.send(Frame(0xFE, 0x80, Command.EXCHANGE, (command() if block is None else block).tobytes()).encode())
        got = self.run(period)
        data = b"".join(piece for _, piece in got)
        return (got[-1][0] - start, data) if got else None

    def close(self):
        self.port.close()
        self.line.close()


@pytest.fixture
def bench(tmp_path, hand):
    made = []

    def make(**options):
        made.append(Bench(tmp_path, hand, **options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_an_exchange_takes_what_it_takes_on_the_hand(bench):
    """On a hand: mean 9.59 to 9.60 ms, 95 % below 9.62 to 9.63 ms, at most 10.7 ms, of 1773 exchanges."""
    one = bench()
    times = []
    for _ in range(700):
        took, data = one.exchange()
        (frame,) = Parser(HAND_REPLIES).feed(data)
        assert frame.command == Command.EXCHANGE
        times.append(1e3 * took)
    assert np.mean(times) == pytest.approx(9.59, abs=0.02) and np.percentile(times, 95) < 9.64
    assert 10.2 < max(times) < 10.8 and min(times) > 9.4
    assert one.line.counts == {"requests": 700, "answers": 700, "damaged requests": 0, "bytes without room": 0}


def test_answers_come_in_pieces_at_the_pace_of_the_wire(bench):
    one = bench(line=LineConfig(jitter=0.0, extra_delay_probability=0.0))
    start = one.now
    one.send(Frame(0xFE, 0x80, Command.EXCHANGE, command().tobytes()).encode())
    pieces = one.run(0.02)
    begin = start + 297 * 10 / 3e6 + 0.0012
    ends = np.cumsum([len(data) for _, data in pieces])
    assert ends.tolist() == [510, 1020, 1530, 2040, 2217]
    np.testing.assert_allclose([when for when, _ in pieces], begin + ends * 10 / 3e6, atol=1e-9)


def test_requests_queue_while_an_answer_is_on_its_way(bench):
    one = bench(line=LineConfig(jitter=0.0, extra_delay_probability=0.0))
    request = Frame(0xFE, 0x80, Command.EXCHANGE, command().tobytes()).encode()
    one.send(request + request)
    got = one.run(0.03)
    assert len(Parser(HAND_REPLIES).feed(b"".join(data for _, data in got))) == 2
    # The second begins when the first has ended, after a pause of its own.
    assert got[5][0] - got[4][0] == pytest.approx(0.0012 + 510 * 10 / 3e6, abs=1e-9)


def test_the_watchdog_in_the_line(bench):
    one = bench()
    one.exchange()
    assert one.board.on
    asked = one.now - 0.012
    one.run(0.5)
    assert not one.board.on
    assert 0.08 < one.board.trips[0] - asked < 0.083  # From when the command was understood.
    # A request that has come counts, even when this machine looks at it too late.
    one.exchange()
    one.port.write(Frame(0xFE, 0x80, Command.EXCHANGE, command().tobytes()).encode())
    one.now += 0.3
    one.line.serve(one.now)
    one.run(0.012)
    assert len(one.board.trips) == 1 and one.board.on


def test_a_host_at_another_baud_rate_is_not_understood(bench):
    one = bench()
    one.port.baudrate = 115200
    assert one.exchange() is None and one.line.counts["bytes at another baud"] == 297
    assert "115200 baud, the hand at 3000000" in one.notes[-1]
    one.port.baudrate = 3_000_000
    assert one.exchange() is not None


@given(st.binary(max_size=600))
def test_noise_on_the_line_is_answered_with_silence(hand, noise):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        one = Bench(Path(folder), hand)
        one.send(noise)
        sound = len(Parser(frames.HOST_REQUESTS).feed(noise))
        assert (one.run(0.05) != []) <= (sound > 0)
        assert one.exchange(period=0.05) is not None
        one.close()


# --- the bridge's own driver on it ---------------------------------------------------------------


class Running:
    """A twin that runs in a thread."""

    def __init__(self, hand, folder, plant=None, **options):
        self.plant = plant or ScriptedPlant()
        self.twin = Twin(TwinArguments(**options), hand, self.plant, folder)
        self._thread = threading.Thread(target=self.twin.run, daemon=True)
        self._thread.start()

    @property
    def port(self):
        return str(self.twin.line.terminal.name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.twin.stop()
        self._thread.join()
        self.twin.close()


def test_the_driver_talks_to_it(hand, tmp_path):
    with Running(hand, tmp_path, task="rotate") as running:
        port = SerialHand(running.port, LinkConfig(settle=0.0, margin=0.2))
        assert "firmware 1.3.9" in port.connect()
        goal, replies = REST + 0.05, []
        for k in range(30):
            replies.append(port.exchange(command(REST if k < 2 else goal)))
        port.close()
        time.sleep(0.15)
    first, last = replies[0].state["joint"], replies[-1].state["joint"]
    np.testing.assert_allclose(first["position"], REST, atol=1e-3)
    np.testing.assert_allclose(last["position"], goal, atol=3e-3)
    assert port.counts.sent == port.counts.answered == running.twin.line.counts["answers"] == 32
    assert np.median([reply.received - reply.sent for reply in replies]) > 0.0095
    assert np.all(last["raw_position"] & 0xF == Mode.POSITION)
    report = running.twin.report()
    assert report["commands"]["outside_limits"] == 0 and len(report["watchdog"]["trips"]) == 1
    assert [text for _, text in running.twin.events if "motors" in text][-1].startswith("watchdog")


def test_physics_follows_the_wall_clock_and_lets_go_what_it_cannot(hand):
    class Slow(ScriptedPlant):
        def advance(self, seconds):
            super().advance(seconds)
            time.sleep(pace * seconds)

    notes, pace = [], 0.0
    clock = PlantClock(Slow(), 10.0, notes.append)
    for now in np.arange(10.0, 10.5, 0.0007):
        clock.catch_up(now, PlantClock.SLICE)
    assert clock.plant.time == pytest.approx(0.5, abs=0.003) and clock.slipped == 0
    # Behind by less than the bound all of it is caught up, in slices; behind by more, the rest is let go.
    for _ in range(100):
        clock.catch_up(10.58, PlantClock.SLICE)
    assert clock.plant.time == pytest.approx(0.58, abs=1e-6)
    clock.catch_up(13.0)
    assert clock.plant.time == pytest.approx(0.59, abs=1e-6) and clock.slipped == pytest.approx(2.41, abs=1e-6)
    assert len(notes) == 1 and "too slow" in notes[0]
    report = clock.report()
    assert report["simulated_s"] + report["slipped_s"] == pytest.approx(3.0, abs=1e-3)


def test_a_terminal_keeps_its_name(tmp_path):
    terminal = Terminal(tmp_path / "port")
    file = os.open(tmp_path / "port", os.O_RDWR | os.O_NOCTTY)
    terminal.write(b"a")
    assert os.read(file, 10) == b"a"
    terminal.close()
    assert not (tmp_path / "port").is_symlink()
    with pytest.raises(OSError):
        os.write(file, b"x")
    os.close(file)
    terminal.open()
    file = os.open(tmp_path / "port", os.O_RDWR | os.O_NOCTTY)
    os.write(file, b"b")
    assert terminal.read() == b"b" and terminal.read() == b""
    os.close(file)
    terminal.close()
    (tmp_path / "file").touch()
    with pytest.raises(HandError, match="not a link"):
        Terminal(tmp_path / "file")
    with pytest.raises(HandError, match="no pseudo-terminal"):
        Terminal(tmp_path / "none" / "port")


# --- the object's side ---------------------------------------------------------------------------


def rotation_by_axis(axis, angle):
    """Rodrigues' formula."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_an_rvc_frame_says_yaw_pitch_and_roll(yaw, pitch, roll):
    """Turned about z, then the new y, then the new x; against the bridge's reader as well."""
    rotation = rotation_by_axis([0, 0, 1], yaw) @ rotation_by_axis([0, 1, 0], pitch) @ rotation_by_axis([1, 0, 0], roll)
    frame = emulated_sensors.rvc_frame(7, rotation, np.array([0.0, 0.5 * 9.80665, 9.80665]))
    assert len(frame) == 19 and frame[:3] == b"\xaa\xaa\x07" and sum(frame[2:18]) % 256 == frame[18]
    words = struct.unpack_from("<6h", frame, 3)
    np.testing.assert_allclose(words[:3], np.degrees([yaw, pitch, roll]) * 100, atol=0.51)
    assert words[3:] == (0, 500, 1000)
    w, x, y, z = imu.decode(frame)
    read = np.eye(3) + 2 * (
        w * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        + np.linalg.matrix_power(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), 2)
    )
    np.testing.assert_allclose(read, rotation, atol=4e-4)


def test_the_bridges_imu_reader_sees_how_the_object_turns(hand, tmp_path):
    plant = ScriptedPlant(turn=2.0)
    with Running(hand, tmp_path, plant, task="rotate") as running:
        reader = imu.Imu(str(running.twin.imu.terminal.name), plant.up)
        reader.wait()
        half = 0.5 * plant.turn * plant.time
        reader.calibrate(np.array([math.cos(half), math.sin(half), 0, 0]))
        seen = []
        for _ in range(20):
            time.sleep(0.02)
            seen.append((plant.time, reader.read()[1]))
        reader.close()
        sent, passed = running.twin.imu.sent, plant.time
    for when, quat in seen:
        off = 2 * math.acos(min(1.0, abs(quat @ [math.cos(when), math.sin(when), 0, 0])))
        assert off < 0.15  # What it turns in the time that this busy test takes to look.
    assert reader.parser.damaged == 0 and sent == pytest.approx(100 * passed, rel=0.15)


OPTICS = CameraConfig()


def test_the_silhouette_of_a_sphere_and_of_a_box():
    place = np.array([0.05, 0.0, 0.09])
    depth = OPTICS.position[1] - place[1]
    ball = emulated_sensors.outline(Primitive("sphere", (0.03,))) + place
    mask = emulated_sensors.silhouette([ball], OPTICS, (640, 480))
    # Outline of a sphere seen by a pinhole: a cone of half angle asin(r / d), nearly a circle.
    radius = 600 * math.tan(math.asin(0.03 / math.dist(OPTICS.position, place)))
    assert mask.sum() == pytest.approx(math.pi * radius**2, rel=0.03)
    cube = emulated_sensors.outline(Primitive("box", (0.025, 0.025, 0.025))) + place
    mask = emulated_sensors.silhouette([cube], OPTICS, (640, 480))
    side = 600 * 0.05 / (depth - 0.025)  # The near face hides the rest, seen nearly head on.
    assert mask.sum() == pytest.approx(side**2, rel=0.06)
    assert height_of(mask, OPTICS, place, 0) == pytest.approx(0.05, abs=0.001)
    # Half outside of the picture, behind the camera, and on edge.
    assert 0 < emulated_sensors.silhouette([cube + [0.2, 0, 0]], OPTICS, (640, 480)).sum() < mask.sum()
    assert not emulated_sensors.silhouette([cube + [0, 0.6, 0]], OPTICS, (640, 480)).any()
    flat = cube * [1, 1, 0] + [0, 0, OPTICS.position[2]]
    assert emulated_sensors.silhouette([flat], OPTICS, (640, 480)).sum() < 100


@pytest.mark.parametrize(
    "part",
    [
        Primitive("cylinder", (0.02, 0.03)),
        Primitive("capsule", (0.02, 0.03)),
        Primitive("sphere", (0.03,)),
        Primitive("box", (0.01, 0.02, 0.03), (0.01, 0.0, -0.02)),
    ],
)
def test_outlines_reach_as_far_as_the_exact_shape(part):
    shape, points = ObjectShape("one", (part,)), emulated_sensors.outline(part)
    rng = np.random.default_rng(0)
    for _ in range(200):
        way = rng.standard_normal(3)
        way /= np.linalg.norm(way)
        exact = shape.reach(way)
        assert exact - 0.0008 < (points @ way).max() <= exact + 1e-9


def test_the_bridges_camera_sees_the_object(hand, tmp_path):
    with Running(hand, tmp_path, task="grasp", seed=3) as running:
        masks = open_masks(f"unix:{running.twin.masks.path}", OPTICS)
        sensor = HeightSensor(masks, OPTICS, np.array([0.06, 0.0, 0.071]), (True, False, False), 0.3)
        until = time.monotonic() + 5
        while not sensor.seen and time.monotonic() < until:
            time.sleep(0.01)
        when, position, _ = sensor.read()
        assert position[0] == pytest.approx(0.047, abs=0.002) and 0 <= time.monotonic() - when < 0.3
        time.sleep(1.0)
        sensor.close()
        pictures = running.twin.masks.counts["pictures"]
        assert 15 < pictures < 60
    with pytest.raises(HandError, match="no program sends masks"):
        open_masks(f"unix:{running.twin.masks.path}", OPTICS)


# --- the command ---------------------------------------------------------------------------------


def start(*options):
    return subprocess.Popen(
        [sys.executable, "-m", "dexsim_real.twin", "--plant", "twin_plant:make", "--no-realtime", *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests' / 'support'}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def test_the_command_shows_how_to_use_it_and_writes_its_results(tmp_path):
    process = start(
        "--task",
        "grasp",
        "--trials",
        "2",
        "--seconds",
        "0.4",
        "--command",
        "0.6",
        "--output",
        str(tmp_path / "out.json"),
        "--object.optics.position",
        "0.06",
        "0.6",
        "0.09",
    )
    out, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    shown = out.decode()
    assert "python -m dexsim_real.run grasp --port /tmp/dexsim-twin-" in shown and "--command 0.6" in shown
    assert "--uncalibrated" in shown and "--camera unix:/tmp/dexsim-twin-" in shown
    assert "--optics.position 0.06 0.6 0.09" in shown
    report = json.loads((tmp_path / "out.json").read_text())
    assert [row["trial"] for row in report["trials"]] == [0, 1] and report["commands"]["checked"] == 0
    assert not list(Path("/tmp").glob("dexsim-twin-*/hand*")) or shown.split("--port ")[1].split()[0] not in map(
        str, Path("/tmp").glob("dexsim-twin-*/hand")
    )


def test_the_calibration_beside_the_port_is_one_of_this_hand(hand, tmp_path):
    path = twin_command.write_calibration(tmp_path / "calibration.toml", hand)
    calibration = load_calibration(path, hand)
    np.testing.assert_allclose(calibration.force_per_count, FirmwareConfig().force_per_count)
    counts = np.linspace(-800, 800, 12).astype(np.float32)
    torque = np.asarray(normalised_torque(calibration, current_from_counts(calibration, counts)))
    assert np.all(torque * counts < 0)  # The wire's current is positive when opening.


def test_it_ends_in_good_order_when_it_is_told_to(tmp_path):
    waiting = start("--link", str(tmp_path / "port"), "--output", str(tmp_path / "out.json"))
    assert waiting.stdout.readline().startswith(b"rotate: the emulated hand is at")
    waiting.send_signal(signal.SIGTERM)
    assert waiting.wait(10) == 0 and (tmp_path / "out.json").exists() and not (tmp_path / "port").is_symlink()
    waiting.communicate()


def test_what_is_wrong_is_said_in_one_line(tmp_path):
    for options, message in (
        (["--faults.script", "5 melt"], "no kind 'melt'"),
        (["--task", "juggle"], "choose from grasp, rotate"),
        (["--policy", "grasp"], "of the task 'grasp', the hand is mounted for 'rotate'"),
        (["--policy", "nobody"], "nobody: no such file"),
        (["--plant", "nowhere:make"], "No module named 'nowhere'"),
        (["--faults.flip", "2"], "between 0 and 1"),
        (["--plant", "twin_plant:make", "--link", str(tmp_path / "no" / "port")], "no pseudo-terminal"),
        (["--plant", "twin_plant:make", "--mask-socket", str(tmp_path / "no" / "m")], "no socket for masks"),
    ):
        with pytest.raises(DexsimError, match=message) as found:
            twin_command.main([*options, "--no-realtime"])
        assert "\n" not in str(found.value)
