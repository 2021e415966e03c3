"""Runs in virtual time: the bridge's parts against the emulated hand, event by event."""

import json
import math

import numpy as np
import pytest
from emulated_plant import free

from dexsim_ppo.policy import load_policy
from dexsim_real.control.controller import Tick
from dexsim_real.sensors.camera import CameraConfig
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.shapes import SHAPES
from dexsim_real.twin.virtual import RATE, VirtualPort, VirtualRun, virtual_camera
from dexsim_real.twin.wire import picture

OPTICS = CameraConfig()
CALM = {"camera_noise": 0.0, "camera_delay": 0.0, "push_rate": 0.0, "heading_error": 0.0, "place_error": 0.0}


class Scripted:
    """A controller whose targets are a function of the tick's number."""

    period = 0.03

    def __init__(self, hand, task, script):
        self.hand, self.spec, self.sources = hand, load_policy(task).spec, {"imu"}
        self._script, self.ticks = script, 0

    def start(self, target):
        self.target = np.array(target)

    def tick(self, measured, seen, goal, command):
        self.ticks += 1
        return Tick(None, None, None, self._script(self.ticks, self.target).astype(np.float32))


def test_a_run_goes_through_the_wire_and_is_judged_by_the_referee(hand, monkeypatch):
    """With one target that is too far away; an exchange begins every 12 ms, and its answer is there 9.6 ms later."""
    monkeypatch.setattr("dexsim_real.twin.virtual._APPROACH", 1.0)
    far = 0.8 * (np.arange(12) == 4)
    plant = EmulatedHand(hand, "rotate", 4, kind="nominal", trials=1, seconds=0.5, overrides=CALM)
    controller = Scripted(hand, "rotate", lambda k, target: target + 0.02 * min(k, 4) + far * (k == 9))
    run = VirtualRun(plant, controller, 0.25)
    update, heard = run.safety.update, []
    run.safety.update = lambda sample: heard.append(sample.time) or update(sample)
    list(run.ticking())
    report = run.report()
    assert report["end"] == "time limit" and report["seconds"] == pytest.approx(0.5) and report["command"] == 0.25
    assert report["bridge"]["successes"] == run.policy.goals.successes == 0
    assert any(name.startswith("target beyond a limit") for name in run.safety.counts)
    assert abs(controller.ticks * controller.period - 0.5) < 0.15
    assert run.port.sequence == pytest.approx(plant.time * RATE, abs=12)  # The tare is not paced.
    assert heard[0] == pytest.approx(0.0096) and np.ptp(np.diff(heard)[40:] - 1 / RATE) < 1e-9
    assert json.loads(json.dumps(report)) == report


def test_the_camera_measures_the_height(hand):
    spec = load_policy("grasp").spec
    reference = np.array(spec.reference)
    for shape in SHAPES:
        plant = EmulatedHand(hand, "grasp", 3, kind="nominal", overrides=CALM, shape_name=shape)
        port = VirtualPort(plant)
        camera = virtual_camera(port, spec)
        free(plant, reference + (0.01, 0.0, 0.0))
        port.sleep(0.002)
        _, position, _ = camera.newest
        assert position[1:] == pytest.approx(reference[1:])
        if shape == "sphere":  # Its outline by a pinhole: a cone of half angle asin(r / d), nearly a circle.
            radius = 600 * math.tan(math.asin(plant.shape.parts[0].size[0] / math.dist(OPTICS.position, position)))
            assert picture(plant, OPTICS).sum() == pytest.approx(math.pi * radius**2, rel=0.03)
        # A composition's outline has another middle than the composition.
        assert position[0] == pytest.approx(reference[0] + 0.01, abs=0.001 if shape != "composition" else 0.006)
