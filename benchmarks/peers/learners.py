"""Both learners on one environment, in turn, a chunk of iterations each: what else the machine does falls on both."""

import collections
import dataclasses
import functools
import statistics
import threading
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.compilation import collector_paused, jit
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.loss import actor_mean
from dexsim_ppo.learner.ppo import make_normalizers, make_train
from dexsim_ppo.learner.types import Environment

from .environments import Contest

Act = Callable[[dict[str, jax.Array]], jax.Array]
"""Observations [B, ...] to actions [B, A], without noise."""


class Turns:
    """Lets threads run one at a time, in turn."""

    def __init__(self, names: list[str]):
        self._order, self._changed = collections.deque(names), threading.Condition()

    def wait(self, name: str) -> None:
        """Wait for the turn of `name`."""
        with self._changed:
            self._changed.wait_for(lambda: self._order[0] == name)

    def end(self, name: str, leave: bool = False) -> None:
        """End the turn of `name`, for good if it leaves."""
        with self._changed:
            self._order.remove(name)
            if not leave:
                self._order.append(name)
            self._changed.notify_all()


class Stopwatch:
    """Times a learner's chunks without its evaluations and the other's turns, and evaluates at the end of each."""

    def __init__(self, name: str, turns: Turns, evaluate: Callable[[Act], float], chunk_steps: int):
        self.name, self._turns, self._evaluate, self._chunk_steps = name, turns, evaluate, chunk_steps
        self.seconds: list[float] = []
        self.returns: list[float] = []
        self._resumed = time.perf_counter()

    def start(self) -> None:
        """Wait for the first turn."""
        self._turns.wait(self.name)
        self._resumed = time.perf_counter()

    def chunk(self, act: Act) -> None:
        """A chunk has ended with this policy."""
        self.seconds.append(time.perf_counter() - self._resumed)
        self.returns.append(self._evaluate(act))
        self._turns.end(self.name)
        self.start()

    def row(self, iterations: int) -> dict[str, Any]:
        """What was measured; `iterations` in a chunk. The first two chunks are compilation besides: brax compiles again
        at its second call."""
        steady = self.seconds[2:]
        chunk = statistics.median(steady)
        wall = [sum(self.seconds[: n + 1]) for n in range(len(self.seconds))]
        return {
            "compile_s": sum(self.seconds[:2]) - 2 * chunk,
            "first_update_s": self.seconds[0] - chunk * (iterations - 1) / iterations,
            "steps_per_s": self._chunk_steps / chunk,
            "slowest_over_fastest": max(steady) / min(steady),
            "return": self.returns[-1],
            "wall_s": wall,
            "returns": self.returns,
        }


def evaluator(env: Environment, episodes: int) -> Callable[[Act], float]:
    """`evaluate(act)`: mean return of the same episodes each time, up to termination or the time limit."""

    def evaluate(act: Act) -> float:
        @functools.partial(jit, backend=env.backend)
        def total(keys):
            state = jax.vmap(env.reset)(keys)

            def tick(carry, _):
                state, alive, total = carry
                state = jax.vmap(env.step)(state, act(dict(state.obs)))
                total += jnp.where(alive & jnp.isfinite(state.reward), state.reward, 0.0)
                return (state, alive & ~state.terminated, total), None

            begin = state, jnp.ones(episodes, bool), jnp.zeros(episodes)
            return jnp.mean(jax.lax.scan(tick, begin, None, length=env.task.evaluation_ticks)[0][2])

        return float(total(jax.random.split(jax.random.key(12345), episodes)))

    return evaluate


def train_ours(contest: Contest, config: PPOConfig, seed: int, chunks: int, iterations: int, watch: Stopwatch) -> None:
    """As `dexsim_ppo.train` does: one call an iteration, metrics fetched after each."""
    watch.start()
    training = make_train(contest.ours, config)
    state = training.init(jax.random.key(seed))
    for _ in range(chunks):
        for _ in range(iterations):
            with collector_paused():
                state, metrics = training.step(state)
                jax.device_get(metrics)
        normalizers = make_normalizers(contest.ours, config, state.observation_stats)
        params = jax.tree.map(jnp.copy, state.params)  # the next step donates them
        watch.chunk(lambda obs, p=params, n=normalizers: jnp.clip(actor_mean(config, p, n, obs), -1.0, 1.0))


def train_brax(contest: Contest, config: PPOConfig, seed: int, chunks: int, iterations: int, watch: Stopwatch) -> None:
    """brax's PPO with the same sizes, passes, discount and learning rate (which ours adapts)."""
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo

    keyed = isinstance(contest.brax.observation_size, dict)

    def chunk(step: int, make_policy: Callable, params: Any) -> None:
        if not step:  # before the first chunk
            return
        policy = make_policy(params, deterministic=True)
        watch.chunk(lambda obs: policy(obs if keyed else obs["actor"], jax.random.PRNGKey(0))[0])

    watch.start()
    ppo.train(
        contest.brax,
        num_timesteps=chunks * iterations * config.steps_per_iteration,
        num_evals=chunks + 1,
        run_evals=False,
        policy_params_fn=chunk,
        seed=seed,
        num_envs=config.num_envs,
        unroll_length=config.rollout_length,
        batch_size=config.num_envs // config.minibatches,
        num_minibatches=config.minibatches,
        num_updates_per_batch=config.epochs,
        discounting=config.discount,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clip_ratio,
        max_grad_norm=config.max_grad_norm,
        learning_rate=config.learning_rate,
        entropy_cost=1e-3,
        normalize_observations=True,
        network_factory=functools.partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=config.actor_layers,
            value_hidden_layer_sizes=config.critic_layers,
            **({"policy_obs_key": "actor", "value_obs_key": "critic"} if keyed else {}),
        ),
        **contest.brax_options,
    )


LEARNERS = {"ours": train_ours, "brax": train_brax}


def contend(
    names: list[str], contest: Contest, config: PPOConfig, seed: int, chunks: int, iterations: int, episodes: int
) -> dict[str, dict[str, Any]]:
    """Some of `LEARNERS` from one seed; the rows by learner. Each seed compiles anew.

    Args:
      chunks: turns of each, at least three.
      iterations: in a turn.
      episodes: of an evaluation.
    """
    config = dataclasses.replace(config, discount=contest.discount)
    turns, evaluate = Turns(names), evaluator(contest.ours, episodes)
    watches = {name: Stopwatch(name, turns, evaluate, iterations * config.steps_per_iteration) for name in names}
    errors: list[BaseException] = []

    def run(name: str) -> None:
        try:
            LEARNERS[name](contest, config, seed, chunks, iterations, watches[name])
        except BaseException as error:  # of a thread: raised again below
            errors.append(error)
        finally:
            turns.end(name, leave=True)

    threads = [threading.Thread(target=run, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return {name: watch.row(iterations) for name, watch in watches.items()}
