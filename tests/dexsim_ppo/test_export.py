"""A policy as an ONNX model, and its own file without JAX: both act as the policy does."""

import subprocess
import sys

import numpy as np
import pytest
from paths import ROOT

from dexsim_ppo import export, load_policy
from dexsim_ppo.portable import PortablePolicy

SHIPPED = ROOT / "assets" / "policies"


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


@pytest.mark.parametrize("form", ["portable", "onnx"])
@pytest.mark.parametrize("name", ["grasp", "rotate"])  # with and without memory
def test_actions_agree_over_episodes(name, form, tmp_path):
    policy, act = load_policy(name), PortablePolicy.load(SHIPPED / f"{name}.msgpack").act
    if form == "onnx":
        pytest.importorskip("onnx")
        assert export.main([name, "--output", str(tmp_path / "policy.onnx")]) == 0
        act = onnx_policy(tmp_path / "policy.onnx")
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


def test_a_policy_runs_where_there_is_neither_jax_nor_the_rest_of_the_library(tmp_path):
    policy = load_policy("grasp")
    obs = observations(policy)
    np.save(tmp_path / "obs.npy", obs)
    for file in (ROOT / "dexsim_ppo" / "portable.py", SHIPPED / "grasp.msgpack"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    code = """
import sys
for name in ("jax", "jaxlib", "mujoco", "scipy", "dexsim", "dexsim_ppo"):
    sys.modules[name] = None
import numpy as np
from portable import PortablePolicy
policy = PortablePolicy.load("grasp.msgpack")
np.save("action.npy", policy.act(policy.initial_carry(1000), np.load("obs.npy"))[1])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    expected = policy.act(policy.initial_carry(1000), obs)[1]
    assert np.abs(np.load(tmp_path / "action.npy") - np.asarray(expected)).max() < 1e-5
