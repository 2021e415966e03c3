"""The emulated hand: one trial after another, from the object in an assistant's hand to the verdict.

C MuJoCo runs at 0.5 ms (`scene`), the firmware at 1 ms (`drives`), fingertips (`taxel_array`) and referee at 10 ms. The
palm frame is the world frame. All follows from the seed and the commands.

The assistant is an emulated person who places the object, releases it, and takes it away:

    AWAY -> (joint targets at the start posture, joints near it) -> HOLD -> (joint targets move) -> FREE -> AWAY

While away the object has its release orientation, so that an IMU in it can be aligned. Each object waits for the hand
to return to the start posture.
"""

import collections
import dataclasses
import enum
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.drives import PERIOD, Drives
from dexsim_real.twin.plant.hand_model import own_model, read_model
from dexsim_real.twin.plant.parameters import (
    EXCHANGE_SENSE,
    GRAVITY,
    OF_THE_FILE,
    PUSHES,
    STRUCTURE,
    Start,
    TrialParameters,
    sample_trial,
    skill_of,
    start_of,
)
from dexsim_real.twin.plant.referee import ON_PALM, Look, Referee
from dexsim_real.twin.plant.scene import Scene, TipContact, build_scene, palm_face, tip_contacts, tip_forces
from dexsim_real.twin.plant.shapes import ObjectShape, matrix, product, sample_shape, turn
from dexsim_real.twin.plant.taxel_array import EmulatedTaxels
from dexsim_real.wire.frames import Mode

PALM_FACE = 0.020  # m, x of the emulated hand's palm
IMU_TRANSPORT = 0.0017  # s for the bytes of an orientation
_MEMORY = 0.2  # s, longest delay of a sensor
_LOOK = 0.01  # s between two samples of the fingertips, and updates of the referee
_OBJECTS, _PLACES = 200, 60  # sampled for a trial, until one has room between the fingers; places for an object
_ARRIVED, _LEFT = 0.002, 0.005  # rad, distance of targets from the start posture: arrived below, left above
_NEAR = 0.3  # rad, largest distance of a joint from the start posture
_OVERLAP = 0.0015  # m, largest overlap of object and hand where it is placed
_STEP, _STEPS = 0.001, 20  # m, and how many an object is moved down or up where fingers carry it
_SINK, _SPRING = 0.3, (3.0, 0.05)  # s, and Nm/rad and Nm s/rad of the fingers, for an object to come to rest on them
_SHELF = np.array([0.35, 0.0, 0.0])  # m, waiting position relative to the release position


class Stage(enum.Enum):
    """State of the object in a trial."""

    AWAY = "away"
    HOLD = "hold"
    FREE = "free"


@dataclasses.dataclass(frozen=True)
class PlantMeasurement:
    """Readings of the emulated hand's sensors at one time, before the quantisation of the wire."""

    joint_position: np.ndarray  # [12] rad, from the encoders
    joint_velocity: np.ndarray  # [12] rad/s
    current: np.ndarray  # [12] mA, positive when opening
    temperature: np.ndarray  # [12] degC, of the motors
    taxel_force: np.ndarray  # [5, 120, 3] N along x, y, z of the wire; z points into the tip


class _Past(NamedTuple):
    """The state at one time, from which delayed sensors read."""

    qpos: np.ndarray
    qvel: np.ndarray
    acceleration: np.ndarray  # [3] of the object
    current: np.ndarray


@dataclasses.dataclass(eq=False)
class EmulatedHand:
    """A hand with an object, trial after trial, none of which depends on another. The owner advances its time.

    Raises HandError: the plant model does not fit the hand, or decides an overridden parameter itself.
    """

    hand: Hand
    task: str  # of `parameters.TASKS`
    seed: int = 0  # of all random numbers
    _: dataclasses.KW_ONLY
    trials: int | None = None  # number of trials, after which the hand stays empty; None is no limit
    kind: str = "outside"  # of `parameters.KINDS`
    overrides: Mapping[str, float] | None = None  # fixed parameters (`sample_trial`)
    seconds: float | None = None  # time limit of a trial; None is that of the task
    shape_name: str | None = None  # of the objects (grasp); None samples one per trial
    first: int = 0  # number of the first trial
    axis: Sequence[float] = ()  # of rotation [3], of a right hand; empty: that of the task
    plant_model: str | Path | None = None  # MJCF (`hand_model.read_model`) whose body and contacts replace our own

    def __post_init__(self) -> None:
        hand = self.hand
        self._model = read_model(self.plant_model, hand) if self.plant_model else own_model(hand)
        if self.plant_model and (own := sorted(OF_THE_FILE & set(self.overrides or ()))):
            raise HandError(f"{own[0]} is not a parameter of a plant model: change it in {self.plant_model}")
        self._drives = Drives(hand.torque_limit, hand.speed_limit)
        self._skin = EmulatedTaxels(hand, by_point=self._model.foreign)
        self.time, self._ticks, self._due = 0.0, 0, 0.0
        self._command: np.ndarray | None = None
        # The fingers of a hand without commands are slightly bent.
        self._joints = np.clip(0.3, hand.joint_lower, hand.joint_upper).astype(float)
        self.start = start_of(hand, self.task, self.axis)
        self._done: list[dict[str, Any]] = []
        self.trial = self.first - 1
        self._next_trial()

    def drive(self, command: np.ndarray) -> None:
        """Set a new `frames.COMMAND_BLOCK`, effective from now."""
        self._command = command
        self._drives.send(self.time, command)

    def advance(self, seconds: float) -> None:
        """Simulate this duration in s; a remainder below 1 ms is kept for the next call."""
        self._due += seconds
        while self._due >= self._period - 1e-12:
            self._due -= self._period
            self._before()
            self._step()
            self._joints = self._data.qpos[self._scene.drive_qpos].copy()
            self._ticks += 1
            self.time = self._ticks * self._period
            self._remember()
            if self._ticks % self._look_every == 0:
                self._sample_skin()
                self._look()

    def measure(self) -> PlantMeasurement:
        """Readings of the hand's sensors, each with its delay."""
        parameters, rng = self.parameters, self._noise
        late = max(parameters.sensing_latency - EXCHANGE_SENSE, 0.0)
        past = self._past_state(late)
        encoder = past.qpos[self._scene.drive_qpos] + self._drives.bias
        encoder = encoder + parameters.encoder_noise * rng.standard_normal(encoder.shape)
        current = past.current * parameters.current_gain
        current = current + parameters.current_noise * rng.standard_normal(current.shape)
        taxels = next((f for time, f in reversed(self._samples) if time <= self.time - late + 1e-9), self._no_force)
        return PlantMeasurement(
            joint_velocity=past.qvel[self._scene.drive_dof],
            joint_position=encoder,
            current=-1000.0 * current,
            temperature=self._drives.case.copy(),
            taxel_force=self._skin.report(taxels, rng, self.time - self._began),
        )

    def measure_object(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position [3] m from a camera's masks; orientation [4] and acceleration [3] m/s^2 from an IMU in the object.

        All with delay, noise and bias.
        """
        parameters, rng, at = self.parameters, self._object_noise, self._scene.object_qpos
        position = self._past_state(parameters.camera_delay).qpos[at : at + 3]
        position = position + parameters.camera_noise * rng.standard_normal(3)
        past = self._past_state(max(getattr(parameters, "imu_delay", 0.0) - IMU_TRANSPORT, 0.0))
        quat = past.qpos[at + 3 : at + 7].copy()
        specific_force = matrix(quat).T @ (past.acceleration - self._gravity)
        if self.task == "grasp":
            return position, quat, specific_force
        heading = turn(self.up, parameters.imu_drift * (self.time - self._began))
        error = parameters.imu_bias + parameters.imu_noise * rng.standard_normal(3)
        angle = float(np.linalg.norm(error))
        skew = turn(error / max(angle, 1e-12), angle)
        return position, product(product(heading, quat), skew), specific_force

    def true_pose(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """True joint angles [12] rad; position [3] m and orientation [4] of the object."""
        qpos, scene, at = self._data.qpos.copy(), self._scene, self._scene.object_qpos
        return qpos[scene.drive_qpos] + qpos[scene.play_qpos], qpos[at : at + 3], qpos[at + 3 : at + 7]

    def results(self) -> list[dict[str, Any]]:
        """True results of all trials so far, including the current one; JSON-able."""
        return [*self._done] if self._finished else [*self._done, self._report()]

    # --- trials ---------------------------------------------------------------------------------

    @property
    def _finished(self) -> bool:
        return self.trials is not None and self.trial >= self.first + self.trials

    def _next_trial(self) -> None:
        self.trial += 1
        self._take_away()
        if self._finished:
            return
        rng = np.random.default_rng([self.seed, self.trial])
        for _ in range(_OBJECTS):  # Some fit nowhere between the fingers: sample another.
            parameters = sample_trial(self.task, rng, self.kind, self.overrides, self.hand)
            shape = sample_shape(parameters, rng, self.shape_name, self.start.upright)
            scene = self._draw(parameters, shape)
            own = next((float(geom.position[0]) for geom in self.hand.geoms if geom.kind == "plane"), PALM_FACE)
            self._palm_face = palm_face(scene, self.start.place[-2:]) if self._model.foreign else own
            place = find_place(scene, parameters, shape, rng, self._palm_face, self.start)
            if place is not None:
                break
        else:
            raise HandError(f"trial {self.trial}: none of {_OBJECTS} objects had room in the hand's start posture")
        self._enter(scene, rng)
        self._place, self._pushes = place, Pushes(parameters, rng.spawn(1)[0])
        self._referee = Referee(self.task, self.start, self.seconds, self.hand.num_fingers)
        self.limit = self._referee.limit  # s, of a trial
        put(scene, self._data, place.position + _SHELF, place.quat)
        mujoco.mj_forward(scene.model, self._data)
        self._remember()

    def _draw(self, parameters: TrialParameters, shape: ObjectShape) -> Scene:
        """The scene of another object, in which `_enter` begins."""
        self.parameters, self.shape = parameters, shape
        self._gravity = tilted(self.start.gravity, parameters.gravity_tilt)
        self.up = -self._gravity / GRAVITY  # [3] the true vertical in the palm frame
        return build_scene(self._model, parameters, shape, self._gravity)

    def _enter(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin in a scene. A period has whole time steps, about as many as the firmware's."""
        self._scene, self._data, step = scene, mujoco.MjData(scene.model), scene.model.opt.timestep
        self._substeps = max(round(PERIOD / step), 1)
        self._period = self._substeps * step
        self._look_every = max(round(_LOOK / self._period), 1)
        self._noise, self._object_noise = rng.spawn(2)
        self._drives.configure(self.parameters)
        self._skin.configure(self.parameters, rng)
        scene.set_joints(self._data, self._joints)
        self._began = self.time
        self._touches: list[TipContact] = []
        self._no_force = np.zeros((*self.hand.taxel_position.shape[:2], 3))
        self._past: collections.deque[_Past] = collections.deque(maxlen=round(_MEMORY / self._period))
        self._samples = collections.deque([(self.time, self._no_force)], maxlen=round(_MEMORY / _LOOK) + 2)

    def _report(self) -> dict[str, Any]:
        left_out = STRUCTURE.keys() | (OF_THE_FILE if self._model.foreign else set())
        values = {name: value for name, value in self.parameters.value.items() if name not in left_out}
        return {
            "trial": self.trial,
            "task": self.task,
            "seed": self.seed,
            "parameter_kind": self.kind,
            "plant": self._model.name,
            "shape": self.shape.name,
            "parts": [{k: v if k == "kind" else list(v) for k, v in vars(part).items()} for part in self.shape.parts],
            "stage": self.stage.value,
            **self._referee.report(),
            "parameters": {name: np.round(value, 6).tolist() for name, value in values.items()},
        }

    # --- one firmware period --------------------------------------------------------------------

    def _before(self) -> None:
        """Forces on the object for the next period."""
        if self.stage is Stage.FREE:
            self._data.xfrc_applied[self._scene.object_body][:3] = self._pushes.force(self.time)

    def _step(self) -> None:
        scene, data = self._scene, self._data
        torque, friction = self._drives.step(self.time, data.qpos[scene.drive_qpos], data.qvel[scene.drive_dof])
        data.qfrc_applied[scene.drive_dof] = torque
        scene.model.dof_frictionloss[scene.drive_dof] = friction
        if self.stage is Stage.FREE:
            mujoco.mj_step(scene.model, data, self._substeps)
            return
        position = self._place.position if self.stage is Stage.HOLD else self._place.position + _SHELF
        for _ in range(self._substeps):
            put(scene, data, position, self._place.quat)
            mujoco.mj_step(scene.model, data)

    def _remember(self) -> None:
        data, dof = self._data, self._scene.object_dof
        acceleration = data.qacc[dof : dof + 3].copy() if self.stage is Stage.FREE else np.zeros(3)
        self._past.append(_Past(data.qpos.copy(), data.qvel.copy(), acceleration, self._drives.current))

    def _past_state(self, age: float) -> _Past:
        """The state `age` s ago, or the oldest one stored."""
        return self._past[-1 - min(round(age / self._period), len(self._past) - 1)]

    def _sample_skin(self) -> None:
        scene, data, body = self._scene, self._data, self._scene.object_body
        self._touches = tip_contacts(scene, data)
        tips = data.site_xpos[scene.tip_site], data.site_xmat[scene.tip_site].reshape(-1, 3, 3)
        rotation = data.xmat[body].reshape(3, 3)
        force = self._skin.load(self.shape, data.xpos[body], rotation, tips, self._touches)
        self._samples.append((self.time, force))

    def _look(self) -> None:
        if self.stage is Stage.FREE:
            self._judge()
        elif not self._finished:
            self._assist()

    def _judge(self) -> None:
        scene, data, dof, at = self._scene, self._data, self._scene.object_dof, self._scene.object_qpos
        quat = data.qpos[at + 3 : at + 7].copy()
        force, normal = tip_forces(self._touches, self.hand.num_fingers)
        look = Look(
            position=data.qpos[at : at + 3].copy(),
            quat=quat,
            velocity=matrix(quat) @ data.qvel[dof + 3 : dof + 6],
            height=float(data.qpos[at]) - self.shape.below(quat) - self._palm_face,
            force=np.linalg.norm(force, axis=-1),
            normal=normal,
            taxels=self._samples[-1][1][..., 2].sum(-1),
            joint_position=self.true_pose()[0],
            joint_speed=data.qvel[scene.drive_dof],
            limited=bool(self._drives.at_limit().any()),
            disturbed=bool(self._pushes.last.any()),
        )
        self._referee.watch(self._look_every * self._period, look)
        if not np.isfinite(data.qpos).all() or data.warning.number.any():
            self._referee.end = "dropped: the physics failed"
        if self._referee.end:
            self._done.append(self._report())
            self._next_trial()

    def _take_away(self) -> None:
        """Take the object away, and wait for the hand."""
        self.stage = Stage.AWAY
        self._moved: float | None = None  # s, when the targets left the start posture

    def _assist(self) -> None:
        """What the assistant does now. Released is the object some time after the targets have moved, as by a person,
        and without motors not at all."""
        command, posture = self._command, self.start.posture
        if command is None or np.any(command["mode"] != Mode.POSITION):
            self._take_away()
            return
        off = np.max(np.abs(command["position"].astype(float) - posture))
        if self.stage is Stage.AWAY:
            if off < _ARRIVED and np.max(np.abs(self._joints - posture)) < _NEAR:
                self.stage = Stage.HOLD
            return
        if self._moved is None and off > _LEFT:
            self._moved = self.time
        reaction = float(self.parameters.value.get("reaction", 0.0))
        if self._moved is not None and self.time - self._moved >= reaction:
            self.stage = Stage.FREE
            put(self._scene, self._data, *self._place)
            self._pushes.begin(self.time)


class Pushes:
    """The pushes of one trial on its object: a constant force for a short time, at random times and in random ways."""

    def __init__(self, parameters: TrialParameters, rng: np.random.Generator):
        self._parameters, self._rng = parameters, rng
        self.last = np.zeros(3)  # N, of the last period
        self._until = self._at = np.inf  # s, end of the push that acts; beginning of the next

    def begin(self, time: float) -> None:
        """The object is free from a time in s."""
        rate = PUSHES[skill_of(self._parameters.task)][0] * self._parameters.push_rate
        self._at = time + self._rng.exponential(1 / rate) if rate > 0 else np.inf

    def force(self, time: float) -> np.ndarray:
        """The force [3] N on the object at a time in s."""
        if time >= self._until:
            self.last, self._until = np.zeros(3), np.inf
        if time >= self._at:
            parameters, direction = self._parameters, self._rng.standard_normal(3)
            change = PUSHES[skill_of(parameters.task)][1] * self._rng.random() * direction / np.linalg.norm(direction)
            self.last = parameters.mass * change / parameters.push_seconds
            self._until = time + parameters.push_seconds
            self.begin(time)
        return self.last


# --- mount and place of a trial ----------------------------------------------------------------------


def tilted(gravity: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Gravity [3] m/s^2 in the palm frame of a hand tilted by angles [2] rad about two horizontal axes."""
    way = gravity / GRAVITY
    side = np.array([0.0, 1.0, 0.0]) - way[1] * way  # the palm's y, made horizontal
    side = side / np.linalg.norm(side)
    for axis, angle in ((side, tilt[0]), (np.cross(way, side), tilt[1])):
        gravity = matrix(turn(axis, float(angle))) @ gravity
    return gravity


class Place(NamedTuple):
    """Release pose and velocity of an object, palm frame."""

    position: np.ndarray  # [3] m
    quat: np.ndarray  # [4]
    velocity: np.ndarray  # [3] m/s


def find_place(
    scene: Scene, parameters: TrialParameters, shape: ObjectShape, rng: np.random.Generator, face: float, start: Start
) -> Place | None:
    """Sample a release pose of the object over a palm at x = `face` m that the fingers in the start posture leave
    clear; None if there seems to be none."""
    data = mujoco.MjData(scene.model)
    scene.set_joints(data, start.posture)
    for _ in range(_PLACES):
        if parameters.task != "grasp":
            quat = turn(start.upright, parameters.heading_error * rng.uniform(-1, 1))
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
        if start.clear:
            position = lower(scene, data, start.place + (0.0, *shift), quat)
        else:
            position = np.array([face + gap + shape.below(quat), *(start.place + shift)])
        if position is not None and is_clear(scene, data, position, quat):
            place = Place(position, quat, np.array([speed, 0.0, 0.0]))
            if not start.clear or rests_on_fingers(scene, place, shape, face, start):
                return place
    return None


def rests_on_fingers(scene: Scene, place: Place, shape: ObjectShape, face: float, start: Start) -> bool:
    """Whether an object that is let go stays off the palm, as in training, while the fingers keep their posture."""
    data, at = mujoco.MjData(scene.model), scene.object_qpos
    scene.set_joints(data, start.posture)
    put(scene, data, place.position, place.quat)
    for _ in range(round(_SINK / scene.model.opt.timestep)):
        off, speed = start.posture - data.qpos[scene.drive_qpos], data.qvel[scene.drive_dof]
        data.qfrc_applied[scene.drive_dof] = _SPRING[0] * off - _SPRING[1] * speed
        mujoco.mj_step(scene.model, data)
        if data.qpos[at] - shape.below(data.qpos[at + 3 : at + 7]) - face < ON_PALM:
            return False
    return True


def lower(scene: Scene, data: mujoco.MjData, place: np.ndarray, quat: np.ndarray) -> np.ndarray | None:
    """Where fingertips carry an object that is lowered between them at `place` [3] m; None: nowhere, or no room."""
    up = -scene.model.opt.gravity / GRAVITY
    positions = [place + step * _STEP * up for step in range(-_STEPS, _STEPS)]
    clear = [is_clear(scene, data, position, quat) for position in positions]
    top = next((k for k in range(_STEPS, 2 * _STEPS) if clear[k]), None)
    below = None if top is None else next((k for k in range(top - 1, -1, -1) if not clear[k]), None)
    return None if below is None else positions[below + 1]


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
