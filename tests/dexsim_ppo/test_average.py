"""Averages of policies: their mean where they have one origin, and one clear line where they do not."""

import dataclasses

import jax
import numpy as np
import pytest

from dexsim.core.errors import ConfigError
from dexsim_ppo import load_policy
from dexsim_ppo.average import average_policies, distance, main


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


def test_a_tree_of_two_is_halfway_and_a_file_holds_it(tmp_path):
    one, other = (moved(load_policy("rotate_clear"), 0.1, seed) for seed in (1, 2))
    files = [str(tmp_path / f"{k}.msgpack") for k in (1, 2)]
    for policy, file in zip((one, other), files, strict=True):
        policy.save(file)
    assert main([*files, "--output", str(tmp_path / "made" / "average.msgpack")]) == 0
    found = load_policy(tmp_path / "made" / "average.msgpack")
    for a, b, mean in zip(*(jax.tree.leaves(p.params) for p in (one, other, found)), strict=True):
        np.testing.assert_allclose(mean, a + (b - a) / 2, rtol=1e-5, atol=1e-7)
    assert found.training == {"average_of": [{"seed": 1}, {"seed": 2}]}
    assert found.env_config == one.env_config


def test_what_has_no_common_origin_is_refused(tmp_path):
    clear, rotate = load_policy("rotate_clear"), load_policy("rotate")
    stranger = moved(clear, 20.0, 0)
    with pytest.raises(ConfigError, match=r"policy 3 has no common origin with the first: weights differ by \d+%"):
        average_policies([clear, moved(clear, 0.1, 1), stranger])
    with pytest.raises(ConfigError, match="policy 2 differs from the first in observation, memory, layers"):
        average_policies([rotate, load_policy("rotate_without_orientation")])
    with pytest.raises(ConfigError, match="policy 2 differs from the first in task"):
        average_policies([rotate, load_policy("grasp")])
    other = dataclasses.replace(rotate.spec, control=dataclasses.replace(rotate.spec.control, step=0.5))
    with pytest.raises(ConfigError, match="policy 2 differs from the first in control$"):
        average_policies([rotate, dataclasses.replace(rotate, spec=other)])
    with pytest.raises(ConfigError, match="two policies or more"):
        average_policies([rotate])
    output = tmp_path / "average.msgpack"
    with pytest.raises(ConfigError, match="^rotate grasp: policy 2 differs"):
        main(["rotate", "grasp", "--output", str(output)])
    assert not output.exists()


def test_no_averaged_policy_is_overwritten(tmp_path):
    files = [tmp_path / "1.msgpack", tmp_path / "2.msgpack"]
    for k, file in enumerate(files):
        moved(load_policy("rotate_clear"), 0.1, k).save(file)
    (tmp_path / "link.msgpack").symlink_to(files[1])
    before = files[1].read_bytes()
    for output in (files[1], tmp_path / "link.msgpack"):
        with pytest.raises(ConfigError, match=f"^--output {output}: is the policy"):
            main([*map(str, files), "--output", str(output)])
    assert files[1].read_bytes() == before
