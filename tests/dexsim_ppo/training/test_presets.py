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


def test_the_ranges_of_rotation_widen_after_five_goals_and_narrow_below_half_of_them():
    """In 180 iterations from a tenth to the full ranges: a run of half an hour has about 500."""
    rules = find_preset("cpu", "rotate").curriculum
    after = lambda goals: float(update_scale(rules, jnp.float32(0.5), {rules.metric: jnp.float32(goals)})[0])  # noqa: E731
    assert [after(goals) for goals in (2.4, 2.6, 4.9, 5.0, 30.0)] == pytest.approx([0.495, 0.5, 0.5, 0.505, 0.505])
    assert rules.start == 0.1


def test_fine_tuning_does_not_begin_on_nearly_nominal_hands():
    """Its policy knows the full ranges."""
    scratch, tuned = (train.default_arguments("rotate", "cpu", begun) for begun in (None, load_policy("rotate")))
    assert scratch.curriculum.on and not tuned.curriculum.on and not tuned.ppo.kl_halving
