"""`benchmarks/throughput.py` leaves out what it says, and nothing else; over physics that compile in a second."""

import dataclasses
import importlib.util
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import ROOT
from simple_physics import SimplePhysics

from dexsim.objects.config import ObjectConfig
from dexsim.registry import TASKS, TaskEntry
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp

FOLDER = ROOT / "benchmarks"
WORLDS, STEPS = 4, 5


@pytest.fixture(scope="module")
def benchmarks():
    """The modules, as they import each other."""
    found = []
    for name in ("throughput", "throughput_split"):
        spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
        found.append(sys.modules[name])
    return found


@pytest.fixture
def simple(monkeypatch):
    monkeypatch.setattr("dexsim.env.env.Physics", SimplePhysics)
    config = GraspConfig(pool_size=16, objects=ObjectConfig(shapes=("sphere",)))
    monkeypatch.setitem(TASKS, "grasp", TaskEntry(GraspConfig, Grasp, lambda: config))


def run(throughput, env, state, step=None, tape=None, steps=STEPS):
    return throughput.runner(env, WORLDS, steps, step)(state, jax.random.key(2), tape)


def equal(first, second):
    named = jax.tree_util.tree_flatten_with_path(first)[0]
    for (path, ours), theirs in zip(named, jax.tree.leaves(second), strict=True):
        if not jnp.issubdtype(ours.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(ours, theirs, err_msg=jax.tree_util.keystr(path))


@pytest.mark.slow
def test_replayed_torques_give_the_same_motion_and_contacts(benchmarks, simple):
    """With friction, latency, ripple, restarts: the tape holds all that the drive did, and readings of its torque."""
    throughput, _ = benchmarks
    full, replay = (throughput.make("grasp", name, "jax", WORLDS) for name in ("full", "actuator"))
    recorder = throughput.Recorder(throughput.make("grasp", "full", "jax", WORLDS))
    state = throughput.started(full, WORLDS, 20)
    after, touched, _ = run(throughput, full, state)

    def recorded(state, action, _):
        after, tick = recorder.recorded_step(state, action)
        return after, tick[-1]

    same, _, tape = run(throughput, recorder, state, recorded)
    assert tape.shape == (STEPS, WORLDS, full.config.physics.substeps + 1, 12) and np.all(np.std(tape, (0, 1)) > 1e-3)
    assert touched > 0 and np.any(after.length < STEPS), "no restart: the test tests less than it says"
    equal(after.physics, same.physics)
    again, _, _ = run(
        throughput,
        replay,
        state,
        lambda state, action, tape: (replay.replayed_step(state, action, tape), tape[:0]),
        tape,
    )
    for name in ("physics", "sensor_input", "reward", "obs", "metrics"):
        pairs = zip(*(jax.tree.leaves(getattr(state, name)) for state in (again, after)), strict=True)
        for ours, theirs in pairs:
            np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-5, err_msg=name)


@pytest.mark.slow
def test_hands_are_kept_or_nominal(benchmarks, simple, hand):
    throughput, _ = benchmarks
    kept = throughput.make("grasp", "redrawing", "jax", WORLDS)
    state = jax.jit(jax.vmap(kept.reset))(jax.random.split(jax.random.key(0), WORLDS))
    after = jax.jit(jax.vmap(kept.restart))(state, jnp.ones(WORLDS, bool))
    equal(after.episode.hand, state.episode.hand)
    equal(after.episode.imu, state.episode.imu)
    assert np.all(np.asarray(after.length) == 0) and np.any(after.physics.qpos != state.physics.qpos)
    nominal = throughput.make("grasp", "randomization", "jax", WORLDS)
    drawn, _ = nominal.sampler.sample_hand(jax.random.key(0), jax.random.key(0))
    np.testing.assert_array_equal(drawn.actuator.stall_torque, hand.torque_limit)
    # Known beforehand, so nothing is drawn: the program has no random bits but for what it needs elsewhere.
    text = [
        jax.jit(lambda k, e=env: e.sampler.sample_hand(k, k)[0]).lower(jax.random.key(0)).as_text()
        for env in (nominal, throughput.make("grasp", "full", "jax", WORLDS))
    ]
    assert text[0].count("threefry") < text[1].count("threefry")


@pytest.mark.slow
def test_rows_are_json_with_a_share(benchmarks, simple, capsys, monkeypatch):
    throughput, _ = benchmarks
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "throughput.py",
            "--num-envs",
            str(WORLDS),
            "--steps",
            "4",
            "--repeats",
            "2",
            "--leave-out",
            "actuator",
            "redrawing",
        ],
    )
    monkeypatch.setattr(throughput, "enable_caches", lambda: None)
    throughput.main()
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["left_out"] for row in rows] == ["nothing", "actuator", "redrawing"]
    assert all(row["env_steps_per_s"] > 0 and row["num_envs"] == WORLDS for row in rows)
    assert rows[0]["share_touching"] == rows[1]["share_touching"] and rows[1]["share"] < 1


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["none", "gru"])
def test_the_parts_of_a_training_step(benchmarks, simple, monkeypatch, memory):
    _, split = benchmarks
    preset = split.find_preset("cpu", "grasp")
    preset = dataclasses.replace(preset, ppo=dataclasses.replace(preset.ppo, memory=memory))
    monkeypatch.setattr(split, "find_preset", lambda device, task: preset)
    rows = {row["part"]: row for row in split.split("grasp", "jax", WORLDS, 1)}
    assert list(rows) == [
        "training step",
        "rollout",
        "environment",
        "physics",
        "touch",
        "policy",
        "learner",
        "environment rest",
        "rest",
    ]
    whole = rows["training step"]
    assert whole["share"] == 1 and whole["env_steps_per_s"] > 0
    parts = sum(rows[name]["share"] for name in ("physics", "touch", "environment rest", "policy", "learner", "rest"))
    assert parts == pytest.approx(1, abs=2e-3)
    assert all(rows[name]["share"] > 0 for name in ("rollout", "environment", "physics", "touch", "policy", "learner"))


@pytest.mark.slow
@pytest.mark.parametrize("task", ["grasp", "rotate"])
def test_training_of_two_engines_in_turn(benchmarks, simple, monkeypatch, capsys, task):
    """The ratio is that of the times; the number of environments is the preset's where none is given."""

    class Named(SimplePhysics):
        def __init__(self, hand, slots, largest, config, **options):
            super().__init__(hand, slots, largest, config, **options)
            self.backend = options["backend"]

    throughput, _ = benchmarks
    monkeypatch.setattr("dexsim.env.env.Physics", Named)
    monkeypatch.setattr(throughput, "enable_caches", lambda: None)
    preset = throughput.preset(task)
    small = dataclasses.replace(preset, ppo=dataclasses.replace(preset.ppo, num_envs=WORLDS, rollout_length=4))
    monkeypatch.setattr(throughput, "preset", lambda task: small)
    options = ["--task", task, "--train", "1", "--repeats", "2", "--backends", "c", "jax"]
    monkeypatch.setattr(sys, "argv", ["throughput.py", *options])
    throughput.main()
    ours, theirs = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["backend"], row["num_envs"], row["measure"]) for row in (ours, theirs)] == [
        ("c", WORLDS, "training"),
        ("jax", WORLDS, "training"),
    ]
    assert ours["times_jax"] > 0 and "times_jax" not in theirs
