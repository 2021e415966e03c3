"""PPO's whole objective and its gradient against NumPy, written sample by sample from the papers' formulas."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import SMALL

from dexsim_ppo.learner.loss import Samples, loss
from dexsim_ppo.learner.networks import Layer, Params
from dexsim_ppo.learner.rollout import Decision
from dexsim_ppo.learner.running_stats import Normalizer

ROWS, ACTIONS, CLIP, VALUE_CLIP = 40, 2, 0.2, 0.3
FULL = dataclasses.replace(
    SMALL,
    actor_layers=(),
    critic_layers=(),
    clip_ratio=CLIP,
    value_clip=VALUE_CLIP,
    value_coefficient=0.7,
    entropy_coefficient=0.3,
    bounds_coefficient=0.4,
)


def problem(seed: int = 0):
    """Linear networks without bias, an identity normaliser, and a batch in which every branch is taken."""
    rng = np.random.default_rng(seed)
    arrays = {
        "obs": rng.normal(size=(ROWS, 3)),
        "noise": rng.normal(size=(ROWS, ACTIONS)),
        "old_mean": rng.normal(0, 1.2, (ROWS, ACTIONS)),
        "old_log_std": np.log([0.5, 0.9]),
        "advantage": rng.normal(size=ROWS),
        "value": rng.normal(size=ROWS),
        "target": rng.normal(size=ROWS),
        "weights": np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :ACTIONS],
        "log_std": np.log([0.6, 0.8]),
        "critic": rng.normal(size=(3, 1)),
    }
    arrays["old_mean"] = arrays["obs"] @ arrays["weights"] + 0.2 * arrays["old_mean"]
    return arrays


def by_hand(a, *, tanh: bool) -> float:
    """Schulman et al. (2017), eq. 7 and 9, with the value clipping of its reference code; one sample at a time."""
    surrogate = value_loss = bounds = squashing = 0.0
    old_std, std = np.exp(a["old_log_std"]), np.exp(a["log_std"])
    density = lambda x, mean, std: float(  # noqa: E731
        np.prod(np.exp(-((x - mean) ** 2) / (2 * std**2)) / np.sqrt(2 * np.pi * std**2))
    )
    for i in range(ROWS):
        mean, old_mean = a["obs"][i] @ a["weights"], a["old_mean"][i]
        action = old_mean + old_std * a["noise"][i]
        ratio = density(action, mean, std) / density(action, old_mean, old_std)
        advantage = a["advantage"][i]
        if advantage > 0:  # The gain of a likelier good action, or of a rarer bad one, is cut off.
            surrogate += min(ratio, 1 + CLIP) * advantage
        else:
            surrogate += max(ratio, 1 - CLIP) * advantage
        value, old, target = float(a["obs"][i] @ a["critic"][:, 0]), a["value"][i], a["target"][i]
        near = min(max(value, old - VALUE_CLIP), old + VALUE_CLIP)
        value_loss += max((value - target) ** 2, (near - target) ** 2) / 2
        bounds += sum(max(0.0, abs(m) - 1.1) ** 2 for m in mean)
        squashing += sum(math.log(1 - math.tanh(x) ** 2) for x in mean + std * a["noise"][i])
    entropy = sum(math.log(s * math.sqrt(2 * math.pi * math.e)) for s in std)
    total = -surrogate / ROWS + 0.7 * value_loss / ROWS
    # More entropy is a lower objective: it is a bonus.
    return total - 0.3 * (entropy + squashing / ROWS) if tanh else total + 0.4 * bounds / ROWS - 0.3 * entropy


def by_library(a, *, tanh: bool):
    """The library's objective as a function of what is learnt."""
    config = dataclasses.replace(FULL, distribution="tanh" if tanh else "gaussian")
    f = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    action = a["old_mean"] + np.exp(a["old_log_std"]) * a["noise"]
    z = (action - a["old_mean"]) / np.exp(a["old_log_std"])
    log_prob = np.sum(-(z**2) / 2 - a["old_log_std"] - np.log(2 * np.pi) / 2, axis=1)
    batch = Samples(
        obs={"actor": f(a["obs"]), "critic": f(a["obs"])},
        decision=Decision(f(action), f(a["old_mean"]), f(log_prob)),
        advantage=f(a["advantage"]),
        value=f(a["value"]),
        target=f(a["target"]),
    )
    same = Normalizer(jnp.zeros(3), jnp.ones(3), clip=100.0)

    def objective(weights, log_std, critic):
        layers = Layer(weights, jnp.zeros(ACTIONS)), Layer(critic, jnp.zeros(1))
        params = Params((layers[0],), log_std, (layers[1],))
        return loss(params, config, {"actor": same, "critic": same}, batch, f(a["old_log_std"]))

    learnt = tuple(f(a[name]) for name in ("weights", "log_std", "critic"))
    return jax.value_and_grad(objective, argnums=(0, 1, 2), has_aux=True)(*learnt)


@pytest.mark.parametrize("tanh", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_objective_and_gradient(tanh, seed):
    a = problem(seed)
    (value, _), grads = by_library(a, tanh=tanh)
    assert float(value) == pytest.approx(by_hand(a, tanh=tanh), rel=2e-5)
    for name, grad in zip(("weights", "log_std", "critic"), grads, strict=True):
        found = np.zeros_like(a[name])
        for index in np.ndindex(found.shape):
            ends = []
            for step in (1e-6, -1e-6):
                moved = a | {name: a[name].copy()}
                moved[name][index] += step
                ends.append(by_hand(moved, tanh=tanh))
            found[index] = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(grad, found, rtol=2e-3, atol=2e-5, err_msg=name)


def ratios(a) -> np.ndarray:
    """The new policy's density over the old one's, of each action."""
    mean = a["obs"] @ a["weights"]
    action = a["old_mean"] + np.exp(a["old_log_std"]) * a["noise"]
    log = lambda mean, log_std: np.sum(  # noqa: E731
        -(((action - mean) / np.exp(log_std)) ** 2) / 2 - log_std, axis=1
    )
    return np.exp(log(mean, a["log_std"]) - log(a["old_mean"], a["old_log_std"]))


def test_the_share_that_is_clipped_counts_both_sides():
    a = problem()
    ratio = ratios(a)
    (_, metrics), _ = by_library(a, tanh=False)
    assert np.any(ratio < 1 - CLIP) and np.any(ratio > 1 + CLIP)
    assert float(metrics["clip_fraction"]) == pytest.approx(np.mean((ratio < 1 - CLIP) | (ratio > 1 + CLIP)))


def test_the_batch_takes_every_branch():
    """Otherwise a clip without effect would pass."""
    a = problem()
    ratio, mean, value = ratios(a), a["obs"] @ a["weights"], a["obs"] @ a["critic"][:, 0]
    for good in (a["advantage"] > 0, a["advantage"] < 0):
        for clipped in (ratio > 1 + CLIP, ratio < 1 - CLIP, np.abs(ratio - 1) < CLIP):
            assert np.any(good & clipped)
    near = np.clip(value, a["value"] - VALUE_CLIP, a["value"] + VALUE_CLIP)
    further = (near - a["target"]) ** 2 > (value - a["target"]) ** 2
    assert 5 < further.sum() < ROWS - 5 and np.any(np.abs(value - a["value"]) < VALUE_CLIP)
    assert np.any(np.abs(mean) > 1.1) and np.any(np.abs(mean) < 1.1)


def test_more_entropy_is_a_bonus():
    """One step down the gradient of an objective of entropy alone widens the policy."""
    a = problem() | {"advantage": np.zeros(ROWS)}
    _, (_, log_std, _) = by_library(a, tanh=False)
    np.testing.assert_allclose(log_std, -0.3, rtol=1e-5)
