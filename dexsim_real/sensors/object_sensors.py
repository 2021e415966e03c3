"""Sensors of the object on hardware: a camera for its height, an IMU for its orientation."""

import numpy as np

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import HeightSensor
from dexsim_real.sensors.imu import IDENTITY, ImuReader
from dexsim_real.sensors.readings import ObjectEstimate


class ObjectSensors:
    """Camera and IMU, None without one. What neither measures is fixed: `reference` [3] m is the nominal position."""

    def __init__(self, reference: np.ndarray, camera: HeightSensor | None, imu: ImuReader | None):
        self._reference, self._camera, self._imu = np.asarray(reference, float), camera, imu

    @property
    def measures_orientation(self) -> bool:
        return self._imu is not None

    def ready(self) -> bool:
        """Whether the camera sees the object; if so, its current orientation becomes the identity.

        Raises HandError: no picture will come any more.
        """
        if self._camera and not self._camera.has_measurement:
            if self._camera.failure:
                raise HandError(self._camera.failure)
            return False
        if self._imu:
            self._imu.calibrate(IDENTITY)
        return True

    def read(self, now: float) -> tuple[ObjectEstimate, float]:
        """The estimate, and the time in s of the newest orientation."""
        position, velocity = self._camera.read()[1:] if self._camera else (self._reference, np.zeros(3))
        if not self._imu:
            return ObjectEstimate(position, velocity, IDENTITY), now
        when, quat = self._imu.read()
        return ObjectEstimate(position, velocity, quat, self._imu.palm_gravity), when

    def lost(self, now: float, limit: float) -> str:
        """Why a measurement is older than `limit` s, or its sensor is not to be trusted; empty if all is well."""
        if self._camera and now - self._camera.read()[0] > limit:
            return self._camera.failure or "the object is out of sight"
        if self._imu and self._imu.jumped:
            return "the orientation that the IMU sends has jumped"
        return "the IMU is silent" if self._imu and now - self._imu.read()[0] > limit else ""

    def close(self) -> None:
        for sensor in (self._camera, self._imu):
            if sensor:
                sensor.close()
