"""Settings of the learner and of the curriculum."""

from dataclasses import dataclass
from typing import Literal

from dexsim.core.config import Config, setting
from dexsim.errors import ConfigError

STD_MIN, STD_MAX = 0.05, 1.0
"""Bounds of the actions' standard deviation during training. More than 1 is mostly clipped at +-1."""


@dataclass(frozen=True, kw_only=True)
class PPOConfig(Config):
    """Settings of the learner."""

    num_envs: int = setting(4096, unit="1", low=1)
    """Environments simulated side by side (B)."""
    rollout_length: int = setting(16, unit="steps", low=1)
    """Steps of each environment per iteration (T)."""
    epochs: int = setting(5, unit="1", low=1)
    """Passes over the experience of one iteration."""
    minibatches: int = setting(4, unit="1", low=1)
    """Minibatches per epoch; must divide T * B, with `gru` B."""
    iterations_per_call: int = setting(1, unit="1", low=1)
    """Iterations inside one compiled call."""
    discount: float = setting(0.99, unit="1", low=0.0, high=1.0)
    """Weight of the next step's return."""
    gae_lambda: float = setting(0.95, unit="1", low=0.0, high=1.0)
    """Weight of longer returns in the advantage."""
    clip_ratio: float = setting(0.2, unit="1", low=1e-3, high=1.0)
    """Relative change of an action's probability beyond which its gradient is zero."""
    value_clip: float = setting(0.2, unit="value deviations", low=0.0)
    """Change of a value beyond which its gradient is zero; 0 turns value clipping off."""
    entropy_coefficient: float = setting(0.0, unit="1", low=0.0)
    """Weight of the entropy bonus."""
    bounds_coefficient: float = setting(1e-3, unit="1", low=0.0)
    """Weight of the penalty on Gaussian means beyond +-1.1."""
    max_grad_norm: float = setting(1.0, unit="1", low=1e-6)
    """Norm that the gradients of actor and critic are each clipped to."""
    learning_rate: float = setting(5e-4, unit="1", low=0.0, high=1.0)
    """Adam's step size, at the start if it adapts."""
    learning_rate_min: float = setting(1e-5, unit="1", low=0.0, high=1.0)
    """Lower end of the adaptive learning rate."""
    learning_rate_max: float = setting(2e-3, unit="1", low=0.0, high=1.0)
    """Upper end of the adaptive learning rate."""
    kl_target: float = setting(0.012, unit="nats", low=0.0)
    """KL divergence per iteration that the learning rate adapts to; 0 keeps the rate fixed."""
    kl_halving: int = setting(0, unit="iterations", low=0)
    """Iterations after which `kl_target` has halved; after twice as many it is a third. 0 keeps it."""
    critic_first: int = setting(0, unit="iterations", low=0)
    """Initial iterations that train only the critic: in fine-tuning it is new. Above 0, the critic always learns at
    `learning_rate_max`."""
    initial_std: float = setting(0.6, unit="1", low=STD_MIN, high=STD_MAX)
    """Initial standard deviation of actions, whose range is [-1, 1]."""
    actor_layers: tuple[int, ...] = setting((512, 256, 128), unit="1", low=1)
    """Hidden layer sizes of the actor."""
    critic_layers: tuple[int, ...] = setting((512, 256, 128), unit="1", low=1)
    """Hidden layer sizes of the critic."""
    memory: Literal["none", "gru"] = setting("none")
    """What the policy keeps of an episode: nothing, or the state of a gated recurrent unit."""
    memory_size: int = setting(64, unit="1", low=1, high=4096)
    """Units of `gru`. Its gradient goes back to the start of the rollout."""
    matmul_precision: Literal["default", "high", "highest"] = setting("highest")
    """Precision of the networks' matrix products; on NVIDIA GPUs `default` is TF32."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rows % self.minibatches:
            of = "" if self.memory == "gru" else " * PPOConfig.rollout_length"
            raise ConfigError(
                f"PPOConfig.minibatches = {self.minibatches}: must divide PPOConfig.num_envs{of}, which is {self.rows}"
            )
        if not self.learning_rate_min <= self.learning_rate <= self.learning_rate_max:
            raise ConfigError(
                f"PPOConfig.learning_rate = {self.learning_rate:g}: must be between PPOConfig.learning_rate_min "
                f"= {self.learning_rate_min:g} and PPOConfig.learning_rate_max = {self.learning_rate_max:g}"
            )

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps collected in one iteration, T * B."""
        return self.num_envs * self.rollout_length

    @property
    def rows(self) -> int:
        """Rows of experience that minibatches are drawn from: steps, or with a GRU whole rollouts."""
        return self.num_envs if self.memory == "gru" else self.steps_per_iteration


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Config):
    """How the scale of the randomisation ranges follows the success rate. The scale is part of the training state."""

    on: bool = setting(False)
    """Widen the ranges during training; otherwise they have their full width from the start."""
    metric: str = setting("")
    """Training metric that measures success, such as episode/successes. Empty: the share of ended episodes that
    reached their time limit."""
    start: float = setting(0.1, unit="1", low=0.0, high=1.0)
    """Initial scale."""
    widen_above: float = setting(0.8, unit="1", low=0.0, high=1e6)
    """Success at or above which the ranges widen."""
    narrow_below: float = setting(0.4, unit="1", low=0.0, high=1e6)
    """Success below which the ranges narrow."""
    step: float = setting(0.02, unit="1", low=0.0001, high=1.0)
    """Change of the scale per iteration."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.narrow_below > self.widen_above:
            raise ConfigError(
                f"CurriculumConfig.narrow_below = {self.narrow_below:g}: must not exceed widen_above = "
                f"{self.widen_above:g}"
            )
