"""Sensors of the object on hardware: a camera for its height, an IMU for its orientation."""

import numpy as np

from dexsim_real.control.controller import IDENTITY, Controller
from dexsim_real.core.errors import HandError
from dexsim_real.run.options import RunArguments
from dexsim_real.sensors.camera import HeightSensor, open_masks
from dexsim_real.sensors.imu import Imu
from dexsim_real.sensors.readings import ObjectEstimate


class ObjectSensors:
    """Camera and IMU of a run; a coordinate that neither measures is taken as fixed.

    Raises:
      HandError: the policy needs a sensor that is not given, or a sensor cannot be opened.
    """

    def __init__(self, arguments: RunArguments, controller: Controller):
        spec, needed = controller.spec, controller.sources
        self._reference = np.asarray(spec.reference, float)
        self._camera: HeightSensor | None = None
        self._imu: Imu | None = None
        if "imu" in needed and not arguments.imu:
            raise HandError("the policy observes the object's orientation; give the IMU's port with --imu")
        if "camera" in needed and not (arguments.camera or arguments.fixed_object):
            raise HandError("the policy observes the object's height; give --camera, or --fixed-object to assume it")
        try:
            if arguments.camera:
                self._camera = HeightSensor(
                    open_masks(arguments.camera, arguments.optics),
                    arguments.optics,
                    self._reference,
                    spec.object_axes,
                    spec.velocity_filter,
                )
            if arguments.imu:
                self._imu = Imu(arguments.imu, arguments.imu_mount)
                self._imu.wait()
        except BaseException:
            self.close()
            raise

    def ready(self) -> bool:
        """Whether the camera sees the object; if so, its current orientation becomes the identity.

        Raises:
          HandError: no picture will come any more.
        """
        if self._camera and not self._camera.seen:
            if self._camera.failure:
                raise HandError(self._camera.failure)
            return False
        if self._imu:
            self._imu.calibrate(IDENTITY)
        return True

    def read(self, now: float) -> tuple[ObjectEstimate, float]:
        """The estimate, and the time in s of the newest orientation."""
        position, velocity, quat, when = self._reference, np.zeros(3), IDENTITY, now
        if self._camera:
            _, position, velocity = self._camera.read()
        if self._imu:
            when, quat = self._imu.read()
        return ObjectEstimate(position, velocity, quat), when

    def lost(self, now: float, limit: float) -> str:
        """Why a measurement is older than `limit` s, with the sensor; empty if none is."""
        if self._camera and now - self._camera.read()[0] > limit:
            return self._camera.failure or "the object is out of sight"
        return "the IMU is silent" if self._imu and now - self._imu.read()[0] > limit else ""

    def close(self) -> None:
        for sensor in (self._camera, self._imu):
            if sensor:
                sensor.close()
