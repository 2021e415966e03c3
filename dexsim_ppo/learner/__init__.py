"""PPO in pure JAX, for any environment with `reset`, `step`, `restart` and `randomize_episode_time`."""
