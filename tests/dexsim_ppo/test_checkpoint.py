"""Files: what is written is what is read, and nothing damaged is ever read."""

import struct

import jax
import jax.numpy as jnp
import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_env import SMALL, TinyConfig, TinyEnv

from dexsim.core.config import from_dict
from dexsim.core.errors import CheckpointError
from dexsim_ppo import checkpoint, reproduce, train
from dexsim_ppo.acting import act
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.policy import Policy

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


@pytest.fixture(scope="module")
def trained():
    env = TinyEnv()
    state, _ = make_train(env, SMALL).step(make_train(env, SMALL).init(jax.random.key(0)))
    return env, state


def equal(a, b):
    def leaf(x, y):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(
            np.asarray(x).view(np.uint8) if x.ndim else x, np.asarray(y).view(np.uint8) if y.ndim else y
        )

    jax.tree.map(leaf, a, b)


def test_round_trip(file):
    loaded = checkpoint.load(file, kind="train", task="tiny")
    assert loaded.content == {"answer": [1, 2.5, None]} and loaded.task == "tiny"
    equal(checkpoint.restore(loaded, jax.eval_shape(lambda: TREE)), TREE)
    assert [p.name for p in file.parent.iterdir()] == ["a.msgpack"], "no temporary file is left"


@given(st.floats(0, 1, exclude_max=True), st.integers(0, 7))
def test_a_flipped_bit_is_found(file, place, bit):
    data = bytearray(file.read_bytes())
    data[int(place * len(data))] ^= 1 << bit
    damaged = file.with_name("damaged")
    damaged.write_bytes(data)
    try:
        with pytest.raises(CheckpointError, match=r"^[^\n]*damaged: [^\n]+$"):
            checkpoint.load(damaged, kind="train")
    finally:
        damaged.unlink()


@given(st.floats(0, 1, exclude_max=True), st.sampled_from(["cut", "extend", "drop", "repeat"]))
def test_a_changed_length_is_found(file, place, how):
    data = file.read_bytes()
    at = int(place * len(data))
    data = {
        "cut": data[:at],
        "extend": data + data[: at + 1],
        "drop": data[:at] + data[at + 1 :],
        "repeat": data[: at + 1] + data[at:],
    }[how]
    damaged = file.with_name("damaged")
    damaged.write_bytes(data)
    try:
        with pytest.raises(CheckpointError):
            checkpoint.load(damaged, kind="train")
    finally:
        damaged.unlink()


def forge(path, **changes):
    """A file with true checksums and a changed header: what a hostile or faulty writer could make."""
    import hashlib

    data = path.read_bytes()
    size = struct.unpack("<Q", data[8:16])[0]
    header = msgpack.unpackb(data[48 : 48 + size]) | changes
    packed = msgpack.packb(header)
    prefix = data[:8] + struct.pack("<Q", len(packed))
    forged = path.with_name("forged")
    forged.write_bytes(prefix + hashlib.sha256(prefix + packed).digest() + packed + data[48 + size :])
    return forged


@pytest.mark.parametrize(
    "leaf",
    [
        {"path": "x", "dtype": "float32", "shape": [2**39, 2**39], "prng": ""},
        {"path": "x", "dtype": "float32", "shape": [-1], "prng": ""},
        {"path": "x", "dtype": "object", "shape": [1], "prng": ""},
        {"path": "x", "dtype": "float32", "shape": [1.5], "prng": ""},
        {"path": "x"},
        7,
    ],
)
def test_impossible_leaves_are_refused_before_allocation(file, leaf):
    forged = forge(file, leaves=[leaf])
    with pytest.raises(CheckpointError):
        checkpoint.load(forged, kind="train")
    forged.unlink()


def deep(levels):
    return [] if levels == 0 else {"a": deep(levels - 1)}


@pytest.mark.parametrize("value", [b"x", {b"x": 1}, msgpack.Timestamp(0), msgpack.ExtType(1, b"x"), deep(800)])
def test_what_a_file_says_is_plain_and_can_be_walked(file, value):
    """Or else a report, an export or another file could not hold it."""
    forged = forge(file, content={"training": value})
    with pytest.raises(CheckpointError, match=r"^[^\n]*a header that makes no sense \(its content [^\n]*$"):
        checkpoint.load(forged, kind="train")
    forge(file, content={"training": deep(90)})
    assert checkpoint.load(forged, kind="train").content["training"]
    forged.unlink()


BEST = {"return": None, "iteration": 0}


@pytest.mark.parametrize(
    "kind, content, said",
    [
        ("train", {"arguments": []}, "arguments = []"),
        ("train", {"progress": {"best": BEST | {"return": "x"}, "seconds": 1.0}}, "progress.best.return = 'x'"),
        ("train", {"progress": {"best": BEST, "seconds": "x"}}, "progress.seconds = 'x'"),
        ("train", {"progress": {"best": BEST, "seconds": 1, "without_better": "x"}}, "progress.without_better = 'x'"),
        ("reproducer", {}, "backend = None"),
        ("reproducer", {"backend": "c", "calls": 1.5}, "calls = 1.5"),
        ("reproducer", {"backend": "c", "calls": True}, "calls = True"),
    ],
)
def test_what_a_run_did_not_write_is_named(tmp_path, kind, content, said):
    path = tmp_path / "a.msgpack"
    checkpoint.save(path, kind=kind, task="tiny", content={"arguments": {}} | content, tree={})
    with pytest.raises(CheckpointError) as error:
        train.find_beginning(None, None, path) if kind == "train" else reproduce.main([str(path)])
    assert str(error.value) == f"{path}: is no sound {kind!r} file: {said}"


def test_other_task_kind_version_and_no_checkpoint(file, tmp_path):
    with pytest.raises(CheckpointError, match="of the task 'tiny', not 'grasp'"):
        checkpoint.load(file, kind="train", task="grasp")
    with pytest.raises(CheckpointError, match="'train' file, not a 'policy' file"):
        Policy.load(file)
    newer = tmp_path / "newer"
    data = bytearray(file.read_bytes())
    data[6] = 9
    newer.write_bytes(data)
    with pytest.raises(CheckpointError, match="format version 9.*update dexsim"):
        checkpoint.load(newer, kind="train")
    (tmp_path / "text").write_text("no checkpoint")
    with pytest.raises(CheckpointError, match="not a dexsim checkpoint"):
        checkpoint.load(tmp_path / "text", kind="train")
    for missing in (tmp_path / "missing", tmp_path):
        with pytest.raises(CheckpointError, match="cannot be read"):
            checkpoint.load(missing, kind="train")


def test_restore_names_what_does_not_fit(file):
    loaded = checkpoint.load(file, kind="train")
    for change, said in (
        ({"x": jnp.zeros((2, 4))}, r"\['x'\] is float32\[2, 3\], expected"),
        ({"y": jnp.zeros(1)}, r"\['y'\] is missing"),
    ):
        with pytest.raises(CheckpointError, match=said):
            checkpoint.restore(loaded, TREE | change)
    with pytest.raises(CheckpointError, match=r"\['x'\] is not expected"):
        checkpoint.restore(loaded, {k: v for k, v in TREE.items() if k != "x"})


def test_a_failed_write_leaves_the_old_file(file, monkeypatch):
    before = file.read_bytes()
    monkeypatch.setattr("dexsim.core.files.os.replace", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        checkpoint.save(file, kind="train", task="other", content={}, tree=TREE)
    assert file.read_bytes() == before
    assert [p.name for p in file.parent.iterdir()] == ["a.msgpack"]


def test_resume_is_exact_to_the_bit(tmp_path):
    """Five iterations equal two, a file, and three more; normalisers, keys and environments included."""
    straight = make_train(TinyEnv(), SMALL)
    state = straight.init(jax.random.key(5))
    for _ in range(2):
        state, _ = straight.step(state)
    checkpoint.save(tmp_path / "c", kind="train", task="tiny", content={}, tree=state)
    for _ in range(3):
        state, _ = straight.step(state)

    resumed = make_train(TinyEnv(), SMALL)
    template = resumed.shapes(jax.random.key(0))
    other = checkpoint.restore(checkpoint.load(tmp_path / "c", kind="train"), template)
    other = jax.tree.map(jnp.copy, other)
    for _ in range(3):
        other, _ = resumed.step(other)
    equal(other, state)
    assert resumed.step._cache_size() == 1


def test_policy_round_trip(trained, tmp_path):
    env, state = trained
    policy = Policy.from_training(env, SMALL, state, {"seed": 0})
    policy.save(tmp_path / "p.msgpack")
    loaded = Policy.load(tmp_path / "p.msgpack", task="tiny")
    obs = jax.random.normal(jax.random.key(1), (5, 3))
    np.testing.assert_array_equal(loaded.act(None, obs)[1], policy.act(None, obs)[1])
    np.testing.assert_allclose(act(loaded.params, None, obs[0])[1], policy.act(None, obs)[1][0], rtol=1e-5, atol=1e-6)
    assert float(jnp.abs(loaded.act(None, 1e6 * obs)[1]).max()) <= 1
    assert from_dict(TinyConfig, loaded.env_config) == env.config
    assert loaded.observation_layout == env.observation_layout["actor"]
    assert loaded.control_rate == pytest.approx(10) and loaded.training == {"seed": 0}
    with pytest.raises(CheckpointError, match="of the task 'tiny', not 'grasp'"):
        Policy.load(tmp_path / "p.msgpack", task="grasp")


def test_a_policy_whose_parts_do_not_fit_is_refused(trained, tmp_path):
    env, state = trained
    Policy.from_training(env, SMALL, state).save(tmp_path / "p.msgpack")
    content = checkpoint.load(tmp_path / "p.msgpack", kind="policy").content
    for change in ({"layers": 1}, {"layers": 3}, {"observation_layout": [["angle", 2, None]]}):
        with pytest.raises(CheckpointError, match="not a sound policy"):
            Policy.load(forge(tmp_path / "p.msgpack", content=content | change))


def test_policies_load_without_the_simulator(trained, tmp_path):
    import subprocess
    import sys

    env, state = trained
    Policy.from_training(env, SMALL, state).save(tmp_path / "p.msgpack")
    code = (
        f"from dexsim_ppo import Policy; import jax.numpy as jnp, sys; "
        f"p = Policy.load({str(tmp_path / 'p.msgpack')!r}); print(p.act(None, jnp.zeros(3))[1].shape); "
        "bad = {'mujoco', 'warp', 'tyro', 'matplotlib', 'trimesh'} & set(sys.modules); "
        "assert not bad, bad"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "(1,)", done.stderr
