"""PPO in pure JAX: train an environment, save a policy, run it anywhere.

    from dexsim_ppo import evaluate_policy as evaluate_policy, load_policy as load_policy, train_policy as train_policy
    trained = train_policy("grasp", minutes=5)
    report = evaluate_policy(trained.policy, episodes=256)

Names are imported at first use: loading a policy loads neither MuJoCo nor MJX.
"""

from typing import TYPE_CHECKING

from dexsim.core.lazy_loading import lazy_exports

if TYPE_CHECKING:
    from dexsim_ppo.evaluate import evaluate_policy as evaluate_policy
    from dexsim_ppo.learner.config import CurriculumConfig as CurriculumConfig, PPOConfig as PPOConfig
    from dexsim_ppo.learner.ppo import TrainState as TrainState, make_train as make_train
    from dexsim_ppo.policy import Policy as Policy, act as act, load_policy as load_policy
    from dexsim_ppo.train import TrainResult as TrainResult, train_policy as train_policy

__all__, __getattr__, __dir__ = lazy_exports(__name__)
