"""The object's sensors together: when a policy may begin."""

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.object_sensors import ObjectSensors


def test_a_policy_waits_for_the_first_picture_and_not_for_a_camera_that_has_ended():
    camera = SimpleNamespace(has_measurement=False, failure="")
    objects = ObjectSensors(np.zeros(3), camera, None)
    assert not objects.ready()
    camera.failure = "the camera sends no more pictures"
    with pytest.raises(HandError, match="no more pictures"):
        objects.ready()
    camera.has_measurement = True
    assert objects.ready() and ObjectSensors(np.zeros(3), None, None).ready()
