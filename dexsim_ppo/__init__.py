"""PPO in pure JAX: train an environment, save a policy, run it anywhere."""

from dexsim_ppo.policy import Policy, act
from dexsim_ppo.ppo import PPOConfig, TrainState, make_train

__all__ = ["PPOConfig", "Policy", "TrainState", "act", "make_train"]
