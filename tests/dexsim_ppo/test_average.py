"""Averages of policies: their mean where they have one origin, and one clear line where they do not."""

import dataclasses

import jax
import numpy as np
import pytest
import tiny_train
from tiny_train import PER_ITERATION

from dexsim.core.errors import ConfigError
from dexsim_ppo import average, load_policy, train
from dexsim_ppo.average import average_policies, distance, main
from dexsim_ppo.training.runlog import RunFolder


def moved(policy, size, seed):
    """The policy with noise on all its numbers, as fine-tuning moves them."""
    rng = np.random.default_rng(seed)
    noisy = jax.tree.map(lambda x: np.asarray(x * (1 + size * rng.standard_normal(x.shape)), np.float32), policy.params)
    return dataclasses.replace(policy, params=noisy, training={"seed": seed})


@pytest.mark.parametrize("name", ["rotate_clear", "rotate_without_orientation"])  # without and with a memory
def test_the_average_of_many_noisy_copies_comes_back_to_the_policy(name):
    policy = load_policy(name)
    copies = [moved(policy, 0.1, seed) for seed in range(16)]
    average = average_policies(copies)
    assert distance(copies[0], policy) == pytest.approx(0.1, rel=0.05)
    assert distance(average, policy) == pytest.approx(0.1 / np.sqrt(16), rel=0.1)
    assert [origin["seed"] for origin in average.training["average_of"]] == list(range(16))

    seen = np.asarray(policy.params.normalizer.mean) + 0.5 * np.asarray(policy.params.normalizer.std)
    wanted = policy.act(policy.initial_carry(), seen)[1]
    one = copies[0].act(copies[0].initial_carry(), seen)[1]
    mean = average.act(average.initial_carry(), seen)[1]
    assert np.linalg.norm(mean - wanted) < np.linalg.norm(one - wanted)


def test_what_has_no_common_origin_is_refused(tmp_path):
    clear, rotate = load_policy("rotate_clear"), load_policy("rotate")
    stranger = moved(clear, 20.0, 0)
    with pytest.raises(ConfigError, match=r"policy 3 has no common origin with the first: weights differ by \d+%"):
        average_policies([clear, moved(clear, 0.1, 1), stranger])
    with pytest.raises(ConfigError, match="policy 2 differs from the first in observation_layout, .*memory"):
        average_policies([rotate, load_policy("rotate_without_orientation")])
    with pytest.raises(ConfigError, match="policy 2 differs from the first in task"):
        average_policies([rotate, load_policy("grasp")])
    other = dataclasses.replace(rotate.spec, control=dataclasses.replace(rotate.spec.control, step=0.5))
    with pytest.raises(ConfigError, match="policy 2 differs from the first in spec$"):
        average_policies([rotate, dataclasses.replace(rotate, spec=other)])
    with pytest.raises(ConfigError, match="two policies or more"):
        average_policies([rotate])
    output = tmp_path / "average.msgpack"
    with pytest.raises(ConfigError, match="^rotate grasp: policy 2 differs"):
        main(["rotate", "grasp", "--output", str(output)])
    assert not output.exists()


QUICK = [*tiny_train.QUICK, "--seed", "3"]


@pytest.mark.slow
def test_a_run_stands_for_the_policies_of_its_checkpoints(tmp_path, monkeypatch):
    tiny_train.install(monkeypatch)
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
    expected = average_policies(policies)
    mean = load_policy(output)
    assert mean.training["average_of"] == [policy.training for policy in policies]
    for a, b in zip(jax.tree.leaves(mean.params), jax.tree.leaves(expected.params), strict=True):
        np.testing.assert_array_equal(a, b)
