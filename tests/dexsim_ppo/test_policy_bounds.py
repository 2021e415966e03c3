"""A policy file from anywhere: forged values with true checksums get one line, and open no file."""

import copy
import dataclasses
import hashlib
import json
import re
import struct

import jax
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from remembering import remembering
from tiny_env import SMALL, TinyEnv

from dexsim.core.assets import asset_path
from dexsim.core.config import to_dict
from dexsim.core.errors import CheckpointError, DexsimError
from dexsim_ppo import checkpoint, evaluate, reproduce, train
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.policy import Policy, load_policy
from dexsim_real.control.controller import Controller


@pytest.fixture(scope="module")
def sound():
    env = TinyEnv()
    return Policy.from_training(env, SMALL, make_train(env, SMALL).init(jax.random.key(0)))


def forge(sound, path, *, content=None, arrays=None):
    """The policy's file with other values of the header's content, or another last number of an array."""
    sound.save(path)
    file = checkpoint.load(path, kind="policy")

    def put(place, leaf):
        leaf = np.array(leaf)
        leaf.flat[-1] = (arrays or {}).get(jax.tree_util.keystr(place), leaf.flat[-1])
        return leaf

    tree = jax.tree_util.tree_map_with_path(put, sound.params)
    checkpoint.save(path, kind="policy", task=file.task, content=file.content | (content or {}), tree=tree)
    return path


CONTENT = {
    "a rate of zero": {"control_rate": 0},
    "a rate that is no number": {"control_rate": float("nan")},
    "a negative rate": {"control_rate": -33},
    "a rate of a gigahertz": {"control_rate": 1e9},
    "an infinite rate": {"control_rate": float("inf")},
    "a rate in words": {"control_rate": "33"},
    "no rate": {"control_rate": None},
    "a clip in words": {"clip": "5"},
    "a list for a clip": {"clip": [5.0]},
    "a clip that is no number": {"clip": float("nan")},
    "a negative clip": {"clip": -5.0},
    "true for a clip": {"clip": True},
    "another squashing": {"squash": "softsign"},
    "a list for a squashing": {"squash": [1]},
    "a fraction of a layer": {"layers": 2.0},
    "no layers": {"layers": 0},
    "many layers": {"layers": 2**40},
    "a scale that is no number": {"observation_layout": [["a", 3, float("nan")]]},
    "a negative scale": {"observation_layout": [["a", 3, -1.0]]},
    "a negative size": {"observation_layout": [["a", 4, None], ["b", -1, None]]},
    "a fraction of a size": {"observation_layout": [["a", 3.0, None]]},
    "a number for a name": {"observation_layout": [[7, 3, None]]},
    "a layout in words": {"observation_layout": "abc"},
    "no configuration": {"env_config": None},
    "a list for the origin": {"training": []},
    "a specification in words": {"spec": "grasp"},
    "a long word for a number": {"spec": {"name": "a", "fields": [], "velocity_filter": "a" * 10_000}},
    "a long list for a name": {"spec": {"name": [0] * 5000, "fields": []}},
    "gravity of no number": {"spec": {"name": "a", "fields": [], "gravity": [float("nan"), 0, 0]}},
    "a posture beyond any joint": {"spec": {"name": "a", "fields": [], "posture": [1e9]}},
}


@pytest.mark.parametrize("what", CONTENT)
def test_a_value_that_no_policy_has_is_one_line(sound, tmp_path, what):
    with pytest.raises(CheckpointError, match=r"^[^\n]{1,400}$"):
        Policy.load(forge(sound, tmp_path / "p.msgpack", content=CONTENT[what]))


ARRAYS = {
    "NaN weight": {".layers[0].kernel": np.nan},
    "infinite bias": {".layers[1].bias": np.inf},
    "NaN mean": {".normalizer.mean": np.nan},
    "deviation of zero": {".normalizer.std": 0.0},
    "negative deviation": {".normalizer.std": -1.0},
    "weights that overflow": {".layers[0].kernel": 3e38, ".layers[1].kernel": 3e38},
}


@pytest.mark.parametrize("what", ARRAYS)
def test_an_array_that_would_give_no_action_is_one_line(sound, tmp_path, what):
    with pytest.raises(CheckpointError, match=r"^[^\n]{1,400}$"):
        Policy.load(forge(sound, tmp_path / "p.msgpack", arrays=ARRAYS[what]))


def test_weights_that_cancel_for_some_observations_overflow_for_others(sound, tmp_path):
    """Rows of large weights with alternating signs: equal inputs give zero, others give infinity."""
    signs = lambda x: 1e20 * (-1.0) ** np.arange(x.shape[0])[:, None] * np.ones(x.shape)  # noqa: E731
    change = lambda x: signs(x).astype(np.float32) if np.ndim(x) == 2 else np.asarray(x)  # noqa: E731
    forged = dataclasses.replace(sound, params=jax.tree.map(change, sound.params))
    forged.save(tmp_path / "p.msgpack")
    with pytest.raises(CheckpointError, match=r"^[^\n]*so large that actions overflow[^\n]*$"):
        Policy.load(tmp_path / "p.msgpack")


FORGED_MEMORY = {
    "no memory where the network has one": (None, {}),
    "another kind": (["lstm", 16], {}),
    "another size": (["gru", 15], {}),
    "a history": (["history", 2], {}),
    "no size": (["gru"], {}),
    "a fraction of a size": (["history", 1.5], {}),
    "NaN weight": (["gru", 16], {".memory.input.kernel": np.nan}),
    "weights that overflow": (["gru", 16], {".memory.recurrent.kernel": 3e38}),
}


@pytest.mark.parametrize("what", FORGED_MEMORY)
def test_a_memory_that_no_policy_has_is_one_line(tmp_path, what):
    memory, arrays = FORGED_MEMORY[what]
    forged = forge(remembering("gru"), tmp_path / "p.msgpack", content={"memory": memory}, arrays=arrays)
    with pytest.raises(CheckpointError, match=r"^[^\n]{1,400}$"):
        Policy.load(forged)


def test_an_observation_that_nothing_gives_is_one_line(hand):
    shipped = load_policy("grasp")
    spec = dataclasses.replace(shipped.spec, fields=("../../etc/passwd",) * 9)
    with pytest.raises(DexsimError, match=r"^the policy observes '../../etc/passwd', which[^\n]*$"):
        Controller(dataclasses.replace(shipped, spec=spec), hand)


def test_a_file_without_end_is_no_policy(tmp_path):
    with pytest.raises(CheckpointError, match="^/dev/zero: is not a dexsim checkpoint or policy$"):
        Policy.load("/dev/zero")


WRONG = st.one_of(
    st.sampled_from(["x" * 9999, [0] * 999]),
    st.none(),
    st.booleans(),
    st.integers(-(2**62), 2**62),
    st.floats(),
    st.text(max_size=3),
    st.lists(st.floats(), max_size=4),
    st.just({}),
    st.just({"a": 1}),
    st.binary(max_size=2),
)


def places(content, above=()):
    """Every place in nested content."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for name, value in inner:
        yield (*above, name)
        yield from places(value, (*above, name))


@settings(max_examples=20)
@given(st.data())
def test_any_other_value_anywhere_is_one_line_or_a_policy(tmp_path_factory, hand, data):
    path = tmp_path_factory.getbasetemp() / "forged.msgpack"
    shipped = load_policy("grasp")
    content = checkpoint.load(asset_path("policies/grasp.msgpack"), kind="policy").content
    content = copy.deepcopy(content | {"spec": to_dict(shipped.spec)})
    *above, name = data.draw(st.sampled_from(list(places(content | {"env_config": {}}))))
    node = content
    for step in above:
        node = node[step]
    node[name] = data.draw(WRONG)
    checkpoint.save(path, kind="policy", task="grasp", content=content, tree=shipped.params)
    try:
        policy = Policy.load(path)
        Controller(policy, hand)
    except DexsimError as error:
        assert re.match(r"^[^\n]{1,500}$", str(error))
        return
    assert 1 <= policy.control_rate <= 1000
    assert np.all(np.abs(policy.act(policy.initial_carry(), np.full(66, 1e30, np.float32))[1]) <= 1)


def test_large_weights_that_do_not_overflow_are_a_policy(sound, tmp_path):
    path = forge(sound, tmp_path / "p.msgpack", arrays={".layers[0].kernel": 1e6})
    action = Policy.load(path)(np.full(3, 1e30, np.float32))
    assert np.all(np.abs(action) <= 1)


@pytest.mark.parametrize("shape", [[1] * 65, [1] * 100_000, [0] + [2**39] * 3, [0] * 65], ids=len)
def test_a_shape_that_no_array_can_have_is_one_line(tmp_path, shape):
    path = tmp_path / "a"
    checkpoint.save(path, kind="policy", task="tiny", content={}, tree={"x": np.zeros(1 if all(shape) else 0)})
    data = path.read_bytes()
    size = struct.unpack("<Q", data[8:16])[0]
    header = msgpack.unpackb(data[48 : 48 + size])
    header["leaves"][0]["shape"] = shape
    packed = msgpack.packb(header)
    prefix = data[:8] + struct.pack("<Q", len(packed))
    path.write_bytes(prefix + hashlib.sha256(prefix + packed).digest() + packed + data[48 + size :])
    with pytest.raises(CheckpointError, match=r"^[^\n]{1,400}$"):
        checkpoint.load(path, kind="policy")


@pytest.mark.parametrize("mesh", ["/etc/passwd", "../secret.stl", "~/secret.stl", "link.stl"])
def test_a_policy_does_not_choose_which_files_are_opened(tmp_path, monkeypatch, mesh):
    """Measuring it, training from it and making its environment name the file in one line; the user may give it."""
    here = tmp_path / "here"
    here.mkdir()
    (tmp_path / "secret.stl").write_text("secret")
    (here / "link.stl").symlink_to(tmp_path / "secret.stl")
    monkeypatch.chdir(here)
    shipped = load_policy("grasp")
    content = checkpoint.load(asset_path("policies/grasp.msgpack"), kind="policy").content
    config = shipped.env_config | {"objects": shipped.env_config["objects"] | {"mesh": mesh}}
    path = here / "p.msgpack"
    checkpoint.save(path, kind="policy", task="grasp", tree=shipped.params, content=content | {"env_config": config})
    opened = []
    monkeypatch.setattr("dexsim.objects.config.load", lambda path, **_: opened.append(path))
    for open_it in (
        lambda: Policy.load(path).make_env(backend="jax"),
        lambda: evaluate.main([str(path), "--episodes", "1"]),
        lambda: evaluate.evaluate_policy(path, episodes=1),
        lambda: train.parse_arguments(["--policy", str(path), "--preset", "cpu"]),
        lambda: train.train_policy(policy=str(path), preset="cpu"),
    ):
        with pytest.raises(
            CheckpointError, match=r"^the policy's object mesh '[^\n]*' is outside of the current folder"
        ):
            open_it()
    assert opened == []
    own, _ = train.parse_arguments(["--policy", str(path), "--preset", "cpu", "--env.objects.mesh", "../mine.stl"])
    assert own.env.objects.mesh == "../mine.stl"


def test_a_mesh_of_the_current_folder_is_the_policys(sound, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for mesh in ("", "mug.stl", "parts/mug.stl", str(tmp_path / "mug.stl")):
        dataclasses.replace(sound, env_config={"objects": {"mesh": mesh}}).check_mesh()


def test_no_file_chooses_what_is_imported_or_called(sound, tmp_path, monkeypatch):
    """A task's name may be `module:function`, but only where a user types it."""
    called = []
    (tmp_path / "their_module.py").write_text("import sys\nsys.called.append('imported')\n")
    monkeypatch.setattr("sys.called", called, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    name, path = "their_module:make_env", tmp_path / "p.msgpack"
    progress = {"best": {"return": None, "iteration": 0}, "seconds": 0.0}
    arguments = {"task": name, "env": {}, "ppo": {}}
    content = {"arguments": arguments, "progress": progress, "backend": "c", "calls": 1}
    for task in (name, "grasp"):  # In the header, and in the options.
        dataclasses.replace(sound, task=task).save(path)
        for kind in ("train", "reproducer"):
            checkpoint.save(tmp_path / kind, kind=kind, task=task, content=content, tree={})
        commands = [lambda: evaluate.main([str(path)]), lambda: train.main(["--policy", str(path)])]
        commands = commands if task == name else []
        commands += [lambda: train.main(["--resume", str(tmp_path / "train")])]
        commands += [lambda: reproduce.main([str(tmp_path / "reproducer")])]
        for command in commands:
            with pytest.raises(DexsimError, match=r"^[^\n]*task = 'their_module:make_env': must be a word[^\n]*$"):
                command()
    (tmp_path / "config.json").write_text(json.dumps({"arguments": arguments}))
    with pytest.raises(DexsimError, match="unknown task 'make_env'"):
        train.main(["--config", str(tmp_path / "config.json")])
    (tmp_path / "config.json").write_text(json.dumps({"arguments": arguments | {"task": "os:grasp"}}))
    with pytest.raises(DexsimError, match="task = 'os:grasp': must be a word"):
        train.main(["--config", str(tmp_path / "config.json")])
    assert called == []
