"""Fine-tuning a policy: what is kept, what trains first, and what is refused."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from test_train import QUICK, exit_code
from tiny_env import SMALL, TinyEnv

from dexsim_ppo import train
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training.arguments import fine_tuning_config
from dexsim_ppo.training.runlog import RunFolder, read_metrics
from dexsim_ppo.training.trainer import initialize_from


def started(policy, config):
    training = make_train(TinyEnv(), config, start=functools.partial(initialize_from, policy))
    return training, training.init(jax.random.key(1))


def test_the_critic_learns_first_and_then_both(policy):
    config = dataclasses.replace(fine_tuning_config(policy, SMALL), critic_first=3)
    training, state = started(policy, config)
    params = []
    for _ in range(4):
        state, metrics = training.step(state)
        params.append(jax.tree.map(np.asarray, state.params))
        rate = float(metrics["learning_rate"][-1])
        assert len(params) > 3 or rate == pytest.approx(config.learning_rate)
    for before, after, moved in zip(params[:-1], params[1:], (False, False, True), strict=True):
        for part in ("actor", "log_std"):
            same = jax.tree.leaves(jax.tree.map(np.array_equal, getattr(before, part), getattr(after, part)))
            assert not any(same) if moved else all(same), part
        assert not np.array_equal(before.critic[0].kernel, after.critic[0].kernel)
    for mine, theirs in zip(params[2].actor, policy.params.layers, strict=True):
        np.testing.assert_array_equal(mine.kernel, theirs.kernel)


@pytest.mark.slow
def test_from_the_command_line(policy, tiny_task, tmp_path):
    file = tmp_path / "policy.msgpack"
    dataclasses.replace(policy, env_config={**policy.env_config, "gain": 0.2}).save(file)
    left_out = [i + k for i, o in enumerate(QUICK) if o in ("--task", "--ppo.actor-layers") for k in (0, 1)]
    options = [o for i, o in enumerate(QUICK) if i not in left_out]
    assert train.main([*options, "--policy", str(file), "--steps", str(2 * 128), "--run-dir", str(tmp_path / "a")]) == 0
    folder = RunFolder(tmp_path / "a")
    ended = load_policy(folder.last)
    assert ended.env_config["gain"] == 0.2, "the policy's configuration is the default"
    assert ended.training["policy"] == str(file)
    assert len(read_metrics(folder.metrics)) == 2
    assert train.main(["--resume", str(tmp_path / "a"), "--steps", str(3 * 128)]) == 0, "resumes like any other"
    assert exit_code(train.main, ["--resume", str(tmp_path / "a"), "--policy", str(file)]) == 2


def test_what_does_not_fit_is_refused(policy, tiny_task, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    policy.save("policy.msgpack")
    other = dataclasses.replace(
        policy, observation_layout=tuple(e._replace(name=e.name + "_2") for e in policy.observation_layout)
    )
    other.save("other.msgpack")
    before = sorted(tmp_path.iterdir())
    for arguments, said in (
        (["--task", "grasp", "--policy", "policy.msgpack"], "of the task 'tiny', not 'grasp'"),
        (["--policy", "nothing.msgpack"], "cannot be read"),
        (["--policy", "other.msgpack"], "the policy expects position_2 [1]"),
        (["--policy", "policy.msgpack", "--ppo.actor-layers", "7"], "actor_layers = (7,): the policy has"),
        (["--policy", "policy.msgpack", "--ppo.memory", "gru"], "memory = gru: the policy has none"),
    ):
        assert exit_code(train.main, [*arguments, "--steps", "128"]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1, error
        assert sorted(tmp_path.iterdir()) == before, "nothing is written"
