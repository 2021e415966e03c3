"""Parameters of the emulated hand against training's ranges."""

import dataclasses
import functools
import operator

import jax
import numpy as np
import pytest
from episodes import POOL_SIZE

from dexsim.core.config import to_dict
from dexsim.hand.load import load_hand
from dexsim.registry import TASKS as TRAINED
from dexsim.tasks.rotate.start import CLEARANCE
from dexsim_ppo.policy import load_policy
from dexsim_real.twin.plant import parameters, referee
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.parameters import BANDS, FAR, KINDS, NEAR, TASK_BANDS, sample_trial, skill_of, start_of

SKILLS = ("grasp", "rotate", "rotate_clear")  # rotate_any shares all but its objects and its mount with rotate


def bands(task):
    return BANDS | TASK_BANDS[task]


@pytest.mark.parametrize("task", SKILLS)
def test_bands_rules_and_places_repeat_those_of_the_tasks_and_of_the_shipped_policies(hand, task):
    shipped = load_policy(task).env_config
    for config in (to_dict(TRAINED[task].config()), shipped):
        for name, band in bands(task).items():
            if not band.origin or band.sides == "within":  # the emulated hand's own
                continue
            trained = functools.reduce(operator.getitem, band.origin.split("."), config)
            low, high = trained if isinstance(trained, (tuple, list)) else (np.sign(band.low) * trained, trained)
            wider = ("latency", "mass", "edge") if config is shipped else ("latency",)  # later hands, other cubes
            inside = task == "rotate" and name in wider and low <= band.low < band.high < high
            assert inside or (band.low, band.high) == pytest.approx((low, high)), name
        skill = skill_of(task)
        assert parameters.PUSHES[skill][1] == config["push_speed"]
        assert parameters.PUSHES[skill][0] == pytest.approx(
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
        told = EmulatedHand(load_hand("xhand_left"), task, axis=(0.0, -1.0, 0.0)).start
        assert task == "rotate_clear" or told.axis.tolist() == [0, 1, 0] and told.upright.tolist() == [1, 0, 0]
        assert start.axis == pytest.approx(rules.turn.unit_axis) and referee.ON_PALM == CLEARANCE
        turn = rules.config.turn
        ours = (start.turn, referee.GOAL_ANGLE, referee.GOAL_DISTANCE, referee.GOAL_SPIN, referee.TIPPED)
        assert ours == pytest.approx((turn.step, turn.angle, turn.distance, turn.spin, rules.config.drop_tilt))


@pytest.mark.parametrize("task", ("rotate", "rotate_clear"))
def test_a_cube_is_put_in_the_middle_of_trainings_starts(hand, task):
    entry = TRAINED[task]
    rules = entry.task(dataclasses.replace(entry.config(), pool_size=POOL_SIZE), hand)
    starts, place = rules.make_pool(jax.random.key(0)).qpos[:, 12:15], start_of(hand, task).place
    assert np.all(np.abs(starts.mean(0)[-len(place) :] - place) < 0.6 * starts.std(0)[-len(place) :])


@pytest.mark.parametrize("task", SKILLS)
def test_values_are_where_their_kind_says(task):
    """Outside: beyond every possible end of training's range and near it. Fingertips and friction follow nothing of
    training: their values fill ranges of the emulated hand's own."""
    seeds = [np.random.default_rng(seed) for seed in range(100)]
    drawn = {kind: [sample_trial(task, rng, kind).value for rng in seeds] for kind in KINDS}
    own = {name for name, band in bands(task).items() if band.sides == "within"}
    assert own - {"reaction"} == {"rubber", "friction", "link_friction"}
    for name, band in bands(task).items():
        outside, inside, nominal = (np.array([value[name] for value in drawn[kind]]) for kind in KINDS)
        width = band.high - band.low
        assert np.all((inside >= band.low) & (inside <= band.high)) and np.all(nominal == band.nominal), name
        beyond = np.maximum(band.low - outside, outside - band.high)
        if name in own:
            assert np.all(beyond <= 0) and np.ptp(outside) > 0.9 * width, name
        else:
            assert np.all((beyond >= (NEAR - 1e-9) * width) & (beyond <= (FAR + 1e-9) * width)), name
            ends = {"both": {True, False}, "high": {True}, "low": {False}}[band.sides]
            assert set((outside > band.high).ravel().tolist()) == ends, name
