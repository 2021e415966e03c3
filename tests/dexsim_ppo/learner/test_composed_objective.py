"""The objective of one iteration, from raw experience to the loss, against float64 NumPy, one sample at a time.

Normalisers, networks, advantages, value targets and loss together: parts that are each right may still not fit. The
environment plays back a script, so all but the sampled actions is known beforehand.
"""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import SMALL

from dexsim.core.layout import LayoutEntry
from dexsim.core.pytree import choose, pytree_dataclass
from dexsim_ppo.learner import ppo
from dexsim_ppo.learner.loss import loss
from dexsim_ppo.learner.networks import init_params
from dexsim_ppo.learner.running_stats import RunningStats

STEPS, ROWS, ACTIONS = 8, 5, 2
CONFIG = dataclasses.replace(
    SMALL,
    num_envs=ROWS,
    rollout_length=STEPS,
    minibatches=1,
    clip_ratio=0.15,
    value_clip=0.1,
    value_coefficient=0.7,
    entropy_coefficient=0.3,
    bounds_coefficient=0.4,
    discount=0.9,
    gae_lambda=0.8,
    observation_clip=1.2,
    observation_std_floor=0.3,
)


@pytree_dataclass
class Played:
    """Where an episode of the script is."""

    row: jax.Array
    time: jax.Array  # since the episode began
    obs: dict[str, jax.Array]
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    metrics: dict[str, jax.Array]


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
        return Played(row, jnp.asarray(time, jnp.int32), obs, jnp.asarray(reward, jnp.float32), *flags, {})

    def restart(self, state, done):
        return choose(done, self.at(state.row, 0), state)

    def step(self, state, action):
        now = [jnp.asarray(x)[state.time, state.row] for x in (self.reward, self.terminated, self.truncated)]
        return self.at(state.row, state.time + 1, *now)


def setting(seed, **options):
    """The learner amid training: script, configuration, parameters, statistics, and a step of the update."""
    rng, config = np.random.default_rng(seed), dataclasses.replace(CONFIG, **options)
    params = init_params(
        jax.random.key(seed), actor_sizes=(4, 6, 4, ACTIONS), critic_sizes=(4, 5, 1), initial_std=config.initial_std
    )
    change = lambda size: jax.tree.map(lambda x: jnp.asarray(size * rng.normal(size=x.shape), x.dtype), params)  # noqa: E731
    params = jax.tree.map(jnp.add, params, change(0.4))
    single = lambda *x: RunningStats(jnp.int32(30), *(jnp.asarray(v, jnp.float32) for v in x))  # noqa: E731
    stats = {g: single(rng.normal(size=4), rng.uniform(0.2, 3, 4)) for g in Script.observation_layout}
    return Script(rng), config, params, stats, single(0.7, 16.0), change(0.15)


def experience(script, config, params, stats, value_stats, key):
    """What the library collects, and its objective and gradient at the parameters moved by a step [tree]."""

    @jax.jit
    def run(step):
        state = SimpleNamespace(
            params=params,
            value_stats=value_stats,
            env_state=jax.vmap(lambda row: script.at(row, 0))(jnp.arange(ROWS)),
            carry=None,
            observation_stats=stats,
            key=key,
        )
        normalizers = ppo.make_normalizers(script, config, stats)
        _, rollout, _ = ppo.collect_rollout(script, config, state)
        samples, start, *_ = ppo.prepare(config, value_stats, {}, params, rollout)
        moved = jax.tree.map(jnp.add, start, step)
        objective = lambda p: loss(p, config, normalizers, samples, params.log_std)  # noqa: E731
        (value, metrics), grads = jax.value_and_grad(objective, has_aux=True)(moved)
        return rollout.decision.action, start, value, grads, metrics["kl"]

    return run


def double(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


class Reference:
    """PPO's objective in float64, from the script and the actions that were drawn; nothing of the library's."""

    def __init__(self, script, config, params, stats, value_stats, actions):
        self.config, self.stats = config, double(stats)
        self.old, self.actions = double(params), np.asarray(actions, np.float64)
        self.mean, self.std = float(value_stats.mean), math.sqrt(float(value_stats.variance) + 1e-6)
        self.layout, self.count = script.observation_layout, int(value_stats.count)
        self.samples = self.advantages(script)

    def seen(self, group, obs):
        """Normalised observation."""
        out, at = [], 0
        for field in self.layout[group]:
            for k in range(at, at + field.size):
                if field.scale:
                    z = obs[k] / field.scale
                else:
                    floor = self.config.observation_std_floor
                    z = (obs[k] - self.stats[group].mean[k]) / math.hypot(
                        math.sqrt(self.stats[group].variance[k]), floor
                    )
                out.append(min(max(z, -self.config.observation_clip), self.config.observation_clip))
            at += field.size
        return np.array(out)

    def network(self, layers, x):
        for k, layer in enumerate(layers):
            x = x @ layer.kernel + layer.bias
            if k < len(layers) - 1:
                x = np.array([v if v > 0 else math.exp(v) - 1 for v in x])
        return x

    def value(self, params, obs):
        """In reward units, by the statistics that the critic has learnt with."""
        return self.mean + self.std * self.network(params.critic, self.seen("critic", obs))[0]

    def advantages(self, script):
        """Of every sample: the script's place and action, old mean and value, advantage and value target."""
        c, samples = self.config, []
        for row in range(ROWS):
            time, chain = 0, []
            for tick in range(STEPS):
                obs, after = ({g: v[t, row] for g, v in script.obs.items()} for t in (time, time + 1))
                terminated, truncated = script.terminated[time, row], script.truncated[time, row]
                value, following = (self.value(self.old, o["critic"]) for o in (obs, after))
                delta = script.reward[time, row] + (0.0 if terminated else c.discount * following) - value
                chain.append((delta, terminated or truncated))
                mean = self.network(self.old.actor, self.seen("actor", obs["actor"]))
                samples.append({"obs": obs, "action": self.actions[tick, row], "mean": mean, "value": value})
                time = 0 if terminated or truncated else time + 1
            for tick in range(STEPS):  # The sum over later steps, written out.
                total, weight = 0.0, 1.0
                for delta, ended in chain[tick:]:
                    total, weight = total + weight * delta, weight * c.discount * c.gae_lambda
                    if ended:
                        break
                sample = samples[row * STEPS + tick]
                sample["advantage"], sample["target"] = total, total + sample["value"]
        advantages, targets = (np.array([s[name] for s in samples]) for name in ("advantage", "target"))
        for sample in samples:
            sample["advantage"] = (sample["advantage"] - advantages.mean()) / advantages.std()
        size = self.count + len(targets)  # Of all targets so far, these among them.
        self.new_mean = (self.count * self.mean + targets.sum()) / size
        squares = self.count * (self.std**2 - 1e-6 + self.mean**2) + np.sum(targets**2)
        self.new_std = math.sqrt(squares / size - self.new_mean**2 + 1e-6)
        return samples

    def __call__(self, params):
        c, surrogate, value_loss, bounds = self.config, 0.0, 0.0, 0.0
        old_std, std = np.exp(self.old.log_std), np.exp(params.log_std)
        for s in self.samples:
            mean = self.network(params.actor, self.seen("actor", s["obs"]["actor"]))
            ratio = 1.0
            for k in range(ACTIONS):
                new = math.exp(-((s["action"][k] - mean[k]) ** 2) / (2 * std[k] ** 2)) / std[k]
                ratio *= new / (math.exp(-((s["action"][k] - s["mean"][k]) ** 2) / (2 * old_std[k] ** 2)) / old_std[k])
            good = s["advantage"] > 0
            surrogate += s["advantage"] * (min(ratio, 1 + c.clip_ratio) if good else max(ratio, 1 - c.clip_ratio))
            value = self.network(params.critic, self.seen("critic", s["obs"]["critic"]))[0]
            old, target = ((s[name] - self.new_mean) / self.new_std for name in ("value", "target"))
            errors = [(value - target) ** 2]
            if c.value_clip:
                errors.append((min(max(value, old - c.value_clip), old + c.value_clip) - target) ** 2)
            value_loss += 0.5 * max(errors)
            for k in range(ACTIONS):
                bounds += max(abs(mean[k]) - 1.1, 0.0) ** 2
        count = len(self.samples)
        entropy = sum(math.log(s) + 0.5 * math.log(2 * math.pi * math.e) for s in std)
        total = -surrogate + c.value_coefficient * value_loss + c.bounds_coefficient * bounds
        return total / count - c.entropy_coefficient * entropy

    def divergence(self, params):
        """KL divergence of the new policy from the old one, which the learning rate adapts to."""
        total, old_std, std = 0.0, np.exp(self.old.log_std), np.exp(params.log_std)
        for s in self.samples:
            mean = self.network(params.actor, self.seen("actor", s["obs"]["actor"]))
            for k in range(ACTIONS):
                spread = old_std[k] ** 2 + (s["mean"][k] - mean[k]) ** 2
                total += math.log(std[k] / old_std[k]) + spread / (2 * std[k] ** 2) - 0.5
        return total / len(self.samples)


@pytest.mark.parametrize("options", [{}, {"value_clip": 0.0}], ids=["clipped values", "plain values"])
def test_objective_and_gradient_from_raw_experience(options):
    """The value before and after a step of the update; the gradient along random directions of all parameters."""
    script, config, params, stats, value_stats, step = setting(3, **options)
    run = experience(script, config, params, stats, value_stats, jax.random.key(5))
    rng = np.random.default_rng(0)
    for share in (0.0, 1.0):
        actions, start, value, grads, kl = run(jax.tree.map(lambda x, share=share: share * x, step))
        reference = Reference(script, config, params, stats, value_stats, actions)
        here = jax.tree.map(lambda a, b, share=share: a + share * b, double(start), double(step))
        assert float(value) == pytest.approx(reference(here), rel=2e-5, abs=2e-5)
        assert float(kl) == pytest.approx(reference.divergence(here), rel=1e-4, abs=1e-6)
    # At the moved parameters only: with ratios of exactly one and unmoved values the objective has kinks.
    for _ in range(4):
        way = jax.tree.map(lambda x: rng.normal(size=x.shape), here)
        ends = [reference(jax.tree.map(lambda x, w, s=s: x + s * w, here, way)) for s in (1e-6, -1e-6)]
        slope = sum(np.sum(g * w) for g, w in zip(jax.tree.leaves(double(grads)), jax.tree.leaves(way), strict=True))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3, abs=1e-4)


def test_the_critics_values_survive_the_new_statistics():
    """In reward units, to the last digit that float32 has: the normaliser moves, the values do not."""
    script, config, params, stats, value_stats, step = setting(3)
    actions, start, *_ = experience(script, config, params, stats, value_stats, jax.random.key(5))(step)
    reference = Reference(script, config, params, stats, value_stats, actions)
    assert abs(reference.new_std / reference.std - 1) > 0.1
    for sample in reference.samples:
        after = reference.network(double(start).critic, reference.seen("critic", sample["obs"]["critic"]))[0]
        assert reference.new_mean + reference.new_std * after == pytest.approx(sample["value"], abs=1e-4)
