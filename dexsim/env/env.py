"""The environment: parts composed into pure `reset` and `step` functions.

    action -> control -> motors' law -> physics -> ground truth -> sensors -> observation -> task (reward, end)

All functions are written for one environment and vmapped by the caller. The state is a frozen pytree of arrays; there
is no hidden state and no automatic reset: `step` returns the true final observation, and `restart` puts a new episode
in its place where asked.

A task (grasp, rotate) is an object with pure methods; see `dexsim.Task`. Evaluation and pictures of an environment are
in `dexsim.env.evaluation`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.control import move_target, observed_action
from dexsim.core.pytree import choose
from dexsim.core.ranges import sample_extreme
from dexsim.env.motors import JointCommand, Motors, check_timestep
from dexsim.env.sensors import SensorInput, SensorSuite
from dexsim.env.state import Episode, Start, State
from dexsim.env.task import GroundTruth, Task, reward_of
from dexsim.errors import ConfigError
from dexsim.geometry import grid, rotations, surface_points
from dexsim.geometry.rotations import length
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import forward_kinematics
from dexsim.objects.config import ObjectConfig, load_mesh_object
from dexsim.objects.params import ObjectParams, resample_properties, toward_nominal
from dexsim.physics.interface import PhysicsState, StepResult
from dexsim.physics.physics import Physics, revert_if_diverged
from dexsim.randomization import sample_hand, tilted_down
from dexsim.sensing.imu import sample_imu
from dexsim.task_spec import TaskSpec, correct_readings
from dexsim.touch.taxel_force import compute_touch, project_on_normals


class Env:
    """A task on a hand: `reset(key)`, `step(state, action)`, `restart(state, done)`."""

    def __init__(self, task: Task, hand: Hand, *, backend: str = "auto", seed: int = 0):
        """Compile the scene for `backend` ("auto", "c", "cuda" or "mjx") and fill the pool of start states by `seed`;
        evaluations have pools of their own.

        Raises:
          AssetError, ConfigError: see `Physics`, `load_hand`, `check_timestep`.
        """
        config = task.config
        check_timestep(hand, config.physics, config.randomization)
        self.task, self.name, self.config, self.hand = task, task.name, config, hand
        self.spec = TaskSpec.of(task).mirror_for(hand)  # what a host must know to run this task's policies
        self.spec.check_hand(hand)
        given: dict[str, Any] = {"gravity": task.gravity, "backend": backend, "pad_thickness": config.skin.margin}
        self.physics = Physics(hand, task.slots, task.largest, config.physics, **given)
        self.backend, self.action_size, self.primitive_kinds = self.physics.backend, hand.num_joints, task.slots
        self.motors = Motors(self.physics)
        self.touch_geometry = touch_geometry(config.objects, config.touch_method)
        self.sensors = SensorSuite(config, hand, task)
        self.observation_layout = self.sensors.layout
        self.control_period = config.physics.control_period
        """One control tick, s."""
        self.pool = task.make_pool(jax.random.key(seed))

    def reset(self, key: jax.Array, scale: jax.Array | None = None) -> State:
        """A new episode from a random start state.

        `scale` [] in [0, 1] narrows what is drawn about nominal, now and at restarts; see `set_randomization_scale`.
        """
        key, pick = jax.random.split(key)
        index = jax.random.randint(pick, (), 0, self.pool.qpos.shape[0])
        return self.reset_from(key, jax.tree.map(lambda rows: jnp.asarray(rows)[index], self.pool), scale=scale)

    def reset_from(self, key: jax.Array, start: Start, goal: Any = None, scale: jax.Array | None = None) -> State:
        """A new episode from this start state, with the task's goal or the given one: its poses and shape, with the
        object's physical properties, hand and sensors drawn by `key`."""
        key, hand_key, goal_key, noise_key, sensor_key, object_key = jax.random.split(key, 6)
        episode = sample_episode(self.sensors, (hand_key, sensor_key, object_key), start.object, scale)
        start = dataclasses.replace(start, object=episode.object)
        goal = self.task.begin(goal_key, start) if goal is None else goal
        joints = start.qpos[self.physics.joint_qpos]
        target, zero = joints if start.joint_target is None else start.joint_target, jnp.zeros(self.action_size)
        command = JointCommand(action=zero, target=target, previous=target, valid=jnp.ones((), bool))
        rest = PhysicsState(start.qpos, start.qvel, jnp.zeros(self.physics.mj_model.nv))
        result, torque = StepResult(rest, jnp.zeros((self.hand.num_fingers, 3))), (zero, jnp.zeros(zero.shape, bool))
        truth = self._ground_truth(episode, result, torque, zero, zero)
        false, none = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        _, metrics = reward_of(self.task, goal, truth, false)  # an episode's start earns nothing
        return State(
            key=key,
            episode=episode,
            physics=rest,
            previous_target=target,
            tick=none,
            length=none,
            episode_return=jnp.zeros(()),
            reward=jnp.zeros(()),
            terminated=false,
            truncated=false,
            metrics=metrics | _common_metrics(episode, truth, jnp.zeros(()), none, ~false),
            scale=scale,
            **self._observe(noise_key, episode, command, goal, truth, None),
        )

    def step(self, state: State, action: jax.Array) -> State:
        """One control tick. `action` [J] is clipped to [-1, 1]. No automatic reset.

        Raises:
          ConfigError: the action has another shape.
        """
        if (shape := jnp.shape(action)) != (self.action_size,):
            raise ConfigError(f"action: expected shape ({self.action_size},), got {shape}")
        key, push_key, goal_key, noise_key = jax.random.split(state.key, 4)
        episode, hand = state.episode, state.episode.hand

        command = self._control(state, action)
        law = self.motors.law(hand, command)
        push = self.task.push(push_key, episode.object) + self._tilt_force(episode)
        held, delta = self.task.held(state.goal), hand.pad_thickness_delta
        fields = self.physics.fields(episode.object, state.tip_stiffness, delta)
        result = self.physics.advance(law, fields, state.physics, push, held)
        result, finite = revert_if_diverged(result, state.physics, command.valid)
        torque = self.motors.current_torque(hand, command, result.state)
        truth = self._ground_truth(episode, result, torque, command.action, state.action)

        goal = self.task.update(goal_key, state.goal, truth)
        observed = self._observe(noise_key, episode, command, goal, truth, state)
        terminated = self.task.dropped(goal, truth) | ~finite
        reward, metrics = reward_of(self.task, state.goal, truth, terminated)
        tick, ticks, total = state.tick + 1, state.length + 1, state.episode_return + reward
        return dataclasses.replace(
            state,
            key=key,
            physics=result.state,
            previous_target=state.joint_target,
            tick=tick,
            length=ticks,
            episode_return=total,
            reward=reward,
            terminated=terminated,
            truncated=(tick >= self.task.episode_ticks) & ~terminated,
            metrics=metrics | _common_metrics(episode, truth, total, ticks, finite),
            **observed,
        )

    def restart(self, state: State, done: jax.Array) -> State:
        """`state`, or where `done` the first state of a new episode from the pool."""
        key, fresh_key = jax.random.split(state.key)
        fresh = self.reset(fresh_key, state.scale)
        return choose(done, fresh, dataclasses.replace(state, key=key))

    def randomize_episode_time(self, state: State, key: jax.Array) -> State:
        """`state` with a random clock, so that a batch's time limits do not fall together."""
        tick = jax.random.randint(key, (), 0, self.task.episode_ticks)
        return dataclasses.replace(state, tick=tick.astype(jnp.int32))

    def set_randomization_scale(self, state: State, scale: jax.Array) -> State:
        """`state`, whose next episodes are drawn from ranges of this width [] in [0, 1].

        It must come from a reset with a scale. The episode under way keeps what it drew.
        """
        return dataclasses.replace(state, scale=scale)

    def _control(self, state: State, action: jax.Array) -> JointCommand:
        """The joint targets of this tick; an action that is not finite counts as none."""
        valid = jnp.all(jnp.isfinite(action))
        action = jnp.where(valid, jnp.clip(action, -1.0, 1.0), 0.0)
        measured = state.physics.qpos[self.physics.joint_qpos]
        target = move_target(self.config.control, self.hand, state.joint_target, action, measured)
        return JointCommand(action, target, state.joint_target, valid, state.previous_target)

    def _ground_truth(
        self,
        episode: Episode,
        result: StepResult,
        torque: tuple[jax.Array, jax.Array],
        action: jax.Array,
        last_action: jax.Array,
    ) -> GroundTruth:
        """Where all is after the tick, and what the fingertips feel of it; `torque` is `Motors.current_torque`."""
        physics, object, delta = self.physics, episode.object, episode.hand.pad_thickness_delta
        hand, skin = self.hand, self.config.skin
        qpos, qvel, force = result.state.qpos, result.state.qvel, result.finger_force
        joints, place, motion = qpos[physics.joint_qpos], qpos[physics.object_qpos], qvel[physics.object_dof]
        pose = forward_kinematics(hand, joints)
        position, quat = place[:3], place[3:] / jnp.linalg.norm(place[3:])
        rotation = rotations.quat_to_matrix(quat)
        geometry = self.touch_geometry(object)
        touch = bearing = compute_touch(hand, pose, geometry, position, rotation, length(force), skin, delta)
        # In the links' frames, where the normals are constants.
        local = rotations.rotate_inverse(pose.tip_rotation, force)
        pressed = project_on_normals(touch, jnp.asarray(hand.taxel_normal), local)
        if self.config.touch_method != "closed_form":  # the contact's springs have the solver's geometry
            bare = jnp.ones(hand.num_fingers)
            bearing = compute_touch(hand, pose, object.shape(), position, rotation, bare, skin, delta)
        skin_force = jnp.sum(bearing.skin_force, 1)
        return GroundTruth(
            object=object,
            joint_position=joints,
            joint_velocity=qvel[physics.joint_dof],
            joint_torque=torque[0],
            torque_limited=torque[1],
            pose=pose,
            finger_force=force,
            normal_force=jnp.sum(pressed.force, 1),
            touch=pressed if skin.total == "pressing" else touch,
            tip_stiffness=physics.tip_stiffness(object, pose, position, rotation, skin_force, delta),
            object_position=position,
            object_quat=quat,
            object_velocity=motion[:3],
            object_spin=rotations.rotate(rotation, motion[3:]),
            action=action,
            last_action=last_action,
        )

    def _observe(
        self, key: jax.Array, episode: Episode, command: JointCommand, goal: Any, truth: GroundTruth, last: State | None
    ) -> dict[str, Any]:
        """What sensors and policy see of a tick after the state `last` (None at an episode's start), and what of the
        truth the next tick needs: fields of `State`."""
        now, goal_reading = self.sensors.input(truth), self.task.goal_readings(goal)
        before = now if last is None else self._last_input(last)
        action = observed_action(self.config.control, self.hand, command.action, command.target)
        readings, taxel_memory = self.sensors.read(key, episode, now, before, goal_reading, action, last)
        correction = None if last is None else last.correction
        if self.spec.control.force.gain:
            readings, correction = correct_readings(self.spec, self.hand, self.control_period, readings, correction)
        return {
            "joint_target": command.target,
            "action": command.action,
            "goal": goal,
            "joint_torque": now.joint_torque,
            "taxel_force": now.taxel_force,
            "readings": readings,
            "taxel_memory": taxel_memory,
            "correction": correction,
            "obs": self.sensors.observe(readings, truth, goal_reading),
            "tip_stiffness": truth.tip_stiffness,
            "finger_force": length(truth.finger_force),
        }

    def _last_input(self, last: State) -> SensorInput:
        """What the sensors saw in the tick that ended with this state."""
        joints, place = last.physics.qpos[self.physics.joint_qpos], last.physics.qpos[self.physics.object_qpos]
        quat = place[3:] / jnp.linalg.norm(place[3:])
        return SensorInput(joints, last.joint_torque, last.taxel_force, place[:3], quat)

    def _tilt_force(self, episode: Episode) -> jax.Array:
        """The object's share [3] N of a tilted gravity; the links' share is small and left out."""
        weight = float(np.linalg.norm(self.task.gravity))  # m/s^2
        down = np.asarray(self.task.gravity, float) / np.linalg.norm(self.task.gravity)
        return episode.object.mass * weight * (tilted_down(down, episode.hand.tilt) - jnp.asarray(down))


def sample_episode(
    sensors: SensorSuite, keys: tuple[jax.Array, ...], object: ObjectParams, scale: jax.Array | None = None
) -> Episode:
    """What an episode draws at its start: the hand, the object's properties, the IMU and the taxels.

    Args:
      keys: of the hand, of the sensors, and of the object's physical properties.
      object: of the start state. Its shape stays, for the state was chosen for it; the physical properties that the
        task draws (`Task.object_ranges`) are drawn anew.
      scale: [] in [0, 1], narrows every range about nominal; None for 1.
    """
    hand_key, sensor_key, object_key = keys
    task, config, period = sensors.task, sensors.config, sensors.period
    ranges = config.randomization
    if drawn := tuple(name.removeprefix("objects.") for name in task.object_ranges):
        object = resample_properties(object_key, object, config.objects, task.unit_inertia(object), drawn)
    if scale is not None:
        object = toward_nominal(object, config.objects, task.unit_inertia(object), scale)
    width = 1.0 if scale is None else scale
    times = {"timestep": config.physics.timestep, "control_period": period}
    extreme = sample_extreme(hand_key, ranges.extremes)  # the one that `sample_hand` draws
    return Episode(
        hand=sample_hand(hand_key, ranges, sensors.hand, **times, scale=width),
        object=object,
        imu=sample_imu(sensor_key, config.sensing.orientation, ranges.scale * width, period, extreme),
        taxels=sensors.taxels.sample(jax.random.fold_in(sensor_key, 1), width),
    )


def touch_geometry(config: ObjectConfig, method: str) -> Callable[[ObjectParams], Any]:
    """A pure function from one episode's object to its geometry, as `dexsim.geometry.distance` takes it.

    The method is closed_form (the solver's primitives), grid (the mesh, baked) or surface_points (points on the mesh,
    or on the primitives at their drawn sizes).

    Raises:
      AssetError: the mesh cannot be baked.
      ConfigError: a grid of primitives, whose sizes are drawn anew in every episode.
    """
    if method == "closed_form":
        return ObjectParams.shape
    if not config.mesh:
        if method == "grid":
            raise ConfigError("touch_method = 'grid': needs ObjectConfig.mesh; or choose closed_form or surface_points")
        return lambda object: surface_points.from_shape(object.shape())
    mesh_object = load_mesh_object(config)
    factor = lambda object: object.size[0, 0] / mesh_object.boxes.size[0, 0]  # noqa: E731
    with jax.ensure_compile_time_eval():
        if method == "grid":  # its values stay shared under `vmap`
            baked = grid.bake(mesh_object.mesh)
            return lambda object: dataclasses.replace(baked, scale=factor(object))
        points = surface_points.from_mesh(mesh_object.mesh)
    return lambda object: dataclasses.replace(points, position=factor(object) * points.position)


def _common_metrics(
    episode: Episode, truth: GroundTruth, total: jax.Array, ticks: jax.Array, finite: jax.Array
) -> dict[str, jax.Array]:
    """Metrics [] of every task; see `Task.reward`."""
    return {
        "return": total,
        "length": ticks.astype(jnp.float32),
        "shape": episode.object.shape_index.astype(jnp.float32),
        "non_finite": 1.0 - jnp.asarray(finite, jnp.float32),
        "torque_limited": jnp.any(truth.torque_limited).astype(jnp.float32),
    }
