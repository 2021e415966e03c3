"""A short training run of each task on C MuJoCo beats a hand that does nothing, by a margin."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import dexsim
from dexsim.objects.config import ObjectConfig
from dexsim.randomization import Randomization
from dexsim.task_spec import TurnSpec
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.rotate.config import RotateConfig
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.training.presets import find_preset

NOMINAL = Randomization(scale=0.0)


def train(task, config, iterations):
    """Mean returns of episodes by iteration: of a hand that does nothing, and of training with the settings for a CPU.

    A hand that does nothing is the same compiled program with an actor of zeros, put back after every iteration.
    """
    env = dexsim.make(task, config, backend="c")
    sizes = {"num_envs": 64, "minibatches": 4, "actor_layers": (64, 64), "critic_layers": (64, 64)}
    ppo = dataclasses.replace(find_preset("cpu", task).ppo, **sizes, iterations_per_call=1)
    training = make_train(env, ppo)

    def run(count, idle=False):
        state, returns = training.init(jax.random.key(0)), []
        still = jax.tree.map(jnp.zeros_like, state.params.actor), jnp.full_like(state.params.log_std, -9.0)
        for _ in range(count):
            if idle:
                actor, log_std = jax.tree.map(jnp.copy, still)
                params = dataclasses.replace(state.params, actor=actor, log_std=log_std)
                state = dataclasses.replace(state, params=params)
            state, metrics = training.step(state)
            returns.append(float(metrics["episode/return"][0]))
        return returns

    return run(10, idle=True)[5:], run(iterations)


def test_grasp():
    """It catches most objects after 26,000 steps; an idle hand drops them all."""
    ball = ObjectConfig(shapes=("sphere",))
    config = GraspConfig(pool_size=16, episode_seconds=2.0, randomization=NOMINAL, objects=ball)
    idle, trained = train("grasp", config, 25)
    assert np.nanmean(trained[-5:]) > np.nanmean(idle) + 10.0, (idle, trained)


def test_rotate():
    """Goals half a radian apart, some of which 26,000 steps find. An idle hand reaches those that a start is near."""
    config = RotateConfig(pool_size=32, episode_seconds=3.0, turn=TurnSpec(spin=2.0, step=0.5), randomization=NOMINAL)
    idle, trained = train("rotate", config, 25)
    assert np.nanmean(trained[-10:]) > np.nanmean(idle) + 40.0, (idle, trained)
