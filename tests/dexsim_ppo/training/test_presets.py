"""Defaults by device and task: what the manual says of them, and how those of rotation differ."""

import dataclasses

import jax
import pytest

import dexsim
from dexsim.core.errors import ConfigError
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.rotate.config import RotateConfig
from dexsim_ppo import train
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training import presets
from dexsim_ppo.training.arguments import printable, training_config
from dexsim_ppo.training.fine_tune import fine_tuning_config
from dexsim_ppo.training.presets import PRESETS, device_preset, find_preset, preset_arguments


@pytest.mark.parametrize(
    ("backend", "cores", "name"), [("gpu", 64, "gpu"), ("cpu", 16, "cpu-large"), ("cpu", 15, "cpu")]
)
def test_the_preset_is_that_of_the_device(backend, cores, name, monkeypatch):
    """The manual: cpu-large is for 16 cores and more."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(presets, "available_cores", lambda: cores)
    assert device_preset() == name


def test_what_the_manual_says_of_defaults():
    """Extremes in 60 % of a GPU's episodes and none of a CPU's; half an hour for rotation on two cores."""
    assert {name: find_preset(name, "grasp").extremes for name in PRESETS} == {"cpu": 0, "cpu-large": 0, "gpu": 0.6}
    assert find_preset("cpu", "rotate").minutes == 30
    assert all(preset.steps == 0 and 0 < preset.minutes <= 10 for preset in PRESETS.values())
    assert find_preset("tpu", "grasp") == find_preset("cpu", "grasp")


def test_tasks_from_elsewhere_get_no_setting_of_ours():
    """Pendulum: -847, -158 and -452 with the steps of our tasks on a CPU, after -153."""
    for name in PRESETS:
        ours = preset_arguments("grasp", GraspConfig(), name)
        given, _ = train.parse_arguments(["--task", "reach_env:reach", "--preset", name])
        default = PPOConfig()
        for field in ("learning_rate", "discount", "kl_halving"):
            assert getattr(given.ppo, field) == getattr(default, field)
        assert given.ppo.kl_target == (0.5 if name != "gpu" else 1.0) * ours.ppo.kl_target
        assert given.ppo == dataclasses.replace(PRESETS[name].ppo, memory="none") and not given.curriculum.on
        assert training_config(given) is given.env, "extremes need ranges, which it has none of"
    assert find_preset("tpu", "reach") is PRESETS["cpu"]


def test_an_unknown_preset_is_no_other_one():
    with pytest.raises(ConfigError, match="preset 'huge': choose from auto, cpu, cpu-large, gpu"):
        train.train_policy("grasp", preset="huge")


def test_no_policy_is_none_whichever_way_it_is_said(monkeypatch):
    class Begun(Exception):
        pass

    def begin(arguments, *_, **__):
        raise Begun(arguments.policy)

    monkeypatch.setattr(train, "run_training", begin)
    found = []
    for given in ({}, {"policy": ""}, {"policy": None}):
        with pytest.raises(Begun) as caught:
            train.train_policy("grasp", preset="cpu", **given)
        found += caught.value.args
    assert found[0] == found[1] == found[2]


def test_grasp_has_a_short_horizon_on_every_device():
    for name in PRESETS:
        arguments, _ = train.parse_arguments(["--preset", name])
        assert arguments.env == GraspConfig()
        assert arguments.ppo.discount < PPOConfig().discount == find_preset(name, "rotate").ppo.discount


@pytest.mark.parametrize("task", ["rotate", "rotate_without_orientation", "rotate_clear"])
def test_rotation_has_less_noise_and_more_updates(task):
    for name in PRESETS:
        grasp, rotate = find_preset(name, "grasp"), find_preset(name, task)
        assert rotate.extremes == grasp.extremes
        assert rotate.ppo.entropy_coefficient == find_preset("gpu", task).ppo.entropy_coefficient
        updates = [p.epochs * p.minibatches / p.steps_per_iteration for p in (grasp.ppo, rotate.ppo)]
        assert updates[1] > updates[0] or name == "cpu-large"
        assert rotate.evaluation_episodes % rotate.evaluation_chunk == 0
    gpu = [find_preset("gpu", name).ppo for name in ("grasp", "rotate")]
    assert gpu[1].entropy_coefficient < gpu[0].entropy_coefficient, "less noise"
    assert gpu[0].num_envs == 4 * gpu[1].num_envs, "a quarter of the environments"
    small, large = (find_preset(name, "rotate") for name in ("cpu", "cpu-large"))
    assert small.ppo.num_envs < large.ppo.num_envs and small.minutes > large.minutes


def test_rotation_on_a_cpu_begins_on_nearly_nominal_hands():
    """And no other training does, fine-tuning included: its policy knows the full ranges."""
    for name, task, widens in (("cpu", "rotate", True), ("cpu-large", "rotate", True), ("gpu", "rotate", False)):
        preset = find_preset(name, task)
        assert preset.curriculum.on == widens and bool(preset.ppo.kl_halving) == widens
    assert not find_preset("cpu", "rotate_without_orientation").curriculum.on, "fewer turns than the threshold"
    assert not find_preset("cpu", "grasp").curriculum.on
    scratch, tuned = (train.default_arguments("rotate", "cpu", begun) for begun in (None, load_policy("rotate")))
    assert scratch.curriculum.on and not tuned.curriculum.on and not tuned.ppo.kl_halving
    env = dexsim.make("rotate", RotateConfig(pool_size=8), backend="c", num_envs=2)
    assert scratch.curriculum.metric.removeprefix("episode/") in env.reset(jax.random.key(0)).metrics


def test_a_policy_is_fine_tuned_with_little_noise_and_small_steps():
    """Its own network; smaller than training from scratch in all that could make it forget."""
    policy, scratch = load_policy("grasp"), PPOConfig(actor_layers=(7,), critic_layers=(9,), kl_target=0.015)
    found = fine_tuning_config(policy, scratch)
    assert found.actor_layers == tuple(layer.kernel.shape[1] for layer in policy.params.layers[:-1])
    assert found.critic_layers == (9,) and found.distribution == policy.params.squash
    assert found.initial_std <= 0.5 * scratch.initial_std and found.kl_target <= 0.1 * scratch.kl_target
    assert found.learning_rate_min < found.learning_rate <= 0.1 * scratch.learning_rate < found.learning_rate_max
    assert found.learning_rate_max <= scratch.learning_rate_max and found.critic_first >= 50
    kept = ("num_envs", "rollout_length", "epochs", "minibatches", "discount", "gae_lambda", "clip_ratio")
    assert all(getattr(found, name) == getattr(scratch, name) for name in kept)


def test_training_has_no_force_loop_and_the_policy_keeps_its_configuration():
    config = GraspConfig()
    force = dataclasses.replace(config.control.force, gain=0.5)
    config = dataclasses.replace(config, control=dataclasses.replace(config.control, force=force))
    arguments = dataclasses.replace(preset_arguments("grasp", config, "gpu"), extremes=0.0)
    trained = training_config(arguments)
    assert trained.control.force == dataclasses.replace(force, gain=0.0) and arguments.env == config
    back = dataclasses.replace(trained.control, force=force)
    assert dataclasses.replace(trained, control=back) == config, "nothing else changes"
    plain = preset_arguments("rotate", RotateConfig(), "cpu")
    assert training_config(plain) is plain.env, "by which an evaluation knows that it may use the same environment"


def test_where_a_run_was_written_is_not_part_of_its_options(tmp_path):
    arguments = preset_arguments("rotate", RotateConfig(), "cpu")
    here = dataclasses.replace(arguments, run_dir=tmp_path, resume=tmp_path, config=tmp_path, seed=5)
    data = printable(here)
    assert str(tmp_path) not in str(data) and not {"run_dir", "resume", "config"} & set(data)
    again = train.arguments_from_dict(RotateConfig, data)
    assert again == dataclasses.replace(arguments, seed=5)
