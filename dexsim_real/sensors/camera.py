"""Sensors of the object: its height from a camera, by segmentation mask, centroid and ray; its orientation from an IMU.

As in the paper, the object's other coordinates are taken as fixed. The height is that of the point on the measured
axis that is nearest to the centroid's ray. `Masks` is any callable; built in are a colour threshold (OpenCV) and a
stream from another program.
"""

import dataclasses
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from dexsim.core.config import Config, setting
from dexsim.core.install import install_line
from dexsim.task_spec import VELOCITY_WEIGHT, TaskSpec
from dexsim_real.core.errors import HandError, find_function
from dexsim_real.core.process import BACKGROUND, change_priority
from dexsim_real.sensors.imu import IDENTITY, ImuReader

Masks = Callable[[], tuple[float, np.ndarray] | None]
"""Blocks until the next picture; returns its time (s, monotonic clock) and a bool mask [H, W], or None at the end.

A time in the future, as of another clock, counts as now."""

_STREAM = struct.Struct("<4sHHd")
_MAGIC = b"MASK"
_PIXELS = 2**26  # largest picture of a stream


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraConfig(Config):
    """Pinhole camera in the palm frame, and colour of the object."""

    focal: tuple[float, float] = setting((600.0, 600.0), unit="px", low=1.0, high=1e5)
    """Focal lengths along columns and rows."""
    centre: tuple[float, float] = setting((320.0, 240.0), unit="px", low=-1e4, high=1e5)
    """Principal point: column and row."""
    position: tuple[float, float, float] = setting((0.06, 0.5, 0.09), unit="m", low=-10.0, high=10.0)
    """Position of the camera in the palm frame."""
    forward: tuple[float, float, float] = setting((0.0, -1.0, 0.0), unit="1", low=-1.0, high=1.0)
    """Viewing direction in the palm frame."""
    down: tuple[float, float, float] = setting((1.0, 0.0, 0.0), unit="1", low=-1.0, high=1.0)
    """Direction in the palm frame in which the rows of the picture increase."""
    hsv_low: tuple[int, int, int] = setting((40, 80, 60), unit="1", low=0, high=255)
    """Lower colour threshold: OpenCV's hue (0 to 179), saturation and value."""
    hsv_high: tuple[int, int, int] = setting((85, 255, 255), unit="1", low=0, high=255)
    """Upper colour threshold."""
    min_area: int = setting(60, unit="px", low=1, high=10_000_000)
    """Smallest area of a mask; smaller ones count as no object."""

    def __post_init__(self):
        super().__post_init__()
        if np.linalg.norm(np.cross(self.forward, self.down)) < 1e-3:
            raise HandError("CameraConfig.forward and CameraConfig.down must not be parallel")


def camera_axes(config: CameraConfig) -> np.ndarray:
    """Rows [3, 3]: the picture's right, down and forward axes in the palm frame, orthonormal."""
    forward = np.asarray(config.forward, float) / np.linalg.norm(config.forward)
    down = np.asarray(config.down, float) - forward * (np.asarray(config.down) @ forward)
    down /= np.linalg.norm(down)
    return np.stack([np.cross(down, forward), down, forward])


def height_of(mask: np.ndarray, config: CameraConfig, reference: np.ndarray, axis: int) -> float | None:
    """Coordinate m of the object along an axis (0, 1 or 2) of the palm frame, by a mask [H, W] bool.

    It is that of the point on the axis through `reference` [3] m which is nearest to the ray through the mask's
    centroid. None when the mask is too small, or the ray is parallel to the axis.
    """
    rows, columns = np.nonzero(mask)
    if rows.size < config.min_area:
        return None
    pixel = (np.array([columns.mean(), rows.mean()]) - config.centre) / config.focal
    ray = np.append(pixel, 1.0) @ camera_axes(config)
    ray /= np.linalg.norm(ray)
    across = 1.0 - ray[axis] ** 2  # squared sine of the angle between ray and axis
    if across < 1e-4:
        return None
    gap = np.asarray(config.position) - reference
    return float(reference[axis] + (gap[axis] - ray[axis] * (gap @ ray)) / across)


class HeightSensor:
    """Tracks the object from its own thread.

    `spec.object_axes` tells which coordinate is measured: exactly one, else HandError. The others are those of
    `spec.reference`.
    """

    def __init__(self, masks: Masks, config: CameraConfig, spec: TaskSpec):
        axes = spec.object_axes
        if sum(axes) != 1:
            raise HandError(f"the policy observes the object's coordinates {axes}, and a camera measures one")
        self._masks, self._config = masks, config
        self._reference, self._axis = np.asarray(spec.reference, float), axes.index(True)
        self.newest = -math.inf, self._reference, np.zeros(3)
        """Time of the newest measurement (s, monotonic clock; -inf before the object was seen), position [3] m and
        filtered velocity [3] m/s."""
        self.failure = ""  # why no picture comes any more
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vision", daemon=True)
        self._thread.start()

    def update(self, when: float, mask: np.ndarray) -> None:
        """Update with the mask of a picture taken at a time in s; one no newer than the newest says nothing new."""
        before, place, velocity = self.newest
        if when <= before:
            return
        height = height_of(mask, self._config, self._reference, self._axis)
        if height is None:
            return
        position = self._reference.copy()
        position[self._axis] = height
        # The first one has a velocity of 0: its difference took for ever.
        self.newest = when, position, velocity + VELOCITY_WEIGHT * ((position - place) / (when - before) - velocity)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        change_priority(BACKGROUND)
        while not self._stop.is_set():
            try:
                picture = self._masks()
                if picture is None:
                    self.failure = "the camera sends no more pictures"
                    return
                when, mask = picture
                now = time.monotonic()
                self.update(when if when < now else now, mask)
            except Exception as error:  # Also of the user's function.
                self.failure = f"the camera failed: {' '.join(str(error).split()) or type(error).__name__:.200}"
                return


class ObjectEstimate(NamedTuple):
    """Pose and velocity of the object, palm frame."""

    position: np.ndarray  # [3] m
    velocity: np.ndarray  # [3] m/s
    quat: np.ndarray  # [4] (w, x, y, z)
    palm_gravity: np.ndarray = np.zeros(3)  # [3] unit vector


@dataclasses.dataclass
class ObjectSensors:
    """Camera and IMU, None without one. What neither measures is nominal."""

    reference: Sequence[float]  # [3] m, position
    gravity: Sequence[float]  # [3] in the palm frame, of any length
    camera: HeightSensor | None = None
    imu: ImuReader | None = None

    def ready(self) -> bool:
        """Whether the camera sees the object; if so, its current orientation becomes the identity.

        Raises HandError: no picture will come any more.
        """
        if self.camera and math.isinf(self.camera.newest[0]):
            if self.camera.failure:
                raise HandError(self.camera.failure)
            return False
        if self.imu:
            self.imu.calibrate(IDENTITY)
        return True

    def read(self, now: float) -> tuple[ObjectEstimate, float]:
        """The estimate, and the time in s of the newest orientation."""
        position, velocity = self.camera.newest[1:] if self.camera else (np.asarray(self.reference), np.zeros(3))
        if not self.imu:
            down = np.asarray(self.gravity) / np.linalg.norm(self.gravity)
            return ObjectEstimate(position, velocity, IDENTITY, down), now
        when, quat = self.imu.read()
        return ObjectEstimate(position, velocity, quat, self.imu.palm_gravity), when

    def lost(self, now: float, limit: float) -> str:
        """Why a measurement is older than `limit` s, or its sensor is not to be trusted; empty if all is well."""
        if self.camera and now - self.camera.newest[0] > limit:
            return self.camera.failure or "the object is out of sight"
        if self.imu and self.imu.jumped:
            return "the orientation that the IMU sends has jumped"
        return "the IMU is silent" if self.imu and now - self.imu.read()[0] > limit else ""

    def close(self) -> None:
        for sensor in (self.camera, self.imu):
            if sensor:
                sensor.close()


# --- sources of masks ----------------------------------------------------------------------------


def open_masks(spec: str, config: CameraConfig) -> Masks:
    """A source of masks, by what `spec` is: a camera number or video file, whose pictures the colours of `config`
    segment; `unix:PATH` for a program that sends records of `encode_mask`; or `MODULE:FUNCTION` for a function from a
    BGR picture [H, W, 3] uint8 of camera 0 to a bool mask [H, W].

    Raises HandError: it cannot be opened.
    """
    if spec.startswith("unix:"):
        return _stream(spec.removeprefix("unix:"))
    if ":" in spec and not spec.startswith(("/", "rtsp:", "http")):
        return _camera("0", find_function(spec, spec, "MODULE:FUNCTION of an importable module"))

    def colour_mask(picture: np.ndarray) -> np.ndarray:
        import cv2

        hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
        mask = cv2.inRange(hsv, np.array(config.hsv_low, np.uint8), np.array(config.hsv_high, np.uint8))
        return cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0  # Without single pixels.

    return _camera(spec, colour_mask)


def encode_mask(when: float, mask: np.ndarray) -> bytes:
    """A record of a mask stream: magic, width, height, time s, packed bits of a mask [H, W]."""
    height, width = mask.shape
    return _STREAM.pack(_MAGIC, width, height, when) + np.packbits(mask).tobytes()


def _stream(path: str) -> Masks:
    link = socket.socket(socket.AF_UNIX)
    try:
        link.connect(path)
    except OSError as error:
        raise HandError(f"{path}: no program sends masks here ({error.strerror}); start that program first") from None
    file = link.makefile("rb")

    def read() -> tuple[float, np.ndarray] | None:
        head = file.read(_STREAM.size)
        if len(head) < _STREAM.size:
            return None
        magic, width, height, when = _STREAM.unpack(head)
        if magic != _MAGIC or width * height > _PIXELS:
            raise HandError(f"{path}: invalid mask frame; send records of `encode_mask`")
        size = (width * height + 7) // 8
        bits = np.frombuffer(file.read(size), np.uint8)
        if len(bits) < size:
            return None
        return when, np.unpackbits(bits, count=width * height).reshape(height, width).astype(bool)

    return read


def _camera(spec: str, segment: Callable[[np.ndarray], np.ndarray]) -> Masks:
    try:
        import cv2
    except ImportError:
        raise HandError(f"OpenCV is missing: {install_line('vision')}") from None
    capture = cv2.VideoCapture(int(spec) if spec.isdigit() else spec)
    if not capture.isOpened():
        raise HandError(f"{spec}: the camera cannot be opened; check its number or the file")

    def read() -> tuple[float, np.ndarray] | None:
        sound, picture = capture.read()
        return (time.monotonic(), segment(picture)) if sound else None

    return read
