"""Options of the training command."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from dexsim.core.config import Config, flat, from_dict, setting, to_dict
from dexsim.errors import ConfigError
from dexsim.hand.description import Hand
from dexsim.hand.load import load_hand
from dexsim.hand.source import check_same, recorded_hand
from dexsim_ppo.checkpoint import Checkpoint
from dexsim_ppo.learner.config import CurriculumConfig, PPOConfig
from dexsim_ppo.learner.networks import carry_size
from dexsim_ppo.policy import Policy

EnvConfig = TypeVar("EnvConfig")


@dataclass(frozen=True, kw_only=True)
class TrainArguments(Config, Generic[EnvConfig]):
    """Options of `python -m dexsim_ppo.train`."""

    env: EnvConfig
    """The task's settings."""
    ppo: PPOConfig
    """The learner's settings; their defaults depend on the preset."""
    curriculum: CurriculumConfig = setting(CurriculumConfig())
    """Widen the randomisation as the policy succeeds."""
    extremes: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of training's hands and objects that get the extreme of every range at once. Evaluations and the policy's
    file keep to the settings of `--env`."""
    task: str = ""
    """Task to train; my_module:poke for a task of your own."""
    hand: str = ""
    """The TOML of a hand of your own, or the name of a shipped one; empty for the XHand."""
    devices: int = setting(1, unit="1", low=0)
    """Devices to train on, which share the environments; 0 for all. In a job of several processes those of all."""
    seed: int = setting(0, unit="1", low=0, high=2**32 - 1)
    """Seed of everything random."""
    backend: Literal["auto", "c", "cuda", "mjx"] = setting("auto")
    """Physics backend. auto: c on a CPU, cuda on an NVIDIA GPU, otherwise mjx."""
    deterministic: bool = False
    """On a GPU, have XLA order its sums, at a cost in speed, so that a training repeats from one seed. On a CPU
    trainings repeat anyway."""
    preset: Literal["auto", "cpu", "cpu-large", "gpu"] = setting("auto")
    """Default sizes and durations. auto: those of the device found; cpu-large is for 16 cores and more."""
    steps: float = setting(0.0, unit="environment steps", low=0.0)
    """Stop after this many steps, including those before a resume; 0 for no limit. With --minutes and without --steps
    there is no limit."""
    minutes: float = setting(0.0, unit="min", low=0.0)
    """Budget of training time, including compilation and the time before a resume; 0 for no limit. With --steps and
    without --minutes there is no limit."""
    run_dir: Path | None = None
    """Folder to write to, which must not exist yet; None for a new runs/TASK-TIME."""
    resume: Path | None = None
    """Folder of a run, or one of its checkpoints, to resume exactly; None starts a new run."""
    config: Path | None = None
    """Configuration of a run, its `config.json` or its folder, whose options are the defaults of a new one; None for
    those of the preset."""
    policy: str = ""
    """Policy to fine-tune: a file, or the name of a shipped one. Its task and configuration are the defaults. Empty:
    train from scratch."""
    wandb: str = ""
    """Weights & Biases project that metrics go to as well; empty for none. Needs the extra `wandb`."""
    video: bool = True
    """Render a video at the end."""
    log_every: int = setting(1, unit="iterations", low=1)
    """Iterations between logged metrics."""
    checkpoint_every: int = setting(100, unit="iterations", low=1)
    """Iterations between checkpoints."""
    keep_checkpoints: int = setting(3, unit="1", low=1)
    """Number of latest checkpoints to keep."""
    evaluate_every: int = setting(0, unit="iterations", low=0)
    """Iterations between the evaluations that choose the best policy, if `--evaluation-share` allows; 0 for none."""
    evaluation_share: float = setting(0.05, unit="1", low=0.0, high=1.0)
    """Largest share of the time that evaluations during training take; those beyond it are left out."""
    patience: int = setting(0, unit="evaluations", low=0)
    """End training after this many evaluations in a row without a better return; 0 for never."""
    evaluation_chunk: int = setting(32, unit="episodes", low=1)
    """Episodes evaluated in parallel; an evaluation during training is one chunk."""
    evaluation_episodes: int = setting(128, unit="episodes", low=1)
    """Episodes of the final evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.patience and not self.evaluate_every:
            raise ConfigError("TrainArguments.patience needs evaluations: set TrainArguments.evaluate_every")


def arguments_from_dict(config_class: type[Any], data: dict[str, Any]) -> TrainArguments:
    """The options that a checkpoint or `config.json` holds. Their task is a word: no file says what is imported."""
    if ":" in data["task"]:
        raise ConfigError(f"TrainArguments.task = {data['task']!r}: must be a name; give its module with --task")
    return from_dict(TrainArguments, data | {"env": from_dict(config_class, data["env"])})


def find_hand(arguments: TrainArguments, source: Checkpoint | Policy | None) -> Hand | None:
    """The hand to train; None for the default one. Raises ConfigError if what the run begins from has another."""
    if source is None:
        return load_hand(arguments.hand) if arguments.hand else None
    if isinstance(source, Policy):
        return source.find_hand(arguments.hand)
    record, what = source.content["hand"], str(source.path)
    hand = recorded_hand(record, arguments.hand, what)
    if hand is not None:
        check_same(record, hand, what)
    return hand


def training_config(arguments: TrainArguments) -> Any:
    """The task's configuration as training uses it: with its share of extremes, and without a force loop.

    A policy that does not follow its command yet learns from a loop to ignore a command that drifts.
    """
    env, share = arguments.env, arguments.extremes
    control = getattr(env, "control", None)
    if control is not None and control.force.gain:
        force = dataclasses.replace(control.force, gain=0.0)
        env = dataclasses.replace(env, control=dataclasses.replace(control, force=force))
    if share:
        parts = {name: dataclasses.replace(getattr(env, name), extremes=share) for name in ("randomization", "objects")}
        env = dataclasses.replace(env, **parts)
    return env


# What a resumed run may be given anew: its budget, what looks on, and where the hand's files are. Everything else is
# part of the saved state.
_RESUMABLE = (
    *("checkpoint_every", "devices", "evaluate_every", "evaluation_chunk", "evaluation_episodes", "evaluation_share"),
    *("hand", "keep_checkpoints", "log_every", "minutes", "patience", "steps", "video", "wandb"),
)


def check_resumed(arguments: TrainArguments, saved: TrainArguments) -> None:
    """Raises ConfigError: an option would make a resumed run another training; names the first."""
    old = flat(printable(saved))
    for path, new in flat(printable(arguments)).items():
        if path not in _RESUMABLE and new != old[path]:
            raise ConfigError(
                f"--{path.replace('_', '-')} {new}: a resumed run keeps its {old[path]}; to train on with other "
                "settings, fine-tune its policy (--policy)"
            )


def printable(arguments: TrainArguments) -> dict[str, Any]:
    """The options as plain data, without the paths of this process."""
    paths = ("run_dir", "resume", "config")
    return {name: value for name, value in to_dict(arguments).items() if name not in paths}


def fine_tuning_config(policy: Policy, config: PPOConfig) -> PPOConfig:
    """`config` with the policy's network, little noise, small steps, and the critic alone at first.

    A policy file holds neither critic nor noise. The noise and step size of training from scratch would make the
    policy forget. So would a fresh critic, whose errors are correlated: it trains alone first.
    """
    units = carry_size(policy.params.memory)
    return dataclasses.replace(
        config,
        memory="gru" if units else "none",
        memory_size=units or config.memory_size,
        actor_layers=tuple(layer.kernel.shape[1] for layer in policy.params.layers[:-1]),
        learning_rate=1e-5,
        learning_rate_min=1e-6,
        learning_rate_max=5e-4,
        kl_target=4e-3,  # with TF32 even the smallest rate makes up to 1.4e-3 (record rotate-1e947b8-fine-tuned)
        kl_halving=0,
        initial_std=0.2,
        critic_first=100,
    )


def check_network(policy: Policy, config: PPOConfig) -> None:
    """Raises ConfigError: the policy's network is not that of a learner with this configuration."""
    network = fine_tuning_config(policy, config)
    for name in ("memory", "memory_size", "actor_layers"):
        if getattr(config, name) != getattr(network, name):
            raise ConfigError(f"PPOConfig.{name} = {getattr(config, name)}: the policy has {getattr(network, name)}")
