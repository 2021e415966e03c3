"""The environment: rooms composed into pure `reset` and `step` functions.

    action -> actuator -> physics -> touch -> Readings -> observe -> observation

All functions are written for one environment and vmapped by the caller. The state is a frozen
pytree of arrays; there is no hidden state and no automatic reset: `step` returns the true final
observation, and `restart` puts a new episode in its place where asked.

A task (grasp, rotate) is an object with pure methods; see `Task`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from dexsim import actuator, observation, rotations, tactile
from dexsim.config import setting, validate
from dexsim.control import Control, move_target, recalled
from dexsim.hand import Hand, HandPose, forward_kinematics, taxel_normals, taxel_positions
from dexsim.objects import ObjectConfig, ObjectParams
from dexsim.observation import Motion, ObservationConfig, Readings
from dexsim.orientation_sensor import (
    OrientationSensor,
    SensorDraw,
    draw_sensor,
    measure_orientation,
)
from dexsim.physics import Physics, PhysicsConfig, PhysicsState
from dexsim.pytree import pytree_dataclass
from dexsim.randomization import Draw, Randomization
from dexsim.randomization import sample as sample_draw
from dexsim.render import Snapshot


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensing:
    """Noise, filtering and resolution of what the hand measures."""

    joint_noise: float = setting(0.003, unit="rad", low=0.0, high=0.5)
    """White noise on joint angles."""
    joint_resolution: float = setting(0.0005, unit="rad", low=0.0, high=0.1)
    """Step of a joint angle reading (12 bits over a turn and a gear); 0 for none."""
    torque_noise: float = setting(0.01, unit="1", low=0.0, high=1.0)
    """White noise on normalised joint torque."""
    object_noise: float = setting(0.002, unit="m", low=0.0, high=0.1)
    """White noise on the object's position."""
    object_axes: tuple[bool, bool, bool] = setting((True, False, False))
    """Which coordinates of the object are measured; the others are fixed at the reference, as
    in the paper, where the camera gives only the height."""
    velocity_filter: float = setting(0.5, unit="1", low=0.01, high=1.0)
    """Weight of the newest difference in the object's velocity estimate."""
    orientation: OrientationSensor = setting(OrientationSensor())
    """The IMU inside the object."""
    taxel: tactile.TaxelSensor = setting(tactile.TaxelSensor())
    """The taxels."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """What every task configures."""

    physics: PhysicsConfig = setting(PhysicsConfig())
    """Time step, solver and contact model."""
    objects: ObjectConfig = setting(ObjectConfig())
    """What is held."""
    randomization: Randomization = setting(Randomization())
    """What is drawn at every episode start."""
    control: Control = setting(Control())
    """From action to joint target."""
    sensing: Sensing = setting(Sensing())
    """From truth to readings."""
    skin: tactile.Skin = setting(tactile.Skin())
    """The rubber over the taxels."""
    observation: ObservationConfig = setting(ObservationConfig())
    """What the policy sees."""
    pool_size: int = setting(2048, unit="1", low=1, high=1_000_000)
    """Start states generated once; every episode starts from one of them."""
    touch: bool = setting(True)
    """Feel with the taxels; off only to measure their cost."""


@pytree_dataclass
class Start:
    """A start state of the pool."""

    qpos: jax.Array
    qvel: jax.Array
    target: ObjectParams
    joint_target: jax.Array | None = None  # [J] rad; None: where the joints are


@pytree_dataclass
class Sample:
    """What the sensors see at one instant, before latency, noise and counts."""

    joint_position: jax.Array  # [J] rad
    joint_torque: jax.Array  # [J] 1
    taxel_force: jax.Array  # [F, N] N
    object_position: jax.Array  # [3] m
    object_quat: jax.Array  # [4]


@pytree_dataclass
class Moment:
    """The truth after a tick: what reward, termination and the critic may look at."""

    target: ObjectParams
    joint_position: jax.Array  # [J] rad
    joint_velocity: jax.Array  # [J] rad/s
    joint_torque: jax.Array  # [J] Nm
    pose: HandPose
    finger_force: jax.Array  # [F, 3] N, of the object on the finger tips
    touch: tactile.Touch
    object_position: jax.Array  # [3] m
    object_quat: jax.Array  # [4]
    object_velocity: jax.Array  # [3] m/s
    object_spin: jax.Array  # [3] rad/s
    action: jax.Array  # [J]
    last_action: jax.Array  # [J]


@pytree_dataclass
class State:
    """Everything that an environment carries from tick to tick."""

    key: jax.Array
    physics: PhysicsState
    target: ObjectParams
    draw: Draw
    orientation_sensor: SensorDraw
    goal: Any  # the task's own pytree
    joint_target: jax.Array  # [J] rad
    action: jax.Array  # [J], the last one applied
    sample: Sample
    object_velocity: jax.Array  # [3] m/s, filtered estimate of the readings
    readings: Readings
    finger_force: jax.Array  # [F] N, true resultant forces
    tick: jax.Array  # [] int32 since the episode began (may begin staggered)
    length: jax.Array  # [] int32 ticks lived
    episode_return: jax.Array  # []
    obs: dict[str, jax.Array]
    reward: jax.Array  # []
    terminated: jax.Array  # [] bool
    truncated: jax.Array  # [] bool
    metrics: dict[str, jax.Array]


class Task(Protocol):
    """What a task adds. All methods are pure and written for one environment."""

    name: str
    config: Any
    fields: dict[str, tuple[str, ...]]  # observation fields of "actor" and "critic"
    gravity: tuple[float, float, float]  # m/s^2, palm frame
    reference: tuple[float, float, float]  # m, where the object belongs
    episode_ticks: int
    slots: tuple[str, ...]
    largest: np.ndarray  # [K, 3] m, upper bound of each slot's size
    evaluation_ticks: int
    evaluation: str  # "series" or "totals": what `summarize` is given, see `Env.summarize`
    object_ranges: tuple[str, ...]  # paths in `config` of what is drawn for every object

    def draw_object(self, key: jax.Array, config: Any,
                    shape_index: jax.Array | None = None) -> ObjectParams: ...
    def make_pool(self, key: jax.Array) -> Start: ...
    def begin(self, key: jax.Array, start: Start) -> Any: ...
    def update(self, key: jax.Array, goal: Any, moment: Moment) -> Any: ...
    def goal_readings(self, goal: Any) -> tuple[jax.Array, jax.Array]: ...
    def push(self, key: jax.Array, target: ObjectParams) -> jax.Array: ...
    def reward(self, goal: Any, moment: Moment,
               dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]: ...
    def dropped(self, goal: Any, moment: Moment) -> jax.Array: ...
    def target_force(self, goal: Any) -> jax.Array: ...
    def evaluation_plan(self, count: int, shape_index: np.ndarray) -> tuple[np.ndarray, Any]: ...
    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray,
                  control_period: float) -> dict: ...


class Env:
    """A task on a hand: `reset(key)`, `step(state, action)`, `restart(state, done)`."""

    def __init__(self, task: Task, hand: Hand, *, backend: str = "auto", num_envs: int = 1,
                 seed: int = 0):
        """Compile the scene and fill the pool of start states.

        Args:
          task: the task with its configuration.
          hand: the hand.
          backend: "auto", "jax" or "warp".
          num_envs: batch size that the Warp buffers are sized for.
          seed: of the pool.

        Raises:
          AssetError, ConfigError: see `Physics`, `load_hand`.
        """
        self.task, self.name, self.config = task, task.name, task.config
        self.hand = hand
        config = self.config
        self.physics = Physics(self.hand, task.slots, task.largest, config.physics,
                               gravity=task.gravity, backend=backend, num_envs=num_envs,
                               skin=config.skin)
        self.backend = self.physics.backend
        self.action_size = self.hand.num_joints
        # What is left out is left out of the actor; a critic may always look.
        self._seen = {group: config.observation if group == "actor" else dataclasses.replace(
            config.observation, leave_out=()) for group in task.fields}
        self.observation_layout = {
            group: observation.layout(self.hand, names, self._seen[group])
            for group, names in task.fields.items()}
        self._up = -jnp.asarray(task.gravity) / np.linalg.norm(task.gravity)
        self.primitive_kinds = task.slots
        self.pool = task.make_pool(jax.random.key(seed))

    @property
    def control_period(self) -> float:
        """One control tick, s."""
        return self.config.physics.control_period

    @property
    def control_rate(self) -> float:
        """Control ticks per second, Hz."""
        return 1.0 / self.control_period

    # --- life of an episode ---------------------------------------------------------------

    def reset(self, key: jax.Array) -> State:
        """A new episode from a random start state."""
        key, pick = jax.random.split(key)
        count = self.pool.qpos.shape[0]
        return self.reset_to(key, jax.random.randint(pick, (), 0, count))

    def reset_to(self, key: jax.Array, index: jax.Array, goal: Any = None) -> State:
        """A new episode from row `index` of the pool, with the task's goal or the given one."""
        key, draw_key, goal_key, noise_key, sensor_key = jax.random.split(key, 5)
        start = jax.tree.map(lambda rows: jnp.asarray(rows)[index], self.pool)
        config, hand = self.config, self.hand
        draw, sensor = self._draw(draw_key, sensor_key)
        if goal is None:
            goal = self.task.begin(goal_key, start)
        joints = start.qpos[self.physics.joint_qpos]
        zero = jnp.zeros(hand.num_joints)
        place = start.qpos[self.physics.object_qpos]
        sample = Sample(joints, zero, jnp.zeros(hand.taxel_area.shape), place[:3], place[3:])
        joint_target = joints if start.joint_target is None else start.joint_target
        readings = self._read(noise_key, sample, sample, draw, sensor, goal,
                              recalled(config.control, hand, zero, joint_target))
        physics = PhysicsState(start.qpos, start.qvel, jnp.zeros(self.physics.mj_model.nv))
        moment = self._moment(physics, start.target, zero, zero, zero,
                              jnp.zeros((hand.num_fingers, 3)))
        false = jnp.zeros((), bool)
        _, metrics = self.task.reward(goal, moment, false)
        state = State(
            key=key, physics=physics, target=start.target, draw=draw, orientation_sensor=sensor,
            goal=goal, joint_target=joint_target,
            action=zero, sample=sample, object_velocity=jnp.zeros(3),
            readings=readings, finger_force=jnp.zeros(hand.num_fingers),
            tick=jnp.zeros((), jnp.int32), length=jnp.zeros((), jnp.int32),
            episode_return=jnp.zeros(()), obs=self._observe(readings, moment, goal),
            reward=jnp.zeros(()), terminated=false, truncated=false, metrics={})
        return dataclasses.replace(state, metrics=self._metrics(state, metrics))

    def step(self, state: State, action: jax.Array) -> State:
        """One control tick. `action` [J] is clipped to [-1, 1]. No automatic reset."""
        key, push_key, goal_key, noise_key = jax.random.split(state.key, 4)
        sound = jnp.all(jnp.isfinite(action))
        action = jnp.where(sound, jnp.clip(action, -1.0, 1.0), 0.0)
        physics, hand, draw = self.physics, self.hand, state.draw
        measured = state.physics.qpos[physics.joint_qpos]
        joint_target = self._joint_target(state.joint_target, action, measured)

        push = self.task.push(push_key, state.target) + self._tilt_force(draw, state.target)
        after, force, torque = self._drive(state, joint_target, push)
        # A diverging solver passes through speeds that are finite and square to 1e27 in the reward.
        finite = (sound & jnp.all(jnp.isfinite(after.qpos)) & jnp.all(jnp.abs(after.qvel) < 1e3)
                  & jnp.all(jnp.isfinite(force)))
        # A world that has blown up ends its episode here; its numbers must not spread.
        after = jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, state.physics)
        force = jnp.where(finite, force, 0.0)

        last = torque(after)
        moment = self._moment(after, state.target, last, action, state.action, force)
        goal = self.task.update(goal_key, state.goal, moment)
        sample = Sample(moment.joint_position, last / hand.torque_limit,
                        moment.touch.force, moment.object_position, moment.object_quat)
        readings = self._read(noise_key, sample, state.sample, draw, state.orientation_sensor,
                              goal, recalled(self.config.control, hand, action, joint_target),
                              state)
        dropped = self.task.dropped(goal, moment) | ~finite
        reward, metrics = self.task.reward(state.goal, moment, dropped)
        tick = state.tick + 1
        state = State(
            key=key, physics=after, target=state.target, draw=draw,
            orientation_sensor=state.orientation_sensor, goal=goal,
            joint_target=joint_target, action=action, sample=sample,
            object_velocity=readings.object_velocity, readings=readings,
            finger_force=jnp.linalg.norm(force, axis=-1), tick=tick, length=state.length + 1,
            episode_return=state.episode_return + reward,
            obs=self._observe(readings, moment, goal), reward=reward, terminated=dropped,
            truncated=(tick >= self.task.episode_ticks) & ~dropped, metrics={})
        return dataclasses.replace(state, metrics=self._metrics(state, metrics, finite))

    def restart(self, state: State, done: jax.Array) -> State:
        """`state`, or where `done` the first state of a new episode from the pool."""
        key, fresh_key = jax.random.split(state.key)
        fresh = self.reset(fresh_key)
        state = dataclasses.replace(state, key=key)
        return jax.tree.map(lambda new, old: _where(done, new, old), fresh, state)

    def stagger(self, state: State, key: jax.Array) -> State:
        """`state` with a random clock, so that a batch's time limits do not fall together."""
        tick = jax.random.randint(key, (), 0, self.task.episode_ticks)
        return dataclasses.replace(state, tick=tick.astype(jnp.int32))

    # --- pieces of a step -----------------------------------------------------------------

    def _draw(self, hand_key: jax.Array, sensor_key: jax.Array) -> tuple[Draw, SensorDraw]:
        """The hand and the object's IMU of one episode."""
        config = self.config
        draw = sample_draw(hand_key, config.randomization, self.hand,
                           timestep=config.physics.timestep, control_period=self.control_period)
        sensor = draw_sensor(sensor_key, config.sensing.orientation, config.randomization.scale,
                             self.control_period)
        return draw, sensor

    def _drive(self, state: State, joint_target: jax.Array, push: jax.Array
               ) -> tuple[PhysicsState, jax.Array, Callable[[PhysicsState], jax.Array]]:
        """A tick of physics under the motors.

        Returns:
          The state after it, the fingers' forces [F, 3] N, and a function of a state: the torque
          [J] Nm that the motors give there, at the end of the tick.
        """
        seam, torque = self.physics, self._torque(state, joint_target)
        after, force = seam.advance(state.target, state.physics,
                                    self._with_friction(state.draw, torque), push)
        return after, force, lambda at: torque(jnp.asarray(self.config.physics.substeps),
                                               at.qpos[seam.joint_qpos], at.qvel[seam.joint_dof])

    def _torque(self, state: State, joint_target: jax.Array) -> Callable[..., jax.Array]:
        """The motors as `Physics.advance` wants them."""
        draw = state.draw

        def torque(substep: jax.Array, position: jax.Array, velocity: jax.Array) -> jax.Array:
            target = actuator.delayed_target(substep, draw.latency, state.joint_target,
                                             joint_target)
            return actuator.drive(draw.actuator, target, jnp.zeros_like(target), position,
                                  velocity)
        return torque

    def _with_friction(self, draw: Draw, torque: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
        """The motors' torque less what friction in the gears keeps; readings show the former."""
        model, dofs = self.physics.mj_model, self.physics.joint_dof
        inertia_rate = jnp.asarray(model.dof_M0[dofs] / model.opt.timestep, jnp.float32)

        def net_torque(substep: jax.Array, position: jax.Array, velocity: jax.Array) -> jax.Array:
            return actuator.apply_friction(draw.actuator, torque(substep, position, velocity),
                                           velocity, inertia_rate)
        return net_torque

    def _joint_target(self, target: jax.Array, action: jax.Array,
                      measured: jax.Array) -> jax.Array:
        return move_target(self.config.control, self.hand, target, action, measured)

    def _tilt_force(self, draw: Draw, target: ObjectParams) -> jax.Array:
        """The object's share of a tilted gravity, N; the links' share is small and left out."""
        gravity = jnp.asarray(self.task.gravity)
        down = gravity / jnp.linalg.norm(gravity)
        side = jnp.array([down[1], down[2], down[0]])
        side = side - jnp.sum(side * down) * down
        side = side / jnp.linalg.norm(side)
        other = jnp.cross(down, side)
        tilted = down + jnp.tan(draw.tilt[0]) * side + jnp.tan(draw.tilt[1]) * other
        tilted = tilted / jnp.linalg.norm(tilted)
        return target.mass * jnp.linalg.norm(gravity) * (tilted - down)

    def _moment(self, physics: PhysicsState, target: ObjectParams, torque: jax.Array,
                action: jax.Array, last_action: jax.Array, force: jax.Array) -> Moment:
        seam, hand, config = self.physics, self.hand, self.config
        joints = physics.qpos[seam.joint_qpos]
        place, motion = physics.qpos[seam.object_qpos], physics.qvel[seam.object_dof]
        pose = forward_kinematics(hand, joints)
        quat = place[3:] / jnp.linalg.norm(place[3:])
        strength = jnp.linalg.norm(force, axis=-1)
        if config.touch:
            touch = tactile.feel(taxel_positions(hand, pose), jnp.asarray(hand.taxel_area),
                                 target.shape(), place[:3], rotations.quat_to_matrix(quat),
                                 strength, config.skin)
            if config.skin.total == "pressing":
                touch = tactile.press_only(touch, taxel_normals(hand, pose), force)
        else:
            nothing = jnp.zeros(hand.taxel_area.shape)
            touch = tactile.Touch(nothing, nothing, nothing)
        return Moment(
            target=target, joint_position=joints, joint_velocity=physics.qvel[seam.joint_dof],
            joint_torque=torque, pose=pose, finger_force=force, touch=touch,
            object_position=place[:3], object_quat=quat, object_velocity=motion[:3],
            object_spin=rotations.rotate(rotations.quat_to_matrix(quat), motion[3:]),
            action=action, last_action=last_action)

    def _read(self, key: jax.Array, sample: Sample, before: Sample, draw: Draw,
              sensor: SensorDraw, goal: Any, last_action: jax.Array,
              state: State | None = None) -> Readings:
        """Latency, noise and counts between the truth and the host; no `state` at a reset."""
        sensing, config = self.config.sensing, self.config
        age = draw.sensing_latency
        late = jax.tree.map(lambda new, old: (1 - age) * new + age * old, sample, before)
        keys = jax.random.split(key, 5)
        joints = late.joint_position + draw.encoder_bias
        joints = joints + sensing.joint_noise * jax.random.normal(keys[0], joints.shape)
        if sensing.joint_resolution > 0:
            joints = jnp.round(joints / sensing.joint_resolution) * sensing.joint_resolution
        torque = late.joint_torque * draw.torque_gain
        torque = torque + sensing.torque_noise * jax.random.normal(keys[1], torque.shape)
        if config.touch:
            taxels = tactile.measure_taxels(late.taxel_force, draw.taxel_gain, sensing.taxel,
                                            keys[2])
        else:
            taxels = late.taxel_force
        noise = sensing.object_noise * jax.random.normal(keys[3], (3,))
        position = jnp.where(jnp.array(sensing.object_axes), late.object_position + noise,
                             jnp.asarray(self.task.reference))
        velocity = jnp.zeros(3)
        if state is not None:
            step = (position - state.readings.object_position) / self.control_period
            velocity = state.object_velocity
            velocity = velocity + sensing.velocity_filter * (step - velocity)
        command, goal_quat = self.task.goal_readings(goal)
        # At a reset the sensor has just read for the first time.
        length, held = (jnp.zeros(()), sample.object_quat) if state is None else (
            state.length + 1.0, state.readings.object_quat)
        quat = measure_orientation(keys[4], sensing.orientation, sensor, length,
                                   sample.object_quat, before.object_quat, held, self._up,
                                   self.control_period)
        return Readings(joints, torque, taxels, position, velocity, quat, goal_quat, command,
                        last_action)

    def _observe(self, readings: Readings, moment: Moment, goal: Any) -> dict[str, jax.Array]:
        """The actor sees the readings; the critic the truth, in the same fields."""
        command, goal_quat = self.task.goal_readings(goal)
        truth = Readings(
            moment.joint_position, moment.joint_torque / self.hand.torque_limit,
            moment.touch.force, moment.object_position, moment.object_velocity,
            moment.object_quat, goal_quat, command, readings.last_action)
        seen = {"actor": readings, "critic": truth}
        motion = Motion(moment.joint_velocity, moment.object_spin)
        return {group: observation.observe(self.hand, seen[group], names, self._seen[group], motion)
                for group, names in self.task.fields.items()}

    def _metrics(self, state: State, terms: dict[str, jax.Array],
                 finite: jax.Array | bool = True) -> dict[str, jax.Array]:
        return {**terms, "return": state.episode_return,
                "length": state.length.astype(jnp.float32),
                "shape": state.target.shape_index.astype(jnp.float32),
                "non_finite": 1.0 - jnp.asarray(finite, jnp.float32)}

    # --- evaluation and pictures ----------------------------------------------------------

    @property
    def evaluation(self) -> str:
        """What `summarize` wants: "series" or "totals"."""
        return self.task.evaluation

    @property
    def evaluation_steps(self) -> int:
        """Length of an evaluation episode, ticks."""
        return self.task.evaluation_ticks

    def evaluation_starts(self, key: jax.Array, count: int) -> State:
        """[count] start states by the task's fixed protocol."""
        index, goal = self.task.evaluation_plan(count, np.asarray(self.pool.target.shape_index))
        keys = jax.random.split(key, count)
        return jax.vmap(self.reset_to)(keys, jnp.asarray(index), goal)

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict:
        """The task's report of an evaluation (host).

        A task of kind "series" gets metrics [T, N] and alive [T, N]; one of kind "totals" those
        of each episode's last tick [N] and the ticks lived [N].
        """
        return self.task.summarize(metrics, alive, self.control_period)

    def snapshot(self, state: State) -> Snapshot:
        """What a frame of video shows."""
        place = state.physics.qpos[self.physics.object_qpos]
        shape = state.target.shape()
        return Snapshot(
            joint_position=state.physics.qpos[self.physics.joint_qpos],
            object_position=place[:3], object_rotation=rotations.quat_to_matrix(place[3:]),
            primitive_size=shape.size, primitive_position=shape.position,
            primitive_rotation=shape.rotation, primitive_active=shape.active,
            taxel_force=state.readings.taxel_force, command=state.readings.command,
            target_force=self.task.target_force(state.goal), finger_force=state.finger_force)


def _where(done: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    if jnp.issubdtype(old.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.where(done, jax.random.key_data(new),
                                                  jax.random.key_data(old)))
    return jnp.where(done, new, old)
