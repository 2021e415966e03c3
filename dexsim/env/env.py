"""The environment: rooms composed into pure `reset` and `step` functions.

    action -> actuator -> physics -> touch -> Readings -> observe -> observation

All functions are written for one environment and vmapped by the caller. The state is a frozen
pytree of arrays; there is no hidden state and no automatic reset: `step` returns the true final
observation, and `restart` puts a new episode in its place where asked.

A task (grasp, rotate) is an object with pure methods; see `dexsim.env.task.Task`.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim import observation
from dexsim.actuator.gear_play import GearState
from dexsim.control import Control, move_target, observed_action
from dexsim.core.pytree import choose
from dexsim.core.ranges import sample_extreme
from dexsim.env.config import EnvConfig
from dexsim.env.fingerprint import fingerprint
from dexsim.env.motors import Drive, rotor_share
from dexsim.env.senses import EpisodeSensors, SensorSuite
from dexsim.env.state import Sample, Start, State
from dexsim.env.task import GroundTruth, Task
from dexsim.geometry import rotations
from dexsim.hand.kinematics import Hand, forward_kinematics, taxel_normals
from dexsim.objects.params import ObjectParams, toward_nominal
from dexsim.objects.touch_geometry import touch_geometry
from dexsim.observation import Motion, Readings, ThreeAxisReadings
from dexsim.physics.physics import Physics
from dexsim.physics.seam import PhysicsState
from dexsim.randomization import Draw, sample, tilted_down
from dexsim.render.snapshot import Snapshot
from dexsim.sensing.config import Sensing
from dexsim.sensing.imu import SensorDraw
from dexsim.task_spec import TaskSpec
from dexsim.touch.feel import Touch, feel_links, keep_normal_part, split_force, taxel_share
from dexsim.touch.surface import taxels_only, whole_surface

__all__ = ["Control", "Env", "EnvConfig", "GroundTruth", "Sample", "Sensing", "Start", "State", "Task"]


class Env:
    """A task on a hand: `reset(key)`, `step(state, action)`, `restart(state, done)`."""

    def __init__(self, task: Task, hand: Hand, *, backend: str = "auto", num_envs: int = 1, seed: int = 0):
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
        self.physics = Physics(
            self.hand,
            task.slots,
            task.largest,
            config.physics,
            gravity=task.gravity,
            backend=backend,
            num_envs=num_envs,
            skin=config.skin,
            rotor_share=rotor_share(config.randomization),
        )
        self.backend = self.physics.backend
        self.action_size = self.hand.num_joints
        actor_view, critic_view = observation.group_configs(config.observation)
        self._seen = {group: actor_view if group == "actor" else critic_view for group in task.fields}
        self.observation_layout = {
            group: observation.layout(self.hand, names, self._seen[group]) for group, names in task.fields.items()
        }
        self.senses = SensorSuite(config, hand, task, (actor_view, critic_view))
        self.drive = Drive(config, hand, self.physics)
        self._surface = whole_surface(hand, config.skin.thickness) if config.skin.untaxelled else taxels_only(hand)
        self.primitive_kinds = task.slots
        self._touch_geometry = touch_geometry(config.objects, config.touch_method)
        self.pool = task.make_pool(jax.random.key(seed))

    @property
    def control_period(self) -> float:
        """One control tick, s."""
        return self.config.physics.control_period

    @property
    def control_rate(self) -> float:
        """Control ticks per second, Hz."""
        return 1.0 / self.control_period

    @property
    def spec(self) -> TaskSpec:
        """What a host must know to run this task's policies."""
        return TaskSpec.of(self.task)

    def fingerprint(self) -> str | None:
        """A hash of what the compiled `reset` and `step` depend on; None if it cannot tell."""
        return fingerprint(self)

    # --- life of an episode ---------------------------------------------------------------

    def reset(self, key: jax.Array, scale: jax.Array | None = None) -> State:
        """A new episode from a random start state.

        `scale` [] in [0, 1] narrows what is drawn about nominal, now and at restarts; see `widen`.
        """
        key, pick = jax.random.split(key)
        count = self.pool.qpos.shape[0]
        return self.reset_to(key, jax.random.randint(pick, (), 0, count), scale=scale)

    def reset_to(self, key: jax.Array, index: jax.Array, goal: Any = None, scale: jax.Array | None = None) -> State:
        """A new episode from row `index` of the pool, with the task's goal or the given one."""
        key, draw_key, goal_key, noise_key, sensor_key = jax.random.split(key, 5)
        start = jax.tree.map(lambda rows: jnp.asarray(rows)[index], self.pool)
        config, hand, senses = self.config, self.hand, self.senses
        if scale is not None:
            start = dataclasses.replace(
                start, target=toward_nominal(start.target, config.objects, self.task.unit_inertia(start.target), scale)
            )
        draw, orientation = self._draw(draw_key, sensor_key, 1.0 if scale is None else scale)
        array_params, array = senses.draw_array(jax.random.fold_in(sensor_key, 1), 1.0 if scale is None else scale)
        if goal is None:
            goal = self.task.begin(goal_key, start)
        joints, place = start.qpos[self.physics.joint_qpos], start.qpos[self.physics.object_qpos]
        joint_target = joints if start.joint_target is None else start.joint_target
        zero, nothing = jnp.zeros(hand.num_joints), jnp.zeros((hand.num_fingers, 3))
        sample = Sample(
            joints, zero, jnp.zeros(hand.taxel_area.shape), place[:3], place[3:], nothing if senses.three_axis else None
        )
        readings, array = senses.read(
            noise_key,
            sample,
            sample,
            EpisodeSensors(draw, orientation, array_params, array),
            goal,
            observed_action(config.control, hand, zero, joint_target),
        )
        physics = PhysicsState(start.qpos, start.qvel, jnp.zeros(self.physics.mj_model.nv))
        truth = self._ground_truth(physics, start.target, zero, zero, zero, nothing)
        false = jnp.zeros((), bool)
        _, metrics = self.task.reward(goal, truth, false)
        state = State(
            key=key,
            physics=physics,
            target=start.target,
            draw=draw,
            orientation_sensor=orientation,
            goal=goal,
            joint_target=joint_target,
            action=zero,
            sample=sample,
            object_velocity=jnp.zeros(3),
            readings=readings,
            finger_force=jnp.zeros(hand.num_fingers),
            tick=jnp.zeros((), jnp.int32),
            length=jnp.zeros((), jnp.int32),
            episode_return=jnp.zeros(()),
            obs=self._observe(readings, truth, goal),
            reward=jnp.zeros(()),
            terminated=false,
            truncated=false,
            metrics={},
            array_params=array_params,
            array=array,
            gear=self.drive.begin(joints),
            tangential_force=truth.tangential_force,
            scale=scale,
        )
        return dataclasses.replace(state, metrics=self._metrics(state, metrics))

    def step(self, state: State, action: jax.Array) -> State:
        """One control tick. `action` [J] is clipped to [-1, 1]. No automatic reset."""
        key, push_key, goal_key, noise_key = jax.random.split(state.key, 4)
        sound = jnp.all(jnp.isfinite(action))
        action = jnp.where(sound, jnp.clip(action, -1.0, 1.0), 0.0)
        physics, hand = self.physics, self.hand
        measured = self.drive.encoder(state.physics.qpos[physics.joint_qpos], state.gear)
        joint_target = self._joint_target(state.joint_target, action, measured)

        push = self.task.push(push_key, state.target) + self._tilt_force(state.draw, state.target)
        after, force, gear = self._drive(state, joint_target, push)
        # A diverging solver passes through speeds that are finite and square to 1e27 in the reward.
        finite = (
            sound
            & jnp.all(jnp.isfinite(after.qpos))
            & jnp.all(jnp.abs(after.qvel) < 1e3)
            & jnp.all(jnp.isfinite(force))
        )
        # A world that has blown up ends its episode here; its numbers must not spread.
        after, gear = choose(finite, (after, gear), (state.physics, state.gear))
        force = jnp.where(finite, force, 0.0)

        torque = self._torque(state, joint_target, after, gear)
        truth = self._ground_truth(after, state.target, torque, action, state.action, force)
        goal = self.task.update(goal_key, state.goal, truth)
        sample = Sample(
            self.drive.encoder(truth.joint_position, gear),
            torque / hand.torque_limit,
            truth.touch.force,
            truth.object_position,
            truth.object_quat,
            truth.tangential_force,
        )
        readings, array = self.senses.read(
            noise_key,
            sample,
            state.sample,
            EpisodeSensors.of(state),
            goal,
            observed_action(self.config.control, hand, action, joint_target),
            state,
        )
        dropped = self.task.dropped(goal, truth) | ~finite
        reward, metrics = self.task.reward(state.goal, truth, dropped)
        tick = state.tick + 1
        state = State(
            key=key,
            physics=after,
            target=state.target,
            draw=state.draw,
            orientation_sensor=state.orientation_sensor,
            goal=goal,
            joint_target=joint_target,
            action=action,
            sample=sample,
            object_velocity=readings.object_velocity,
            readings=readings,
            finger_force=jnp.linalg.norm(force, axis=-1),
            tick=tick,
            length=state.length + 1,
            episode_return=state.episode_return + reward,
            obs=self._observe(readings, truth, goal),
            reward=reward,
            terminated=dropped,
            truncated=(tick >= self.task.episode_ticks) & ~dropped,
            metrics={},
            array_params=state.array_params,
            array=array,
            gear=gear,
            tangential_force=truth.tangential_force,
            scale=state.scale,
        )
        return dataclasses.replace(state, metrics=self._metrics(state, metrics, finite))

    def restart(self, state: State, done: jax.Array) -> State:
        """`state`, or where `done` the first state of a new episode from the pool."""
        key, fresh_key = jax.random.split(state.key)
        fresh = self.reset(fresh_key, state.scale)
        state = dataclasses.replace(state, key=key)
        return choose(done, fresh, state)

    def stagger(self, state: State, key: jax.Array) -> State:
        """`state` with a random clock, so that a batch's time limits do not fall together."""
        tick = jax.random.randint(key, (), 0, self.task.episode_ticks)
        return dataclasses.replace(state, tick=tick.astype(jnp.int32))

    def widen(self, state: State, scale: jax.Array) -> State:
        """`state`, whose next episodes are drawn from ranges of this width [] in [0, 1].

        It must come from a reset with a scale. The episode under way goes on as it was drawn.
        """
        return dataclasses.replace(state, scale=scale)

    # --- pieces of a step -----------------------------------------------------------------

    def _draw(
        self, hand_key: jax.Array, sensor_key: jax.Array, scale: jax.Array | float = 1.0
    ) -> tuple[Draw, SensorDraw]:
        """The hand and the object's IMU of one episode."""
        ranges = self.config.randomization
        draw = sample(
            hand_key,
            ranges,
            self.hand,
            timestep=self.config.physics.timestep,
            control_period=self.control_period,
            scale=scale,
        )
        extreme = sample_extreme(hand_key, ranges.extremes)  # the one that `sample` draws
        sensor = self.senses.draw_orientation(sensor_key, ranges.scale * scale, extreme)
        # An IMU's upright is the true one; the host takes it for that of a hand without tilt.
        down, tilted = self._tilted(draw)
        return draw, dataclasses.replace(sensor, bias=sensor.bias + jnp.cross(tilted, down))

    def _drive(
        self, state: State, joint_target: jax.Array, push: jax.Array
    ) -> tuple[PhysicsState, jax.Array, GearState | None]:
        """A tick of physics under the motors: the state after it, forces [F, 3] N, gears."""
        return self.drive.tick(state, joint_target, push)

    def _torque(self, state: State, joint_target: jax.Array, after: PhysicsState, gear: GearState | None) -> jax.Array:
        """The torque [J] Nm that the motors give at the end of the tick."""
        return self.drive.reading(state.draw, state.joint_target, joint_target, after, gear)

    def _joint_target(self, target: jax.Array, action: jax.Array, measured: jax.Array) -> jax.Array:
        return move_target(self.config.control, self.hand, target, action, measured)

    def _tilt_force(self, draw: Draw, target: ObjectParams) -> jax.Array:
        """The object's share of a tilted gravity, N; the links' share is small and left out."""
        down, tilted = self._tilted(draw)
        return target.mass * np.linalg.norm(self.task.gravity) * (tilted - down)

    def _tilted(self, draw: Draw) -> tuple[jax.Array, jax.Array]:
        """Directions [3] of gravity in the palm frame: as the host takes it, and as it is."""
        down = np.asarray(self.task.gravity, float) / np.linalg.norm(self.task.gravity)
        return jnp.asarray(down), tilted_down(down, draw.tilt)

    def _ground_truth(
        self,
        physics: PhysicsState,
        target: ObjectParams,
        torque: jax.Array,
        action: jax.Array,
        last_action: jax.Array,
        force: jax.Array,
    ) -> GroundTruth:
        seam, hand, config = self.physics, self.hand, self.config
        joints = physics.qpos[seam.joint_qpos]
        place, motion = physics.qpos[seam.object_qpos], physics.qvel[seam.object_dof]
        pose = forward_kinematics(hand, joints)
        quat = place[3:] / jnp.linalg.norm(place[3:])
        strength = jnp.linalg.norm(force, axis=-1)
        if config.touch:
            surface = self._surface
            touch = feel_links(
                hand,
                pose,
                self._touch_geometry(target),
                place[:3],
                rotations.quat_to_matrix(quat),
                strength,
                config.skin,
                surface,
            )
            if config.skin.total == "pressing":
                # In the links' frames, where the normals are constants.
                local = rotations.rotate_inverse(pose.tip_rotation, force)
                touch = keep_normal_part(touch, jnp.asarray(surface.normal), local)
            share = taxel_share(touch.skin_force, hand.num_taxels) if config.skin.untaxelled else 1.0
            touch = jax.tree.map(lambda x: x[:, : hand.num_taxels], touch)
        else:
            nothing, share = jnp.zeros(hand.taxel_area.shape), 1.0
            touch = Touch(nothing, nothing, nothing)
        return GroundTruth(
            target=target,
            joint_position=joints,
            joint_velocity=physics.qvel[seam.joint_dof],
            joint_torque=torque,
            pose=pose,
            finger_force=force,
            touch=touch,
            object_position=place[:3],
            object_quat=quat,
            object_velocity=motion[:3],
            object_spin=rotations.rotate(rotations.quat_to_matrix(quat), motion[3:]),
            action=action,
            last_action=last_action,
            tangential_force=(
                split_force(touch.force, taxel_normals(hand, pose), share * force)[1]
                if self.senses.three_axis
                else None
            ),
        )

    def _observe(self, readings: Readings, truth: GroundTruth, goal: Any) -> dict[str, jax.Array]:
        """The actor sees the readings; the critic the truth, in the same fields."""
        command, goal_quat = self.task.goal_readings(goal)
        known = (
            truth.joint_position,
            truth.joint_torque / self.hand.torque_limit,
            truth.touch.force,
            truth.object_position,
            truth.object_velocity,
            truth.object_quat,
            goal_quat,
            command,
            readings.last_action,
        )
        true_readings = (
            ThreeAxisReadings(*known, truth.tangential_force)
            if isinstance(readings, ThreeAxisReadings)
            else Readings(*known)
        )
        seen = {"actor": readings, "critic": true_readings}
        motion = Motion(truth.joint_velocity, truth.object_spin)
        return {
            group: observation.observe(self.hand, seen[group], names, self._seen[group], motion)
            for group, names in self.task.fields.items()
        }

    def _metrics(
        self, state: State, terms: dict[str, jax.Array], finite: jax.Array | bool = True
    ) -> dict[str, jax.Array]:
        if state.tangential_force is not None:
            along = jnp.linalg.norm(state.tangential_force, axis=-1)
            terms = {
                **terms,
                "tangential_force": jnp.sum(along),
                **{f"tangential/{i}": along[i] for i in range(along.shape[0])},
            }
        return {
            **terms,
            "return": state.episode_return,
            "length": state.length.astype(jnp.float32),
            "shape": state.target.shape_index.astype(jnp.float32),
            "non_finite": 1.0 - jnp.asarray(finite, jnp.float32),
        }

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
            object_position=place[:3],
            object_rotation=rotations.quat_to_matrix(place[3:]),
            primitive_size=shape.size,
            primitive_position=shape.position,
            primitive_rotation=shape.rotation,
            primitive_active=shape.active,
            taxel_force=state.readings.taxel_force,
            command=state.readings.command,
            target_force=self.task.target_force(state.goal),
            finger_force=state.finger_force,
        )
