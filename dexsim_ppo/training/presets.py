"""Training defaults per device: sizes and durations."""

from dataclasses import replace
from typing import Any

import jax

from dexsim.core.compilation import available_cores
from dexsim.core.config import NoSettings
from dexsim.errors import ConfigError
from dexsim.registry import OURS
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.rotate.config import RotateConfig
from dexsim_ppo.learner.config import CurriculumConfig, PPOConfig
from dexsim_ppo.training.arguments import TrainArguments

Preset = TrainArguments[Any]  # without the options of a task

# Two cores: simulation takes nearly all of the time, so small networks and many passes over little data. Our tasks take
# large steps, which become smaller; see `find_preset`.
_CPU = Preset(
    env=NoSettings(),
    ppo=PPOConfig(num_envs=256, kl_target=0.02, actor_layers=(128, 128), critic_layers=(128, 128)),
    minutes=7.0,
    evaluate_every=20,
    evaluation_chunk=50,
    evaluation_episodes=150,
    log_every=5,
)
# A gait is found on nearly nominal hands and widened: twice the turns of a training on the full ranges. What counts is
# the goals of an episode: two goals and a stop end it early, so that their rate is that of a slow gait.
_WIDENING = CurriculumConfig(on=True, metric="episode/successes", widen_above=5.0, narrow_below=2.5, step=0.005)
PRESETS = {
    "cpu": _CPU,
    # 16 cores and more: enough environments for all of them. Sized from trainings of rotate on 2 to 12 cores.
    "cpu-large": replace(
        _CPU,
        ppo=replace(_CPU.ppo, num_envs=1024, epochs=4, minibatches=16),
        minutes=5.0,
        evaluation_chunk=250,
        evaluation_episodes=500,
    ),
    # One large GPU: enough environments to fill it, and few large minibatches. A grasp that remembers follows its
    # command better; on a CPU there is no time to learn what to remember.
    "gpu": Preset(
        env=NoSettings(),
        ppo=PPOConfig(
            num_envs=32768,
            epochs=4,
            minibatches=16,
            kl_target=0.015,
            entropy_coefficient=0.004,
            matmul_precision="default",
            memory="gru",
            actor_layers=(256, 256, 128),
            critic_layers=(256, 256, 128),
        ),
        minutes=8.0,
        evaluate_every=100,
        evaluation_chunk=1024,
        evaluation_episodes=1024,
        log_every=10,
        extremes=0.6,
    ),
}


def find_preset(name: str, task: str) -> Preset:
    """The preset of a device, adapted to our tasks; `task` is a name without its module."""
    preset = PRESETS.get(name, PRESETS["cpu"])
    grasp, rotate, cpu = task.startswith("grasp"), task.startswith("rotate"), name != "gpu"
    if not (grasp or rotate):
        return preset
    if cpu or task == "rotate_any":
        # Large steps find a skill, smaller ones refine it. They would end Pendulum's learning.
        preset = replace(preset, ppo=replace(preset.ppo, learning_rate=1e-3, kl_target=0.04, kl_halving=150))
    if grasp:
        # A force follows its command within tenths of a second: a short horizon is enough, and learnt from fewer steps.
        preset = replace(preset, ppo=replace(preset.ppo, discount=0.97))
        return preset if cpu else replace(preset, minutes=0.0, steps=3.5e8)
    # A gait needs less noise than a grasp, which has to explore forces.
    ppo = replace(preset.ppo, epochs=4, minibatches=16, entropy_coefficient=0.001)
    if not cpu:  # Half of the environments: twice the updates from the same experience, for the gait.
        # Touch tells an orientation over time only; of a cube, past actions tell as much as a memory.
        ppo = replace(ppo, num_envs=16384, memory="gru" if task == "rotate_any" else "none")
        # The ranges of `rotate_any` are wide enough without extremes: four times the goals after 120 million steps.
        extremes = 0.0 if task == "rotate_any" else preset.extremes
        if task in ("rotate", "rotate_without_orientation"):  # A slip costs seconds later: fewer cubes are lost.
            ppo = replace(ppo, discount=0.995)
        # Steps in place of minutes, so that any GPU trains what is shipped. After 800 million steps a rotation turns as
        # much in simulation, and a third less on another plant.
        return replace(preset, ppo=ppo, minutes=0.0, steps=2.5e8, extremes=extremes)
    curriculum = _WIDENING if task == "rotate" else CurriculumConfig()
    preset = replace(preset, ppo=replace(ppo, kl_halving=400), curriculum=curriculum, evaluation_episodes=256)
    if name == "cpu-large":
        return replace(preset, minutes=15.0, evaluation_chunk=256)
    return replace(preset, ppo=replace(preset.ppo, num_envs=512), minutes=30.0, evaluation_chunk=64)


def preset_arguments(task: str, env_config: Any, name: str) -> TrainArguments:
    """The options' defaults under a preset."""
    if name != "auto" and name not in PRESETS:
        raise ConfigError(f"preset {name!r}: choose from auto, {', '.join(PRESETS)}")
    # A task of your own learns like the one whose configuration it extends.
    like = "grasp" if isinstance(env_config, GraspConfig) else "rotate" if isinstance(env_config, RotateConfig) else ""
    preset = find_preset(device_preset() if name == "auto" else name, task if task in OURS else like)
    if preset.minutes and hasattr(env_config, "trap"):  # Few steps: the first goals come after half as many without.
        env_config = replace(env_config, trap=0.0)
    if not hasattr(env_config, "randomization"):  # An environment from elsewhere: no ranges, and small as a rule.
        preset = replace(preset, extremes=0.0, ppo=replace(preset.ppo, memory="none"))
    return replace(preset, env=env_config, task=task)


def device_preset() -> str:
    """The preset for the device found, on a CPU by the number of cores that this process may use."""
    if jax.default_backend() == "gpu":
        return "gpu"
    return "cpu-large" if available_cores() >= 16 else "cpu"
