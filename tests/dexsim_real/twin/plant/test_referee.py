"""The referee against scripted trials."""

import math

import numpy as np
import pytest

from dexsim_real.twin.plant import referee
from dexsim_real.twin.plant.parameters import Start
from dexsim_real.twin.plant.referee import Look, Referee
from dexsim_real.twin.plant.shapes import product, turn

X = np.array((1.0, 0.0, 0.0))
PLACE = np.array((0.047, 0.024, 0.088))  # nominal, of the object


def start(axis=X, clear=False):
    return Start(np.zeros(12), PLACE, PLACE[0 if clear else 1 :], 9.81 * X, axis=axis)


def seen(position, quat=(1.0, 0, 0, 0), spin=X * 0.0, force=0.0, limited=False, disturbed=False, height=0.01):
    force = np.broadcast_to(force, 5).astype(float)
    forces, joints = (force, 0.8 * force, 0.5 * force), (np.full(12, 0.3), np.full(12, 0.5))
    return Look(np.array(position, float), np.array(quat, float), spin, height, *forces, *joints, limited, disturbed)


def look(judge, quat, spin=X * 0.0, away=0.0, step=0.01):
    """One look at a cube that nobody touches, `away` m from its nominal position."""
    judge.watch(step, seen(PLACE + (away, 0, 0), quat, spin))


def spinning(rate, seconds, heading=0.05, step=0.01, axis=X):
    judge = Referee("rotate", start(axis))
    for k in range(round(seconds / step) + 1):
        look(judge, turn(axis, heading + rate * k * step), rate * axis)
    return judge.goals["task"], judge.goals["paper"]


def test_goals_of_a_steady_turn():
    quarter = math.pi / 2
    for goals in (1, 5):  # Goal k is reached 0.3 rad before it.
        assert spinning(1.0, goals * quarter - referee.GOAL_ANGLE + 0.02) == (goals, goals)
        assert spinning(1.0, goals * quarter - referee.GOAL_ANGLE - 0.02) == (goals - 1, goals - 1)
    assert spinning(-1.0, 1.0) == (0, 0)
    assert spinning(3.0, 10.0) == (0, 19)  # Too fast for the task, not for the paper.
    assert spinning(1.0, 5.0, axis=np.array((0.6, 0.0, -0.8))) == (3, 3)


def test_a_goal_needs_the_whole_orientation_and_the_place():
    judge, quarter = Referee("rotate", start()), turn((1, 0, 0), math.pi / 2)
    look(judge, turn((1, 0, 0), 0.0))
    look(judge, quarter, away=0.06)
    look(judge, product(turn((0, 0, 1), 0.35), quarter))
    assert judge.goals["task"] == 0
    look(judge, product(turn((0, 0, 1), 0.25), quarter), away=0.04)
    assert judge.goals["task"] == 1


def watched(task, positions, *, seconds=None, tips=0.0, quat=(1.0, 0, 0, 0), limited=0.0, push=()):
    """A trial with a look each 10 ms; `limited`: share of looks with a joint at its limit, `push`: when one acts."""
    judge = Referee(task, start(), seconds)
    for k, position in enumerate(positions):
        force, now = (part(k) if callable(part) else part for part in (tips, quat))
        judge.watch(0.01, seen(position, now, X * 0.0, force, k % 10 < 10 * limited, k in push))
    return judge


def test_drops_and_their_causes():
    away = [PLACE] * 50 + [PLACE + (0, 0, -0.071)]
    slipped = watched("rotate", away, tips=lambda k: 1.0 if k < 20 else 0.0).report()
    assert slipped["end"] == "dropped: slipped" and slipped["seconds_to_fall"] == pytest.approx(0.51)
    assert slipped["fell"]
    assert slipped["joint_speed"] == pytest.approx(0.5)
    assert slipped["before"]["object_position"] == pytest.approx(PLACE, abs=1e-4)
    assert watched("rotate", away, tips=1.0).end == "dropped: pushed out"
    assert watched("rotate", away).end == "dropped: untouched"
    assert watched("rotate", away, tips=1.0, limited=0.8).end == "dropped: at the torque limit"
    assert watched("rotate", away, tips=1.0, limited=0.2, push=range(10, 20)).end == "dropped: disturbed"
    over = lambda k: turn((0, 1, 0), 1.05 if k == 50 else 0.0)  # noqa: E731
    assert watched("rotate", [PLACE] * 51, quat=over, tips=1.0).end == "dropped: tipped"
    lean = lambda k: turn((0, 1, 0), 0.0 if k < 100 else 0.6 if k < 350 else 1.05)  # noqa: E731
    middle = lambda k: (np.arange(5) == 2) * 12.0 if k >= 100 else 1.0  # noqa: E731
    assert watched("rotate", [PLACE] * 351, quat=lean, tips=middle).end == "dropped: trapped"
    assert watched("rotate", [PLACE] * 351, quat=lean, tips=1.0).end == "dropped: tipped"
    kept = watched("rotate", [PLACE] * 300, seconds=2.0).report()
    assert kept["end"] == "time limit" and not kept["fell"] and kept["seconds"] == pytest.approx(2.0)
    assert "before" not in kept


def test_a_cube_held_clear_of_the_palm_is_lost_on_it():
    for clear, end in ((False, ""), (True, "dropped: on the palm")):
        judge = Referee("rotate", start(clear=clear))
        for height in (0.01, 0.0005):
            judge.watch(0.01, seen(PLACE, force=1.0, height=height))
        assert judge.end == end


def test_forces_of_a_grasp_are_means_from_three_seconds_on():
    judge = Referee("grasp", start())
    for k in range(801):
        force = np.array((9.0, 1.0, 2.0, 0.0, 3.0) if k >= 300 else [50.0] * 5)
        judge.watch(0.01, seen(PLACE, force=force, limited=k % 4 == 0))
    report = judge.report()
    assert report["held"] and report["force"] == pytest.approx([9.0, 1.0, 2.0, 0.0, 3.0])
    assert report["finger_force"] == pytest.approx(2.0) and report["total_force"] == pytest.approx(15.0)
    assert report["finger_normal"] == pytest.approx(1.6) and report["finger_taxels"] == pytest.approx(1.0)
    assert report["torque_limited"] == pytest.approx(0.25) and report["window_s"] == [3.0, 8.0]
    lost = watched("grasp", [PLACE + (0.121, 0, 0)]).report()
    assert not lost["held"] and lost["end"].startswith("dropped")
