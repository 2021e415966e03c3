"""The IMU inside the object: a BNO08x in UART-RVC mode, and its orientation in the palm frame.

The IMU sends 100 RVC frames a second at 115200 baud: AA AA, index, yaw, pitch and roll in 0.01 degree, three
accelerations in mg, three more bytes, and the sum of all bytes after the head (BNO080 datasheet, 1.3.5.2). Yaw has no
absolute reference and the palm may lean, so a known pose of the object aligns both. Yaw, pitch and roll are
singular where the IMU's x points up or down: mount it with its z along the axis that stays upright. `UPRIGHT_X` is the
mount in an object that turns about its x.
"""

import math
import struct
import threading
import time

import mujoco
import numpy as np

from dexsim_real.core.errors import HandError, open_serial
from dexsim_real.core.stream import FrameParser

HEAD = b"\xaa\xaa"
SIZE = 19
BAUD = 115200
_BODY = struct.Struct("<B6h3B")
_PERIOD = 0.01  # s between two samples
_FASTEST = 30.0  # rad/s that an object may turn
_JUMP = 0.1  # rad, noise
_GAP = 0.05  # s, longest motion that an interval between two samples explains
_SAMPLES = 5  # in a row that are far from the last make a jump: a damaged frame may have a right checksum
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
UPRIGHT_X = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
"""Orientation (w, x, y, z) of the IMU in the object: the IMU's z along the object's x."""


def encode(index: int, quat: np.ndarray, acceleration: tuple[float, float, float] = (0.0, 0.0, 9.81)) -> bytes:
    """The RVC frame of an orientation (w, x, y, z) in the IMU's world frame, z up; acceleration in m/s^2."""
    w, x, y, z = (float(v) for v in quat)
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    angles = (round(math.degrees(a) * 100) for a in (yaw, pitch, roll))
    counts = np.clip(np.round(np.asarray(acceleration) / 9.80665e-3), -32768, 32767).astype(int)  # saturates in a bump
    body = _BODY.pack(index & 0xFF, *angles, *counts, 0, 0, 0)
    return HEAD + body + bytes([sum(body) & 0xFF])


def decode(frame: bytes) -> tuple[int, np.ndarray] | None:
    """Index and orientation (w, x, y, z) of an RVC frame; None when the frame is damaged."""
    body = frame[len(HEAD) : -1]
    if len(frame) != SIZE or frame[:2] != HEAD or sum(body) & 0xFF != frame[-1]:
        return None
    _, yaw, pitch, roll, *_ = _BODY.unpack(body)
    if abs(yaw) > 18000 or abs(pitch) > 9000 or abs(roll) > 18000:
        return None
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, np.radians([yaw, pitch, roll]) / 100, "zyx")
    return frame[2], quat


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of two quaternions (w, x, y, z)."""
    w, v = a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.concatenate([[w], v])


def conjugate(a: np.ndarray) -> np.ndarray:
    """The inverse of a unit quaternion."""
    return a * np.array([1.0, -1.0, -1.0, -1.0])


class ImuReader:
    """From an IMU's bytes to the orientation of the object in the palm frame.

    All three angles between the IMU's world and the palm come from one known pose (`calibrate`). Gravity would give two
    of them only if the palm's own lean were known: a mount that leans would then look like a turned object. What the
    pose is off by stays as a constant error.

    A frame that repeats the index of the last one is no new sample: an IMU that hangs is silent. A sample farther from
    the last sound one than an object turns between two samples is left out; when the next ones are, too, `jumped` is
    true until they come back.
    `mount` [4] is the orientation of the IMU in the object.
    """

    def __init__(self, mount: tuple[float, ...] = UPRIGHT_X):
        self.parser = FrameParser(HEAD, SIZE, len, decode)
        self._mount = np.asarray(mount) / np.linalg.norm(mount)
        self._world: np.ndarray | None = None
        self._newest: tuple[float, np.ndarray] | None = None
        self._last_index, self._far = -1, 0  # index of the last frame; samples in a row far from the last sound one

    @property
    def jumped(self) -> bool:
        """Whether the orientation has changed faster than an object turns, as of an IMU that lost its reference."""
        return self._far >= _SAMPLES

    def receive(self, time: float, data: bytes) -> None:
        """Update with bytes that were received at a time in s."""
        for index, quat in self.parser.feed(data):
            if index == self._last_index:
                continue
            # By the index and not by the time: samples that waited arrive together.
            gap = _PERIOD * ((index - self._last_index) % 256)
            self._last_index = index
            before = quat if self._newest is None else self._newest[1]
            angle = 2.0 * math.acos(min(abs(float(quat @ before)), 1.0))
            self._far = self._far + 1 if angle > _JUMP + _FASTEST * min(gap, _GAP) else 0
            if self._far == 0 or (self.jumped and self._world is None):  # Nothing relies on the last one yet.
                # q and -q are one orientation: take the one nearer to the last, as in simulation.
                self._newest, self._far = (time, quat if quat @ before >= 0 else -quat), 0

    def calibrate(self, true: np.ndarray) -> None:
        """Align: the object now has the orientation `true` [4] in the palm frame."""
        assert self._newest is not None, "`wait` for the first orientation"
        self._world = multiply(multiply(true, self._mount), conjugate(self._newest[1]))

    def read(self) -> tuple[float, np.ndarray]:
        """Time of the newest sample (s, monotonic clock) and orientation [4] of the object in the palm frame."""
        assert self._newest is not None and self._world is not None, "`calibrate` first"
        when, quat = self._newest
        return when, multiply(multiply(self._world, quat), conjugate(self._mount))

    @property
    def palm_gravity(self) -> np.ndarray:
        """Where gravity [3] points in the palm frame, by the last alignment."""
        assert self._world is not None, "`calibrate` first"
        return multiply(multiply(self._world, np.array([0.0, 0.0, 0.0, -1.0])), conjugate(self._world))[1:]

    def close(self) -> None:
        """Nothing is open here."""


class Imu(ImuReader):
    """Reads the IMU at a serial port from its own thread. HandError: the port cannot be opened."""

    def __init__(self, port: str, mount: tuple[float, ...] = UPRIGHT_X):
        super().__init__(mount)
        self.port, self._stop = port, threading.Event()
        self._serial = open_serial(port, BAUD, timeout=0.05)
        self._thread = threading.Thread(target=self._run, name="imu", daemon=True)
        self._thread.start()

    def wait(self, seconds: float = 2.0) -> None:
        """Wait for the first orientation. Raises HandError: none arrived in this time."""
        until = time.monotonic() + seconds
        while self._newest is None:
            if time.monotonic() > until:
                raise HandError(f"{self.port}: no orientation; set the IMU to UART-RVC mode (PS0 high, PS1 low)")
            time.sleep(0.005)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(1.0)
        self._serial.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                data = self._serial.read(SIZE)
            except OSError:
                return  # `Safety` reacts to the age of the last sample.
            self.receive(time.monotonic(), data)
