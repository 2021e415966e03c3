"""Parameters of the emulated hand against training's ranges, and its sources against training's code."""

import ast
import dataclasses
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from paths import ROOT

import dexsim_real.twin.plant
from dexsim.core.config import to_dict
from dexsim.registry import TASKS as TRAINED
from dexsim.tasks.rotate.objects import CLEARANCE
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant import emulated_hand, referee
from dexsim_real.twin.plant.emulated_hand import EmulatedHand, is_clear
from dexsim_real.twin.plant.parameters import BANDS, FAR, NEAR, PUSHES, TASK_BANDS, sample_trial, skill_of, start_of

SKILLS = ("grasp", "rotate", "rotate_clear")  # rotate_any shares all but its objects and its mount with rotate


def bands(task):
    return BANDS | TASK_BANDS[task]


def _lookup(config, path):
    for name in path.split("."):
        config = config[name]
    return config


def trained_bands(task):
    """Those that training has; the others are the emulated hand's own."""
    return {name: band for name, band in bands(task).items() if band.origin and band.sides != "within"}


def test_fingertips_and_friction_follow_nothing_of_training():
    """Their values fill ranges of the emulated hand's own, whatever training has."""
    for task in SKILLS:
        own = {name: band for name, band in bands(task).items() if band.sides == "within"}
        assert own.keys() - {"reaction"} == {"rubber", "friction", "link_friction"}
        drawn = [sample_trial(task, np.random.default_rng(seed)).value for seed in range(100)]
        for name, band in own.items():
            values = np.array([each[name] for each in drawn])
            assert np.all((values >= band.low) & (values <= band.high)), name
            assert np.ptp(values) > 0.9 * (band.high - band.low), name


@pytest.mark.parametrize("task", SKILLS)
def test_bands_rules_and_places_repeat_those_of_the_tasks_and_of_the_shipped_policies(hand, task):
    from dexsim_ppo.policy import load_policy

    shipped = load_policy(task).env_config
    for config in (to_dict(TRAINED[task].config()), shipped):
        for name, band in trained_bands(task).items():
            trained = _lookup(config, band.origin)
            low, high = (
                trained
                if isinstance(trained, (tuple, list))
                else ((-trained, trained) if band.low < 0 else (trained, trained))
            )
            if (task, name) == ("rotate", "latency") and high > band.high:  # trained on later hands than these
                continue
            assert (band.low, band.high) == pytest.approx((low, high)), name
        skill = skill_of(task)
        assert PUSHES[skill][1] == config["push_speed"]
        assert PUSHES[skill][0] == pytest.approx(
            config["push_probability"] / config["physics"]["timestep"] / config["physics"]["substeps"]
        )
        assert referee.LOST[skill] == config["drop_distance"]
        assert referee.LIMITS[skill] == config["evaluation_seconds"]
    rules = TRAINED[task].task(TRAINED[task].config(), hand)
    start = start_of(hand, task)
    assert start.reference == pytest.approx(rules.reference)
    assert start.posture.tolist() == list(rules.config.posture) == pytest.approx(shipped["posture"])
    assert start.gravity == pytest.approx(rules.gravity)
    if skill == "rotate":
        assert start.axis == pytest.approx(rules.turn.unit_axis) and referee.ON_PALM == CLEARANCE
        turn = rules.config.turn
        ours = (start.turn, referee.GOAL_ANGLE, referee.GOAL_DISTANCE, referee.GOAL_SPIN, referee.TIPPED)
        assert ours == pytest.approx((turn.step, turn.angle, turn.distance, turn.spin, rules.config.drop_tilt))


@pytest.mark.parametrize("task", ("rotate", "rotate_clear"))
def test_a_cube_is_put_in_the_middle_of_trainings_starts(hand, monkeypatch, tmp_path, task):
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))
    entry = TRAINED[task]
    rules = entry.task(dataclasses.replace(entry.config(), pool_size=32), hand)
    starts, place = rules.make_pool(jax.random.key(0)).qpos[:, 12:15], start_of(hand, task).place
    assert np.all(np.abs(starts.mean(0)[-len(place) :] - place) < 0.6 * starts.std(0)[-len(place) :])


def test_a_cube_between_the_fingertips_is_put_where_they_carry_it(hand):
    """A millimetre lower it would overlap with them."""
    for trial in range(3):
        plant = EmulatedHand(hand, "rotate_clear", 7, first=trial)
        place, scene, data = plant._place, plant._scene, mujoco.MjData(plant._scene.model)
        scene.set_joints(data, plant.start.posture)
        at, lower = place.position, place.position - 0.001 * plant.up
        assert is_clear(scene, data, at, place.quat) and not is_clear(scene, data, lower, place.quat)


def test_the_fingers_leave_room_where_a_cube_is_put(hand, monkeypatch):
    """Hands around which no cube fits are drawn anew, which must not choose among them."""
    monkeypatch.setattr(emulated_hand, "_OBJECTS", 1)
    for trial in range(15):
        EmulatedHand(hand, "rotate", 7, first=trial)


@pytest.mark.parametrize("task", SKILLS)
def test_every_value_lies_outside_its_range_and_near_it(task):
    sides = {name: set() for name in trained_bands(task)}
    for seed in range(60):
        parameters = sample_trial(task, np.random.default_rng(seed))
        for name, band in trained_bands(task).items():
            value, width = parameters.value[name], band.high - band.low
            assert np.all((value < band.low) | (value > band.high)), name
            assert np.all(value >= band.low - (FAR + 1e-9) * width), name
            assert np.all(value <= band.high + (FAR + 1e-9) * width), name
            beyond = np.maximum(band.low - value, value - band.high)
            assert np.all(beyond >= (NEAR - 1e-9) * width), name
            sides[name] |= set(np.atleast_1d(value > band.high).ravel().tolist())
    for name, band in trained_bands(task).items():
        assert sides[name] == {"both": {True, False}, "high": {True}, "low": {False}}[band.sides], name


def test_inside_nominal_and_overrides():
    for task in SKILLS:
        inside, nominal = (sample_trial(task, np.random.default_rng(3), kind) for kind in ("inside", "nominal"))
        for name, band in bands(task).items():
            assert np.all((inside.value[name] >= band.low) & (inside.value[name] <= band.high)), name
            assert np.all(nominal.value[name] == band.nominal), name
    fixed = sample_trial("grasp", np.random.default_rng(3), "outside", {"gear_play": 0.002, "rolling": 0.0})
    assert np.all(fixed.gear_play == 0.002) and fixed.rolling == 0.0
    assert np.array_equal(fixed.stiffness, sample_trial("grasp", np.random.default_rng(3)).stiffness)
    with pytest.raises(HandError, match="no parameter 'gaer_play'"):
        sample_trial("grasp", np.random.default_rng(0), overrides={"gaer_play": 1.0})


def test_the_physics_shares_no_code_with_training():
    """Every module of the folder: of `dexsim` it takes the type of a hand's model, its MJCF and the walk along its
    bodies, of JAX nothing."""
    folder = Path(dexsim_real.twin.plant.__file__).parent
    paths = sorted(folder.rglob("*.py"))
    ours = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths}
    assert "dexsim_real.twin.plant.emulated_hand" in ours and len(ours) > 8
    hand = ("description.Hand", "kinematics.finger_bodies", "mjcf.read_mjcf")
    bridge = {"dexsim_real.wire.frames", "dexsim_real.core.errors", *ours}
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            prefix = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
            names = node.names if isinstance(node, (ast.Import, ast.ImportFrom)) else ()
            for name in (prefix + alias.name for alias in names):
                package = name.split(".")[0]
                assert package not in ("jax", "dexsim_ppo", "importlib"), f"{path.name} imports {name}"
                assert "mjx" not in name
                assert package != "dexsim" or name.removeprefix("dexsim.hand.") in hand, f"{path.name}: {name}"
                if package == "dexsim_real":
                    assert name in bridge or name.rpartition(".")[0] in bridge, f"{path.name}: {name}"
