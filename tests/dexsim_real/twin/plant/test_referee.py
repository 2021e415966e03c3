"""The referee against scripted trials."""

import math

import numpy as np
import pytest

from dexsim_real.twin.plant import referee
from dexsim_real.twin.plant.assistant import REFERENCES
from dexsim_real.twin.plant.referee import Referee
from dexsim_real.twin.plant.shapes import product, turn


def look(judge, quat, spin=0.0, away=0.0, step=0.01):
    """One look at a cube that nobody touches, `away` m from its nominal position."""
    position, forces = np.array(REFERENCES["rotate"]) + (away, 0, 0), dict.fromkeys(("force", "normal"), np.zeros(5))
    judge.watch(step, position, quat, np.array([spin, 0, 0]), forces, np.zeros(12), np.zeros(12, bool))


def spinning(rate, seconds, heading=0.05, step=0.01):
    judge = Referee("rotate")
    for k in range(round(seconds / step) + 1):
        look(judge, turn((1, 0, 0), heading + rate * k * step), rate)
    return judge.goals["task"], judge.goals["paper"]


def test_goals_of_a_steady_turn():
    quarter = math.pi / 2
    for goals in (1, 5, 12):  # Goal k is reached 0.3 rad before it.
        assert spinning(1.0, goals * quarter - referee.GOAL_ANGLE + 0.02) == (goals, goals)
        assert spinning(1.0, goals * quarter - referee.GOAL_ANGLE - 0.02) == (goals - 1, goals - 1)
    assert spinning(-1.0, 1.0) == (0, 0)
    assert spinning(3.0, 10.0) == (0, 19)  # Too fast for the task, not for the paper.


def test_a_goal_needs_the_whole_orientation_and_the_place():
    judge, quarter = Referee("rotate"), turn((1, 0, 0), math.pi / 2)
    look(judge, turn((1, 0, 0), 0.0))
    look(judge, quarter, away=0.06)
    look(judge, product(turn((0, 0, 1), 0.35), quarter))
    assert judge.goals["task"] == 0
    look(judge, product(turn((0, 0, 1), 0.25), quarter), away=0.04)
    assert judge.goals["task"] == 1


def watched(task, positions, *, seconds=None, tips=0.0, quat=(1.0, 0, 0, 0)):
    judge = Referee(task, seconds)
    for k, position in enumerate(positions):
        force = np.full(5, tips(k) if callable(tips) else tips)
        forces = {"force": force, "normal": force, "taxels": force}
        quat, still = np.asarray(quat, float), np.zeros(3)
        judge.watch(0.01, np.asarray(position), quat, still, forces, np.full(12, 0.5), np.zeros(12, bool))
    return judge


def test_drops_and_their_causes():
    place = np.array(REFERENCES["rotate"])
    away = [place] * 50 + [place + (0, 0, -0.071)]
    slipped = watched("rotate", away, tips=lambda k: 1.0 if k < 20 else 0.0).report()
    assert slipped["end"] == "dropped: slipped" and slipped["seconds_to_fall"] == pytest.approx(0.51)
    assert slipped["fell"] and slipped["duty"] == pytest.approx([0.2 / 0.51] * 5, abs=1e-3)
    assert slipped["joint_speed"] == pytest.approx(0.5)
    assert watched("rotate", away, tips=1.0).end == "dropped: pushed out"
    assert watched("rotate", [place], quat=turn((0, 1, 0), 1.05)).end == "dropped: tipped"
    kept = watched("rotate", [place] * 300, seconds=2.0).report()
    assert kept["end"] == "time limit" and not kept["fell"] and kept["seconds"] == pytest.approx(2.0)


def test_forces_of_a_grasp_are_means_from_three_seconds_on():
    place = np.array(REFERENCES["grasp"])
    judge = Referee("grasp")
    for k in range(801):
        force = np.array((9.0, 1.0, 2.0, 0.0, 3.0) if k >= 300 else [50.0] * 5)
        forces = {"force": force, "normal": 0.8 * force, "taxels": 0.5 * force}
        limited = np.arange(12) == (3 if k % 4 == 0 else -1)
        judge.watch(0.01, place, np.array([1.0, 0, 0, 0]), np.zeros(3), forces, np.zeros(12), limited)
    report = judge.report()
    assert report["held"] and report["force"] == pytest.approx([9.0, 1.0, 2.0, 0.0, 3.0])
    assert report["finger_force"] == pytest.approx(2.0) and report["total_force"] == pytest.approx(15.0)
    assert report["finger_normal"] == pytest.approx(1.6) and report["finger_taxels"] == pytest.approx(1.0)
    assert report["torque_limited"] == pytest.approx(0.25) and report["window_s"] == [3.0, 8.0]
    lost = watched("grasp", [place + (0.121, 0, 0)]).report()
    assert not lost["held"] and lost["end"].startswith("dropped")
