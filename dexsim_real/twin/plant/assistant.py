"""Whoever puts the object into the hand: waits for the start posture, holds it in place, lets go, takes it away.

    AWAY -> (targets stand at the start posture, joints near it) -> HOLD -> (targets move on) -> FREE -> AWAY

While away the object has the orientation that it will be put down with, so that an IMU in it can be aligned. A
runner that goes on after a drop never returns to the start posture: when `patience` is over and the object's place
is clear, the assistant gives it the next object as its fingers are.
"""

import dataclasses
import enum

import mujoco
import numpy as np

from dexsim_real.twin.plant import shapes
from dexsim_real.twin.plant.parameters import TrialParameters
from dexsim_real.twin.plant.scene import Scene
from dexsim_real.twin.plant.shapes import ObjectShape, product, turn

POSTURES = {
    "grasp": (1.45, 0.15, 0.25, 0.0, 1.1, 0.8, 1.1, 0.8, 1.1, 0.8, 1.1, 0.8),
    "rotate": (1.0, 0.2, 0.3, 0.0, 0.8, 0.5, 0.8, 0.5, 0.8, 0.5, 0.8, 0.5),
}
"""Joint angles rad at which a run begins."""
REFERENCES = {"grasp": (0.055, -0.005, 0.090), "rotate": (0.047, 0.024, 0.088)}
"""Where the object belongs, m."""
PLACES = {"grasp": REFERENCES["grasp"][1:], "rotate": (0.007, 0.079)}
"""Where along the palm (y, z) it is put, m: in the middle of training's start states. 5 mm nearer to the wrist is where
hardly any of them lies, and a policy's first strokes may miss it there (`docs/hardware.md` tells users so)."""
PALM_FACE = 0.020  # m, x of the palm's surface
_ARRIVED, _LEFT = 0.002, 0.005  # rad, targets off the start posture: arrived within, gone beyond
_NEAR = 0.3  # rad, joints off it: the hand stands there as well as its gears let it
_OVERLAP = 0.0015  # m that object and hand may share where it is put
_SHELF = np.array([0.35, 0.0, 0.0])  # m from its place, where an object waits
_HAND_OVER = 0.5  # s of holding before letting go, for a runner that goes on


class Stage(enum.Enum):
    """Where the object is."""

    AWAY = "away"
    HOLD = "hold"
    FREE = "free"


@dataclasses.dataclass(frozen=True)
class Place:
    """Where and how fast an object is let go, palm frame."""

    position: np.ndarray  # [3] m
    quat: np.ndarray  # [4]
    velocity: np.ndarray  # [3] m/s


def sample_place(parameters: TrialParameters, shape: ObjectShape, rng: np.random.Generator) -> Place:
    """A place to let go of the object, whether the fingers leave it free or not."""
    if parameters.task == "rotate":
        quat = turn((1.0, 0.0, 0.0), float(parameters.heading_error) * rng.uniform(-1, 1))
        shift = float(parameters.place_error) * rng.uniform(-1, 1, 2)
        gap, speed = 0.0005, 0.0
    else:
        # Long objects lie across the fingers, a little askew; their roll is free.
        roll, about, askew = rng.uniform(-1, 1, 3)
        quat = turn((0.0, 0.0, 1.0), roll * np.pi)
        for axis, angle in (((1, 0, 0), -np.pi / 2), ((0, 0, 1), 0.2 * askew), ((1, 0, 0), 0.5 * about)):
            quat = product(turn(axis, angle), quat)
        shift = 0.01 * rng.uniform(-1, 1, 2)
        gap, speed = float(parameters.gap), float(parameters.release_speed)
    up = shapes.matrix(quat).T @ np.array([-1.0, 0.0, 0.0])
    position = np.array([PALM_FACE + gap + shape.reach(up), *(PLACES[parameters.task] + shift)])
    return Place(position, quat, np.array([speed, 0.0, 0.0]))


def find_place(scene: Scene, parameters: TrialParameters, shape: ObjectShape, rng: np.random.Generator) -> Place | None:
    """A place where the hand in its start posture leaves the object free; None when there seems to be none."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.drive_qpos] = POSTURES[parameters.task]
    for _ in range(60):
        place = sample_place(parameters, shape, rng)
        if clear(scene, data, place):
            return place
    return None


def clear(scene: Scene, data: mujoco.MjData, place: Place) -> bool:
    """Whether the hand, as `data` has it, leaves the object's place free. Moves the object there."""
    put(scene, data, place.position, place.quat)
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_collision(scene.model, data)
    touching = scene.is_object[data.contact.geom].any(-1) if data.ncon else np.zeros(0, bool)
    return bool(np.all(data.contact.dist[touching] > -_OVERLAP))


def put(
    scene: Scene, data: mujoco.MjData, position: np.ndarray, quat: np.ndarray, velocity: np.ndarray | None = None
) -> None:
    """Place the object, at rest or with a velocity [3] m/s."""
    at, dof = scene.object_qpos, scene.object_dof
    data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = position, quat
    data.qvel[dof : dof + 6] = 0.0
    if velocity is not None:
        data.qvel[dof : dof + 3] = velocity


class Assistant:
    """The stage of a trial.

    Args:
      patience: s after which a runner that does not return to the start posture is served as it is.
    """

    def __init__(self, task: str, patience: float = 15.0):
        self._posture, self._patience = np.array(POSTURES[task]), patience
        self.begin(0.0)

    def begin(self, time: float) -> None:
        """Take the object away and wait for the hand."""
        self.stage, self._since, self._held, self._on = Stage.AWAY, time, None, False

    def watch(self, time: float, targets: np.ndarray | None, joints: np.ndarray, free: bool | None) -> Stage:
        """The stage after one more look.

        Args:
          targets: [12] rad that the motors follow; None when they are off.
          joints: [12] rad.
          free: whether the object's place is clear of the hand; None when nobody looked (see `curious`).
        """
        if self.stage is Stage.FREE:
            return self.stage
        if targets is None:
            self.begin(time)
            return self.stage
        if not self._on:  # Patience is with a runner at work, not with a hand that is switched off.
            self._on, self._since = True, time
        off = np.max(np.abs(targets - self._posture))
        if self.stage is Stage.AWAY:
            if off < _ARRIVED and np.max(np.abs(joints - self._posture)) < _NEAR:
                self.stage, self._held = Stage.HOLD, None
            elif free and self.curious(time):
                self.stage, self._held = Stage.HOLD, time
        elif self._held is None and off > _LEFT or self._held is not None and time - self._held > _HAND_OVER:
            self.stage = Stage.FREE
        return self.stage

    def curious(self, time: float) -> bool:
        """Whether it would serve a hand that is not in its start posture."""
        return self.stage is Stage.AWAY and self._on and time - self._since > self._patience

    def shelf(self, place: Place) -> np.ndarray:
        """Where the object waits, [3] m."""
        return place.position + _SHELF
