"""A short training run of each task on C MuJoCo beats a hand that does nothing, by a margin."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from episodes import POOL_SIZE

import dexsim
from dexsim.objects.config import ObjectConfig
from dexsim.randomization import Randomization
from dexsim.task_spec import TurnSpec
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.rotate.config import RotateConfig
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.training.presets import find_preset

NOMINAL = Randomization(scale=0.0)


def learns(task, config, margin, window):
    """Whether training with the settings for a CPU exceeds, within 23,000 steps, a hand that does nothing: its mean
    return over `window` iterations by a margin.

    A hand that does nothing is the same compiled program with an actor of zeros, put back after every iteration.
    """
    env = dexsim.make(task, config, backend="c")
    sizes = {"num_envs": 32, "minibatches": 4, "actor_layers": (64, 64), "critic_layers": (64, 64)}
    ppo = dataclasses.replace(find_preset("cpu", task).ppo, **sizes, iterations_per_call=1)
    training = make_train(env, ppo)

    def returns(count, idle=False):
        state = training.init(jax.random.key(0))
        still = jax.tree.map(jnp.zeros_like, state.params.actor), jnp.full_like(state.params.log_std, -9.0)
        for _ in range(count):
            if idle:
                actor, log_std = jax.tree.map(jnp.copy, still)
                params = dataclasses.replace(state.params, actor=actor, log_std=log_std)
                state = dataclasses.replace(state, params=params)
            state, metrics = training.step(state)
            yield float(metrics["episode/return"][0])

    wanted, trained = np.nanmean(list(returns(8, idle=True))[2:]) + margin, []
    for value in returns(45):
        trained.append(value)
        if len(trained) >= window and np.nanmean(trained[-window:]) > wanted:
            return True
    print(f"{task}: {wanted} wanted, {trained}")
    return False


def test_grasp():
    """It catches most objects; an idle hand drops them all."""
    ball = ObjectConfig(shapes=("sphere",))
    assert learns(
        "grasp", GraspConfig(pool_size=16, episode_seconds=2.0, randomization=NOMINAL, objects=ball), 10.0, window=5
    )


def test_rotate():
    """Goals half a radian apart, some of which are found. An idle hand reaches those that a start is near."""
    turn = TurnSpec(spin=2.0, step=0.5)
    config = RotateConfig(pool_size=POOL_SIZE, episode_seconds=3.0, turn=turn, randomization=NOMINAL)
    assert learns("rotate", config, 60.0, window=10)
