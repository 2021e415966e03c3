"""The objective of one iteration, from raw experience to the loss, against float64 NumPy.

Normalisers, networks, advantages, value targets and loss together: parts that are each right may still not fit. The
environment plays back a script, so all but the sampled actions is known beforehand.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import SMALL

from dexsim.core.layout import LayoutEntry
from dexsim.core.pytree import choose
from dexsim_ppo.learner import ppo
from dexsim_ppo.learner.adapter import AdaptedState
from dexsim_ppo.learner.loss import loss
from dexsim_ppo.learner.networks import Params, init_mlp
from dexsim_ppo.learner.running_stats import RunningStats
from dexsim_ppo.learner.types import TrainState

STEPS, ROWS, ACTIONS = 8, 5, 2
CONFIG = dataclasses.replace(
    SMALL,
    num_envs=ROWS,
    rollout_length=STEPS,
    minibatches=1,
    clip_ratio=0.15,
    value_clip=0.1,
    entropy_coefficient=0.3,
    bounds_coefficient=0.4,
    discount=0.9,
    gae_lambda=0.8,
)


class Script:
    """Each row plays the same episode again and again, whatever the actions."""

    observation_layout = {
        "actor": (LayoutEntry("pose", 2, None), LayoutEntry("touch", 2, 4.0)),
        "critic": (LayoutEntry("touch", 1, 0.5), LayoutEntry("pose", 3, None)),
    }

    def __init__(self, rng):
        self.obs = {group: rng.normal(0.3, 1.5, (STEPS + 1, ROWS, 4)) for group in self.observation_layout}
        self.reward = rng.normal(size=(STEPS, ROWS))
        self.terminated, self.truncated = np.zeros((2, STEPS, ROWS), bool)
        self.terminated[[2, 1], [1, 3]] = True
        self.truncated[[3, 1, 7], [2, 3, 4]] = True  # in row 3 both, in row 4 at the very end

    def at(self, row, time, reward=0.0, terminated=False, truncated=False):
        obs = {group: jnp.asarray(values, jnp.float32)[time, row] for group, values in self.obs.items()}
        flags = jnp.asarray(terminated, bool), jnp.asarray(truncated, bool)
        return AdaptedState(row, obs, jnp.asarray(reward, jnp.float32), *flags, {}, jnp.asarray(time, jnp.int32), None)

    def restart(self, state, done):
        return choose(done, self.at(state.inner, 0), state)

    def step(self, state, action):
        now = [jnp.asarray(x)[state.clock, state.inner] for x in (self.reward, self.terminated, self.truncated)]
        return self.at(state.inner, state.clock + 1, *now)


def setting(seed, **options):
    """The learner amid training: script, configuration, parameters, statistics, and a step of the update."""
    rng, config = np.random.default_rng(seed), dataclasses.replace(CONFIG, **options)
    networks = (init_mlp(jax.random.key(seed), sizes, 1.0) for sizes in ((4, 6, 4, ACTIONS), (4, 5, 1)))
    params = Params(next(networks), jnp.full(ACTIONS, jnp.log(config.initial_std)), next(networks))
    change = lambda size: jax.tree.map(lambda x: jnp.asarray(size * rng.normal(size=x.shape), x.dtype), params)  # noqa: E731
    params = jax.tree.map(jnp.add, params, change(0.4))
    single = lambda *x: RunningStats(jnp.int32(30), *(jnp.asarray(v, jnp.float32) for v in x))  # noqa: E731
    stats = {g: single(rng.normal(size=4), rng.uniform(0.02, 3, 4)) for g in Script.observation_layout}
    return Script(rng), config, params, stats, single(0.7, 16.0), change(0.15)


def experience(script, config, params, stats, value_stats, key):
    """What the library collects, and its objective and gradient at the parameters moved by a step [tree]."""

    @jax.jit
    def run(step):
        state = TrainState(
            params=params,
            value_stats=value_stats,
            env_state=jax.vmap(lambda row: script.at(row, 0))(jnp.arange(ROWS)),
            carry=None,
            observation_stats=stats,
            key=key,
            **dict.fromkeys(("average", "adam", "learning_rate", "iteration", "skipped_updates")),
        )
        normalizers = ppo.make_normalizers(script, stats)
        _, rollout, _ = ppo.collect_rollout(script, config, state)
        samples, state, explained = ppo.prepare(config, state, rollout)
        start = state.params
        moved = jax.tree.map(jnp.add, start, step)
        objective = lambda p: loss(p, config, normalizers, samples, params.log_std)  # noqa: E731
        (value, metrics), grads = jax.value_and_grad(objective, has_aux=True)(moved)
        return rollout.decision.action, start, value, grads, metrics["kl"], explained

    return run


def double(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


class Reference:
    """PPO's objective in float64 NumPy, from the script and the actions [T, B, A] that were drawn; nothing of the
    library's."""

    def __init__(self, script, config, params, stats, value_stats, actions):
        self.config, self.stats, self.layout = config, double(stats), script.observation_layout
        self.old, self.actions = double(params), np.asarray(actions, np.float64)
        self.mean, self.std = float(value_stats.mean), math.sqrt(float(value_stats.variance) + 1e-6)
        self.count = int(value_stats.count)
        self.estimate_advantages(script)

    def seen(self, group, obs):
        """Normalised observation [..., n]."""
        scale = np.concatenate([[field.scale or np.nan] * field.size for field in self.layout[group]])
        spread = np.hypot(np.sqrt(self.stats[group].variance), 0.01)
        z = np.where(np.isnan(scale), (obs - self.stats[group].mean) / spread, obs / scale)
        return np.clip(z, -5.0, 5.0)

    def network(self, layers, x):
        for layer in layers[:-1]:
            x = x @ layer.kernel + layer.bias
            x = np.where(x > 0, x, np.exp(x) - 1)
        return x @ layers[-1].kernel + layers[-1].bias

    def critic(self, params, obs):
        return self.network(params.critic, self.seen("critic", obs))[..., 0]

    def actor(self, params):
        return self.network(params.actor, self.seen("actor", self.obs["actor"]))

    def estimate_advantages(self, script):
        """Of every sample [T, B]: what is seen, the old value in reward units, advantage and value target."""
        config, rows, time = self.config, np.arange(ROWS), np.zeros((STEPS, ROWS), int)
        ends = script.terminated | script.truncated
        for tick in range(1, STEPS):
            time[tick] = np.where(ends[time[tick - 1], rows], 0, time[tick - 1] + 1)
        self.obs, after = ({group: x[t, rows] for group, x in script.obs.items()} for t in (time, time + 1))
        # By the statistics that the critic has learnt with.
        self.value, following = (self.mean + self.std * self.critic(self.old, x["critic"]) for x in (self.obs, after))
        following = np.where(script.terminated[time, rows], 0.0, following)
        delta, ended = script.reward[time, rows] + config.discount * following - self.value, ends[time, rows]
        total = np.zeros((STEPS, ROWS))
        for tick in range(STEPS):  # The sum over later steps, written out.
            weight = np.ones(ROWS)
            for later in range(tick, STEPS):
                total[tick] += weight * delta[later]
                weight = weight * ~ended[later] * config.discount * config.gae_lambda
        self.advantage, self.target = (total - total.mean()) / total.std(), total + self.value
        size = self.count + total.size  # Of all targets so far, these among them.
        self.new_mean = (self.count * self.mean + self.target.sum()) / size
        squares = self.count * (self.std**2 - 1e-6 + self.mean**2) + np.sum(self.target**2)
        self.new_std = math.sqrt(squares / size - self.new_mean**2 + 1e-6)

    def __call__(self, params):
        c, mean, advantage = self.config, self.actor(params), self.advantage
        density = lambda m, s: np.exp(-((self.actions - m) ** 2) / (2 * s**2)) / s  # noqa: E731
        std = np.exp(params.log_std)
        ratio = np.prod(density(mean, std) / density(self.actor(self.old), np.exp(self.old.log_std)), -1)
        bounded = np.where(advantage > 0, np.minimum(ratio, 1 + c.clip_ratio), np.maximum(ratio, 1 - c.clip_ratio))
        value = self.critic(params, self.obs["critic"])
        old, target = ((x - self.new_mean) / self.new_std for x in (self.value, self.target))
        errors = [(value - target) ** 2]
        if c.value_clip:
            errors.append((np.clip(value, old - c.value_clip, old + c.value_clip) - target) ** 2)
        value_loss = 0.5 * np.max(errors, 0)
        bounds = np.sum(np.maximum(np.abs(mean) - 1.1, 0.0) ** 2, -1)
        entropy = np.sum(np.log(std) + 0.5 * math.log(2 * math.pi * math.e))
        losses = -advantage * bounded + value_loss + c.bounds_coefficient * bounds
        return losses.mean() - c.entropy_coefficient * entropy

    def divergence(self, params):
        """KL divergence of the new policy from the old one, which the learning rate adapts to."""
        old_std, std = np.exp(self.old.log_std), np.exp(params.log_std)
        spread = old_std**2 + (self.actor(self.old) - self.actor(params)) ** 2
        return np.sum(np.log(std / old_std) + spread / (2 * std**2) - 0.5, -1).mean()


@pytest.mark.parametrize("options", [{}, {"value_clip": 0.0}], ids=["clipped values", "plain values"])
def test_objective_and_gradient_from_raw_experience(options):
    """The value before and after a step of the update; the gradient along random directions of all parameters. In
    reward units the critic's values survive the new statistics: the normaliser moves, the values do not."""
    script, config, params, stats, value_stats, step = setting(3, **options)
    run = experience(script, config, params, stats, value_stats, jax.random.key(5))
    rng = np.random.default_rng(0)
    for share in (0.0, 1.0):
        actions, start, value, grads, kl, explained = run(jax.tree.map(lambda x, share=share: share * x, step))
        reference = Reference(script, config, params, stats, value_stats, actions)
        here = jax.tree.map(lambda a, b, share=share: a + share * b, double(start), double(step))
        assert float(value) == pytest.approx(reference(here), rel=2e-5, abs=2e-5)
        assert float(kl) == pytest.approx(reference.divergence(here), rel=1e-4, abs=1e-6)
    unexplained = np.var(reference.target - reference.value) / np.var(reference.target)
    assert float(explained) == pytest.approx(1 - unexplained, abs=1e-4)
    assert abs(reference.new_std / reference.std - 1) > 0.1
    after = reference.new_mean + reference.new_std * reference.critic(double(start), reference.obs["critic"])
    np.testing.assert_allclose(after, reference.value, atol=1e-4)
    # At the moved parameters only: with ratios of exactly one and unmoved values the objective has kinks.
    for _ in range(4):
        way = jax.tree.map(lambda x: rng.normal(size=x.shape), here)
        ends = [reference(jax.tree.map(lambda x, w, s=s: x + s * w, here, way)) for s in (1e-6, -1e-6)]
        slope = sum(np.sum(g * w) for g, w in zip(jax.tree.leaves(double(grads)), jax.tree.leaves(way), strict=True))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3, abs=1e-4)
