"""Sensors of the object on hardware: a camera for its height, an IMU for its orientation."""

from typing import NamedTuple

import numpy as np

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import HeightSensor
from dexsim_real.sensors.imu import IDENTITY, ImuReader


class ObjectEstimate(NamedTuple):
    """Pose and velocity of the object, palm frame."""

    position: np.ndarray  # [3] m
    velocity: np.ndarray  # [3] m/s
    quat: np.ndarray  # [4] (w, x, y, z)
    palm_gravity: np.ndarray = np.zeros(3)  # [3]; zeros without an IMU


class ObjectSensors:
    """Camera and IMU, None without one. What neither measures is fixed: `reference` [3] m is the nominal position."""

    def __init__(self, reference: np.ndarray, camera: HeightSensor | None = None, imu: ImuReader | None = None):
        self._reference, self.camera, self.imu = np.asarray(reference, float), camera, imu

    def ready(self) -> bool:
        """Whether the camera sees the object; if so, its current orientation becomes the identity.

        Raises HandError: no picture will come any more.
        """
        if self.camera and not self.camera.has_measurement:
            if self.camera.failure:
                raise HandError(self.camera.failure)
            return False
        if self.imu:
            self.imu.calibrate(IDENTITY)
        return True

    def read(self, now: float) -> tuple[ObjectEstimate, float]:
        """The estimate, and the time in s of the newest orientation."""
        position, velocity = self.camera.read()[1:] if self.camera else (self._reference, np.zeros(3))
        if not self.imu:
            return ObjectEstimate(position, velocity, IDENTITY), now
        when, quat = self.imu.read()
        return ObjectEstimate(position, velocity, quat, self.imu.palm_gravity), when

    def lost(self, now: float, limit: float) -> str:
        """Why a measurement is older than `limit` s, or its sensor is not to be trusted; empty if all is well."""
        if self.camera and now - self.camera.read()[0] > limit:
            return self.camera.failure or "the object is out of sight"
        if self.imu and self.imu.jumped:
            return "the orientation that the IMU sends has jumped"
        return "the IMU is silent" if self.imu and now - self.imu.read()[0] > limit else ""

    def close(self) -> None:
        for sensor in (self.camera, self.imu):
            if sensor:
                sensor.close()
