"""One tick of the rotation task: every term and metric worked out by hand, over two ticks of different motion."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_rotate import PERIOD, quat_of, truth, turned

from dexsim.physics.config import PhysicsConfig
from dexsim.tasks.rotate.config import RotateConfig, RotateReward
from dexsim.tasks.rotate.task import Rotate
from dexsim.touch.feel import Touch

WEIGHTS = RotateReward(
    goal=2.0,
    bonus=100.0,
    spin=3.0,
    action=-0.5,
    velocity=-0.1,
    torque=-0.25,
    drop=-7.0,
    bonus_speed=0.1,
    bonus_tips=0.0,
)


@pytest.fixture(scope="module")
def task(hand):
    return Rotate(RotateConfig(reward=WEIGHTS), hand)


def moment(task, **changes):
    """A hand that moves, with a cube 30 degrees on its way."""
    velocity, torque, action, force = np.zeros(12), np.zeros(12), np.zeros(12), np.zeros((5, 3))
    velocity[[2, 7]], torque[[0, 3]], action[5] = (2.0, -4.0), (0.5, -1.5), 0.75
    force[1], force[4] = (0.0, 0.08, 0.07), (0.06, 0.0, 0.07)  # 0.106 N touches, 0.092 N does not
    felt = jnp.zeros((5, 120)).at[1, 3].set(0.25)
    values = {
        "joint_velocity": velocity,
        "joint_torque": torque,
        "action": action,
        "last_action": 0.2 * action,
        "finger_force": force,
        "object_quat": turned(30),
        "object_spin": [0.6, 5.0, 5.0],
    }
    here = truth(task, **{name: np.asarray(value, np.float32) for name, value in (values | changes).items()})
    return dataclasses.replace(here, touch=Touch(felt, felt, felt))


def test_every_term_of_a_tick(task):
    goal = task.begin(jax.random.key(0), None)
    away = np.asarray(task.reference) + [0.0, 0.03, 0.04]
    first = moment(task, object_position=away)
    reward, found = task.reward(goal, first, jnp.bool_(False))
    terms = {
        "goal": 2.0
        / (math.radians(60) + WEIGHTS.epsilon)
        / (1 + math.exp(WEIGHTS.gate_steepness * (0.05 - WEIGHTS.gate))),
        "bonus": 0.0,
        "spin": 3.0 * 0.6,
        "action": -0.5 * 0.6**2,
        "velocity": -0.1 * (4 + 16),
        "torque": -0.25 * (0.25 + 2.25),
        "drop": 0.0,
    }
    known = {f"reward/{name}": value for name, value in terms.items()} | {
        "goals_per_minute": 0.0,
        "successes": 0.0,
        "paper_successes": 0.0,
        "time_at_last_success": 0.0,
        "angle_error": math.radians(60),
        "distance": 0.05,
        "pushed_out": 0.0,
        "slipped": 0.0,
        "spin": 0.6,
        "joint_speed": 6 / 12,
        "action_rate": 0.6 / 12,
        "tilt": 0.0,
        "taxel_force": 0.25,
        **{f"duty/{i}": float(i == 1) for i in range(5)},
    }
    assert set(found) == set(known)
    for name, value in known.items():
        assert float(found[name]) == pytest.approx(value, rel=2e-4, abs=1e-5), name
    assert float(reward) == pytest.approx(sum(terms.values()), rel=1e-4)


def test_the_means_are_over_the_ticks_of_the_episode(task):
    """The second tick: nothing moves, nothing touches, the cube leans by 0.3 rad and reaches its goal."""
    goal = task.update(jax.random.key(0), task.begin(jax.random.key(0), None), moment(task))
    zero = np.zeros(12)
    lean = quat_of(turn_of("y", 0.2) * turn_of("x", math.pi / 2))
    second = moment(
        task,
        joint_velocity=zero,
        action=zero,
        last_action=zero,
        finger_force=np.zeros((5, 3)),
        object_spin=[-0.2, 0, 0],
        object_quat=lean,
    )
    _, found = task.reward(goal, second, jnp.bool_(False))
    assert float(found["reward/spin"]) == pytest.approx(-0.6)
    means = {"spin": 0.2, "joint_speed": 0.25, "action_rate": 0.025, "tilt": 0.1, "duty/1": 0.5, "duty/0": 0.0}
    counts = {"successes": 1, "paper_successes": 1, "time_at_last_success": 2 * PERIOD, "goals_per_minute": 30 / PERIOD}
    for name, value in (means | counts).items():
        assert float(found[name]) == pytest.approx(value, rel=1e-3, abs=1e-5), name
    pace = 0.5 * PERIOD / 2.0 * (1 - PERIOD / 2.0)  # below `bonus_speed`: the whole bonus
    assert float(found["reward/bonus"]) == pytest.approx(100.0) and pace < 0.1


def turn_of(axis, angle):
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler(axis, angle)


@pytest.mark.parametrize(("spin", "paid"), [(0.5, 1.5), (2.0, 3.0), (-0.5, -1.5), (-9.0, -3.0)])
def test_turning_is_paid_up_to_one_radian_a_second_and_back_turns_cost(task, spin, paid):
    goal = task.begin(jax.random.key(0), None)
    _, found = task.reward(goal, moment(task, object_spin=[spin, 0, 0]), jnp.bool_(False))
    assert float(found["reward/spin"]) == pytest.approx(paid)


def test_a_touch_is_recent_for_a_fifth_of_a_second(task):
    """The drop's own tick may be the one that touches."""
    goal = task.update(jax.random.key(0), task.begin(jax.random.key(0), None), moment(task))
    quiet = moment(task, finger_force=np.zeros((5, 3)))
    assert float(goal.since_touch) == 0.0
    for tick in range(1, 12):
        _, found = task.reward(goal, quiet, jnp.bool_(True))
        recent = tick * PERIOD <= 0.2 + 1e-6
        assert (bool(found["pushed_out"]), bool(found["slipped"])) == (recent, not recent)
        goal = task.update(jax.random.key(0), goal, quiet)
    _, found = task.reward(goal, moment(task), jnp.bool_(True))
    assert bool(found["pushed_out"]) and float(found["reward/spin"]) == float(found["reward/goal"]) == 0.0
    _, found = task.reward(goal, moment(task), jnp.bool_(False))
    assert not found["pushed_out"] and not found["slipped"]


def test_clocks_pushes_and_rows(hand):
    physics = PhysicsConfig(timestep=0.005, substeps=8)  # 0.04 s
    config = RotateConfig(
        episode_seconds=2.0, evaluation_seconds=3.0, physics=physics, push_probability=1.0, push_speed=0.5
    )
    task = Rotate(config, hand)
    assert (task.episode_ticks, task.evaluation_ticks) == (50, 75)
    key = jax.random.key(3)
    change = np.linalg.norm(task.push(key, SimpleNamespace(mass=0.2))) / 0.2 * 0.04
    assert change == pytest.approx(0.5 * float(jax.random.uniform(jax.random.split(key, 3)[2])), rel=1e-5)
    rows, goals = task.evaluation_plan(5, np.zeros(9, int))
    assert rows.tolist() == [0, 2, 4, 6, 8] and goals.turns.shape == (5,) and goals.duty.shape == (5, 5)
    assert not np.any(goals.gives_up) and bool(task.begin(key, None).gives_up)
    assert task.evaluation_plan(4, np.zeros(2, int))[0].tolist() == [0, 0, 1, 1]
