"""Collects experience: T steps of B environments and the policy inside one `lax.scan`."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dexsim.core.pytree import choose, pytree_dataclass
from dexsim_ppo.learner import distribution
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.distribution import Decision
from dexsim_ppo.learner.loss import actor_step, critic_value, make_normalizers
from dexsim_ppo.learner.running_stats import RunningStats, value_std
from dexsim_ppo.learner.sharding import batched
from dexsim_ppo.learner.types import Environment, TrainState

# A reward beyond this many deviations of the returns is a fault of the simulation, not something to learn from. It is
# bounded, not dropped: where rewards do grow, each iteration raises the bound.
_FAR = 100.0
_FAR_AT_FIRST = 1000.0  # of the root mean square of the other rewards, while there are no returns

_RESERVE_STEPS = 16  # short compared with an episode; makes a batch of new episodes cheap per step


@pytree_dataclass
class Rollout:
    """Experience [T, B, ...]. Observations are raw: not normalised."""

    obs: dict[str, jax.Array]
    decision: Decision
    value: jax.Array  # [T, B] of `obs`
    next_value: jax.Array  # [T, B] of the observation after the step, before any restart
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    carry: jax.Array | None = None  # [T, B, m] of the policy's memory before the step


def collect_rollout(
    env: Environment, config: PPOConfig, state: TrainState, mesh: Mesh | None = None
) -> tuple[tuple[Any, jax.Array | None], Rollout, dict[str, jax.Array]]:
    """Run the policy for T steps.

    The order is act, step, record, restart: the recorded flags, metrics and `next_value` belong to the true
    final state of an episode, and the next step starts from a fresh one, with a zero carry.

    Returns:
      The last environment states [B] and carry [B, m], the experience, whose values are in reward units, and its
      metrics; see `rollout_metrics`.
    """
    normalizers, key = make_normalizers(env, state.observation_stats), jax.random.split(state.key, 3)[1]
    params, std, step_env = state.params, value_std(state.value_stats), batched(env.step, mesh)

    def value(obs, carry):
        return state.value_stats.mean + std * critic_value(config, params, normalizers, obs, carry)

    def step(now, key):
        env_state, carry, value_now = now
        obs = dict(env_state.obs)
        next_carry, mean = actor_step(config, params, normalizers, obs, carry)
        action = distribution.sample(jax.random.normal(key, mean.shape), mean, params.log_std)
        after = step_env(env_state, jnp.clip(action, -1.0, 1.0))
        next_value = value(after.obs, next_carry)
        record = Rollout(
            obs=obs,
            decision=Decision(action, mean, distribution.log_prob(action, mean, params.log_std)),
            value=value_now,
            next_value=next_value,
            reward=after.reward,
            terminated=after.terminated,
            truncated=after.truncated,
            carry=carry,
        )
        return (after, next_carry, next_value), after.terminated | after.truncated, (record, dict(after.metrics))

    def begin(env_state, carry, done):
        return env.restart(env_state, done), jax.tree.map(lambda x: jnp.where(done, 0.0, x), carry)

    def restart(now, done):
        env_state, carry = batched(begin, mesh)(*now[:2], done)
        return env_state, carry, jnp.where(done, value(env_state.obs, carry), now[2])

    # The value travels with the state: that of the next observation is the next step's, but where an episode begins.
    first = state.env_state, state.carry, value(state.env_state.obs, state.carry)
    keys = jax.random.split(key, config.rollout_length)
    (*last, _), (rollout, step_metrics) = scan_restarting(restart, step, first, keys)
    finite = jnp.isfinite(rollout.reward)
    rollout = dataclasses.replace(rollout, reward=jnp.where(finite, rollout.reward, 0.0))
    return tuple(last), rollout, rollout_metrics(rollout, finite, step_metrics)


def rollout_metrics(rollout: Rollout, finite: jax.Array, step_metrics: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """Scalars: `step/<name>` is a mean over all steps, `episode/<name>` the mean final value over the episodes that
    ended (NaN if none did), `episodes` their number. `finite` [T, B] says whether the environment's reward was, and
    `step_metrics` [T, B] are its own."""
    done = rollout.terminated | rollout.truncated
    counted = (rollout.reward, done, rollout.terminated, ~finite)
    # Sums are taken outside the scan: inside it each would reduce few numbers, which is slow on GPUs. One product gives
    # all of them, so that several processes exchange one array.
    values = jnp.stack([v.astype(jnp.float32) for v in (*counted, *step_metrics.values())])
    masks = jnp.stack([jnp.ones_like(done), done]).astype(jnp.float32)
    sums, ended_sums = jnp.einsum(
        "ktb,mtb->mk", jnp.where(jnp.isfinite(values), values, 0.0), masks, precision="highest"
    )
    reward, ended, terminated, nonfinite = sums[: len(counted)]
    metrics = {
        "reward": reward / done.size,
        "episodes": ended,
        "terminated_share": terminated / ended,
        "nonfinite_rewards": nonfinite,
    }
    for name, of, count in (("step", sums, done.size), ("episode", ended_sums, ended)):
        metrics |= {f"{name}/{k}": v / count for k, v in zip(step_metrics, of[len(counted) :], strict=True)}
    return metrics


def scan_restarting(
    restart: Callable[[Any, jax.Array], Any],
    step: Callable[[Any, Any], tuple[Any, jax.Array, Any]],
    state: Any,
    inputs: Any,
) -> tuple[Any, Any]:
    """`jax.lax.scan` that starts a new episode after each step wherever one ended.

    Calling `restart` after every step would compute a new episode for every environment and discard
    nearly all of them. Instead one new episode per environment is kept in reserve and renewed after at most
    16 steps; an environment whose episode ends twice within that time starts the same episode twice.
    Restarting only the rows that ended would make a GPU wait for the host at every step.

    Args:
      restart: `(states [B], done [B]) -> states`, new where `done`.
      step: `(states [B], input) -> (next states, done [B], output)`, without restarting.
      inputs: pytree [T, ...].

    Returns:
      The last states and the outputs [T, ...].
    """
    length = jax.tree.leaves(inputs)[0].shape[0]
    block = max(n for n in range(1, _RESERVE_STEPS + 1) if length % n == 0)
    restart = jax.jit(restart)

    def run_block(state, inputs):
        everyone = jnp.ones(jax.tree.leaves(state)[0].shape[0], bool)
        # The second call advances the random keys that the first one used.
        fresh, state = restart(state, everyone), restart(state, ~everyone)

        def run_step(state, step_input):
            after, done, output = step(state, step_input)
            return jax.vmap(choose)(done, fresh, after), output

        return jax.lax.scan(run_step, state, inputs)

    blocks = jax.tree.map(lambda x: x.reshape(length // block, block, *x.shape[1:]), inputs)
    state, outputs = jax.lax.scan(run_block, state, blocks)
    return state, jax.tree.map(lambda x: x.reshape(length, *x.shape[2:]), outputs)


def bound_rewards(rollout: Rollout, returns: RunningStats) -> tuple[Rollout, jax.Array]:
    """Bound rewards so far from all others that they would ruin the value normaliser for hundreds of iterations; also
    the number [] of these. `returns` [] are statistics of the returns so far."""
    size = jnp.abs(rollout.reward).reshape(-1)
    others = jnp.where(jnp.arange(size.size) == jnp.argmax(size), 0.0, size)  # one fault must not excuse itself
    spread = jnp.sqrt(jnp.mean(others**2))
    at_first = _FAR_AT_FIRST * jnp.where(spread > 0, spread, 1.0)  # A sparse reward may come once.
    limit = jnp.where(returns.count > 0, _FAR * value_std(returns), at_first)
    bounded = jnp.sum(size > limit, dtype=jnp.float32)
    return dataclasses.replace(rollout, reward=jnp.clip(rollout.reward, -limit, limit)), bounded
