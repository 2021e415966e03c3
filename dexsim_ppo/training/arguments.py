"""Options of the training command."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from dexsim.core.config import setting, to_dict, validate
from dexsim.core.errors import ConfigError
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.curriculum import Curriculum

EnvConfig = TypeVar("EnvConfig")


@dataclass(frozen=True, kw_only=True)
class TrainArguments(Generic[EnvConfig]):
    """Options of `python -m dexsim_ppo.train`."""

    env: EnvConfig
    """The task's settings."""
    ppo: PPOConfig
    """The learner's settings; their defaults depend on the preset."""
    curriculum: Curriculum = setting(Curriculum())
    """Widen the randomisation as the policy succeeds."""
    extremes: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of training's hands and objects that get the extreme of every range at once. Evaluations and the policy's
    file keep to the settings of `--env`."""
    task: str = "grasp"
    """Task to train; my_module:poke for a task of your own."""
    seed: int = setting(0, unit="1", low=0, high=2**32 - 1)
    """Seed of everything random."""
    backend: Literal["auto", "jax", "warp", "c"] = setting("auto")
    """Physics backend. auto: warp on a GPU if it is installed, otherwise jax."""
    preset: Literal["auto", "cpu", "gpu"] = setting("auto")
    """Default sizes and durations. auto: those of the device found."""
    steps: float = setting(0.0, unit="environment steps", low=0.0)
    """Stop after this many steps, including those before a resume; 0 for no limit."""
    minutes: float = setting(0.0, unit="min", low=0.0)
    """Budget of training time, including compilation and the time before a resume; 0 for no limit. With --steps and
    without --minutes there is no limit."""
    run_dir: Path | None = None
    """Folder to write to, which must not exist yet; None for a new runs/TASK-TIME."""
    resume: Path | None = None
    """Folder of a run, or one of its checkpoints, to resume exactly; None starts a new run."""
    policy: str = ""
    """Policy to fine-tune: a file, or the name of a shipped one. Its task and configuration are the defaults. Empty:
    train from scratch."""
    video: bool = True
    """Render a video at the end."""
    log_every: int = setting(1, unit="iterations", low=1)
    """Iterations between logged metrics."""
    checkpoint_every: int = setting(100, unit="iterations", low=1)
    """Iterations between checkpoints."""
    keep_checkpoints: int = setting(3, unit="1", low=1)
    """Number of latest checkpoints to keep."""
    evaluate_every: int = setting(0, unit="iterations", low=0)
    """Iterations between the evaluations that choose the best policy; 0 for none."""
    evaluation_chunk: int = setting(32, unit="episodes", low=1)
    """Episodes evaluated in parallel; an evaluation during training is one chunk."""
    evaluation_episodes: int = setting(128, unit="episodes", low=1)
    """Episodes of the final evaluation."""

    def __post_init__(self) -> None:
        validate(self)


def training_config(arguments: TrainArguments) -> Any:
    """The task's configuration with the share of extremes that training uses.

    Raises:
      ConfigError: extremes for a task without randomisation ranges.
    """
    env, share = arguments.env, arguments.extremes
    if not share:
        return env
    if not (hasattr(env, "randomization") and hasattr(env, "objects")):
        raise ConfigError(f"--extremes {share:g}: task {arguments.task!r} has no randomisation ranges")
    return dataclasses.replace(
        env,
        randomization=dataclasses.replace(env.randomization, extremes=share),
        objects=dataclasses.replace(env.objects, extremes=share),
    )


def printable(arguments: TrainArguments) -> dict[str, Any]:
    """The options as plain data, without the paths of this process."""
    data = to_dict(dataclasses.replace(arguments, run_dir=None, resume=None))
    return {k: v for k, v in data.items() if k not in ("run_dir", "resume")}
