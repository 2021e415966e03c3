"""Exported policies act as the policy does, without JAX, and the bridge takes them."""

import json
import subprocess
import sys

import numpy as np
import pytest
from paths import ROOT
from remembering import KINDS, remembering

from dexsim import load_hand
from dexsim.core.errors import CheckpointError, ConfigError
from dexsim_ppo import export, load_policy
from dexsim_ppo.portable import PortablePolicy

NAMES = ("grasp", "rotate", "rotate_without_orientation")


def observations(policy, count=1000, seed=0):
    """Around the mean of training, and now and then far beyond the clip."""
    rng, normalizer = np.random.default_rng(seed), policy.params.normalizer
    spread = np.where(rng.random((count, 1)) < 0.1, 30.0, 1.0)
    noise = spread * rng.standard_normal((count, len(normalizer.mean)))
    return (np.asarray(normalizer.mean) + np.asarray(normalizer.std) * noise).astype(np.float32)


def from_the_start(policy, seen):
    """Actions for observations [..., n], each as the first of an episode."""
    return policy.act(policy.initial_carry(*seen.shape[:-1]), seen)[1]


@pytest.fixture(scope="module", params=[".npz", ".onnx"])
def suffix(request):
    if request.param == ".onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    return request.param


@pytest.mark.parametrize("name", NAMES)
def test_actions_agree_on_a_thousand_observations(name, suffix, tmp_path):
    path = tmp_path / f"{name}{suffix}"
    assert export.main([name, "--output", str(path)]) == 0
    policy, exported = load_policy(name), export.load_exported(path)
    seen = observations(policy)
    wanted = np.asarray(from_the_start(policy, seen))
    assert np.abs(from_the_start(exported, seen) - wanted).max() < 1e-5
    assert 0.1 < wanted.std() and wanted.min() < -0.9 and wanted.max() > 0.9, "the observations try the policy"
    np.testing.assert_allclose(from_the_start(exported, seen[3]), wanted[3], atol=1e-5)  # one alone
    assert exported.task == policy.task and exported.spec == policy.spec
    assert exported.observation_layout == policy.observation_layout and exported.control_rate == policy.control_rate


def test_a_squashing_policy_is_exported_as_such(suffix, tmp_path):
    import dataclasses

    policy = load_policy("grasp")
    policy = dataclasses.replace(policy, params=dataclasses.replace(policy.params, squash="tanh"))
    path = tmp_path / f"policy{suffix}"
    {".npz": export.to_numpy, ".onnx": export.to_onnx}[suffix](policy, path)
    seen = observations(policy)
    wanted = from_the_start(policy, seen)
    np.testing.assert_allclose(from_the_start(export.load_exported(path), seen), wanted, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_policy_with_memory_is_exported_with_it(kind, suffix, tmp_path):
    policy, path = remembering(kind), tmp_path / f"policy{suffix}"
    {".npz": export.to_numpy, ".onnx": export.to_onnx}[suffix](policy, path)
    exported, seen = export.load_exported(path), observations(policy, 80).reshape(8, 10, -1)
    carry, other = policy.initial_carry(10), exported.initial_carry(10)
    np.testing.assert_array_equal(other, carry)
    for obs in seen:
        (carry, wanted), (other, action) = policy.act(carry, obs), exported.act(other, obs)
        np.testing.assert_allclose(action, wanted, atol=2e-5)
        np.testing.assert_allclose(other, carry, atol=2e-5)
    one = exported.act(exported.initial_carry(), seen[0, 0])  # one alone, from the start
    np.testing.assert_allclose(one[1], policy.act(policy.initial_carry(), seen[0, 0])[1], atol=2e-5)
    assert np.abs(action - np.asarray(policy.act(policy.initial_carry(10), obs)[1])).max() > 0.01, "memory matters"


def test_it_runs_where_there_is_neither_jax_nor_the_rest_of_the_library(tmp_path):
    policy = load_policy("grasp")
    export.to_numpy(policy, tmp_path / "grasp.npz")
    seen = observations(policy)
    np.save(tmp_path / "seen.npy", seen)
    (tmp_path / "portable.py").write_text((ROOT / "dexsim_ppo" / "portable.py").read_text())
    code = """
import sys
for name in ("jax", "jaxlib", "mujoco", "scipy", "msgpack", "dexsim", "dexsim_ppo"):
    sys.modules[name] = None
import numpy as np
from portable import PortablePolicy
policy = PortablePolicy.load("grasp.npz")
np.save("action.npy", policy.act(policy.initial_carry(1000), np.load("seen.npy"))[1])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert np.abs(np.load(tmp_path / "action.npy") - np.asarray(from_the_start(policy, seen))).max() < 1e-5


@pytest.mark.parametrize("kind", ["", *KINDS])
def test_the_bridge_chooses_the_same_targets(kind, suffix, tmp_path):
    from dexsim_real.control.controller import IDENTITY, Controller
    from dexsim_real.sensors.hand import HandMeasurement
    from dexsim_real.sensors.readings import ObjectEstimate

    path, hand = tmp_path / f"grasp{suffix}", load_hand()
    policy = remembering(kind) if kind else load_policy("grasp")
    policy.save(tmp_path / "policy.msgpack")
    export.main([str(tmp_path / "policy.msgpack"), "--output", str(path)])
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

    monkeypatch.setattr("dexsim_real.run.__main__.prepare_jax", lambda: None)
    export.main(["grasp", "--output", str(tmp_path / "grasp.npz")])
    with FollowingHand() as peer:
        _, *others = arguments(peer, tmp_path, "--seconds", "0.5")
        assert run.main([str(tmp_path / "grasp.npz"), *others]) == 0
    assert summary(tmp_path)["end"] == "time is over"


def test_what_is_unsound_is_refused_in_one_line(tmp_path):
    export.to_numpy(load_policy("grasp"), tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as file:
        good = dict(file)
    header = json.loads(str(good["header"]))
    for name, change in {
        "another format": {"header": np.array(json.dumps(header | {"format": "other"}))},
        "a layer that does not fit": {"kernel_1": np.zeros((3, 3), np.float32)},
        "not finite": {"bias_0": np.full_like(good["bias_0"], np.nan)},
        "another layout": {"header": np.array(json.dumps(header | {"observation_layout": [["a", 3, None]]}))},
    }.items():
        path = tmp_path / f"{name}.npz"
        np.savez(path, **(good | change))
        with pytest.raises(CheckpointError, match="is not a policy of this format") as error:
            export.load_exported(path)
        assert "\n" not in str(error.value)
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(CheckpointError, match=r"text\.npz"):
        export.load_exported(tmp_path / "text.npz")
    with pytest.raises(CheckpointError, match="No such file"):
        export.load_exported(tmp_path / "missing.npz")
    np.savez(tmp_path / "pickle.npz", header=np.array([{"a": 1}], object))
    with pytest.raises(ValueError, match="is not a policy"):
        PortablePolicy.load(tmp_path / "pickle.npz")
    with pytest.raises(ConfigError, match=r"ends in \.npz or \.onnx"):
        export.main(["grasp", "--output", str(tmp_path / "grasp.tflite")])


def rewritten(path, good, header, arrays):
    """The exported policy `good` (an .npz) with changes, in the format of `path`'s suffix."""
    with np.load(good) as file:
        kept = dict(file)
    kept["header"] = np.array(json.dumps(json.loads(str(kept["header"])) | header))
    np.savez(path, **(kept | arrays))
    return path


HEADERS = (
    {"control_rate": 0.0},
    {"control_rate": 1e6},
    {"control_rate": "33"},
    {"clip": "5"},
    {"clip": float("nan")},
    {"squash": "sine"},
    {"task": 3},
    {"memory": ["gru", 64.0]},
    {"memory": None},
    {"observation_layout": [[3, 66, None]]},
    {"hand": "mine"},
    {"hand": {"file": 3}},
    {"spec": {"nothing": 1}},
)


@pytest.mark.parametrize("header", HEADERS, ids=str)
def test_a_forged_header_is_refused_in_one_line(header, suffix, tmp_path):
    path = tmp_path / f"good{suffix}"
    export.main(["grasp", "--output", str(path)])
    if suffix == ".npz":
        path = rewritten(tmp_path / "forged.npz", path, header, {})
    else:
        import onnx

        model = onnx.load(path)
        (known,) = (prop for prop in model.metadata_props if prop.key == "dexsim")
        known.value = json.dumps(json.loads(known.value) | header)
        path = tmp_path / "forged.onnx"
        onnx.save(model, path)
    with pytest.raises(CheckpointError, match=rf"forged\{suffix}: is not a ") as error:
        export.load_exported(path)
    assert "\n" not in str(error.value) and str(error.value).count(f"forged{suffix}") == 1


def test_forged_numbers_are_refused_in_one_line(tmp_path):
    export.to_numpy(load_policy("grasp"), tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as file:
        std, kernel, bias = file["std"], file["kernel_0"], file["bias_0"]
    for name, arrays in {
        "no deviation": {"std": np.zeros_like(std)},
        "overflow": {"kernel_0": np.full_like(kernel, 3e38)},
        "dates": {"bias_0": np.full(bias.shape, np.datetime64("2026-01-01"))},
    }.items():
        path = rewritten(tmp_path / f"{name}.npz", tmp_path / "good.npz", {}, arrays)
        with pytest.raises(ValueError, match="is not a policy of this format"):
            PortablePolicy.load(path)
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "text.npz").write_text("no archive")
    whole = bytearray((tmp_path / "good.npz").read_bytes())
    whole[whole.rindex(b"PK\1\2") + 10] = 77  # a compression that nobody has
    (tmp_path / "packed.npz").write_bytes(whole)
    deep = np.array("[" * 100_000)
    np.savez(tmp_path / "deep.npz", header=deep)
    for name in ("empty", "text", "packed", "deep"):
        with pytest.raises(ValueError, match=rf"{name}\.npz: is not a policy of this format") as error:
            PortablePolicy.load(tmp_path / f"{name}.npz")
        assert "pickle" not in str(error.value)


def test_a_small_archive_of_giant_arrays_is_refused_before_they_are_made(tmp_path, monkeypatch):
    monkeypatch.setattr("dexsim_ppo.portable.LARGEST", 10 * 2**20)
    np.savez_compressed(tmp_path / "bomb.npz", header=np.array("{}"), mean=np.zeros(11 * 2**20, np.uint8))
    assert (tmp_path / "bomb.npz").stat().st_size < 2**16
    with pytest.raises(CheckpointError, match="its arrays have more than 10 MiB"):
        export.load_exported(tmp_path / "bomb.npz")


def test_a_network_of_onnx_must_take_and_give_what_the_header_says(tmp_path):
    onnx, path = pytest.importorskip("onnx"), tmp_path / "rotate.onnx"
    pytest.importorskip("onnxruntime")
    export.main(["rotate", "--output", str(path)])
    model = onnx.load(path)
    for tensor in model.graph.initializer:
        if tensor.name == "bias_0":
            numbers = np.full(onnx.numpy_helper.to_array(tensor).shape, np.nan, np.float32)
            tensor.CopyFrom(onnx.numpy_helper.from_array(numbers, "bias_0"))
    onnx.save(model, path)
    with pytest.raises(CheckpointError, match="not finite"):
        export.load_exported(path)
    with pytest.raises(CheckpointError, match="missing.onnx: No such file or directory$"):
        export.load_exported(tmp_path / "missing.onnx")


def test_an_output_that_is_a_folder_is_named_as_typed(tmp_path):
    folder = tmp_path / "folder.npz"
    folder.mkdir()
    with pytest.raises(IsADirectoryError) as error:
        export.main(["grasp", "--output", str(folder)])
    assert error.value.filename == str(folder)
