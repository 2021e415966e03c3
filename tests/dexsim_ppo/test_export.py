"""A policy as an ONNX model, in a bundle, its own file without JAX: all act as the policy does. Recorded episodes."""

import hashlib
import json
import re
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest
from paths import ROOT

import dexsim
from dexsim.calibration.maps import load_calibration
from dexsim.control import move_target
from dexsim.core.compilation import jit
from dexsim.env.evaluation import evaluation_of
from dexsim.errors import CalibrationError, DexsimError
from dexsim.hand.load import load_hand
from dexsim.observation import FIELDS
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo import export, load_policy, record
from dexsim_ppo.portable import PortablePolicy

SHIPPED = ROOT / "assets" / "policies"


def observations(policy, count=1000, seed=0):
    """Around the mean of training, and now and then far beyond the clip."""
    rng, normalizer = np.random.default_rng(seed), policy.params.normalizer
    spread = np.where(rng.random((count, 1)) < 0.1, 30.0, 1.0)
    noise = spread * rng.standard_normal((count, len(normalizer.mean)))
    return (np.asarray(normalizer.mean) + np.asarray(normalizer.std) * noise).astype(np.float32)


@pytest.mark.parametrize("name", ["grasp", "rotate"])  # with and without memory
def test_actions_agree_over_episodes(name):
    policy, act = load_policy(name), PortablePolicy.load(SHIPPED / f"{name}.msgpack").act
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


def test_a_policys_own_file_needs_numpy_alone():
    found = re.findall(r"^ *(?:from|import) (\w+)", (ROOT / "dexsim_ppo" / "portable.py").read_text(), re.MULTILINE)
    assert {*found} - sys.stdlib_module_names == {"numpy", "msgpack"}


@pytest.mark.parametrize(("name", "form"), [("grasp", "bundle"), ("rotate", "bundle.zip")])  # without and with memory
def test_the_code_of_a_bundle_acts_as_the_policy_where_neither_jax_nor_this_library_is(name, form, tmp_path):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    policy, bundle = load_policy(name), tmp_path / "bundle"
    assert export.main([name, "--bundle", str(tmp_path / form)]) == 0
    assert export.main([name, "--output", str(tmp_path / "alone.onnx")]) == 0
    if form.endswith(".zip"):
        shutil.unpack_archive(tmp_path / form, bundle)
    files = {"README.md", "SHA256SUMS", "calibration.toml", "config.json", "policy.onnx"}
    assert {path.name for path in bundle.iterdir()} == files
    assert {path.name for path in tmp_path.iterdir()} <= {"alone.onnx", "bundle", "bundle.zip"}
    assert (tmp_path / "alone.onnx").read_bytes() == (bundle / "policy.onnx").read_bytes()
    for line in (bundle / "SHA256SUMS").read_text().splitlines():
        digest, file = line.split("  ")
        assert hashlib.sha256((bundle / file).read_bytes()).hexdigest() == digest and files.discard(file) is None
    assert files == {"SHA256SUMS"}
    with pytest.raises(CalibrationError):
        load_calibration(bundle / "calibration.toml", load_hand())
    obs = observations(policy, 60)
    np.save(bundle / "observations.npy", obs)
    (code,) = re.findall(r"```python\n(.*?)```", (bundle / "README.md").read_text(), re.DOTALL)
    head = "import sys\nfor name in ('jax', 'mujoco', 'scipy', 'dexsim', 'dexsim_ppo'):\n    sys.modules[name] = None\n"
    run = """
actions, targets, target = [], [], (lower + upper) / 2
for observation in np.load("observations.npy"):
    action, carry = act(observation, carry)
    target = move(target, action, observation[:12])
    actions.append(action), targets.append(target)
np.savez("found.npz", action=actions, target=targets)
"""
    done = subprocess.run([sys.executable, "-c", head + code + run], cwd=bundle, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found, hand, carry = np.load(bundle / "found.npz"), load_hand(), policy.initial_carry()
    target = (hand.joint_lower + hand.joint_upper) / 2
    for observation, action, moved in zip(obs, found["action"], found["target"], strict=True):
        carry, expected = policy.act(carry, observation)
        np.testing.assert_allclose(action, expected, atol=2e-5)
        target = move_target(policy.spec.control, hand, target, expected, observation[:12])
        np.testing.assert_allclose(moved, target, atol=1e-4)
    config = json.loads((bundle / "config.json").read_text())
    assert [tuple(field[key] for key in ("name", "size")) for field in config["observation"]] == [
        entry[:2] for entry in policy.observation_layout
    ]


@pytest.mark.parametrize(
    ("command", "option"), [(export, "--output"), (export, "--bundle"), (record, "--npz"), (record, "--rrd")]
)
def test_no_output_takes_the_place_of_the_policy(command, option, tmp_path):
    path = str(shutil.copy(SHIPPED / "grasp.msgpack", tmp_path))
    before = (tmp_path / "grasp.msgpack").read_bytes()
    with pytest.raises(DexsimError, match=f"{path}: (is the policy|exists already); name another "):
        command.main([path, option, path])
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [before]


def test_every_field_that_an_actor_may_observe_has_a_unit():
    assert set(export._UNITS) == {field.name for field in FIELDS.values() if field.source != "simulator"}


@pytest.mark.slow
def test_readings_and_targets_are_those_of_the_episodes():
    env, policy = dexsim.make("grasp", GraspConfig(pool_size=80), backend="c"), load_policy("grasp")
    found, shown = record.record(policy, env, episodes=3, seconds=0.3, seed=0)
    assert [len(one.time) for one in found] == [10, 10, 10]
    for one, snapshots in zip(found, shown, strict=True):
        np.testing.assert_allclose(snapshots.taxel_force, one.taxel_force)
        assert snapshots.primitive_active.shape == (10, len(env.primitive_kinds))
    protocol, memory = evaluation_of(env), policy.initial_carry(3)
    state = jit(protocol.evaluation_starts, once=True)(protocol.evaluation_plan(3, 0))
    step = jit(jax.vmap(env.step), once=True)
    for tick in range(10):
        for i, one in enumerate(found):
            for name in ("joint_position", "taxel_force", "command"):
                wanted = np.asarray(getattr(state.readings, name))[i]
                np.testing.assert_allclose(getattr(one, name)[tick], wanted, atol=2e-3)
        memory, action = policy.act(memory, state.obs["actor"])
        state = step(state, action)
        np.testing.assert_allclose([one.target[tick] for one in found], state.joint_target, atol=2e-3)
