"""Compiled training steps kept between runs."""

import copy
import dataclasses
import os
import pickle
import re
import shutil
import tempfile
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache

import dexsim_ppo
from dexsim.core.assets import asset_path
from dexsim.core.errors import DexsimWarning
from dexsim.env.fingerprint import fingerprint
from dexsim.hand.load import load_hand
from dexsim_ppo.training import programs
from dexsim_ppo.training.programs import compile_step, key

KEY = jax.random.key(3)
SHAPES = jax.eval_shape(lambda: {"key": KEY, "keys": jax.random.split(KEY, 4), "total": jnp.zeros(3)})


def fresh():
    return {"key": jax.random.key(3), "keys": jax.random.split(jax.random.key(4), 4), "total": jnp.arange(3.0)}


def step(state):
    key, use = jax.random.split(state["key"])
    noise = jax.vmap(jax.random.normal)(state["keys"])
    total = state["total"] + jax.random.normal(use, (3,)) + noise.sum()
    return state | {"key": key, "total": total}, {"norm": jnp.linalg.norm(total), "a": total[0]}


@pytest.fixture(autouse=True)
def no_compilation_cache():
    """What JAX's own cache holds is not kept again, so these tests do without."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    reset_cache()
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    reset_cache()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))
    return tmp_path / "programs"


def run(identity, steps=2):
    """(what two steps give, whether the step was traced)."""
    traced, state = [], fresh()
    program = compile_step(step, SHAPES, identity, lambda: traced.append(1))
    for _ in range(steps):
        state, metrics = program(state)
    return (*jax.device_get((state["total"], metrics)), jax.random.key_data(state["key"])), bool(traced)


def test_the_second_start_traces_nothing_and_does_the_same(folder):
    state = fresh()
    for _ in range(2):
        state, metrics = jax.jit(step)(state)
    first, traced = run("one")
    again, traced_again = run("one")
    assert traced and not traced_again
    for found in (first, again):
        np.testing.assert_allclose(found[0], state["total"], rtol=1e-6)
        assert found[1] == {name: pytest.approx(float(value), rel=1e-6) for name, value in metrics.items()}
        np.testing.assert_array_equal(found[2], jax.random.key_data(state["key"]))


def test_another_program_is_not_taken_for_this_one(folder, monkeypatch):
    run("one")
    assert run("two")[1]
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert run("one")[1]


def test_what_tells_programs_apart(monkeypatch):
    base = key(["x"], SHAPES)
    assert key(["x"], SHAPES) == base != key(["y"], SHAPES)
    assert key(["x"], SHAPES | {"total": jax.ShapeDtypeStruct((4,), jnp.float32)}) != base
    with jax.enable_x64(True):
        assert key(["x"], SHAPES) != base
    others = [key({"x": 1}, SHAPES), key(["x"], {"sum": SHAPES["total"]} | {k: SHAPES[k] for k in ("key", "keys")})]
    for option in (
        jax.numpy_dtype_promotion("standard"),  # the tests are strict
        jax.default_matmul_precision("float32"),
        jax.debug_nans(True),
        jax.debug_infs(True),
        jax.default_prng_impl("rbg"),
        jax.threefry_partitionable(not jax.config.jax_threefry_partitionable),
        jax.disable_jit(),
    ):
        with option:
            others.append(key(["x"], SHAPES))
    for name, change in (
        ("_cpu_features", lambda: "another processor"),
        ("environment_report", lambda: {"versions": "other ones"}),
        ("python_sources", lambda folder: [Path(__file__)]),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(programs, name, change)
            others.append(key(["x"], SHAPES))
    assert len({base, *others}) == 1 + len(others)


def test_its_sources_are_those_of_the_learner(monkeypatch):
    asked = []
    monkeypatch.setattr(programs, "python_sources", lambda folder: asked.append(folder) or [])
    key(["x"], SHAPES)
    assert asked == [Path(dexsim_ppo.__file__).parent]


def test_a_program_that_is_used_stays(folder, monkeypatch):
    """The oldest by use goes, not the oldest by age."""
    monkeypatch.setattr(programs, "KEPT", 2)
    for name in ("one", "two"):
        run(name)
        for path in folder.glob("*.pkl"):
            os.utime(path, (path.stat().st_atime, path.stat().st_mtime - 100))
    assert not run("one")[1]
    run("three")
    assert not run("one")[1] and run("two")[1]


def test_the_step_takes_its_state_over(folder):
    """Two states would not fit beside each other. What came from the cache is tried on a copy, once."""
    for identity in ("one", None, "one"):
        program, state = compile_step(step, SHAPES, identity, lambda: None), fresh()
        if isinstance(program, programs.Program) and program._fallback:
            state, _ = program(state)
        program(state)
        assert state["total"].is_deleted()


def test_the_newest_programs_are_kept(folder, monkeypatch):
    monkeypatch.setattr(programs, "KEPT", 2)
    for age, name in enumerate(("one", "two", "three")):
        run(name)
        for path in folder.glob("*.pkl"):
            os.utime(path, (path.stat().st_atime, path.stat().st_mtime - 100 * (age < 2)))
    assert len(list(folder.glob("*.pkl"))) == 2
    assert not run("three")[1] and not run("two")[1] and run("one")[1]


@pytest.mark.parametrize("harm", [lambda content: content[: len(content) // 2], lambda content: b"x" * 99])
def test_a_damaged_file_is_compiled_again(folder, harm):
    good, _ = run("one")
    (path,) = folder.glob("*.pkl")
    path.write_bytes(harm(path.read_bytes()))
    again, traced = run("one")
    assert traced
    np.testing.assert_array_equal(again[0], good[0])
    assert not run("one")[1]


def test_what_jax_kept_is_not_kept_again(folder, tmp_path):
    """XLA serialises such a program without its functions."""
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "xla"))
    reset_cache()
    good, _ = run("one")
    (path,) = folder.glob("*.pkl")
    assert list((tmp_path / "xla").iterdir())
    path.unlink()
    again, traced = run("one")
    assert traced and not list(folder.glob("*"))
    np.testing.assert_array_equal(again[0], good[0])


def test_a_program_that_does_not_run_is_made_again(folder, monkeypatch):
    good, _ = run("one")

    def broken(leaves):
        raise jax.errors.JaxRuntimeError("INTERNAL: Function add_fusion not found")

    monkeypatch.setattr(programs.serialize_executable, "deserialize_and_load", lambda *_: broken)
    again, traced = run("one")
    assert traced
    np.testing.assert_array_equal(again[0], good[0])


def test_without_a_place_to_write_it_runs_all_the_same(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path / "file"))
    assert run("one")[1] and run("one")[1]


def test_an_environment_without_an_identity_keeps_nothing(folder):
    assert run(None)[1] and not folder.exists()


def test_the_oldest_go(folder, monkeypatch):
    monkeypatch.setattr(programs, "KEPT", 2)
    for name in ("a", "b", "c"):
        run(name)
    assert len(list(folder.glob("*"))) == 2


def test_fingerprints(grasp_env, monkeypatch):
    base = fingerprint(grasp_env)
    assert base == fingerprint(grasp_env) == grasp_env.fingerprint()
    other = copy.copy(grasp_env)
    other.config = dataclasses.replace(grasp_env.config, pool_size=grasp_env.config.pool_size + 1)
    assert fingerprint(other) not in (base, None)
    other = copy.copy(grasp_env)
    other.pool = jax.tree.map(lambda x: x + 1 if np.issubdtype(np.asarray(x).dtype, np.floating) else x, grasp_env.pool)
    assert fingerprint(other) not in (base, None)
    other = copy.copy(grasp_env)
    for field in dataclasses.fields(grasp_env.hand):
        other.hand = dataclasses.replace(grasp_env.hand, **{field.name: changed(getattr(grasp_env.hand, field.name))})
        assert fingerprint(other) not in (base, None), field.name
    other.task = type("Mine", (), {})()  # its sources are not this package's
    assert fingerprint(other) is None


def changed(value):
    """A hand's field with one small change."""
    if isinstance(value, np.ndarray):
        other = value.copy()
        other.flat[0] += 1
        return other
    if isinstance(value, tuple) and dataclasses.is_dataclass(value[0]):
        return (dataclasses.replace(value[0], size=changed(value[0].size)), *value[1:])
    if isinstance(value, tuple):
        return (value[0] * 2, *value[1:])
    return Path(shutil.copy(value, tempfile.mkdtemp())) if isinstance(value, Path) else value + "x"


def test_a_hand_with_other_speed_limits_in_its_toml_is_another_program(tmp_path, grasp_env):
    """The drive closes over them, so a kept program would go on with the old hand."""
    folder = tmp_path / "hand"
    shutil.copytree(asset_path("hand"), folder)
    toml = folder / "xhand_right.toml"
    text = toml.read_text()
    slower = re.sub(
        r"speed_limits = \[([^\]]*)\]",
        lambda found: f"speed_limits = [{', '.join(str(float(x) / 20) for x in found[1].split(',') if x.strip())}]",
        text,
    )
    assert slower != text
    hashes = []
    for content in (text, slower):
        toml.write_text(content)
        env = copy.copy(grasp_env)
        env.hand = load_hand(toml)
        hashes.append(fingerprint(env))
    assert None not in hashes and hashes[0] != hashes[1]


class Planted:
    """What unpickling runs."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


OTHERS = {
    "folder for all": lambda folder, file: folder.chmod(0o777),
    "folder for the group": lambda folder, file: folder.chmod(0o770),
    "file for all": lambda folder, file: file.chmod(0o666),
    "file for the group": lambda folder, file: file.chmod(0o664),
    "a link": lambda folder, file: file.symlink_to(shutil.move(file, folder.parent / "elsewhere")),
    "folder of another user": lambda folder, file: os.chown(folder, 12345, -1),
    "file of another user": lambda folder, file: os.chown(file, 12345, -1),
}


@pytest.mark.parametrize("how", OTHERS)
def test_what_others_may_have_written_is_not_loaded(folder, tmp_path, how):
    """One warning, nothing unpickled, and the program runs all the same."""
    if "another" in how and os.geteuid():
        pytest.skip("only root can give files away")
    good, _ = run("one")
    (file,) = folder.glob("*.pkl")
    assert folder.stat().st_mode & 0o777 == 0o700
    file.write_bytes(pickle.dumps(Planted(tmp_path / "planted")))
    OTHERS[how](folder, file)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        again, traced = run("one")
    assert traced and not (tmp_path / "planted").exists()
    np.testing.assert_array_equal(again[0], good[0])
    (line,) = [str(w.message) for w in said if issubclass(w.category, DexsimWarning)]
    assert line.startswith("compiled programs are not cached: ") and "\n" not in line and str(folder.parent) in line


def test_the_planted_file_would_run(folder, tmp_path):
    """Otherwise the test above would test nothing."""
    run("one")
    (file,) = folder.glob("*.pkl")
    file.write_bytes(pickle.dumps(Planted(tmp_path / "planted")))
    run("one")
    assert (tmp_path / "planted").exists()
