"""The emulated sensors of the object: an IMU inside it, and a camera that sends masks of it.

Noise, bias, drift and delay come from the plant; this module adds formats, rates and lost pictures. `ImuFrames` and
`picture` are what the sensors send; `EmulatedImu` serves it on a terminal, `EmulatedCamera` on a Unix socket.
"""

import contextlib
import socket
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import CameraConfig, camera_axes, encode_mask
from dexsim_real.sensors.imu import UPRIGHT_X, encode
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.shapes import Primitive, matrix, product, turn
from dexsim_real.twin.wire.firmware import Terminal

IMU_RATE, CAMERA_RATE = 100.0, 30.0  # Hz
PICTURE = (640, 480)  # px, columns and rows
_LOST = 0.01  # probability that the object is not found in a picture
_MOUNT = np.array(UPRIGHT_X)


class ImuFrames:
    """The RVC frames of the IMU, like a BNO08x. Its world frame has the true vertical as z and an arbitrary heading."""

    def __init__(self, plant: EmulatedHand, seed: int):
        self.sent, self._plant = 0, plant
        up = plant.up
        level = np.array([1.0 + up[2], up[1], -up[0], 0.0])  # turns the vertical to z
        self._world = product(turn((0, 0, 1), 1.0 + seed), level / np.linalg.norm(level))

    def sample(self) -> bytes:
        """The bytes of the current orientation and acceleration."""
        _, quat, specific_force = self._plant.measure_object()
        self.sent += 1
        acceleration = matrix(_MOUNT).T @ specific_force
        return encode(self.sent, product(self._world, product(quat, _MOUNT)), tuple(acceleration))


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
    return points + part.place


def silhouette(parts: list[np.ndarray], optics: CameraConfig) -> np.ndarray:
    """The mask [rows, columns], bool, of convex bodies, each of points [N, 3] m in the palm frame.

    Bodies that extend behind the camera are not seen.
    """
    mask = np.zeros(PICTURE[::-1], bool)
    for points in parts:
        x, y, depth = camera_axes(optics) @ (points - optics.position).T
        if depth.min() < 1e-3:
            continue
        pixels = np.stack([x / depth, y / depth], 1) * optics.focal + optics.centre
        low = np.clip(np.floor(pixels.min(0)), 0, PICTURE).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + 1, 0, PICTURE).astype(int)
        grid = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1)
        with contextlib.suppress(QhullError):  # A body that projects to a line covers no pixel.
            sides = ConvexHull(pixels).equations  # a x + b y + c <= 0 inside
            mask[low[1] : high[1], low[0] : high[0]] |= (grid @ sides[:, :2].T + sides[:, 2] <= 0).all(-1)
    return mask


class EmulatedImu:
    """The emulated IMU on a terminal of its own: call `serve` when `due`; missed samples are skipped."""

    def __init__(self, link: Path, plant: EmulatedHand, seed: int, start: float):
        self.terminal, self.frames, self.due = Terminal(link), ImuFrames(plant, seed), start
        self.option = "--imu", str(link)  # of the runner

    def close(self) -> None:
        self.terminal.close()

    def serve(self, now: float) -> None:
        """Send a sample if one is due at this time in s."""
        if now < self.due:
            return
        self.due = max(self.due + 1 / IMU_RATE, now)
        self.terminal.read()  # It ignores what it receives.
        self.terminal.write(self.frames.sample())


class EmulatedCamera:
    """The emulated camera, and the program that sends its masks to the client of a socket; called as `EmulatedImu`.

    Raises HandError: the socket cannot be created.
    """

    def __init__(self, path: Path, plant: EmulatedHand, seed: int, start: float):
        self.path, self.due, self.sent = path, start, 0
        self.option = "--camera", f"unix:{path}"
        self._plant, self._rng = plant, np.random.default_rng(seed)
        self._client: socket.socket | None = None
        self._waiting = b""  # what the client has not read yet
        self._server = socket.socket(socket.AF_UNIX)
        try:
            self._server.bind(str(path))
        except OSError as error:
            self._server.close()
            why = error.strerror or error
            raise HandError(f"{path}: the socket for masks cannot be created ({why}); remove the file") from None
        self._server.listen()
        self._server.setblocking(False)

    def close(self) -> None:
        for link in (self._client, self._server):
            if link:
                link.close()
        self.path.unlink(missing_ok=True)

    def serve(self, now: float) -> None:
        """Send a mask if one is due at this time in s, and somebody listens."""
        if now < self.due:
            return
        self.due = max(self.due + 1 / CAMERA_RATE, now)
        with contextlib.suppress(BlockingIOError):
            self._client, self._waiting = self._server.accept()[0], b""
            self._client.setblocking(False)
        if self._client is None:
            return
        if not self._waiting:
            mask = picture(self._plant, CameraConfig()) & (self._rng.random() >= _LOST)
            self.sent += 1
            self._waiting = encode_mask(now, mask)
        try:
            self._waiting = self._waiting[self._client.send(self._waiting) :]
        except BlockingIOError:
            pass
        except OSError:  # The client has disconnected.
            self._client.close()
            self._client = None
