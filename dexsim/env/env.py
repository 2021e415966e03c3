"""The environment: parts composed into pure `reset` and `step` functions.

    action -> control -> motors and physics -> touch -> senses -> observer -> task (reward, end)

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

from dexsim.control import observed_action
from dexsim.core.errors import ConfigError
from dexsim.core.pytree import choose
from dexsim.env.episode import EpisodeSampler
from dexsim.env.evaluation import EvaluationPlan, make_plan
from dexsim.env.fingerprint import fingerprint
from dexsim.env.motors import JointCommand, Motors, PhysicsTick, rotor_share
from dexsim.env.observer import Observer
from dexsim.env.rules import dropped_of, reward_of, updated_goal
from dexsim.env.senses import SensorSuite
from dexsim.env.state import Episode, Outcome, Perception, SensorInput, Start, State
from dexsim.env.task import GroundTruth, Task
from dexsim.env.touch import TouchModel
from dexsim.geometry import rotations
from dexsim.geometry.vectors import length
from dexsim.hand.kinematics import Hand, forward_kinematics
from dexsim.physics.physics import Physics
from dexsim.render.snapshot import Snapshot
from dexsim.task_spec import TaskSpec, correct_readings, next_target


class Env:
    """A task on a hand: `reset(key)`, `step(state, action)`, `restart(state, done)`."""

    def __init__(self, task: Task, hand: Hand, *, backend: str = "auto", num_envs: int = 1, seed: int = 0):
        """Compile the scene and fill the pool of start states.

        Args:
          task: the task with its configuration.
          hand: the hand.
          backend: "auto", "jax", "cuda", "warp" or "c".
          num_envs: batch size that the Warp buffers are sized for.
          seed: of the pool. Evaluations have pools of their own.

        Raises:
          AssetError, ConfigError: see `Physics`, `load_hand`.
        """
        self.task, self.name, self.config, self.hand = task, task.name, task.config, hand
        self.spec = TaskSpec.of(task)  # what a host must know to run this task's policies
        config = self.config
        self.physics = Physics(
            hand,
            task.slots,
            task.largest,
            config.physics,
            gravity=task.gravity,
            backend=backend,
            num_envs=num_envs,
            skin=config.skin,
            rotor_share=rotor_share(config.randomization),
        )
        self.backend, self.action_size, self.primitive_kinds = self.physics.backend, hand.num_joints, task.slots
        self.motors = Motors(config, hand, self.physics)
        self.touch = TouchModel(config, hand)
        self.senses = SensorSuite(config, hand, task)
        self.observer = Observer(config, hand, task)
        self.sampler = EpisodeSampler(config, hand, task, self.senses)
        self.observation_layout = self.observer.layout
        self.pool = task.make_pool(jax.random.key(seed))

    @property
    def control_period(self) -> float:
        """One control tick, s."""
        return self.config.physics.control_period

    @property
    def control_rate(self) -> float:
        """Control ticks per second, Hz."""
        return 1.0 / self.control_period

    def fingerprint(self) -> str | None:
        """A hash of what the compiled `reset` and `step` depend on; None if it cannot tell."""
        return fingerprint(self)

    # --- life of an episode ---------------------------------------------------------------

    def reset(self, key: jax.Array, scale: jax.Array | None = None) -> State:
        """A new episode from a random start state.

        `scale` [] in [0, 1] narrows what is drawn about nominal, now and at restarts; see `widen`.
        """
        key, pick = jax.random.split(key)
        return self.reset_to(key, jax.random.randint(pick, (), 0, self.pool.qpos.shape[0]), scale=scale)

    def reset_to(self, key: jax.Array, index: jax.Array, goal: Any = None, scale: jax.Array | None = None) -> State:
        """A new episode from row `index` of the pool, with the task's goal or the given one."""
        return self.reset_from(key, jax.tree.map(lambda rows: jnp.asarray(rows)[index], self.pool), goal, scale)

    def reset_from(self, key: jax.Array, start: Start, goal: Any = None, scale: jax.Array | None = None) -> State:
        """A new episode from this start state: its poses and shape, with bulk, hand and sensors drawn by `key`."""
        key, hand_key, goal_key, noise_key, sensor_key, object_key = jax.random.split(key, 6)
        episode = self.sampler.sample(hand_key, sensor_key, object_key, start.object, scale)
        start = dataclasses.replace(start, object=episode.object)
        goal = self.task.begin(goal_key, start) if goal is None else goal
        command, tick = self.motors.rest(start.qpos, start.qvel, start.joint_target)
        if self.spec.grip_reflex:
            command = dataclasses.replace(command, reflex=jnp.zeros(self.hand.num_fingers))
        truth = self._ground_truth(episode, tick, command.action, command.action)
        sensor_input = self.senses.at_rest(start.qpos[self.physics.joint_qpos], start.qpos[self.physics.object_qpos])
        seen = self._sense(noise_key, episode, command, truth, goal, sensor_input)
        outcome = self._judge(truth, goal, tick.finite)
        return self._state(key, episode, command, tick, goal, seen, outcome, scale)

    def step(self, state: State, action: jax.Array) -> State:
        """One control tick. `action` [J] is clipped to [-1, 1]. No automatic reset.

        Raises:
          ConfigError: the action has another shape.
        """
        if (shape := jnp.shape(action)) != (self.action_size,):
            raise ConfigError(f"the action has the shape {shape}; {self.name!r} takes one of ({self.action_size},)")
        key, push_key, goal_key, noise_key = jax.random.split(state.key, 4)
        episode = state.episode
        command = self._control(state, action)
        push = self.task.push(push_key, episode.object) + self.sampler.tilt_force(episode)
        tick = self.motors.tick(episode, command, state.physics, state.gear, push)
        truth = self._ground_truth(episode, tick, command.action, state.action)
        goal = updated_goal(self.task, goal_key, state.goal, truth)
        seen = self._sense(noise_key, episode, command, truth, goal, self._sensor_input(truth, tick), state)
        outcome = self._judge(truth, goal, tick.finite, state)
        return self._state(key, episode, command, tick, goal, seen, outcome, state.scale)

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

        It must come from a reset with a scale. The episode under way keeps what it drew.
        """
        return dataclasses.replace(state, scale=scale)

    # --- parts of a step, in their order --------------------------------------------------

    def _control(self, state: State, action: jax.Array) -> JointCommand:
        """The joint targets of this tick; an action that is not finite counts as none."""
        valid = jnp.all(jnp.isfinite(action))
        action = jnp.where(valid, jnp.clip(action, -1.0, 1.0), 0.0)
        measured = self.motors.encoder(state.physics.qpos[self.physics.joint_qpos], state.gear)
        before = state.joint_target
        target, reflex = next_target(
            self.spec, self.hand, self.control_period, state.readings, before, state.reflex, action, measured
        )
        return JointCommand(action=action, target=target, previous=before, valid=valid, reflex=reflex)

    def _ground_truth(
        self, episode: Episode, tick: PhysicsTick, action: jax.Array, last_action: jax.Array
    ) -> GroundTruth:
        """Where all is after the tick, and what the fingertips feel of it."""
        seam, physics, force, object = self.physics, tick.physics, tick.finger_force, episode.object
        joints = physics.qpos[seam.joint_qpos]
        place, motion = physics.qpos[seam.object_qpos], physics.qvel[seam.object_dof]
        pose = forward_kinematics(self.hand, joints)
        quat = place[3:] / jnp.linalg.norm(place[3:])
        felt = self.touch.feel(pose, object, place[:3], quat, force, episode.hand.cover)
        return GroundTruth(
            object=object,
            joint_position=joints,
            joint_velocity=physics.qvel[seam.joint_dof],
            joint_torque=tick.joint_torque,
            pose=pose,
            finger_force=force,
            normal_force=felt.normal_force,
            touch=felt.touch,
            object_position=place[:3],
            object_quat=quat,
            object_velocity=motion[:3],
            object_spin=rotations.rotate(rotations.quat_to_matrix(quat), motion[3:]),
            action=action,
            last_action=last_action,
            tangential_force=felt.tangential_force,
        )

    def _sensor_input(self, truth: GroundTruth, tick: PhysicsTick) -> SensorInput:
        return SensorInput(
            joint_position=self.motors.encoder(truth.joint_position, tick.gear),
            joint_torque=truth.joint_torque / self.hand.torque_limit,
            taxel_force=truth.touch.force,
            object_position=truth.object_position,
            object_quat=truth.object_quat,
            tangential_force=truth.tangential_force,
        )

    def _sense(
        self,
        key: jax.Array,
        episode: Episode,
        command: JointCommand,
        truth: GroundTruth,
        goal: Any,
        sensor_input: SensorInput,
        last: State | None = None,
    ) -> Perception:
        """Readings and observations of a tick after the state `last`, or of an episode's start."""
        shown = self.task.goal_readings(goal)
        action = observed_action(self.config.control, self.hand, command.action, command.target)
        readings, memory = self.senses.read(key, episode, sensor_input, shown, action, last)
        correction = None
        if self.spec.force_loop:
            correction = None if last is None else last.correction
            readings, correction = correct_readings(self.spec, self.hand, self.control_period, readings, correction)
        obs = self.observer.observe(readings, truth, *shown)
        return Perception(sensor_input, readings, memory, obs, correction)

    def _judge(self, truth: GroundTruth, goal: Any, finite: jax.Array, last: State | None = None) -> Outcome:
        """The task's verdict on a tick after the state `last`; an episode's start earns nothing."""
        zero, false, ticks = jnp.zeros(()), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        if last is None:
            _, terms = reward_of(self.task, goal, truth, false)
            return Outcome(zero, false, false, ticks, ticks, zero, terms)
        dropped = dropped_of(self.task, goal, truth) | ~finite
        reward, terms = reward_of(self.task, last.goal, truth, dropped)
        tick = last.tick + 1
        truncated = (tick >= self.task.episode_ticks) & ~dropped
        return Outcome(reward, dropped, truncated, tick, last.length + 1, last.episode_return + reward, terms)

    def _state(
        self,
        key: jax.Array,
        episode: Episode,
        command: JointCommand,
        tick: PhysicsTick,
        goal: Any,
        seen: Perception,
        outcome: Outcome,
        scale: jax.Array | None,
    ) -> State:
        return State(
            key=key,
            episode=episode,
            physics=tick.physics,
            joint_target=command.target,
            action=command.action,
            goal=goal,
            sensor_input=seen.sensor_input,
            readings=seen.readings,
            finger_force=length(tick.finger_force),
            tick=outcome.tick,
            length=outcome.length,
            episode_return=outcome.episode_return,
            obs=seen.obs,
            reward=outcome.reward,
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            metrics={
                **outcome.metrics,
                **_tangential_metrics(seen.sensor_input.tangential_force),
                "return": outcome.episode_return,
                "length": outcome.length.astype(jnp.float32),
                "shape": episode.object.shape_index.astype(jnp.float32),
                "non_finite": 1.0 - jnp.asarray(tick.finite, jnp.float32),
                "torque_limited": jnp.any(tick.limited).astype(jnp.float32),
            },
            taxel_memory=seen.taxel_memory,
            correction=seen.correction,
            reflex=command.reflex,
            gear=tick.gear,
            scale=scale,
        )

    # --- evaluation and pictures ----------------------------------------------------------

    @property
    def evaluation(self) -> str:
        """What `summarize` wants: "series" or "totals"."""
        return self.task.evaluation

    @property
    def evaluation_steps(self) -> int:
        """Length of an evaluation episode, ticks."""
        return self.task.evaluation_ticks

    def evaluation_plan(self, count: int, seed: int) -> EvaluationPlan:
        """The task's fixed protocol for `count` episodes, from a pool of start states of this evaluation's own."""
        return make_plan(self.task, count, seed)

    def evaluation_starts(self, plan: EvaluationPlan) -> State:
        """[N] start states of a plan, or of a slice of one."""
        return jax.vmap(self.reset_from)(plan.key, plan.start, plan.goal)

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict:
        """The task's report of an evaluation (host).

        A task of kind "series" gets metrics [T, N] and alive [T, N]; one of kind "totals" those of each episode's last
        tick [N] and the ticks lived [N].
        """
        return self.task.summarize(metrics, alive, self.control_period)

    def snapshot(self, state: State) -> Snapshot:
        """What a frame of video shows."""
        place = state.physics.qpos[self.physics.object_qpos]
        shape = state.episode.object.shape()
        turning = self.spec.turn is not None
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
            goal_rotation=rotations.quat_to_matrix(state.readings.goal_quat) if turning else None,
            turns=getattr(state.goal, "turns", None) if turning else None,
            seconds=state.length.astype(jnp.float32) * self.control_period,
        )


def _tangential_metrics(force: jax.Array | None) -> dict[str, jax.Array]:
    """Size of each finger's true tangential force [F, 3] and their sum, N; nothing without three-axis taxels."""
    if force is None:
        return {}
    along = length(force)
    return {"tangential_force": jnp.sum(along), **{f"tangential/{i}": along[i] for i in range(along.shape[0])}}
