"""Exported policies act as the policy does, without JAX, and the bridge takes them."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest
from paths import ROOT

from dexsim.core.errors import CheckpointError, ConfigError
from dexsim_ppo import export, load_policy
from dexsim_ppo.portable import PortablePolicy


def observations(policy, count=1000, seed=0):
    """Around the mean of training, and now and then far beyond the clip."""
    rng, normalizer = np.random.default_rng(seed), policy.params.normalizer
    spread = np.where(rng.random((count, 1)) < 0.1, 30.0, 1.0)
    noise = spread * rng.standard_normal((count, len(normalizer.mean)))
    return (np.asarray(normalizer.mean) + np.asarray(normalizer.std) * noise).astype(np.float32)


def onnx_policy(path):
    """A session as a policy: from carry and observations [N, n] to carry and actions [N, A]."""
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])

    def act(carry, obs):
        if carry is None:
            return None, session.run(["action"], {"observation": obs})[0]
        return session.run(["next_carry", "action"], {"observation": obs, "carry": np.asarray(carry)})

    return act


@pytest.mark.parametrize("suffix", [".npz", ".onnx"])
@pytest.mark.parametrize("name", ["grasp", "rotate"])  # with and without memory
def test_actions_agree_over_episodes(name, suffix, tmp_path):
    path = tmp_path / f"{name}{suffix}"
    if suffix == ".onnx":
        pytest.importorskip("onnx")
    assert export.main([name, "--output", str(path)]) == 0
    policy = load_policy(name)
    act = onnx_policy(path) if suffix == ".onnx" else PortablePolicy.load(path).act
    carry, largest = policy.initial_carry(50), 0.0
    other = carry if carry is None else np.asarray(carry)
    for obs in observations(policy).reshape(20, 50, -1):
        (carry, expected), (other, action) = policy.act(carry, obs), act(other, obs)
        np.testing.assert_allclose(action, expected, atol=2e-5)
        largest = max(largest, float(np.abs(action).max()))
    assert largest > 0.9, "the observations try the policy"
    if carry is not None:
        fresh = policy.act(policy.initial_carry(50), obs)[1]
        assert np.abs(action - np.asarray(fresh)).max() > 0.01, "memory matters"


@pytest.mark.parametrize("name", ["grasp", "rotate"])
def test_the_numpy_file_is_the_policy(name, tmp_path):
    policy = load_policy(name)
    export.to_numpy(policy, tmp_path / "policy.npz")
    again = load_policy(tmp_path / "policy.npz", task=policy.task)
    jax.tree.map(np.testing.assert_array_equal, again.params, policy.params)
    assert again.header() == policy.header() and again.task == policy.task


def test_it_runs_where_there_is_neither_jax_nor_the_rest_of_the_library(tmp_path):
    policy = load_policy("grasp")
    export.to_numpy(policy, tmp_path / "grasp.npz")
    obs = observations(policy)
    np.save(tmp_path / "obs.npy", obs)
    (tmp_path / "portable.py").write_text((ROOT / "dexsim_ppo" / "portable.py").read_text())
    code = """
import sys
for name in ("jax", "jaxlib", "mujoco", "scipy", "msgpack", "dexsim", "dexsim_ppo"):
    sys.modules[name] = None
import numpy as np
from portable import PortablePolicy
policy = PortablePolicy.load("grasp.npz")
np.save("action.npy", policy.act(policy.initial_carry(1000), np.load("obs.npy"))[1])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    expected = policy.act(policy.initial_carry(1000), obs)[1]
    assert np.abs(np.load(tmp_path / "action.npy") - np.asarray(expected)).max() < 1e-5


def test_a_run_takes_an_exported_policy(tmp_path, monkeypatch):
    pytest.importorskip("serial")
    from following_hand import FollowingHand, arguments, summary

    from dexsim_real.run import __main__ as run

    monkeypatch.setattr("dexsim_real.run.session.prepare_jax", lambda: None)
    export.main(["grasp", "--output", str(tmp_path / "grasp.npz")])
    with FollowingHand() as peer:
        _, *others = arguments(peer, tmp_path, "--seconds", "0.5")
        assert run.main([str(tmp_path / "grasp.npz"), *others]) == 0
    assert summary(tmp_path)["end"] == "time is over"


INVALID = {
    "another format": ({"format": "other"}, {}, "format"),
    "a rate in words": ({"control_rate": "33"}, {}, "control_rate"),
    "another layout": ({"observation_layout": [["a", 3, None]]}, {}, "observation"),
    "a layer that does not fit": ({}, {"kernel_1": np.zeros((3, 3), np.float32)}, "invalid"),
    "not finite": ({}, {"bias_3": np.full(12, np.nan, np.float32)}, "not finite"),
}


@pytest.mark.parametrize("what", INVALID)
def test_an_invalid_file_is_named_in_one_line(what, tmp_path):
    header, arrays, word = INVALID[what]
    export.to_numpy(load_policy("grasp"), tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as file:
        content = dict(file)
    content["header"] = np.array(json.dumps(json.loads(str(content["header"])) | header))
    np.savez(tmp_path / "bad.npz", **(content | arrays))
    with pytest.raises(CheckpointError, match=rf"^[^\n]*bad\.npz: [^\n]*{word}[^\n]*$"):
        load_policy(tmp_path / "bad.npz")


def test_what_is_no_export_is_named_in_one_line(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    for name, word in (("text", "invalid policy"), ("missing", "No such file")):
        with pytest.raises(CheckpointError, match=rf"{name}\.npz: [^\n]*{word}"):
            load_policy(tmp_path / f"{name}.npz")
    with pytest.raises(ConfigError, match=r"ends in \.npz or \.onnx"):
        export.main(["grasp", "--output", str(tmp_path / "grasp.tflite")])
