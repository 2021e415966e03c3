"""Collects experience: `T` steps of `B` environments under one `lax.scan`, policy inside."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.pytree import pytree_dataclass
from dexsim_ppo.types import Environment


@pytree_dataclass
class Decision:
    """What the policy did in one state; arrays [B, ...]."""

    action: jax.Array  # [B, A] the Gaussian sample, before any squashing
    mean: jax.Array  # [B, A]
    log_prob: jax.Array  # [B]


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


Act = Callable[[jax.Array, Mapping[str, jax.Array]], tuple[Decision, jax.Array]]
"""`act(key, obs) -> (decision, action for the environment [B, A])`"""
Value = Callable[[Mapping[str, jax.Array]], jax.Array]
"""`value(obs) -> [B]`"""


def collect(env: Environment, state: Any, key: jax.Array, act: Act, value: Value,
            length: int) -> tuple[Any, Rollout, dict[str, jax.Array]]:
    """Run the policy for `length` steps.

    The order is: act, step, record, restart. So the recorded flags, metrics and `next_value` belong to
    the true final state of an episode, and the next step starts from a fresh one.

    Args:
      state: batch [B] of environment states.

    Returns:
      The states to go on from, the experience, and scalar metrics: `step/<name>` is a mean over all
      steps, `episode/<name>` the mean of the last step's value over the episodes that ended (NaN if
      none did), `episodes` their number.
    """
    step_env = jax.vmap(env.step)

    def step(state, key):
        obs = dict(state.obs)
        decision, action = act(key, obs)
        after = step_env(state, action)
        done = after.terminated | after.truncated
        finite = jnp.isfinite(after.reward)
        record = Rollout(
            obs=obs, decision=decision, value=value(obs), next_value=value(after.obs),
            reward=jnp.where(finite, after.reward, 0.0),
            terminated=after.terminated, truncated=after.truncated & ~after.terminated,
        )
        sums = {"episodes": jnp.sum(done.astype(jnp.float32)),
                "terminated": jnp.sum(after.terminated.astype(jnp.float32)),
                "nonfinite_rewards": jnp.sum((~finite).astype(jnp.float32)),
                "step": {k: _sum(v, jnp.ones_like(done)) for k, v in after.metrics.items()},
                "episode": {k: _sum(v, done) for k, v in after.metrics.items()}}
        return restart_done(env, after, done), (record, sums)

    state, (rollout, sums) = jax.lax.scan(step, state, jax.random.split(key, length))
    sums = jax.tree.map(lambda x: jnp.sum(x, axis=0), sums)
    episodes, steps = sums["episodes"], rollout.reward.size
    metrics = {"reward": jnp.mean(rollout.reward), "episodes": episodes,
               "terminated_share": sums["terminated"] / episodes,
               "nonfinite_rewards": sums["nonfinite_rewards"]}
    metrics |= {f"step/{k}": v / steps for k, v in sums["step"].items()}
    metrics |= {f"episode/{k}": v / episodes for k, v in sums["episode"].items()}
    return state, rollout, metrics


def restart_done(env: Environment, state: Any, done: jax.Array) -> Any:
    """A new episode in the rows of `state` [B] that are `done` [B]; the others stay as they are.

    What `jax.vmap(env.restart)` does, but that computes a new episode for every row and throws nearly all of
    them away: few episodes end in any one step. Here the done rows are restarted a few at a time.
    """
    size = done.shape[0]
    count = min(max(size // 32, 8), size)

    def restart_some(carry):
        state, left = carry
        rows = jnp.nonzero(left, size=count, fill_value=size)[0]
        some = jax.tree.map(lambda x: x.at[rows].get(mode="clip"), state)
        # All are told that they are done, those that fill up, too: what nobody reads need not be fetched.
        fresh = jax.vmap(env.restart)(some, jnp.ones(count, bool))
        state = jax.tree.map(lambda x, new: x.at[rows].set(new, mode="drop"), state, fresh)
        return state, left.at[rows].set(False, mode="drop")

    return jax.lax.while_loop(lambda carry: jnp.any(carry[1]), restart_some, (state, done))[0]


def _sum(x: jax.Array, mask: jax.Array) -> jax.Array:
    """Sum of the finite elements of `x` [B] where `mask`."""
    x = x.astype(jnp.float32)
    return jnp.sum(jnp.where(mask & jnp.isfinite(x), x, 0.0))
