"""Exported policies act as the policy does, without JAX, and the bridge takes them."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
from paths import ROOT

from dexsim import load_hand
from dexsim.core.errors import CheckpointError, ConfigError
from dexsim_ppo import export, load_policy

NAMES = ("grasp", "rotate", "rotate_without_orientation")
WRITERS = {".npz": export.to_numpy, ".onnx": export.to_onnx}


def observations(policy, count=1000, seed=0):
    """Around the mean of training, and now and then far beyond the clip."""
    rng, normalizer = np.random.default_rng(seed), policy.params.normalizer
    spread = np.where(rng.random((count, 1)) < 0.1, 30.0, 1.0)
    noise = spread * rng.standard_normal((count, len(normalizer.mean)))
    return (np.asarray(normalizer.mean) + np.asarray(normalizer.std) * noise).astype(np.float32)


@pytest.fixture(scope="module", params=WRITERS)
def suffix(request):
    if request.param == ".onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    return request.param


@pytest.mark.parametrize("name", NAMES)
def test_actions_agree_over_episodes(name, suffix, tmp_path):
    path = tmp_path / f"{name}{suffix}"
    assert export.main([name, "--output", str(path)]) == 0
    policy, exported = load_policy(name), export.load_exported(path)
    ticks, largest = observations(policy).reshape(20, 50, -1), 0.0
    carry, other = policy.initial_carry(50), exported.initial_carry(50)
    for obs in ticks:
        (carry, expected), (other, action) = policy.act(carry, obs), exported.act(other, obs)
        np.testing.assert_allclose(action, expected, atol=2e-5)
        largest = max(largest, float(np.abs(action).max()))
    assert largest > 0.9, "the observations try the policy"
    one = exported.act(exported.initial_carry(), ticks[0, 0])[1]  # one alone, from the start
    np.testing.assert_allclose(one, policy.act(policy.initial_carry(), ticks[0, 0])[1], atol=2e-5)
    if carry is not None:
        fresh = policy.act(policy.initial_carry(50), obs)[1]
        assert np.abs(action - np.asarray(fresh)).max() > 0.01, "memory matters"
    assert exported.task == policy.task and exported.spec == policy.spec
    assert exported.observation_layout == policy.observation_layout and exported.control_rate == policy.control_rate


def test_a_squashing_policy_is_exported_as_such(suffix, tmp_path):
    policy = load_policy("rotate")
    policy = dataclasses.replace(policy, params=dataclasses.replace(policy.params, squash="tanh"))
    WRITERS[suffix](policy, tmp_path / f"policy{suffix}")
    obs = observations(policy)
    exported = export.load_exported(tmp_path / f"policy{suffix}")
    np.testing.assert_allclose(exported.act(None, obs)[1], policy.act(None, obs)[1], atol=1e-5)


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


@pytest.mark.parametrize("name", ["grasp", "rotate_clear"])  # with and without memory
def test_the_bridge_chooses_the_same_targets(name, suffix, tmp_path):
    from dexsim_real.control.controller import IDENTITY, Controller
    from dexsim_real.sensors.hand import HandMeasurement
    from dexsim_real.sensors.readings import ObjectEstimate

    path, hand, policy = tmp_path / f"{name}{suffix}", load_hand(), load_policy(name)
    WRITERS[suffix](policy, path)
    controllers = [Controller(policy, hand) for policy in (policy, export.load_exported(path))]
    rng = np.random.default_rng(1)
    for _ in range(20):
        joints = rng.uniform(0, 1, 12).astype(np.float32)
        touch = (rng.random((5, 120)) * (rng.random((5, 120)) < 0.1)).astype(np.float32)
        rest = np.zeros(1)
        measured = HandMeasurement(joints, 0.1 * joints, touch, joints, rest, rest, rest)
        seen = ObjectEstimate(np.array([0.05, 0.0, 0.09]), np.zeros(3), IDENTITY)
        ticks = [controller.tick(measured, seen, IDENTITY, 0.5) for controller in controllers]
        np.testing.assert_allclose(ticks[0].target, ticks[1].target, atol=1e-5)
        assert np.abs(ticks[0].action).max() > 0.01


def test_a_run_takes_an_exported_policy(tmp_path, monkeypatch):
    pytest.importorskip("serial")
    from following_hand import FollowingHand, arguments, summary

    from dexsim_real.run import __main__ as run

    monkeypatch.setattr("dexsim_real.run.result.prepare_jax", lambda: None)
    export.main(["grasp", "--output", str(tmp_path / "grasp.npz")])
    with FollowingHand() as peer:
        _, *others = arguments(peer, tmp_path, "--seconds", "0.5")
        assert run.main([str(tmp_path / "grasp.npz"), *others]) == 0
    assert summary(tmp_path)["end"] == "time is over"


INVALID = {
    "another format": ({"format": "other"}, {}, "format"),
    "a rate in words": ({"control_rate": "33"}, {}, "control_rate"),
    "an unknown field": ({"colour": "red"}, {}, "colour"),
    "another layout": ({"observation_layout": [["a", 3, None]]}, {}, "observation"),
    "a layer that does not fit": ({}, {"kernel_1": np.zeros((3, 3), np.float32)}, "invalid"),
    "not finite": ({}, {"bias_3": np.full(12, np.nan, np.float32)}, "not finite"),
}


@pytest.mark.parametrize("what", INVALID)
def test_an_invalid_export_is_named_in_one_line(what, tmp_path):
    header, arrays, word = INVALID[what]
    export.to_numpy(load_policy("grasp"), tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as file:
        content = dict(file)
    content["header"] = np.array(json.dumps(json.loads(str(content["header"])) | header))
    np.savez(tmp_path / "bad.npz", **(content | arrays))
    with pytest.raises(CheckpointError, match=rf"^[^\n]*bad\.npz: [^\n]*{word}[^\n]*$"):
        export.load_exported(tmp_path / "bad.npz")


def test_what_is_no_export_is_named_in_one_line(suffix, tmp_path):
    (tmp_path / f"text{suffix}").write_text("no archive")
    for name, word in (("text", "invalid exported policy"), ("missing", "No such file")):
        with pytest.raises(CheckpointError, match=rf"{name}\{suffix}: [^\n]*{word}"):
            export.load_exported(tmp_path / f"{name}{suffix}")
    with pytest.raises(ConfigError, match=r"ends in \.npz or \.onnx"):
        export.main(["grasp", "--output", str(tmp_path / "grasp.tflite")])
