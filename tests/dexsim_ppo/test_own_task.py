"""A task of one's own from registering to resuming, over simple physics: train, evaluate, fine-tune, resume by name."""

import json
import sys

import pytest
from simple_physics import SimplePhysics

from dexsim import registry
from dexsim.core.config import override
from dexsim.errors import CheckpointError, ConfigError, OtherEnvWarning
from dexsim_ppo import evaluate as evaluate_command
from dexsim_ppo import evaluate_policy, load_policy, record, train_policy
from dexsim_ppo import train as train_command
from dexsim_ppo.learner.config import PPOConfig

SMALL = PPOConfig(num_envs=8, rollout_length=4, epochs=1, minibatches=1, actor_layers=(8,), critic_layers=(8,))
SIZES = {"evaluation_chunk": 4, "evaluation_episodes": 4, "video": False}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of two iterations, in a process that has registered the task by naming its module."""
    patch = pytest.MonkeyPatch()
    patch.setattr("dexsim.env.env.Physics", SimplePhysics)
    patch.setattr(registry, "TASKS", dict(registry.TASKS))
    patch.delitem(sys.modules, "poke_task", raising=False)
    folder = tmp_path_factory.mktemp("own") / "run"
    yield train_policy("poke_task:poke", ppo=SMALL, backend="c", steps=64, run_dir=folder, seed=3, **SIZES)
    patch.undo()


@pytest.mark.slow
def test_training_by_name_leaves_a_policy_of_that_task(run):
    assert run.policy.task == run.report["task"] == "poke" and run.policy.env_config["gain"] == 3.0
    assert run.policy.spec is not None and run.policy.spec.name == "poke"
    assert run.report["arguments"]["ppo"]["num_envs"] == 8
    assert {"trained", "untrained"} <= run.report.keys() and (run.folder / "last.msgpack").exists()
    assert json.loads((run.folder / "config.json").read_text())["arguments"]["task"] == "poke"


@pytest.mark.slow
def test_evaluation_by_name_and_from_python_agree(run, tmp_path, capsys):
    report = evaluate_policy(run.folder / "last.msgpack", episodes=4, chunk=4, backend="c", seed=5)
    code = evaluate_command.main(
        [str(run.folder / "last.msgpack"), "--task", "poke_task:poke", "--episodes", "4", "--chunk", "4"]
        + ["--backend", "c", "--seed", "5", "--output", str(tmp_path / "report.json")]
    )
    written = json.loads((tmp_path / "report.json").read_text())
    assert code == 0 and "poke" in capsys.readouterr().out
    assert written["return"] == pytest.approx(report["return"]) and report["episodes"] == 4


def test_another_environment_is_warned_of(run, monkeypatch):
    monkeypatch.setattr("dexsim_ppo.evaluate.Evaluator", lambda env, chunk: lambda params, **options: ({}, None))
    other = load_policy(run.folder / "last.msgpack")
    changed = override(other.env_config, ["gain=1.5"])
    env = registry.make("poke", registry.find_task("poke").config_class(gain=1.5), backend="c")
    with pytest.warns(OtherEnvWarning, match=r"gain = 1\.5 \(trained: 3\.0\)"):
        evaluate_policy(other, env=env, episodes=4, chunk=4)
    assert changed["gain"] == 1.5


@pytest.mark.slow
def test_resuming_by_name_goes_on_where_it_stopped(run):
    again = train_policy(resume=run.folder, steps=96, **SIZES)
    assert again.folder == run.folder and again.report["origin"]["iteration"] == 3
    assert again.policy.task == "poke"


def test_a_policy_of_another_task_is_refused(run):
    file = str(run.folder / "last.msgpack")
    for command in (evaluate_command.main, train_command.main, record.main):
        policy = ["--policy", file] if command is train_command.main else [file, "--rrd", "x.rrd"]
        with pytest.raises(CheckpointError, match="is of the task 'poke', not 'grasp'"):
            command([*policy[: 1 if command is evaluate_command.main else 3], "--task", "grasp"])
    assert load_policy("rotate_without_orientation", task="rotate_without_orientation").task == "rotate"


ERRORS = {
    "number of episodes": (lambda run: evaluate_policy(run.policy, episodes=-4), "episodes = -4: must be between"),
    "two beginnings": (lambda run: train_policy(policy="grasp", resume=run.folder), "give one of them"),
    "task": (lambda run: train_policy("juggle"), "unknown task 'juggle'"),
}


@pytest.mark.parametrize("what", ERRORS)
def test_mistakes_are_named(run, what):
    make, words = ERRORS[what]
    with pytest.raises(ConfigError, match=words):
        make(run)
