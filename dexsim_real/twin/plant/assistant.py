"""The assistant: an emulated person who places the object, releases it, and takes it away.

    AWAY -> (joint targets at the start posture, joints near it) -> HOLD -> (joint targets move) -> FREE -> AWAY

While away the object has its release orientation, so that an IMU in it can be aligned. Each object waits for the hand
to return to the start posture.
"""

import enum
from typing import NamedTuple

import mujoco
import numpy as np

from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.parameters import TrialParameters, skill_of
from dexsim_real.twin.plant.scene import Scene
from dexsim_real.twin.plant.shapes import ObjectShape, matrix, product, turn

ROTATE_PLACE = (0.007, 0.079)
"""Position along the palm (y, z) m of a right hand where a cube is placed: the centre of the start states in training.
Few of them are 5 mm nearer to the wrist, and a policy may miss an object there (docs/camera.md)."""
CLEAR_POSTURE = (1.2, 0.3, 0.3, 0.0, 0.8, 0.6, 0.8, 0.6, 0.8, 0.6, 0.8, 0.6)  # rad, of the XHand
CLEAR_REFERENCE, CLEAR_PLACE = (0.072, 0.005, 0.098), (0.066, 0.007, 0.099)
"""Nominal position, m, of a cube that turns clear of the palm, and where it is placed: the mean of the start states."""
CLEAR_AXIS = (0.6, 0.0, -0.8)  # about which it turns


class Start(NamedTuple):
    """Where the trials of a hand begin; palm frame."""

    posture: np.ndarray  # [J] rad
    reference: np.ndarray  # [3] m, nominal position of the object
    place: np.ndarray  # [2] m, y and z where it is placed on the palm; [3] m, x as well: between the fingertips
    axis: np.ndarray = np.array((1.0, 0.0, 0.0))  # about which it turns


def start_of(hand: Hand, task: str) -> Start:
    """The start by the hand's TOML. HandError: there is none in it."""
    if task == "rotate_clear":
        if hand.num_joints != len(CLEAR_POSTURE):
            raise HandError(f"{hand.name}: the emulated hand has the start of rotate_clear for the XHand only")
        mirror = np.array((1.0, hand.thumb_side, 1.0))
        reference, place = mirror * CLEAR_REFERENCE, mirror * CLEAR_PLACE
        return Start(np.array(CLEAR_POSTURE), reference, place, np.array(CLEAR_AXIS))
    if skill_of(task) == "grasp":
        posture, reference, names = hand.grasp_posture, hand.grasp_centre, "[grasp] with posture and centre"
        place = np.array(reference[1:])
    else:
        posture, reference, names = hand.rotate_posture, hand.rotate_reference, "[rotate] with posture and reference"
        place = np.array(ROTATE_PLACE) * (hand.thumb_side, 1.0)
    if not (posture and reference):
        raise HandError(f"{hand.name}: the emulated hand needs a {names} in its TOML")
    return Start(np.array(posture), np.array(reference), place)


MOUNT, CLEAR_MOUNT = (-0.2, -0.2), (-1.1, 0.0)
"""Pitch and roll, rad, of the hand that is palm up (rotate_clear: nearly upright, fingers down): wrist and thumb side
lowered, or raised where negative."""
GRAVITY = 9.81  # m/s^2
_ARRIVED, _LEFT = 0.002, 0.005  # rad, distance of targets from the start posture: arrived below, left above
_NEAR = 0.3  # rad, largest distance of a joint from the start posture
_OVERLAP = 0.0015  # m, largest overlap of object and hand where it is placed
_SHELF = np.array([0.35, 0.0, 0.0])  # m, waiting position relative to the release position
_PLACES = 60  # sampled for an object
_STEP, _STEPS = 0.001, 20  # m, and how many an object is moved down or up where fingers carry it


def nominal_gravity(task: str, thumb_side: float = 1.0) -> np.ndarray:
    """Gravity [3] m/s^2 in the palm frame: upside down to grasp, palm up on a leaning mount to rotate.

    `thumb_side` is the hand's (`Hand.thumb_side`), here and below.
    """
    if task == "grasp":
        return GRAVITY * np.array([1.0, 0.0, 0.0])
    pitch, roll = CLEAR_MOUNT if task == "rotate_clear" else MOUNT
    return GRAVITY * np.array([-np.cos(pitch) * np.cos(roll), thumb_side * np.sin(roll), -np.sin(pitch) * np.cos(roll)])


def tilted_gravity(task: str, tilt: np.ndarray, thumb_side: float = 1.0) -> np.ndarray:
    """Gravity [3] m/s^2 in the palm frame of a hand tilted by angles [2] rad about two horizontal axes."""
    down = nominal_gravity(task, thumb_side)
    way = down / GRAVITY
    side = np.array([0.0, 1.0, 0.0]) - way[1] * way  # the palm's y, made horizontal
    side = side / np.linalg.norm(side)
    for axis, angle in ((side, tilt[0]), (np.cross(way, side), tilt[1])):
        down = matrix(turn(axis, float(angle))) @ down
    return down


class Place(NamedTuple):
    """Release pose and velocity of an object, palm frame."""

    position: np.ndarray  # [3] m
    quat: np.ndarray  # [4]
    velocity: np.ndarray  # [3] m/s
    shelf: np.ndarray  # [3] m, where the object waits


def _sample_place(
    parameters: TrialParameters, shape: ObjectShape, rng: np.random.Generator, face: float, start: Start
) -> Place:
    if parameters.task != "grasp":
        quat = turn(start.axis, parameters.heading_error * rng.uniform(-1, 1))
        shift = parameters.place_error * rng.uniform(-1, 1, 2)
        gap, speed = 0.0005, 0.0
    else:
        # The long axis is across the fingers with a small error; the roll about it is uniform.
        roll, about, askew = rng.uniform(-1, 1, 3)
        quat = turn((0.0, 0.0, 1.0), roll * np.pi)
        for axis, angle in (((1, 0, 0), -np.pi / 2), ((0, 0, 1), 0.2 * askew), ((1, 0, 0), 0.5 * about)):
            quat = product(turn(axis, angle), quat)
        shift = 0.01 * rng.uniform(-1, 1, 2)
        gap, speed = parameters.gap, parameters.release_speed
    if len(start.place) == 3:
        position = start.place + (0.0, *shift)
    else:
        down = matrix(quat).T @ np.array([-1.0, 0.0, 0.0])
        position = np.array([face + gap + shape.reach(down), *(start.place + shift)])
    return Place(position, quat, np.array([speed, 0.0, 0.0]), position + _SHELF)


def find_place(
    scene: Scene,
    parameters: TrialParameters,
    shape: ObjectShape,
    rng: np.random.Generator,
    face: float,
    start: Start,
) -> Place | None:
    """Sample a release pose of the object over a palm at x = `face` m that the fingers in the start posture leave
    clear; None if there seems to be none."""
    data = mujoco.MjData(scene.model)
    scene.set_joints(data, start.posture)
    for _ in range(_PLACES):
        place = _sample_place(parameters, shape, rng, face, start)
        if len(start.place) == 3:
            place = _lower(scene, data, place)
        if place and is_clear(scene, data, place.position, place.quat):
            return place
    return None


def _lower(scene: Scene, data: mujoco.MjData, place: Place) -> Place | None:
    """Lower an object between the fingertips until they carry it; None if they do not, or leave no room."""
    up = -scene.model.opt.gravity / GRAVITY
    at = [place.position + step * _STEP * up for step in range(-_STEPS, _STEPS)]
    clear = [is_clear(scene, data, position, place.quat) for position in at]
    try:
        top = clear.index(True, _STEPS)
    except ValueError:
        return None
    lowest = next((k + 1 for k in range(top - 1, -1, -1) if not clear[k]), None)
    return None if lowest is None else place._replace(position=at[lowest], shelf=at[lowest] + _SHELF)


def is_clear(scene: Scene, data: mujoco.MjData, position: np.ndarray, quat: np.ndarray) -> bool:
    """Whether the object has room at a pose, with the joints as they are in `data`."""
    put(scene, data, position, quat)
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_collision(scene.model, data)
    touching = scene.is_object[data.contact.geom].any(-1) if data.ncon else np.zeros(0, bool)
    return bool(np.all(data.contact.dist[touching] > -_OVERLAP))


def put(scene: Scene, data: mujoco.MjData, position: np.ndarray, quat: np.ndarray, velocity: object = 0.0) -> None:
    """Set the object's pose, and its velocity [3] m/s."""
    at, dof = scene.object_qpos, scene.object_dof
    data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = position, quat
    data.qvel[dof : dof + 3], data.qvel[dof + 3 : dof + 6] = velocity, 0.0


class Stage(enum.Enum):
    """State of the object in a trial."""

    AWAY = "away"
    HOLD = "hold"
    FREE = "free"


class Assistant:
    """Decides the stage of a trial.

    Args:
      posture: [J] rad, where trials start.

    Attributes:
      reaction: s from the first motion of the targets to the release, a person's.
    """

    def __init__(self, posture: np.ndarray):
        self._posture, self.reaction = np.asarray(posture), 0.0
        self.begin()

    def begin(self) -> None:
        """Take the object away, and wait for the hand."""
        self.stage = Stage.AWAY
        self._moved: float | None = None  # s, when the targets left the start posture

    def watch(self, time: float, targets: np.ndarray | None, joints: np.ndarray) -> Stage:
        """Update the stage at a time in s by targets and joints [J] rad; targets are None when the motors are off."""
        if self.stage is Stage.FREE:
            return self.stage
        if targets is None:
            self.begin()
            return self.stage
        off = np.max(np.abs(targets - self._posture))
        if self.stage is Stage.AWAY:
            if off < _ARRIVED and np.max(np.abs(joints - self._posture)) < _NEAR:
                self.stage = Stage.HOLD
            return self.stage
        if self._moved is None and off > _LEFT:
            self._moved = time
        if self._moved is not None and time - self._moved >= self.reaction:
            self.stage = Stage.FREE
        return self.stage
