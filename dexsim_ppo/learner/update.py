"""The update: epochs over shuffled minibatches, gradient clipping, Adam, the adaptive learning rate."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dexsim_ppo.learner.config import STD_MAX, STD_MIN, PPOConfig
from dexsim_ppo.learner.loss import Metrics, Normalizers, Samples, loss
from dexsim_ppo.learner.networks import Params
from dexsim_ppo.learner.sharding import averaged
from dexsim_ppo.learner.types import AdamState


class Learner(NamedTuple):
    """What the minibatch loop carries."""

    params: Params
    adam: AdamState
    learning_rate: jax.Array
    skipped_updates: jax.Array


def update(
    config: PPOConfig,
    normalizers: Normalizers,
    samples: Samples,
    key: jax.Array,
    learner: Learner,
    mesh: Mesh | None = None,
) -> tuple[Learner, Metrics]:
    """All epochs over shuffled minibatches, then the learning rate of the next iteration.

    Each block of `samples` [K, rows, ...] is shuffled by itself and gives the same share of every minibatch: a device
    needs no rows of another one. Metrics are means over all minibatches, except the KL divergence: its mean over the
    last epoch.
    """
    blocks, rows = samples.advantage.shape[:2]
    order = draw_order(key, config.epochs * blocks, rows)
    order = order.reshape(config.epochs, blocks, config.minibatches, -1).swapaxes(1, 2)
    order = order.reshape(config.epochs * config.minibatches, blocks, -1)
    old_log_std, moves = learner.params.log_std, actor_learns(config, learner)

    def part_of_gradients(shared, split):
        params, normalizers, old_log_std = shared
        return jax.grad(loss, has_aux=True)(params, config, normalizers, pick_rows(*split), old_log_std)

    gradients = averaged(part_of_gradients, mesh)

    def minibatch(learner, indices):
        grads, metrics = gradients((learner.params, normalizers, old_log_std), (samples, indices))
        learner, norms = apply_gradients(config, learner, grads)
        return learner, metrics | norms

    learner, metrics = jax.lax.scan(minibatch, learner, order)
    last_epoch = metrics["kl"][-config.minibatches :]
    metrics = jax.tree.map(jnp.nanmean, metrics) | {"kl": jnp.nanmean(last_epoch)}
    iteration = learner.adam.count / (config.epochs * config.minibatches)  # skipped minibatches not counted
    rate = adapt_learning_rate(config, learner.learning_rate, metrics["kl"], iteration)
    if config.critic_first:  # A policy that does not move says nothing about the rate.
        rate = jnp.where(moves, rate, learner.learning_rate)
    return learner._replace(learning_rate=rate), metrics


def draw_order(key: jax.Array, times: int, rows: int) -> jax.Array:
    """All rows in random order, int32 [times, rows], an eighth of the time of `jax.random.permutation` on a CPU.

    Sorts random numbers whose low bits are the row's. Rows with equal random bits keep their order, which matters only
    where such a group meets the edge of a minibatch.
    """
    width = (rows - 1).bit_length()
    number = jax.random.bits(key, (times, rows), jnp.uint32) >> width << width
    ordered = jnp.sort(number | jnp.arange(rows, dtype=jnp.uint32)[None], axis=1)
    return (ordered & ((1 << width) - 1)).astype(jnp.int32)


def pick_rows(samples: Samples, indices: jax.Array) -> Samples:
    """Rows `indices` [K, M] of each block of `samples` [K, rows, ...], as [K * M, ...]."""
    flat = (indices + samples.advantage.shape[1] * jnp.arange(len(indices))[:, None]).reshape(-1)
    rows = lambda x: x.reshape(-1, *x.shape[2:]).at[flat].get(mode="promise_in_bounds")  # noqa: E731
    return jax.tree.map(rows, samples)


def apply_gradients(config: PPOConfig, learner: Learner, grads: Params) -> tuple[Learner, Metrics]:
    """Clip the gradients and step. A minibatch whose gradient is not finite is skipped and counted."""
    actor = (grads.actor, grads.log_std, grads.memory)
    (actor_grads, std_grads, memory_grads), actor_norm = clip_by_global_norm(actor, config.max_grad_norm)
    critic_grads, critic_norm = clip_by_global_norm(grads.critic, config.max_grad_norm)
    grads = Params(actor_grads, std_grads, critic_grads, memory_grads)
    params, moments = step_adam(grads, learner.adam, learner.params, learner.learning_rate)
    # Projected after the step, not clipped in the loss: beyond a clip the gradient is zero, and it could not return.
    log_std = jnp.clip(params.log_std, jnp.log(STD_MIN), jnp.log(STD_MAX))
    params = dataclasses.replace(params, log_std=log_std)
    if config.critic_first:
        # Adam's moments follow the gradient from the start, so that the actor's first step is small. The critic keeps
        # its rate: at the actor's it would fall behind, and the actor would climb its errors.
        moves = actor_learns(config, learner)
        held = jax.tree.map(functools.partial(jnp.where, moves), params, learner.params)
        quick, _ = step_adam(grads, learner.adam, learner.params, jnp.float32(config.learning_rate_max))
        params = dataclasses.replace(held, critic=quick.critic)
    ok = jnp.isfinite(actor_norm) & jnp.isfinite(critic_norm)
    new = learner._replace(params=params, adam=moments)
    learner = jax.tree.map(functools.partial(jnp.where, ok), new, learner)
    skipped = learner.skipped_updates + (1 - ok.astype(jnp.int32))
    return learner._replace(skipped_updates=skipped), {"actor_grad_norm": actor_norm, "critic_grad_norm": critic_norm}


def step_adam(grads: Params, state: AdamState, params: Params, learning_rate: jax.Array) -> tuple[Params, AdamState]:
    """One step down the gradient: new parameters and moments. `learning_rate` is []."""
    b1, b2, epsilon = 0.9, 0.999, 1e-5
    count = state.count + 1
    mean = jax.tree.map(lambda m, g: b1 * m + (1 - b1) * g, state.mean, grads)
    variance = jax.tree.map(lambda v, g: b2 * v + (1 - b2) * g**2, state.variance, grads)
    time = count.astype(jnp.float32)
    mean_scale, variance_scale = 1 / (1 - b1**time), 1 / (1 - b2**time)

    def step(p, m, v):
        return p - learning_rate * (m * mean_scale) / (jnp.sqrt(v * variance_scale) + epsilon)

    return jax.tree.map(step, params, mean, variance), AdamState(count, mean, variance)


def clip_by_global_norm(grads: Any, max_norm: float) -> tuple[Any, jax.Array]:
    """Scale gradients longer than `max_norm` down to it; also return the norm [] before clipping."""
    norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(grads)))
    scale = jnp.minimum(1.0, max_norm / jnp.maximum(norm, 1e-12))
    return jax.tree.map(lambda g: g * scale, grads), norm


def actor_learns(config: PPOConfig, learner: Learner) -> jax.Array:
    """Whether the initial iterations for the critic alone are over: bool []."""
    return learner.adam.count >= config.critic_first * config.epochs * config.minibatches


def adapt_learning_rate(config: PPOConfig, rate: jax.Array, kl: jax.Array, iteration: jax.Array) -> jax.Array:
    """The next learning rate []: lower above twice the target KL, higher below half of it, within its bounds.

    `kl` [] measures the whole iteration: adapting after every minibatch would overshoot.
    """
    if config.kl_target == 0:
        return rate
    target = config.kl_target / (1.0 + iteration / config.kl_halving) if config.kl_halving else config.kl_target
    slower = jnp.maximum(rate / 1.5, config.learning_rate_min)
    faster = jnp.minimum(rate * 1.5, config.learning_rate_max)
    rate = jnp.where(kl > 2 * target, slower, rate)
    return jnp.where(kl < 0.5 * target, faster, rate)
