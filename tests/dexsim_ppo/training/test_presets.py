"""Defaults by device and task: what the manual says of them, and how those of rotation differ."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.rotate.config import RotateConfig
from dexsim_ppo import train
from dexsim_ppo.learner.ppo import update_scale
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training import presets
from dexsim_ppo.training.arguments import training_config
from dexsim_ppo.training.presets import device_preset, find_preset, preset_arguments


@pytest.mark.parametrize(
    ("backend", "cores", "name"), [("gpu", 64, "gpu"), ("cpu", 16, "cpu-large"), ("cpu", 15, "cpu")]
)
def test_the_preset_is_that_of_the_device(backend, cores, name, monkeypatch):
    """The manual: cpu-large is for 16 cores and more."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(presets, "available_cores", lambda: cores)
    assert device_preset() == name


COMMON = {"rollout_length": 16, "gae_lambda": 0.95, "clip_ratio": 0.2, "max_grad_norm": 1.0, "initial_std": 0.6}
SMALL, LARGE = (128, 128), (256, 256, 128)
# Environments, epochs, minibatches, discount, entropy bonus, first learning rate, target KL and its half-life, layers,
# memory; minutes, million steps. Each is from training runs: change a number together with a record of one.
TRAINED = {
    ("cpu", "grasp"): (256, 5, 4, 0.97, 0.0, 1e-3, 0.04, 150, SMALL, "none", 7.0, 0),
    ("cpu", "rotate"): (512, 4, 16, 0.99, 0.001, 1e-3, 0.04, 400, SMALL, "none", 30.0, 0),
    ("cpu-large", "grasp"): (1024, 4, 16, 0.97, 0.0, 1e-3, 0.04, 150, SMALL, "none", 5.0, 0),
    ("cpu-large", "rotate"): (1024, 4, 16, 0.99, 0.001, 1e-3, 0.04, 400, SMALL, "none", 15.0, 0),
    ("gpu", "grasp"): (32768, 4, 16, 0.97, 0.004, 5e-4, 0.015, 0, LARGE, "gru", 0, 350),
    ("gpu", "rotate"): (16384, 4, 16, 0.995, 0.001, 5e-4, 0.015, 0, LARGE, "none", 0, 250),
    ("gpu", "rotate_without_orientation"): (16384, 4, 16, 0.995, 0.001, 5e-4, 0.015, 0, LARGE, "none", 0, 250),
    ("gpu", "rotate_clear"): (16384, 4, 16, 0.99, 0.001, 5e-4, 0.015, 0, LARGE, "none", 0, 250),
    ("gpu", "rotate_any"): (16384, 4, 16, 0.99, 0.001, 1e-3, 0.04, 150, LARGE, "gru", 0, 250),
}


@pytest.mark.parametrize(("name", "task"), TRAINED)
def test_default_settings_are_those_that_trained_the_tasks(name, task):
    preset = find_preset(name, task)
    ppo = preset.ppo
    sizes = (ppo.num_envs, ppo.epochs, ppo.minibatches, ppo.discount, ppo.entropy_coefficient)
    rates = (ppo.learning_rate, ppo.kl_target, ppo.kl_halving)
    budget = (preset.minutes, preset.steps / 1e6)
    assert (*sizes, *rates, ppo.actor_layers, ppo.memory, *budget) == TRAINED[name, task]
    assert ppo.critic_layers == ppo.actor_layers
    assert {field: getattr(ppo, field) for field in COMMON} == COMMON
    assert preset.curriculum.on == (task == "rotate" and name != "gpu")
    assert preset.extremes == (0.6 if name == "gpu" and task != "rotate_any" else 0.0)


@pytest.mark.parametrize(
    ("given", "budget"),
    [
        ("", (0.0, 2.5e8)),
        ("--minutes 30", (30.0, 0.0)),
        ("--steps 1e6", (0.0, 1e6)),
        ("--steps 1e6 --minutes 2", (2.0, 1e6)),
    ],
)
def test_a_budget_that_is_given_takes_the_place_of_the_presets(given, budget):
    """Thirty minutes are not cut off by the steps that a preset counts."""
    arguments, _ = train.parse_arguments(["--task", "rotate", "--preset", "gpu", *given.split()])
    assert (arguments.minutes, arguments.steps) == budget


def test_extremes_and_no_force_loop_are_for_training_alone():
    """Evaluations and the policy's file have the task's own configuration."""
    plain, _ = train.parse_arguments(["--task", "grasp", "--preset", "gpu"])
    assert plain.extremes == 0.6 and plain.env == GraspConfig() and plain.env.control.force.gain > 0
    trained = training_config(plain)
    assert trained.randomization.extremes == trained.objects.extremes == 0.6 and trained.control.force.gain == 0
    control = dataclasses.replace(trained.control, force=plain.env.control.force)
    same = {"randomization": plain.env.randomization, "objects": plain.env.objects, "control": control}
    assert dataclasses.replace(trained, **same) == plain.env
    plain = preset_arguments("rotate", RotateConfig(), "cpu")
    assert (plain.env.trap, preset_arguments("rotate", RotateConfig(), "gpu").env.trap) == (0.0, 0.25)
    assert training_config(plain) is plain.env, "by which an evaluation knows that it may use the same environment"


def test_a_task_of_your_own_learns_like_the_one_that_it_extends():
    class Still(RotateConfig):
        pass

    for name in ("still", "rotate_still"):
        own, parent = (preset_arguments(task, Still(), "cpu") for task in (name, "rotate"))
        assert own == dataclasses.replace(parent, task=name)


def test_the_ranges_of_rotation_widen_after_five_goals_and_narrow_below_half_of_them():
    """In 180 iterations from a tenth to the full ranges: a run of half an hour has about 500."""
    rules = find_preset("cpu", "rotate").curriculum
    after = lambda goals: float(update_scale(rules, jnp.float32(0.5), {rules.metric: jnp.float32(goals)})[0])  # noqa: E731
    assert [after(goals) for goals in (2.4, 2.6, 4.9, 5.0, 30.0)] == pytest.approx([0.495, 0.5, 0.5, 0.505, 0.505])
    assert rules.start == 0.1


def test_fine_tuning_keeps_the_full_ranges():
    """Its policy knows them; nor does a task with fewer turns than the threshold begin on narrow ones."""
    assert not find_preset("cpu", "rotate_without_orientation").curriculum.on
    scratch, tuned = (train.default_arguments("rotate", "cpu", begun) for begun in (None, load_policy("rotate")))
    assert scratch.curriculum.on and not tuned.curriculum.on and not tuned.ppo.kl_halving
