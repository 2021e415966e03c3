"""Files: what is written is what is read, nothing damaged is read, and a policy's file is checked when it is loaded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from tiny_env import TinyConfig, leaves

from dexsim.core.config import from_dict
from dexsim.errors import CheckpointError, DexsimError
from dexsim_ppo import checkpoint, train
from dexsim_ppo.policy import load_policy

TREE = {
    "x": jnp.arange(6, dtype=jnp.float32).reshape(2, 3),
    "empty": jnp.zeros((0, 4)),
    "flag": jnp.bool_(True),
    "half": jnp.ones(3, jnp.bfloat16),
    "key": jax.random.key(7),
    "keys": jax.random.split(jax.random.key(1), 3),
    "n": (jnp.int32(-5), jnp.uint32(2**31)),
}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "a.msgpack"
    checkpoint.save(path, kind="train", task="tiny", content={"answer": [1, 2.5, None]}, tree=TREE)
    return path


def test_checkpoint_round_trip(file):
    loaded = checkpoint.load(file, kind="train", task="tiny")
    assert loaded.content == {"answer": [1, 2.5, None]} and loaded.task == "tiny"
    restored = checkpoint.restore(loaded, jax.eval_shape(lambda: TREE))
    assert jax.tree.map(lambda x: x.dtype, restored) == jax.tree.map(lambda x: x.dtype, TREE)
    jax.tree.map(np.testing.assert_array_equal, leaves(restored), leaves(TREE))
    assert [p.name for p in file.parent.iterdir()] == ["a.msgpack"], "no temporary file is left"


@given(st.floats(0, 1, exclude_max=True), st.integers(0, 7), st.sampled_from(["flip", "cut", "extend", "drop"]))
def test_load_finds_any_damage(file, place, bit, how):
    data = bytearray(file.read_bytes())
    at = int(place * len(data))
    if how == "flip":
        data[at] ^= 1 << bit
    else:
        data = {"cut": data[:at], "extend": data + data[: at + 1], "drop": data[:at] + data[at + 1 :]}[how]
    damaged = file.with_name("damaged")
    damaged.write_bytes(data)
    try:
        with pytest.raises(CheckpointError, match=r"^[^\n]*damaged: [^\n]+$"):
            checkpoint.load(damaged, kind="train")
    finally:
        damaged.unlink()


def test_load_names_what_is_wrong(file, tmp_path):
    newer = tmp_path / "newer"
    data = bytearray(file.read_bytes())
    data[6] = 9
    newer.write_bytes(data)
    (tmp_path / "text").write_text("no checkpoint")
    for path, options, word in (
        (file, {"kind": "train", "task": "grasp"}, "task 'tiny', not 'grasp'"),
        (file, {"kind": "policy"}, "'train' file, not a 'policy' file"),
        (newer, {"kind": "train"}, "format version 9"),
        (tmp_path / "text", {"kind": "train"}, "not a dexsim checkpoint"),
        (tmp_path / "missing", {"kind": "train"}, "cannot be read"),
    ):
        with pytest.raises(CheckpointError, match=word):
            checkpoint.load(path, **options)


def test_policy_round_trip(policy, tmp_path):
    policy.save(tmp_path / "p.msgpack")
    loaded = load_policy(tmp_path / "p.msgpack")
    obs = jax.random.normal(jax.random.key(1), (5, 3))
    np.testing.assert_array_equal(loaded.act(None, obs)[1], policy.act(None, obs)[1])
    assert float(jnp.abs(loaded.act(None, 1e6 * obs)[1]).max()) <= 1
    assert from_dict(TinyConfig, loaded.env_config) == TinyConfig()
    assert loaded.observation_layout == policy.observation_layout
    assert loaded.control_rate == pytest.approx(10) and loaded.training == {"seed": 0}


@pytest.mark.parametrize(
    ("header", "arrays", "words"),
    [
        ({"control_rate": 1e9}, {}, "control_rate"),
        ({"spec": {"name": "a", "fields": [], "posture": [1e9]}}, {}, "posture"),
        ({"observation_layout": [["a", 2, None]]}, {}, "observation"),
        ({}, {"kernel_0": np.full((3, 8), np.nan, np.float32)}, "not finite, or deviations"),
    ],
)
def test_numbers_that_give_no_action_are_an_error(policy, tmp_path, header, arrays, words):
    path, header, arrays = tmp_path / "p.msgpack", policy.header() | header, policy.arrays() | arrays
    checkpoint.save(path, kind="policy", task="tiny", content=header, tree=arrays)
    with pytest.raises(CheckpointError, match=rf"^[^\n]*p\.msgpack: [^\n]*{words}[^\n]*$"):
        load_policy(path)


def test_no_file_chooses_which_module_is_imported(policy, tmp_path, monkeypatch):
    """A task's name may be `module:function`, but only where a user types it."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "their_module.py").write_text("raise AssertionError('imported')\n")
    path, name = tmp_path / "p.msgpack", "their_module:make_env"
    checkpoint.save(path, kind="policy", task=name, content={}, tree={})
    with pytest.raises(CheckpointError, match="invalid task"):
        load_policy(path)
    checkpoint.save(path, kind="train", task="grasp", content={"arguments": {"task": name}}, tree={})
    with pytest.raises(DexsimError, match="must be a name"):
        train.main(["--resume", str(path)])
