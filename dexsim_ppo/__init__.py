"""PPO in pure JAX: train an environment, save a policy, run it anywhere.

    from dexsim_ppo import evaluate_policy, load_policy, train_policy
    trained = train_policy("grasp", minutes=5)
    report = evaluate_policy(trained.policy, episodes=256)

Names are imported at first use: loading a policy loads neither MuJoCo nor MJX.
"""

from typing import TYPE_CHECKING

from dexsim.core.lazy_loading import lazy_exports

if TYPE_CHECKING:
    from dexsim_ppo.evaluate import evaluate_policy
    from dexsim_ppo.learner.config import CurriculumConfig, PPOConfig
    from dexsim_ppo.learner.ppo import TrainState, make_train
    from dexsim_ppo.policy import Policy, act, load_policy
    from dexsim_ppo.train import TrainResult, train_policy

__all__ = [
    "CurriculumConfig",
    "PPOConfig",
    "Policy",
    "TrainResult",
    "TrainState",
    "act",
    "evaluate_policy",
    "load_policy",
    "make_train",
    "train_policy",
]

__getattr__, __dir__ = lazy_exports(__name__, __all__)
