"""PPO in pure JAX. Knows an environment only by its `reset`, `step`, `restart` and `stagger`."""
