"""Averages of policies: their mean where they have one origin, and one clear line where they do not."""

import dataclasses

import jax
import numpy as np
import pytest

from dexsim.core.errors import ConfigError
from dexsim_ppo import average, load_policy
from dexsim_ppo.average import average_policies, distance


def moved(policy, size, seed):
    """The policy with noise on all its numbers, as fine-tuning moves them."""
    rng = np.random.default_rng(seed)
    noisy = jax.tree.map(lambda x: np.asarray(x * (1 + size * rng.standard_normal(x.shape)), np.float32), policy.params)
    return dataclasses.replace(policy, params=noisy, training={"seed": seed})


def test_the_average_of_many_noisy_copies_comes_back_to_the_policy(tmp_path):
    policy = load_policy("rotate_without_orientation")  # with a memory
    files = [str(tmp_path / f"{seed}.msgpack") for seed in range(16)]
    for seed, file in enumerate(files):
        moved(policy, 0.1, seed).save(file)
    assert average.main([*files, "--output", str(tmp_path / "average.msgpack")]) == 0
    mean = load_policy(tmp_path / "average.msgpack")
    assert distance(load_policy(files[0]), policy) == pytest.approx(0.1, rel=0.05)
    assert distance(mean, policy) == pytest.approx(0.1 / np.sqrt(16), rel=0.1)
    assert [origin["seed"] for origin in mean.training["average_of"]] == list(range(16))


def test_what_has_no_common_origin_is_refused(tmp_path):
    clear, rotate = load_policy("rotate_clear"), load_policy("rotate")
    other = dataclasses.replace(rotate.spec, control=dataclasses.replace(rotate.spec.control, step=0.5))
    for policies, words in (
        ([clear, moved(clear, 0.1, 1), moved(clear, 20.0, 0)], r"policy 3 has no common origin .* by \d+%"),
        ([rotate, load_policy("rotate_without_orientation")], "policy 2 differs from the first in its observation"),
        ([rotate, load_policy("grasp")], "policy 2 differs from the first in its task"),
        ([rotate, dataclasses.replace(rotate, spec=other)], "policy 2 differs from the first in its spec"),
        ([rotate], "two policies or more"),
    ):
        with pytest.raises(ConfigError, match=words):
            average_policies(policies)
    with pytest.raises(ConfigError, match="name another file"):
        rotate.save(tmp_path / "rotate.msgpack")
        average.main([*2 * [str(tmp_path / "rotate.msgpack")], "--output", str(tmp_path / "rotate.msgpack")])
