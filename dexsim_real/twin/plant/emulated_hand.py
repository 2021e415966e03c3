"""The physics of the emulated hand: a `Plant` that runs one trial after another.

C MuJoCo runs at 0.5 ms (`scene`), the firmware at 1 ms (`drives`), fingertips (`taxel_array`) and referee at 10 ms. An
assistant places the objects. The palm frame is the world frame. All follows from the seed and the commands.
"""

import collections
from typing import Any, NamedTuple

import mujoco
import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.assistant import PALM_FACE, Assistant, Place, Stage, clear, find_place, put
from dexsim_real.twin.plant.contacts import tip_contacts
from dexsim_real.twin.plant.drives import PERIOD, Drives
from dexsim_real.twin.plant.mount import GRAVITY, tilted_gravity
from dexsim_real.twin.plant.parameters import EXCHANGE_SENSE, TrialParameters, sample_trial
from dexsim_real.twin.plant.protocol import MotorCommands, PlantMeasurement
from dexsim_real.twin.plant.pushes import Pushes
from dexsim_real.twin.plant.referee import Referee
from dexsim_real.twin.plant.scene import Scene, build_scene
from dexsim_real.twin.plant.shapes import ObjectShape, matrix, product, sample_shape, turn
from dexsim_real.twin.plant.taxel_array import EmulatedTaxels
from dexsim_real.wire.frames import Mode

IMU_TRANSPORT = 0.0017  # s for the bytes of an orientation
_LOOK = 0.01  # s between two updates of the referee
_OBJECTS = 200  # sampled for a trial, until one has room between the fingers
_MEMORY = 0.2  # s, longest delay of a sensor


class _Past(NamedTuple):
    """The state at one time, from which delayed sensors read."""

    qpos: np.ndarray
    qvel: np.ndarray
    acceleration: np.ndarray  # [3] of the object
    current: np.ndarray


class EmulatedHand:
    """A hand with an object, trial after trial.

    Args:
      hand: model of the hand.
      task: "grasp" or "rotate".
      seed: of all random numbers.
      trials: number of trials, after which the hand stays empty; None is no limit.
      kind: "outside", "inside" or "nominal" (`parameters.KINDS`).
      overrides: fixed parameters (`sample_trial`).
      seconds: time limit of a trial; None is that of the task.
      command: grip command of the runner; only noted in the results.
      shape: name of the objects (grasp); None samples one per trial.
      first: number of the first trial. A trial does not depend on the trials before it.
    """

    def __init__(
        self,
        hand: Hand,
        task: str,
        seed: int = 0,
        *,
        trials: int | None = None,
        kind: str = "outside",
        overrides: dict[str, float | str] | None = None,
        seconds: float | None = None,
        command: float | None = None,
        shape: str | None = None,
        first: int = 0,
    ):
        self.hand, self.task, self.seed, self.kind = hand, task, seed, kind
        self.command, self._end = command, None if trials is None else first + trials
        self._overrides, self._seconds, self._shape = overrides, seconds, shape
        self._assistant = Assistant(task)
        self._make_parts()
        self._done: list[dict[str, Any]] = []
        self.time, self._ticks, self._due = 0.0, 0, 0.0
        self._commands: MotorCommands | None = None
        # The fingers of a hand without commands are slightly bent.
        self._rest = np.clip(0.3, hand.joint_lower, hand.joint_upper).astype(float)
        self._data: Any = None  # `mujoco.MjData` from the first trial on
        self.trial = first - 1
        self._next_trial()

    # --- the interface --------------------------------------------------------------------------

    def drive(self, motors: MotorCommands) -> None:
        """Set new motor commands, effective from now."""
        self._commands = motors
        self._drives.send(self.time, motors)

    def advance(self, seconds: float) -> None:
        """Simulate this duration in s; a remainder below 1 ms is kept for the next call."""
        self._due += seconds
        while self._due >= self._period - 1e-12:
            self._due -= self._period
            self._tick()

    def measure(self) -> PlantMeasurement:
        """Readings of the hand's sensors, each with its delay."""
        late = max(float(self.parameters.sensing_latency) - EXCHANGE_SENSE, 0.0)
        past, rng = self._before(late), self._noise
        position, quat, acceleration = self.measure_object()
        encoder = past.qpos[self._scene.drive_qpos] + self._drives.bias
        return PlantMeasurement(
            time=self.time,
            joint_velocity=past.qvel[self._scene.drive_dof],
            joint_position=encoder + self.parameters.encoder_noise * rng.standard_normal(encoder.shape),
            current=self._reported_current(past),
            temperature=self._drives.case.copy(),
            taxel_force=self._skin.report(self._delayed_taxel_force(late), rng, self.time - self._began),
            object_quat=quat,
            object_position=position,
            object_acceleration=acceleration,
        )

    def measure_object(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position [3] m from a camera's masks; orientation [4] and acceleration [3] m/s^2 from an IMU in the object.

        All with delay, noise and bias.
        """
        parameters, rng = self.parameters, self._object_noise
        at = self._scene.object_qpos
        position = self._before(float(parameters.camera_delay)).qpos[at : at + 3]
        position = position + parameters.camera_noise * rng.standard_normal(3)
        past = self._before(max(float(getattr(parameters, "imu_delay", 0.0)) - IMU_TRANSPORT, 0.0))
        quat = past.qpos[at + 3 : at + 7].copy()
        specific_force = matrix(quat).T @ (past.acceleration - self._gravity)
        if self.task != "rotate":
            return position, quat, specific_force
        heading = turn(self.up, float(parameters.imu_drift) * (self.time - self._began))
        error = parameters.imu_bias + parameters.imu_noise * rng.standard_normal(3)
        angle = float(np.linalg.norm(error))
        skew = turn(error / max(angle, 1e-12), angle)
        return position, product(product(heading, quat), skew), specific_force

    def true_pose(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """True joint angles [12] rad; position [3] m and orientation [4] of the object."""
        qpos, scene, at = self._data.qpos.copy(), self._scene, self._scene.object_qpos
        play = 0.0 if scene.play_qpos is None else qpos[scene.play_qpos]
        return qpos[scene.drive_qpos] + play, qpos[at : at + 3], qpos[at + 3 : at + 7]

    def warm(self, joint: int, degrees: float) -> None:
        """Heat a motor by this many K (a fault); cool it if negative."""
        self._drives.winding[joint] += degrees
        self._drives.case[joint] += degrees

    def results(self) -> list[dict[str, Any]]:
        """True results of all trials so far, including the current one."""
        return [*self._done] if self._finished else [*self._done, self._report()]

    @property
    def up(self) -> np.ndarray:
        """[3] the true vertical in the palm frame."""
        return -self._gravity / GRAVITY

    @property
    def limit(self) -> float:
        """Time limit of a trial in s."""
        return self._referee.limit

    @property
    def stage(self) -> Stage:
        """State of the object."""
        return self._assistant.stage

    # --- trials ---------------------------------------------------------------------------------

    def _make_parts(self) -> None:
        self._drives: Any = Drives(self.hand.torque_limit, self.hand.speed_limit)
        self._skin = EmulatedTaxels(self.hand)

    def _build(self) -> Scene:
        self._palm_face = PALM_FACE
        return build_scene(self.hand, self.parameters, self.shape, self._gravity)

    def _next_trial(self) -> None:
        self.trial += 1
        if self._finished:
            self._assistant.begin(self.time)
            return
        rng = np.random.default_rng([self.seed, self.trial])
        joints = self._rest if self._data is None else self._joints()
        for _ in range(_OBJECTS):  # Some fit nowhere between the fingers: sample another.
            self.parameters: TrialParameters = sample_trial(self.task, rng, self.kind, self._overrides)
            self.shape: ObjectShape = sample_shape(self.parameters, rng, self._shape)
            self._gravity = tilted_gravity(self.task, self.parameters.gravity_tilt)
            scene = self._build()
            place = find_place(scene, self.parameters, self.shape, rng, self._palm_face)
            if place is not None:
                break
        else:
            raise HandError(f"trial {self.trial}: none of {_OBJECTS} objects had room in the hand's start posture")
        self._enter(scene, place)
        self._noise, self._object_noise, pushing = rng.spawn(3)
        self._pushes = Pushes(self.parameters, pushing)
        self._drives.configure(self.parameters)
        self._skin.configure(self.parameters, rng)
        self._data = mujoco.MjData(scene.model)
        self._data.qpos[scene.drive_qpos] = joints
        self._assistant.begin(self.time)
        self._referee = Referee(self.task, self._seconds)
        self._began, self._hottest = self.time, 0.0
        put(scene, self._data, self._assistant.shelf(place), place.quat)
        mujoco.mj_forward(scene.model, self._data)
        self._tips, self._normal = np.zeros((5, 3)), np.zeros(5)
        self._touches: list[Any] = []
        self._past: collections.deque[_Past] = collections.deque(maxlen=round(_MEMORY / self._period))
        self._samples = collections.deque[Any](maxlen=round(_MEMORY / float(self.parameters.taxel_period)) + 2)
        self._next_sample = self.time
        self._remember()

    @property
    def _finished(self) -> bool:
        return self._end is not None and self.trial >= self._end

    def _joints(self) -> np.ndarray:
        return self._data.qpos[self._scene.drive_qpos].copy()

    def _enter(self, scene: Scene, place: Place) -> None:
        """Take the scene of a new trial. A period has whole time steps, about as many as the firmware's."""
        self._scene, self._place, step = scene, place, scene.model.opt.timestep
        self._substeps = max(round(PERIOD / step), 1)
        self._period = self._substeps * step
        self._look_every = max(round(_LOOK / self._period), 1)

    def _report(self) -> dict[str, Any]:
        return {
            "trial": self.trial,
            "task": self.task,
            "seed": self.seed,
            "parameter_kind": self.kind,
            "command": self.command,
            "shape": self.shape.name,
            "stage": self.stage.value,
            "hottest": round(self._hottest, 2),
            **self._referee.report(),
            "parameters": self.parameters.summary(),
        }

    # --- one firmware period --------------------------------------------------------------------

    def _tick(self) -> None:
        scene, data = self._scene, self._data
        self._power()
        if self.stage is Stage.FREE:
            self._pushes.apply(self.time, data.xfrc_applied[scene.object_body][:3])
            mujoco.mj_step(scene.model, data, self._substeps)
        else:
            held = self._place.position if self.stage is Stage.HOLD else self._assistant.shelf(self._place)
            for _ in range(self._substeps):
                put(scene, data, held, self._place.quat)
                mujoco.mj_step(scene.model, data)
        self._ticks += 1
        self.time = self._ticks * self._period
        self._remember()
        if self.time >= self._next_sample - 1e-9:
            self._next_sample += float(self.parameters.taxel_period)
            self._sample_skin()
        if self._ticks % self._look_every == 0:
            self._look()

    def _power(self) -> None:
        """The drives' torques and friction for the next period."""
        scene, data = self._scene, self._data
        rotor, speed = data.qpos[scene.drive_qpos], data.qvel[scene.drive_dof]
        torque, friction = self._drives.step(self.time, rotor, speed)
        data.qfrc_applied[scene.drive_dof] = torque
        scene.model.dof_frictionloss[scene.drive_dof] = friction

    def _look(self) -> None:
        scene, data = self._scene, self._data
        dof, at = scene.object_dof, scene.object_qpos
        if self.stage is Stage.FREE:
            self._contacts()
            quat = data.qpos[at + 3 : at + 7]
            spin = matrix(quat) @ data.qvel[dof + 3 : dof + 6]
            self._referee.watch(
                self._look_every * self._period,
                data.qpos[at : at + 3].copy(),
                quat.copy(),
                spin,
                self._tips,
                self._normal,
                self._samples[-1][1][..., 2].sum(-1) if self._samples else np.zeros(5),
                data.qvel[scene.drive_dof],
                self._drives.at_limit(),
            )
            self._hottest = max(self._hottest, float(self._drives.case.max()))
            if not np.isfinite(data.qpos).all() or data.warning.number.any():
                self._referee.end = "dropped: the physics failed"
            if self._referee.over:
                self._done.append(self._report())
                self._next_trial()
            return
        before, commands = self.stage, self._commands
        targets = commands.position if commands is not None and np.all(commands.mode == Mode.POSITION) else None
        if self._finished:
            return
        free = self._place_is_clear() if self._assistant.wants_clearance(self.time) else None
        if self._assistant.watch(self.time, targets, self._joints(), free) is Stage.FREE and before is Stage.HOLD:
            put(scene, data, self._place.position, self._place.quat, self._place.velocity)
            self._pushes.begin(self.time)

    def _place_is_clear(self) -> bool:
        probe = mujoco.MjData(self._scene.model)
        probe.qpos[:] = self._data.qpos
        return clear(self._scene, probe, self._place)

    # --- sensors --------------------------------------------------------------------------------

    def _contacts(self) -> None:
        """Update the forces of the object on the fingertips."""
        self._tips, self._normal, self._touches = tip_contacts(self._scene, self._data)

    def _sample_skin(self) -> None:
        self._contacts()
        scene, data = self._scene, self._data
        force = np.zeros((5, self.hand.num_taxels, 3))
        if self._touches:
            tips = data.site_xpos[scene.tip_site], data.site_xmat[scene.tip_site].reshape(-1, 3, 3)
            force = self._skin.load(
                self.shape,
                data.xpos[scene.object_body],
                data.xmat[scene.object_body].reshape(3, 3),
                tips,
                self._touches,
            )
        self._samples.append((self.time, force))

    def _remember(self) -> None:
        data, dof = self._data, self._scene.object_dof
        acceleration = data.qacc[dof : dof + 3].copy() if self.stage is Stage.FREE else np.zeros(3)
        self._past.append(_Past(data.qpos.copy(), data.qvel.copy(), acceleration, self._drives.current))

    def _before(self, age: float) -> _Past:
        """The state `age` s ago, or the oldest one stored."""
        back = min(round(age / self._period), len(self._past) - 1)
        return self._past[-1 - back]

    def _delayed_taxel_force(self, late: float) -> np.ndarray:
        taken = (force for time, force in reversed(self._samples) if time <= self.time - late + 1e-9)
        return next(taken, np.zeros((5, self.hand.num_taxels, 3)))

    def _reported_current(self, past: _Past) -> np.ndarray:
        """Reported current [12] mA, positive when opening."""
        noise = float(self.parameters.current_noise) * self._noise.standard_normal(past.current.shape)
        return -1000.0 * (past.current * self.parameters.current_gain + noise)
