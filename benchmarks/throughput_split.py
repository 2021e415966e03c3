"""Where the time of a training step goes: physics, touch, the rest of the environment, policy, learner.

One iteration of PPO is recorded, then its parts are run again alone, on the recorded inputs: physics meets
the same contacts, touch the same fingertips, the learner the same experience. `share` is a part's time over
that of the whole iteration; `environment rest` is what a step and its restart cost beside physics and touch
(task, readings, observation, draws), `rest` what the parts do not explain (parts compiled together are not
the sum of parts compiled apart).
"""

import dataclasses
import functools
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from throughput import Recorder, make, preset, seconds, timing

from dexsim.core.compilation import jit
from dexsim.env.env import Env
from dexsim.geometry import rotations
from dexsim.hand.kinematics import forward_kinematics, taxel_positions
from dexsim.sensing.taxels import TaxelArray
from dexsim.touch import feel as tactile
from dexsim.touch.reduce import reduce_touch
from dexsim_ppo.learner import ppo
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.distribution import log_prob, sample, squash
from dexsim_ppo.learner.loss import actor_step, critic_value
from dexsim_ppo.learner.ppo import TrainState, make_train
from dexsim_ppo.learner.rollout import Rollout, scan_restarting
from dexsim_ppo.learner.update import Learner, update


def split(task: str, backend: str, num_envs: int, repeats: int) -> list[dict]:
    """A row for a whole training iteration and one for each part."""
    env, recorder = make(task, "full", backend, num_envs), Recorder(make(task, "full", backend, num_envs))
    config = dataclasses.replace(preset(task).ppo, num_envs=num_envs, iterations_per_call=1)
    training = make_train(env, config)
    # Some iterations first: objects settle, episodes of all ages are under way.
    state = training.init(jax.random.key(0))
    for _ in range(3):
        state, _ = training.step(state)
    compiled = functools.partial(jit, backend=env.backend)
    whole = compiled(lambda state: ppo.train_iteration(env, config, state))
    ticks, actions = compiled(lambda state: record(recorder, config, state))(state)
    rollout = compiled(lambda state: ppo.collect_rollout(env, config, state))(state)[1]
    # What a part works on is an argument: as constants, XLA would fold it or hold it twice.
    cases: dict[str, tuple[Callable, tuple[Any, ...]]] = {
        "training step": (whole, (state,)),
        "rollout": (compiled(lambda state: ppo.collect_rollout(env, config, state)), (state,)),
        "environment": (compiled(lambda begin, actions: environment(env, begin, actions)), (state.env_state, actions)),
        "physics": (compiled(lambda ticks: physics(env, ticks)), (ticks,)),
        "touch": (compiled(lambda ticks, key: touch(env, ticks, key)), (ticks, jax.random.key(1))),
        "policy": (compiled(lambda state, rollout: policy(env, config, state, rollout)), (state, rollout)),
        "learner": (compiled(lambda state, rollout: learn(env, config, state, rollout)), (state, rollout)),
    }
    times = {name: [] for name in cases}
    for run, arguments in cases.values():
        seconds(run, *arguments)
    for _ in range(repeats):
        for name, (run, arguments) in cases.items():
            times[name].append(seconds(run, *arguments)[0])
    return list(rows(times, env.backend, config))


def rows(times: dict[str, list[float]], backend: str, config: PPOConfig):
    """Rows of what was measured, and of the differences."""
    middle = {name: statistics.median(values) for name, values in times.items()}
    middle["environment rest"] = middle["environment"] - middle["physics"] - middle["touch"]
    middle["rest"] = middle["training step"] - middle["environment"] - middle["policy"] - middle["learner"]
    for name, value in middle.items():
        measured = times.get(name)
        row = (
            timing(measured, config.steps_per_iteration, config.rollout_length)
            if measured
            else {
                "env_steps_per_s": round(config.steps_per_iteration / value) if value > 0 else None,
                "ms_per_step": round(1e3 * value / config.rollout_length, 4),
            }
        )
        yield (
            {"part": name, "backend": backend, "num_envs": config.num_envs, "rollout_length": config.rollout_length}
            | row
            | {"share": round(value / middle["training step"], 4)}
        )


def record(env: Recorder, config: PPOConfig, state: TrainState) -> tuple[Any, jax.Array]:
    """The ticks [T, B] that physics gets under the policy, with what comes of them, and the actions."""
    normalizers = ppo.make_normalizers(env, config, state.observation_stats)

    def restart(now, done):
        return env.restart(now[0], done), jax.tree.map(lambda x: jnp.where(done, 0.0, x), now[1])

    def tick(now, key):
        before, carry = now
        carry, mean = actor_step(config, state.params, normalizers, before.obs, carry)
        action = sample(jax.random.normal(key, mean.shape), mean, state.params.log_std)
        action = squash(action, config.distribution)
        after, given = jax.vmap(env.recorded_step)(before, action)
        outcome = after.physics.qpos, after.finger_force
        return (after, carry), after.terminated | after.truncated, (*given, *outcome, action)

    keys, begin = jax.random.split(state.key, config.rollout_length), (state.env_state, state.carry)
    *ticks, actions = scan_restarting(jax.vmap(restart), tick, begin, keys)[1]
    return tuple(ticks), actions


def environment(env: Env, state: Any, actions: jax.Array) -> Any:
    """Steps and restarts under recorded actions [T, B, A]."""

    def tick(state, action):
        after = jax.vmap(env.step)(state, action)
        return after, after.terminated | after.truncated, _used((after.obs, after.reward, after.metrics))

    return scan_restarting(jax.vmap(env.restart), tick, state, actions)


def physics(env: Env, ticks: Any) -> jax.Array:
    """The recorded ticks, each from its own start."""

    return jax.lax.scan(lambda _, given: (None, _used(replay(env, given))), None, ticks)[1]


def replay(env: Env, tick: Any) -> Any:
    """Physics of one recorded tick of all environments: what is after it, and the fingers' forces."""
    object, state, push, cover, tape, *_ = tick
    return jax.vmap(
        lambda object, state, push, cover, tape: env.physics.advance(
            object, state, lambda substep, position, velocity: tape[substep], push, cover
        )
    )(object, state, push, cover, tape)


def touch(env: Env, ticks: Any, key: jax.Array) -> jax.Array:
    """From poses and forces to taxels, readings, and force and centre of each finger, true and read."""
    hand, config, seam = env.hand, env.config, env.physics

    array = TaxelArray(config.sensing.taxel, hand.taxel_grid, hand.num_fingers, config.physics.control_period)
    params, memory = array.sample(jax.random.key(0)), array.init()

    def feel(object, cover, qpos, strength, key):
        pose = forward_kinematics(hand, qpos[seam.joint_qpos])
        taxels, place = taxel_positions(hand, pose), qpos[seam.object_qpos]
        felt = tactile.feel(
            taxels,
            jnp.asarray(hand.taxel_area),
            object.shape(),
            place[:3],
            rotations.quat_to_matrix(place[3:]),
            strength,
            config.skin,
            cover,
        )
        read = array.apply(params, memory, key, felt.force, jnp.ones((hand.num_fingers, 1)))[1]
        weighting = config.observation.weighting
        return [reduce_touch(force, taxels, weighting) for force in (felt.force, read)]

    def tick(key, given):
        object, _, _, cover, _, qpos, strength = given
        key, use = jax.random.split(key)
        return key, _used(jax.vmap(feel)(object, cover, qpos, strength, jax.random.split(use, len(qpos))))

    return jax.lax.scan(tick, key, ticks)[1]


def policy(env: Env, config: PPOConfig, state: TrainState, rollout: Rollout) -> jax.Array:
    """An action and two values for every observation, as in a rollout."""
    normalizers = ppo.make_normalizers(env, config, state.observation_stats)

    def tick(key, given):
        key, use = jax.random.split(key)
        later, mean = actor_step(config, state.params, normalizers, *given)
        action = sample(jax.random.normal(use, mean.shape), mean, state.params.log_std)
        # The value after the step is that of another observation; here those of other rows stand for it.
        values = [
            critic_value(config, state.params, normalizers, *seen)
            for seen in (given, jax.tree.map(lambda x: jnp.roll(x, 1, 0), given))
        ]
        return key, _used((action, log_prob(action, mean, state.params.log_std), values, later))

    return jax.lax.scan(tick, state.key, (rollout.obs, rollout.carry))[1]


def learn(env: Env, config: PPOConfig, state: TrainState, rollout: Rollout) -> Any:
    """Advantages, all epochs over all minibatches, statistics."""
    normalizers = ppo.make_normalizers(env, config, state.observation_stats)
    batch = ppo.prepare(config, state.value_stats, state.observation_stats, state.params, rollout)
    learner = Learner(batch.params, state.adam, state.learning_rate, state.skipped_updates)
    return update(config, normalizers, batch.samples, state.key, learner), batch


def _used(tree: Any) -> jax.Array:
    """One number that depends on all leaves, so that none is left out."""
    return sum(jnp.sum(leaf.astype(jnp.float32)) for leaf in jax.tree.leaves(tree))
