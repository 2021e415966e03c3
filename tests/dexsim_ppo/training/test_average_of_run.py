"""The average of a run's checkpoints: that of the policies which the run had when it wrote them."""

import dataclasses

import jax
import numpy as np
import pytest
import tiny_train
from tiny_train import PER_ITERATION

from dexsim.core.errors import CheckpointError, ConfigError
from dexsim_ppo import average, checkpoint, train
from dexsim_ppo.average import average_policies
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training.runlog import RunFolder

QUICK = [*tiny_train.QUICK, "--seed", "3"]


@pytest.fixture(autouse=True)
def tiny_task(monkeypatch):
    tiny_train.install(monkeypatch)


@pytest.mark.slow
def test_a_run_stands_for_the_policies_of_its_checkpoints(tmp_path):
    run = RunFolder(tmp_path / "a")
    policies = []
    for steps in (1, 3):  # Each time it ends it writes a checkpoint, and the policy as it is.
        begin = (
            [*QUICK, "--ppo.memory", "gru", "--run-dir", str(run.path)] if steps == 1 else ["--resume", str(run.path)]
        )
        assert train.main([*begin, "--steps", str(steps * PER_ITERATION)]) == 0
        policies.append(load_policy(run.last))

    found = average.policies_of(run.path)
    assert [path.name for path in found] == ["00000001.msgpack", "00000003.msgpack"]
    for policy, copy in zip(found.values(), policies, strict=True):
        assert policy.training == copy.training
        for a, b in zip(jax.tree.leaves(policy.params), jax.tree.leaves(copy.params), strict=True):
            np.testing.assert_array_equal(a, b)

    with pytest.raises(ConfigError, match="name another file"):
        average.main([str(run.path), "--output", str(run.last)])
    output = tmp_path / "average.msgpack"
    assert average.main([str(run.path), "--output", str(output)]) == 0
    wanted = average_policies(policies)
    mean = load_policy(output)
    assert mean.training["average_of"] == [policy.training for policy in policies]
    for a, b in zip(jax.tree.leaves(mean.params), jax.tree.leaves(wanted.params), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_no_whole_run_is_refused(tmp_path, monkeypatch):
    run, output = RunFolder(tmp_path / "a"), tmp_path / "average.msgpack"
    refused = lambda: average.main([str(run.path), "--output", str(output)])  # noqa: E731
    run.path.mkdir()
    with pytest.raises(CheckpointError, match="a: holds no checkpoint"):
        refused()
    run.path.rmdir()
    assert train.main([*QUICK, "--steps", str(PER_ITERATION), "--run-dir", str(run.path)]) == 0
    with pytest.raises(ConfigError, match="a: an average needs two policies or more"):
        refused()

    # A last policy of another network, and a checkpoint that is cut short.
    (written,) = run.existing_checkpoints()
    last, network = run.last.read_bytes(), ["--ppo.actor-layers", "4"]
    assert train.main([*QUICK, *network, "--steps", str(PER_ITERATION), "--run-dir", str(tmp_path / "b")]) == 0
    run.last.write_bytes(RunFolder(tmp_path / "b").last.read_bytes())
    with pytest.raises(CheckpointError, match=r"00000001.msgpack: does not fit this configuration: \.params"):
        refused()
    run.last.write_bytes(last)

    # Weights that are no numbers, and a checkpoint that is cut short.
    load = checkpoint.load

    def forged(path, *, kind, **options):
        file = load(path, kind=kind, **options)
        actor = {name: x * np.float32("nan") for name, x in file.leaves.items() if name.startswith(".params.actor")}
        return dataclasses.replace(file, leaves=file.leaves | actor)

    with (
        monkeypatch.context() as patch,
        pytest.raises(CheckpointError, match="00000001.msgpack: holds numbers that are not finite"),
    ):
        patch.setattr(checkpoint, "load", forged)
        refused()
    written.write_bytes(written.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="00000001.msgpack"):
        refused()
    run.last.unlink()
    with pytest.raises(CheckpointError, match="last.msgpack"):
        refused()
    assert not output.exists()
