"""PPO in one file in the manner of CleanRL, on any Gymnasium vector environment: what its users bring to ours."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward, RecordEpisodeStatistics, TransformReward


class Agent(nn.Module):
    """Gaussian actor and critic."""

    actions: int

    @nn.compact
    def __call__(self, observation):
        hidden = observation
        for _ in range(2):
            hidden = nn.tanh(nn.Dense(32, kernel_init=nn.initializers.orthogonal(np.sqrt(2)))(hidden))
        mean = nn.Dense(self.actions, kernel_init=nn.initializers.orthogonal(0.01))(hidden)
        value = nn.tanh(nn.Dense(32)(observation))
        log_std = self.param("log_std", nn.initializers.constant(-0.5), (self.actions,))
        return mean, jnp.broadcast_to(log_std, mean.shape), nn.Dense(1)(value)[..., 0]


def log_probability(action, mean, log_std):
    return (-0.5 * ((action - mean) / jnp.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)).sum(-1)


def train(envs, iterations, *, steps=32, epochs=4, minibatches=4, gamma=0.95, lam=0.95, clip=0.2, rate=3e-3, seed=0):
    """Returns of all finished episodes, in order."""
    envs = RecordEpisodeStatistics(envs)
    envs = NormalizeReward(NormalizeObservation(envs), gamma=gamma)
    envs = TransformReward(envs, lambda reward: np.clip(reward, -10, 10))
    agent, random = Agent(envs.single_action_space.shape[0]), np.random.default_rng(seed)
    observation, _ = envs.reset(seed=seed)
    params = agent.init(jax.random.key(seed), observation)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate))
    moments, forward = optimizer.init(params), jax.jit(agent.apply)

    def loss(params, observation, action, logp, advantage, target, valid):
        mean, log_std, value = agent.apply(params, observation)
        ratio = jnp.exp(log_probability(action, mean, log_std) - logp)
        advantage = (advantage - advantage.mean(where=valid)) / (advantage.std(where=valid) + 1e-8)
        surrogate = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)
        return (-surrogate + 0.25 * (value - target) ** 2).mean(where=valid)

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(params, moments, batch):
        changes, moments = optimizer.update(jax.grad(loss)(params, *batch), moments)
        return optax.apply_updates(params, changes), moments

    returns, done = [], np.zeros(envs.num_envs, bool)
    for _ in range(iterations):
        rows = []
        for _ in range(steps):
            mean, log_std, value = map(np.asarray, forward(params, observation))
            action = mean + np.exp(log_std) * random.standard_normal(mean.shape)
            after, reward, terminated, truncated, info = envs.step(action.astype(np.float32))
            # After an end comes a step that only restarts: no sample.
            logp = np.asarray(log_probability(action, mean, log_std))
            rows.append((observation, action, logp, value, reward, terminated, terminated | truncated, ~done))
            observation, done = after, terminated | truncated
            if "episode" in info:
                returns.extend(info["episode"]["r"][info["_episode"]])
        last = np.asarray(forward(params, observation)[2])
        observations, actions, logps, values, rewards, ends, dones, valid = (
            np.stack(x) for x in zip(*rows, strict=True)
        )
        # The observation that follows a time limit is the episode's last: its value is the bootstrap.
        following = np.concatenate([values[1:], last[None]])
        delta = rewards + gamma * following * ~ends - values
        advantages, running = np.zeros_like(rewards), np.zeros(envs.num_envs)
        for t in reversed(range(steps)):
            running = delta[t] + gamma * lam * ~dones[t] * running
            advantages[t] = running
        samples = observations, actions, logps, advantages, advantages + values, valid
        flat = [x.reshape(-1, *x.shape[2:]).astype(x.dtype if x.dtype == bool else np.float32) for x in samples]
        for _ in range(epochs):
            for part in np.split(random.permutation(len(flat[0])), minibatches):
                params, moments = update(params, moments, tuple(x[part] for x in flat))
    return np.array(returns)
