"""What the emulated hand shows of itself: its palm board on a serial line, the IMU in the object, the camera.

The palm board (`Firmware`) has the commands that the bridge sends, and refuses others; answers have the layouts of
`dexsim_real.wire.frames`. No public source describes the meaning of the error bits: they are defined here.

An exchange (`HandLine`) takes as long as on the real hand: the bytes of the request at 3 Mbaud, a delay in the palm
board, and the bytes of the answer, forwarded in chunks like a USB adapter does. The constants are measured on a hand
(mean 9.60 ms, 95 % below 9.63 ms, maximum 10.7 ms).

The sensors of the object: noise, bias, drift and delay come from the plant; this module adds formats, rates and lost
pictures. `imu_frames` and `picture` are what they send; `EmulatedImu` serves it on a terminal, `EmulatedCamera` on a
Unix socket.
"""

import contextlib
import itertools
import os
import socket
import tty
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import CameraConfig, camera_axes, encode_mask
from dexsim_real.sensors.imu import UPRIGHT_X, encode
from dexsim_real.twin.plant.emulated_hand import EmulatedHand, PlantMeasurement
from dexsim_real.twin.plant.shapes import Primitive, matrix, product, turn
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode, Parser, passive_command
from dexsim_real.wire.link import SERIAL_NUMBER, SIDE, LinkConfig

OVERHEATED = 1  # error bit of a joint, defined by this board: too hot and off
VERSION = "1.3.9 emulated"
SERIALS = {"right": "2R32EMULATED", "left": "2L32EMULATED"}
FORCE_PER_COUNT = 0.1  # N of one taxel count
SHUTDOWN = 95.0  # degC at which a motor goes off until it is 10 K cooler
_PALM, _TIP = 38, 31  # degC of palm board and fingertips
_TICK = 2 * np.pi / 4096  # rad, resolution of the encoders
_ID, _PARAMETER, _MODE, _FORCE_MODE = 1, 30, 67, 81  # numbers of refusals
_ERROR_BASE = 1501000
_ADDRESS = frames.palm_address(0)

PROCESSING, JITTER = 0.00120, 0.00002  # s from a request's last byte to its answer's first: mean, standard deviation
EXTRA_DELAY, EXTRA_PROBABILITY = 0.0011, 0.01  # s, largest extra delay of an exchange; how often there is one
CHUNK = 510  # bytes that the adapter forwards at once
_SILENCE = 0.003  # s without a byte after which an incomplete request is dropped
_on_wire = LinkConfig().on_wire

IMU_RATE, CAMERA_RATE = 100.0, 30.0  # Hz
PICTURE = (640, 480)  # px, columns and rows
_LOST = 0.01  # probability that the object is not found in a picture
_MOUNT = np.array(UPRIGHT_X)


class Firmware:
    """Executes frames on a plant."""

    def __init__(self, plant: EmulatedHand):
        self.plant, side = plant, plant.hand.side
        self._registers = {SERIAL_NUMBER.to_bytes(2, "little"): SERIALS[side], SIDE.to_bytes(2, "little"): side}
        self.motors = passive_command()  # `frames.COMMAND_BLOCK` that the joints execute
        self._hot = np.zeros(frames.JOINTS, bool)

    def answer(self, frame: Frame) -> Frame | None:
        """Execute a frame and return the answer; None for a frame addressed to another hand."""
        if frame.target not in (_ADDRESS, frames.BROADCAST):
            return None
        command, result = frame.command, self._execute(Command(frame.command), frame.data)
        if isinstance(result, int):
            command, result = Command.ERROR, (_ERROR_BASE + result).to_bytes(4, "little")
        return Frame(_ADDRESS, frame.source, command, result)

    def state(self, measured: PlantMeasurement) -> np.ndarray:
        """A `frames.STATE_BLOCK` of a measurement, with the quantisation of the wire."""
        block = frames.empty_state()
        joint, tip = block["joint"], block["tip"]
        joint["position"] = np.round(measured.joint_position / _TICK) * _TICK
        joint["current"] = _whole(measured.current, np.int16)
        joint["velocity"] = _whole(1e3 * measured.joint_velocity, np.int16)
        raw = (np.round(joint["position"] / _TICK).astype(int) + 2048) & 0xFFF
        joint["raw_position"] = raw << 4 | self.motors["mode"]
        joint["temperature"] = _PALM << 8 | _whole(measured.temperature, np.uint8).astype(np.uint16)
        joint["joint_error"] = OVERHEATED * self._hot
        counts = np.round(measured.taxel_force / FORCE_PER_COUNT).astype(np.int32)
        tip["taxel_temperature"] = tip["temperature"] = _TIP
        for axis, name in enumerate("xyz"):
            kind = np.uint8 if name == "z" else np.int8
            tip["taxel"][name] = _whole(counts[..., axis], kind)
            tip["total"][name] = _whole(counts[..., axis].sum(-1), kind)
        return block

    def _execute(self, command: Command, data: bytes) -> bytes | int:
        """The data of the answer, or the number of the refusal."""
        if command == Command.VERSION:
            return VERSION.encode()
        if command == Command.READ_REGISTER and data[:2] in self._registers:
            return data[:2] + self._registers[data[:2]].encode().ljust(32, b"\0")
        if command != Command.EXCHANGE:
            return _PARAMETER
        try:
            block = frames.decode(data, frames.COMMAND_BLOCK)
        except HandError:
            return _ID
        if not np.isin(block["mode"], list(Mode)).all():
            return _MODE
        if np.any(block["mode"] == Mode.FORCE):
            return _FORCE_MODE
        if not np.isfinite(block["position"]).all():
            return _PARAMETER
        measured = self.plant.measure()
        hot = measured.temperature
        self._hot = (hot > SHUTDOWN) | (self._hot & (hot > SHUTDOWN - 10.0))
        block["mode"][self._hot] = Mode.PASSIVE
        self.motors = block
        self.plant.drive(block)
        return self.state(measured).tobytes()


def _whole(values: np.ndarray, kind: type) -> np.ndarray:
    """Rounded and clipped to the range of an integer type."""
    span = np.iinfo(kind)
    return np.clip(np.round(values), span.min, span.max).astype(kind)


class Terminal:
    """A pseudo-terminal; `name` is a link to it.

    Raises HandError: something else has this name, or no terminal can be created.
    """

    def __init__(self, link: Path):
        self.name, self._master, self._slave = Path(link), -1, -1
        ours = self.name.is_symlink() and os.path.realpath(self.name).startswith("/dev/pts/")
        if self.name.exists() and not ours:
            raise HandError(f"{link}: already exists and is not a link to a pseudo-terminal; choose another path")
        try:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            # Renamed into place, so that the link changes atomically.
            fresh = self.name.with_name(f".{self.name.name}.{os.getpid()}")
            fresh.symlink_to(os.ttyname(self._slave))
            fresh.replace(self.name)
        except OSError as error:
            self.close()
            raise HandError(f"{self.name}: no pseudo-terminal can be created here ({error.strerror})") from None

    def close(self) -> None:
        """Disconnect: programs that have the terminal open get an error."""
        if self._master >= 0:
            with contextlib.suppress(OSError):
                if os.readlink(self.name) == os.ttyname(self._slave):
                    self.name.unlink()
            os.close(self._master)
            os.close(self._slave)
        self._master = self._slave = -1

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        """Received bytes; empty if there are none."""
        try:
            return os.read(self._master, 65536)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        """Send bytes; what nobody reads is lost, as on a wire."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)


class HandLine:
    """Serves one terminal. It has no clock: call `serve` with the time, often, and whenever `due` has passed.

    `catch_up` is called with a time in s before the hand acts, to advance the plant to that time; `seed` is of delays.
    """

    def __init__(self, terminal: Terminal, firmware: Firmware, catch_up: Callable[[float], None], seed: int = 0):
        self.terminal, self.firmware, self._catch_up = terminal, firmware, catch_up
        self._rng, self._parser = np.random.default_rng(seed), Parser(frames.HOST_REQUESTS)
        self._tasks: deque[tuple[float, Frame | bytes]] = deque()  # when (s): a request to execute, bytes to send
        self._heard = -np.inf

    def due(self) -> float:
        """Time s at which `serve` must be called at the latest; infinite while it can only wait for a request."""
        return self._tasks[0][0] if self._tasks else np.inf

    def serve(self, now: float) -> None:
        data, rng = self.terminal.read(), self._rng
        if not data and now - self._heard > _SILENCE:
            self._parser.feed(b"", final=True)
        self._heard = now if data else self._heard
        for frame in self._parser.feed(data):
            if self._tasks:  # It cannot listen and talk on one pair of wires.
                continue
            extra = rng.uniform(0.0, EXTRA_DELAY) if rng.random() < EXTRA_PROBABILITY else 0.0
            delay = max(PROCESSING + JITTER * rng.standard_normal(), 0.0) + extra
            self._tasks.append((now + _on_wire(len(frame.encode())) + delay, frame))
        while self._tasks and self._tasks[0][0] <= now:
            due, task = self._tasks.popleft()
            if isinstance(task, Frame):
                self._execute(task, due, now)
            else:
                self.terminal.write(task)

    def _execute(self, request: Frame, due: float, now: float) -> None:
        """Execute a request that was due at a time, and plan the bytes of its answer."""
        self._catch_up(now)
        answer = self.firmware.answer(request)
        if answer is None:
            return
        data = answer.encode()
        # From when it was due: a late machine catches up during the transfer.
        start = max(due, now - _on_wire(len(data)) / 2)
        for begin in range(0, len(data), CHUNK):
            chunk = data[begin : begin + CHUNK]
            self._tasks.append((start + _on_wire(begin + len(chunk)), chunk))


# --- sensors of the object --------------------------------------------------------------------------


def imu_frames(plant: EmulatedHand, seed: int) -> Iterator[bytes]:
    """The RVC frames of the IMU, like a BNO08x, each measured when it is taken. Its world frame has the true vertical
    as z and an arbitrary heading."""
    up = plant.up
    level = np.array([1.0 + up[2], up[1], -up[0], 0.0])  # turns the vertical to z
    world = product(turn((0, 0, 1), 1.0 + seed), level / np.linalg.norm(level))
    for index in itertools.count(1):
        _, quat, specific_force = plant.measure_object()
        yield encode(index, product(world, product(quat, _MOUNT)), tuple(matrix(_MOUNT).T @ specific_force))


def picture(plant: EmulatedHand, optics: CameraConfig) -> np.ndarray:
    """The mask [rows, columns], bool, of the object as a camera sees it, with the camera's delay."""
    place, quat, _ = plant.measure_object()
    return silhouette([outline(part) @ matrix(quat).T + place for part in plant.shape.parts], optics)


def outline(part: Primitive) -> np.ndarray:
    """Points [N, 3] m in the object's frame whose convex hull approximates a primitive."""
    round_ = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(round_), np.sin(round_), 0 * round_], 1)
    if part.kind == "box":
        points = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]]), -1).reshape(-1, 3) * part.size
    elif part.kind == "cylinder":
        radius, half = part.size
        points = np.concatenate([radius * ring + [0, 0, half], radius * ring - [0, 0, half]])
    else:  # A sphere, or the two hemispheres of a capsule.
        heights = np.linspace(-np.pi / 2, np.pi / 2, 13)
        ball = part.size[0] * np.concatenate([np.cos(h) * ring + [0, 0, np.sin(h)] for h in heights])
        half = part.size[1] if part.kind == "capsule" else 0.0
        points = ball + np.where(ball[:, 2:] >= 0, half, -half) * [0, 0, 1]
    return points @ matrix(part.quat).T + part.place


def silhouette(parts: list[np.ndarray], optics: CameraConfig) -> np.ndarray:
    """The mask [rows, columns], bool, of convex bodies in front of the camera, each of points [N, 3] m in the palm
    frame."""
    mask = np.zeros(PICTURE[::-1], bool)
    for points in parts:
        x, y, depth = camera_axes(optics) @ (points - optics.position).T
        pixels = np.stack([x / depth, y / depth], 1) * optics.focal + optics.centre
        low = np.clip(np.floor(pixels.min(0)), 0, PICTURE).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + 1, 0, PICTURE).astype(int)
        grid = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1)
        sides = ConvexHull(pixels).equations  # a x + b y + c <= 0 inside
        mask[low[1] : high[1], low[0] : high[0]] |= (grid @ sides[:, :2].T + sides[:, 2] <= 0).all(-1)
    return mask


class EmulatedImu:
    """The emulated IMU on a terminal of its own: call `serve` when `due`; missed samples are skipped."""

    def __init__(self, link: Path, plant: EmulatedHand, seed: int, start: float):
        self.terminal, self._frames, self.due = Terminal(link), imu_frames(plant, seed), start
        self.option = "--imu", str(link)  # of the runner

    def close(self) -> None:
        self.terminal.close()

    def serve(self, now: float) -> None:
        """Send a sample at a time in s."""
        self.due = max(self.due + 1 / IMU_RATE, now)
        self.terminal.read()  # It ignores what it receives.
        self.terminal.write(next(self._frames))


class EmulatedCamera:
    """The emulated camera, and the program that sends its masks to the client of a socket; called as `EmulatedImu`."""

    def __init__(self, path: Path, plant: EmulatedHand, seed: int, start: float):
        self.path, self.due = path, start
        self.option = "--camera", f"unix:{path}"
        self._plant, self._rng = plant, np.random.default_rng(seed)
        self._client: socket.socket | None = None
        self._waiting = b""  # what the client has not read yet
        self._server = socket.socket(socket.AF_UNIX)
        if path.is_socket():  # of a program that was killed
            path.unlink()
        self._server.bind(str(path))
        self._server.listen()
        self._server.setblocking(False)

    def close(self) -> None:
        for link in (self._client, self._server):
            if link:
                link.close()
        self.path.unlink(missing_ok=True)

    def serve(self, now: float) -> None:
        """Send a mask at a time in s, if somebody listens."""
        self.due = max(self.due + 1 / CAMERA_RATE, now)
        with contextlib.suppress(BlockingIOError):
            self._client, self._waiting = self._server.accept()[0], b""
            self._client.setblocking(False)
        if self._client is None:
            return
        if not self._waiting:
            mask = picture(self._plant, CameraConfig()) & (self._rng.random() >= _LOST)
            self._waiting = encode_mask(now, mask)
        try:
            self._waiting = self._waiting[self._client.send(self._waiting) :]
        except BlockingIOError:
            pass
        except OSError:  # The client has disconnected.
            self._client.close()
            self._client = None
