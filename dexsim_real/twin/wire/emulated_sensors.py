"""What knows of the object beside an emulated hand: an IMU within it, and a camera's masks of it.

The IMU sends what a BNO08x sends in its UART-RVC mode, 19 bytes a hundred times a second, on a terminal of its own.
The masks go to whoever connects to a Unix socket, as records of `dexsim_real.sensors.camera.encode_mask`. What is
wrong with
both (noise, bias, drift, delay) is in what the plant measures; here are their formats, rates and blind spots.
"""

import contextlib
import dataclasses
import math
import socket
from collections import Counter
from pathlib import Path

import numpy as np

from dexsim.core.config import setting, validate
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import CameraConfig, encode_mask
from dexsim_real.twin.plant.protocol import Plant
from dexsim_real.twin.plant.shapes import Primitive
from dexsim_real.twin.wire.terminal import Terminal

_STANDARD_GRAVITY = 9.80665  # m/s^2, what a part means by 1 g


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectSensorConfig:
    """IMU and camera, as far as they are the same in every trial."""

    imu_rate: float = setting(100.0, unit="Hz", low=1.0, high=1000.0)
    """Samples per second."""
    imu_mount: tuple[float, float, float, float] = setting(
        (0.70710678, 0.0, 0.70710678, 0.0), unit="1", low=-1.0, high=1.0
    )
    """Orientation (w, x, y, z) of the part in the object: its z along the object's x."""
    camera_rate: float = setting(30.0, unit="Hz", low=1.0, high=200.0)
    """Pictures per second."""
    picture: tuple[int, int] = setting((640, 480), unit="px", low=8, high=8192)
    """Columns and rows of a picture."""
    lost: float = setting(0.01, unit="1", low=0.0, high=1.0)
    """Share of pictures in which the object is not found."""
    optics: CameraConfig = setting(CameraConfig())
    """Where the camera is; tell the runner the same."""

    def __post_init__(self):
        validate(self)


class Clocked:
    """What samples at a rate of its own: served when `due`; samples that were missed are left out."""

    def __init__(self, rate: float, start: float):
        self.due, self._period = start, 1.0 / rate

    def serve(self, now: float) -> None:
        """One sample, if it is time."""
        if now >= self.due:
            self.due = max(self.due + self._period, now)
            self._sample(now)

    def _sample(self, now: float) -> None:
        raise NotImplementedError


# --- IMU -----------------------------------------------------------------------------------------


def rvc_frame(index: int, rotation: np.ndarray, acceleration: np.ndarray) -> bytes:
    """The 19 bytes about a part that is turned by `rotation` [3, 3] in its level world and feels `acceleration` [3]
    m/s^2 in its own frame."""
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    pitch = math.asin(float(np.clip(-rotation[2, 0], -1.0, 1.0)))
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    words = [round(math.degrees(angle) * 100) for angle in (yaw, pitch, roll)]
    words += [round(float(np.clip(a / _STANDARD_GRAVITY * 1000, -32768, 32767))) for a in acceleration]
    body = bytes([index % 256]) + b"".join(word.to_bytes(2, "little", signed=True) for word in words) + bytes(3)
    return b"\xaa\xaa" + body + bytes([sum(body) % 256])


class EmulatedImu(Clocked):
    """The part's wire.

    Args:
      link: name of its terminal.
      start: s, time of its first sample.
    """

    def __init__(self, link: Path, plant: Plant, config: ObjectSensorConfig, *, seed: int, start: float):
        super().__init__(config.imu_rate, start)
        self.terminal, self.sent = Terminal(link), 0
        self._plant, self._mount = plant, _matrix(np.asarray(config.imu_mount))
        # It knows no north.
        self._north = _about_z(float(np.random.default_rng(seed).uniform(-math.pi, math.pi)))

    def close(self) -> None:
        self.terminal.close()

    def _sample(self, now: float) -> None:
        _, quat, felt = self._plant.measure_object()
        # Its world stands upright by what gravity really is, which the runner knows only nearly.
        world = self._north @ _level(np.asarray(self._plant.up))
        self.terminal.read()  # It has no ears.
        self.terminal.write(rvc_frame(self.sent, world @ _matrix(quat) @ self._mount, self._mount.T @ felt))
        self.sent += 1


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion (w, x, y, z)."""
    w, (x, y, z) = quat[0], quat[1:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross) / float(quat @ quat)


def _about_z(angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _level(up: np.ndarray) -> np.ndarray:
    """Rows [3, 3]: a level frame's axes in the frame in which `up` [3] is the vertical."""
    z = up / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


# --- camera --------------------------------------------------------------------------------------


def outline(part: Primitive) -> np.ndarray:
    """Points [N, 3] m of a primitive, in the object's frame, whose hull looks like it."""
    round_ = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(round_), np.sin(round_), 0 * round_], 1)
    if part.kind == "box":
        points = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]]), -1).reshape(-1, 3) * part.size
    elif part.kind == "cylinder":
        radius, half = part.size
        points = np.concatenate([radius * ring + [0, 0, half], radius * ring - [0, 0, half]])
    else:  # A sphere, or two halves of one.
        heights = np.linspace(-np.pi / 2, np.pi / 2, 13)
        ball = part.size[0] * np.concatenate([np.cos(h) * ring + [0, 0, np.sin(h)] for h in heights])
        half = part.size[1] if part.kind == "capsule" else 0.0
        points = ball + np.where(ball[:, 2:] >= 0, half, -half) * [0, 0, 1]
    return points + part.place


def silhouette(parts: list[np.ndarray], optics: CameraConfig, size: tuple[int, int]) -> np.ndarray:
    """The picture [rows, columns], bool, of convex bodies given by points [N, 3] m in the palm frame.

    Bodies that reach behind the camera are not seen.
    """
    from scipy.spatial import ConvexHull, QhullError

    mask = np.zeros((size[1], size[0]), bool)
    forward = np.asarray(optics.forward) / np.linalg.norm(optics.forward)
    right = np.cross(optics.down, forward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    for points in parts:
        x, y, depth = axes @ (points - optics.position).T
        if depth.min() < 1e-3:
            continue
        pixels = np.stack(
            [optics.focal[0] * x / depth + optics.centre[0], optics.focal[1] * y / depth + optics.centre[1]], 1
        )
        with contextlib.suppress(QhullError):  # A body that is seen as a line covers no pixel.
            _fill(mask, pixels, ConvexHull(pixels).equations)
    return mask


def _fill(mask: np.ndarray, pixels: np.ndarray, sides: np.ndarray) -> None:
    """Set the pixels whose centres lie within all sides (a x + b y + c <= 0) of a polygon."""
    low = np.clip(np.floor(pixels.min(0)).astype(int), 0, mask.shape[::-1])
    high = np.clip(np.ceil(pixels.max(0)).astype(int) + 1, 0, mask.shape[::-1])
    columns, rows = np.arange(low[0], high[0]), np.arange(low[1], high[1])
    inside = np.ones((len(rows), len(columns)), bool)
    for a, b, c in sides:
        inside &= a * columns + (b * rows + c)[:, None] <= 0
    mask[low[1] : high[1], low[0] : high[0]] |= inside


class EmulatedCamera(Clocked):
    """The program that sends masks.

    Args:
      path: of its socket.
      start: s, time of its first picture.
    """

    _ROOM = 4  # records that may wait for a slow reader

    def __init__(self, path: Path, plant: Plant, config: ObjectSensorConfig, *, seed: int, start: float):
        super().__init__(config.camera_rate, start)
        self.path, self.counts = path, Counter()
        self._plant, self._config = plant, config
        self._rng = np.random.default_rng(seed)
        silhouette(
            [outline(Primitive("sphere", (0.03,)))], config.optics, config.picture
        )  # Imports what it needs: now.
        self._clients: dict[socket.socket, bytearray] = {}
        self._server = socket.socket(socket.AF_UNIX)
        try:
            if path.is_socket():
                path.unlink()  # Of a program that is no more.
            self._server.bind(str(path))
        except OSError as error:
            self._server.close()
            raise HandError(f"{path}: no socket for masks here ({error.strerror})") from None
        self._server.listen()
        self._server.setblocking(False)

    def close(self) -> None:
        for link in (*self._clients, self._server):
            link.close()
        self.path.unlink(missing_ok=True)

    def _sample(self, now: float) -> None:
        with contextlib.suppress(BlockingIOError):
            client, _ = self._server.accept()
            client.setblocking(False)
            self._clients[client] = bytearray()
        if not self._clients:
            return
        place, quat, _ = self._plant.measure_object()
        turn, parts = _matrix(quat), self._plant.shape.parts if self._rng.random() >= self._config.lost else ()
        mask = silhouette([outline(part) @ turn.T + place for part in parts], self._config.optics, self._config.picture)
        self.counts["pictures"] += 1
        self._send(encode_mask(now, mask))

    def _send(self, data: bytes) -> None:
        for client, waiting in list(self._clients.items()):
            if len(waiting) < self._ROOM * len(data):
                waiting += data
            else:
                self.counts["left out"] += 1
            try:
                del waiting[: client.send(waiting)]
            except BlockingIOError:
                pass
            except OSError:  # It has gone.
                client.close()
                del self._clients[client]
