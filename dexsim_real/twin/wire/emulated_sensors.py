"""The emulated sensors of the object: an IMU inside it, and a camera that sends masks of it.

The IMU sends RVC frames like a BNO08x, 19 bytes a hundred times a second, on a terminal of its own. The masks are sent
to clients of a Unix socket, as records of `dexsim_real.sensors.camera.encode_mask`. Noise, bias, drift and delay come
from the plant; this module adds formats, rates and lost pictures.
"""

import contextlib
import dataclasses
import errno
import math
import socket
from collections import Counter
from pathlib import Path

import numpy as np

from dexsim.core.config import setting, validate
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import CameraConfig, encode_mask
from dexsim_real.sensors.imu import check_mount
from dexsim_real.twin.plant.protocol import Plant
from dexsim_real.twin.plant.shapes import Primitive
from dexsim_real.twin.wire.terminal import Terminal

_STANDARD_GRAVITY = 9.80665  # m/s^2, 1 g of the IMU


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectSensorConfig:
    """Properties of IMU and camera that are the same in every trial."""

    imu_rate: float = setting(100.0, unit="Hz", low=1.0, high=1000.0)
    """Samples of the IMU per second."""
    imu_mount: tuple[float, float, float, float] = setting(
        (0.70710678, 0.0, 0.70710678, 0.0), unit="1", low=-1.0, high=1.0
    )
    """Orientation (w, x, y, z) of the IMU in the object; by default its z is along the object's x."""
    camera_rate: float = setting(30.0, unit="Hz", low=1.0, high=200.0)
    """Pictures per second."""
    picture: tuple[int, int] = setting((640, 480), unit="px", low=8, high=8192)
    """Columns and rows of a picture."""
    lost: float = setting(0.01, unit="1", low=0.0, high=1.0)
    """Probability that the object is not found in a picture."""
    optics: CameraConfig = setting(CameraConfig())
    """Pose of the camera; give the same `--optics` options to `dexsim_real.run`."""

    def __post_init__(self):
        validate(self)
        check_mount(self.imu_mount, "imu_mount")


class Clocked:
    """A sensor with a rate of its own: call `serve` when `due`; missed samples are skipped.

    Args:
      rate: Hz.
      start: s, time of the first sample.
    """

    def __init__(self, rate: float, start: float):
        self.due, self._period = start, 1.0 / rate

    def serve(self, now: float) -> None:
        """Take a sample if one is due at this time in s."""
        if now >= self.due:
            self.due = max(self.due + self._period, now)
            self._sample(now)

    def _sample(self, now: float) -> None:
        raise NotImplementedError


# --- IMU -----------------------------------------------------------------------------------------


def rvc_frame(index: int, rotation: np.ndarray, acceleration: np.ndarray) -> bytes:
    """The RVC frame of an IMU with a rotation [3, 3] in its world frame, z up, and an acceleration [3] m/s^2 in its own
    frame."""
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    pitch = math.asin(float(np.clip(-rotation[2, 0], -1.0, 1.0)))
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    words = [round(math.degrees(angle) * 100) for angle in (yaw, pitch, roll)]
    words += [round(float(np.clip(a / _STANDARD_GRAVITY * 1000, -32768, 32767))) for a in acceleration]
    body = bytes([index % 256]) + b"".join(word.to_bytes(2, "little", signed=True) for word in words) + bytes(3)
    return b"\xaa\xaa" + body + bytes([sum(body) % 256])


class EmulatedImu(Clocked):
    """The emulated IMU.

    Args:
      link: name of its terminal.
      plant: the physics.
      config: rate and mount.
      seed: of its heading, which has no absolute reference.
      start: s, time of the first sample.
    """

    def __init__(self, link: Path, plant: Plant, config: ObjectSensorConfig, *, seed: int, start: float):
        super().__init__(config.imu_rate, start)
        self.terminal, self.sent = Terminal(link), 0
        self._plant, self._mount = plant, _matrix(np.asarray(config.imu_mount))
        self._north = _about_z(float(np.random.default_rng(seed).uniform(-math.pi, math.pi)))

    def close(self) -> None:
        self.terminal.close()

    def _sample(self, now: float) -> None:
        _, quat, specific_force = self._plant.measure_object()
        # The vertical of its world frame follows the true gravity, which the runner knows only approximately.
        world = self._north @ _level(np.asarray(self._plant.up))
        self.terminal.read()  # It ignores what it receives.
        self.terminal.write(rvc_frame(self.sent, world @ _matrix(quat) @ self._mount, self._mount.T @ specific_force))
        self.sent += 1


def _abandoned(path: Path) -> bool:
    """Whether a socket was left by a program that has ended: nobody listens."""
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(str(path)) == errno.ECONNREFUSED


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion (w, x, y, z)."""
    w, (x, y, z) = quat[0], quat[1:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross) / float(quat @ quat)


def _about_z(angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _level(up: np.ndarray) -> np.ndarray:
    """Rows [3, 3]: the axes of a level frame, in the frame in which `up` [3] is the vertical."""
    z = up / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


# --- camera --------------------------------------------------------------------------------------


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
    return points + part.place


def silhouette(parts: list[np.ndarray], optics: CameraConfig, size: tuple[int, int]) -> np.ndarray:
    """The mask [rows, columns], bool, of convex bodies.

    Args:
      parts: points [N, 3] m of each body, palm frame. Bodies that extend behind the camera are not seen.
      optics: the camera.
      size: columns and rows.
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
        with contextlib.suppress(QhullError):  # A body that projects to a line covers no pixel.
            _fill(mask, pixels, ConvexHull(pixels).equations)
    return mask


def _fill(mask: np.ndarray, pixels: np.ndarray, sides: np.ndarray) -> None:
    """Set the pixels whose centres are inside a convex polygon with sides a x + b y + c <= 0."""
    low = np.clip(np.floor(pixels.min(0)).astype(int), 0, mask.shape[::-1])
    high = np.clip(np.ceil(pixels.max(0)).astype(int) + 1, 0, mask.shape[::-1])
    columns, rows = np.arange(low[0], high[0]), np.arange(low[1], high[1])
    inside = np.ones((len(rows), len(columns)), bool)
    for a, b, c in sides:
        inside &= a * columns + (b * rows + c)[:, None] <= 0
    mask[low[1] : high[1], low[0] : high[0]] |= inside


class EmulatedCamera(Clocked):
    """The emulated camera, and the program that sends its masks.

    Args:
      path: of its socket.
      plant: the physics.
      config: rate, pose and pictures.
      seed: of the lost pictures.
      start: s, time of the first picture.

    Raises:
      HandError: the socket cannot be created.
    """

    _MAX_QUEUED = 4  # records waiting for a slow reader

    def __init__(self, path: Path, plant: Plant, config: ObjectSensorConfig, *, seed: int, start: float):
        super().__init__(config.camera_rate, start)
        self.path = path
        self.counts: Counter[str] = Counter()
        self._plant, self._config = plant, config
        self._rng = np.random.default_rng(seed)
        # Imports SciPy now, not during the first exchange.
        silhouette([outline(Primitive("sphere", (0.03,)))], config.optics, config.picture)
        self._clients: dict[socket.socket, bytearray] = {}
        self._server = socket.socket(socket.AF_UNIX)
        try:
            if path.is_socket() and _abandoned(path):
                path.unlink()
            self._server.bind(str(path))
        except OSError as error:
            self._server.close()
            raise HandError(
                f"{path}: the socket for masks cannot be created ({error.strerror or error}); choose another "
                "--mask-socket"
            ) from None
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
            if len(waiting) < self._MAX_QUEUED * len(data):
                waiting += data
            else:
                self.counts["skipped"] += 1
            try:
                del waiting[: client.send(waiting)]
            except BlockingIOError:
                pass
            except OSError:  # The client has disconnected.
                client.close()
                del self._clients[client]
