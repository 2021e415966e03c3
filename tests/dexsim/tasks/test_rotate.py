"""The rotation task: goals, reward, counting, start states, report."""

import dataclasses
import functools
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from episodes import still_moment
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation
from shapes import integrate

import dexsim
from dexsim.env.task import GroundTruth
from dexsim.errors import ConfigError
from dexsim.hand.kinematics import tip_twist
from dexsim.physics.config import PhysicsConfig
from dexsim.task_spec import TurnSpec
from dexsim.tasks.rotate import start
from dexsim.tasks.rotate.config import RotateConfig, RotateReward, any_object, clear_of_palm, paper
from dexsim.tasks.rotate.report import summarize
from dexsim.tasks.rotate.start import lowest_point, sample_turned_object, solid_inertia, upright
from dexsim.tasks.rotate.task import WORKING_DUTY, Rotate
from dexsim.tasks.shared import palm_height
from dexsim.touch.taxel_force import Touch

PERIOD = RotateConfig().physics.control_period
CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T  # of a cube from -1 to 1


def quat_of(rotation: Rotation) -> np.ndarray:
    """(w, x, y, z)"""
    return np.roll(rotation.as_quat(), 1).astype(np.float32)


draw_object = jax.jit(sample_turned_object, static_argnums=1)


def turned(degrees: float, axis=(1, 0, 0)) -> np.ndarray:
    return quat_of(Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis)))


class Rules:
    """A task whose rules are compiled, and the goal of an episode that begins."""

    def __init__(self, config: RotateConfig, hand):
        self.task = Rotate(config, hand)
        self.reference = np.asarray(self.task.reference)
        self.progress, self.dropped, self.reward = map(
            jax.jit, (self.task.progress, self.task.dropped, self.task.reward)
        )
        self.update = jax.jit(lambda goal, truth: self.task.update(jax.random.key(0), goal, truth))
        self.begun = self.task.begin(jax.random.key(0), None)
        # A goal of an evaluation waits for ever.
        self.waiting = jax.tree.map(lambda x: x[0], self.task.evaluation_plan(1, np.zeros(4, int))[1])

    def truth(self, **changes) -> GroundTruth:
        """The cube at the reference, aligned and at rest, in a hand that touches nothing."""
        cube = draw_object(jax.random.key(0), RotateConfig())
        return still_moment(self.task.hand, self.task.reference, object=cube, **changes)

    def rewards(self, goal, here, dropped=False):
        """Reward and its terms and metrics."""
        return self.reward(goal, here, jnp.bool_(dropped))


@pytest.fixture(scope="module")
def rules_of(hand):
    return functools.cache(lambda config: Rules(config, hand))


@pytest.fixture(scope="module")
def rules(rules_of) -> Rules:
    return rules_of(RotateConfig())


class TestGoal:
    def test_posture_and_reference_are_the_hands_unless_given(self, hand):
        of_hand, given = Rotate(RotateConfig(), hand), Rotate(clear_of_palm(), hand)
        assert of_hand.reference == of_hand.config.reference == hand.rotate_reference == (0.047, 0.024, 0.088)
        assert of_hand.config.posture == hand.rotate_posture
        assert given.config == clear_of_palm() and given.reference == (0.072, 0.005, 0.098)
        for missing in ("rotate_posture", "rotate_reference"):
            bare = dataclasses.replace(hand, name="bare", **{missing: ()})
            with pytest.raises(ConfigError, match=r"'bare' has no rotate: .*\[rotate\] with posture and reference$"):
                Rotate(RotateConfig(), bare)
        with pytest.raises(ConfigError, match="12 posture angles, the hand has 6"):
            dexsim.make("rotate_clear", hand=dexsim.load_hand("inspire_like"), backend="c")
        with pytest.raises(ConfigError, match="expected 3 numbers"):
            RotateConfig(reference=(0.0, 0.0))

    def test_within_0_3_rad_is_reached_but_not_too_far_off_too_fast_or_tilted(self, rules):
        def reached(**changes):
            here = rules.truth(**{"object_quat": turned(90)} | changes)
            return bool(rules.progress(rules.begun, here).success)

        for angle, inside in ((72.5, False), (73.5, True), (106.5, True), (107.5, False)):
            assert reached(object_quat=turned(angle)) == inside
        assert reached(object_position=rules.reference + [0, 0.049, 0])
        assert not reached(object_position=rules.reference + [0, 0.051, 0])
        assert reached(object_spin=[1.9, 5, 5])
        assert not reached(object_spin=[2.1, 0, 0])
        assert not reached(object_spin=[-2.1, 0, 0])
        tilted = Rotation.from_euler("y", 20, degrees=True) * Rotation.from_euler("x", 90, degrees=True)
        assert not reached(object_quat=quat_of(tilted))

    def test_counts_over_an_episode(self, rules):
        """A whip through the window counts for the paper; only a calm one moves the goal on."""
        goal, turns, entries = rules.begun, [], []
        for degrees, spin in ((45, 1), (90, 4), (150, 4), (90, 0.5), (100, 0.5), (180, 1), (270, 1), (0, 1)):
            goal = rules.update(goal, rules.truth(object_quat=turned(degrees), object_spin=[float(spin), 0.0, 0.0]))
            turns.append(int(goal.turns))
            entries.append(int(goal.entries))
        assert turns == [0, 0, 0, 1, 1, 2, 3, 4]
        assert entries == [0, 1, 1, 1, 1, 2, 3, 4]
        np.testing.assert_allclose(goal.last_success, 8 * PERIOD, rtol=1e-5)
        np.testing.assert_allclose(goal.totals["spin"], 1 + 4 + 4 + 0.5 + 0.5 + 1 + 1 + 1, rtol=1e-5)

    def test_an_episode_turns_about_the_axis_it_drew_and_evaluations_take_them_in_turn(self, rules_of):
        axes = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.5, 0.0))
        rules = rules_of(RotateConfig(turn=TurnSpec(spin=2.0, axes=axes)))
        drawn = jax.vmap(lambda key: rules.task.begin(key, None))(jax.random.split(jax.random.key(0), 200))
        found, counts = np.unique(drawn.axis, axis=0, return_counts=True)
        assert found.tolist() == [[-1, 0, 0], [0, 1, 0], [1, 0, 0]] and counts.min() > 40
        plan = rules.task.evaluation_plan(6, np.zeros(6, int))[1]
        assert plan.axis.tolist() == 2 * [[1, 0, 0], [-1, 0, 0], [0, 1, 0]]
        for number, (way, sign) in enumerate((("x", 1), ("x", -1), ("y", 1))):
            goal = jax.tree.map(lambda leaf, number=number: leaf[number], plan)
            quat, spin = (
                quat_of(Rotation.from_euler(way, 90 * sign, degrees=True)),
                sign * (np.array(["x", "y", "z"]) == way),
            )
            here = rules.truth(object_quat=quat, object_spin=spin.astype(float))
            now, (_, metrics) = rules.progress(goal, here), rules.rewards(goal, here)
            assert now.success and now.spin == 1 and metrics["axis"] == number and metrics["tilt"] < 1e-3
            np.testing.assert_array_equal(rules.update(goal, here).axis, goal.axis)


@pytest.mark.parametrize(("tilt", "roll"), [(0.0, 0.0), (-0.3, -0.2), (0.4, 0.3)])
def test_gravity_in_a_hand_that_is_pitched_and_rolled(hand, tilt, roll):
    """The roll turns the palm-up hand about the axis along its fingers, then the tilt about the one across them."""
    mount = Rotation.from_euler("y", -tilt) * Rotation.from_euler("z", -roll)
    found = np.array(Rotate(RotateConfig(tilt=tilt, roll=roll), hand).gravity)
    np.testing.assert_allclose(found, mount.apply([-9.81, 0.0, 0.0]), atol=1e-6)


class TestReward:
    def test_the_papers_reward_is_its_three_terms(self, rules_of):
        assert paper().control.last_action_encoding == "action"
        rules, action = rules_of(paper()), np.linspace(-1, 1, 12)
        for degrees, earned in ((45, 1 / (math.pi / 4 + 0.1)), (90, 250 + 1 / 0.1)):
            busy = moment(rules, action=action, object_spin=[9.0, 0, 0], object_quat=turned(degrees))
            reward, _ = rules.rewards(rules.begun, busy)
            np.testing.assert_allclose(reward, earned - 0.0002 * np.sum(action**2), rtol=1e-4)

    def test_fingertips_at_work_earn_the_rest_of_the_bonus(self, rules):
        tips = RotateReward().bonus_tips
        half = 0.5 * WORKING_DUTY / (1 - PERIOD / 2.0)  # less this tick, in which nothing touches
        here = rules.truth(object_quat=turned(270))
        for last, share in ((0, 1 - tips), (half, 1 - tips / 2), (1, 1.0)):
            duty = jnp.array([1, 1, 0, 0, last], jnp.float32)
            goal = dataclasses.replace(rules.begun, duty=duty, turns=jnp.int32(2))
            _, metrics = rules.rewards(goal, here)
            np.testing.assert_allclose(metrics["reward/bonus"], 250 * share, rtol=1e-5)
        _, metrics = rules.rewards(rules.begun, rules.truth(object_quat=turned(90)))
        np.testing.assert_allclose(metrics["reward/bonus"], 250)  # of the first goal nothing is asked
        assert 0 < tips < 1

    def test_a_gait_too_fast_earns_less(self, rules):
        limit, here = RotateReward().bonus_speed, rules.truth(object_quat=turned(90))
        for pace, share in ((0.5 * limit, 1.0), (limit, 1.0), (2 * limit, 0.25), (3 * limit, 1 / 9)):
            # Of this tick's own speed: none.
            pace = jnp.float32(pace / (1 - PERIOD / 2.0))
            _, metrics = rules.rewards(dataclasses.replace(rules.begun, duty=jnp.ones(5), pace=pace), here)
            np.testing.assert_allclose(metrics["reward/bonus"], 250 * share, rtol=1e-4)

    def test_the_trap_costs_by_tilt_and_by_how_far_ahead(self, rules_of):
        rules = rules_of(RotateConfig(trap=0.5))
        for tilt, ahead, cost in ((0.0, -0.02, 0.0), (0.6, 0.0, 1.0), (0.0, 0.022, 1.0), (0.3, 0.044, 4.25)):
            place, lean = rules.reference + [0, 0, ahead], quat_of(Rotation.from_euler("y", tilt))
            _, metrics = rules.rewards(rules.begun, rules.truth(object_quat=lean, object_position=place))
            assert float(metrics["reward/trap"]) == pytest.approx(-cost, abs=1e-4)


# --- one tick: every term and metric worked out by hand ------------------------------------------------

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
def weighted(rules_of) -> Rules:
    return rules_of(RotateConfig(reward=WEIGHTS))


def moment(rules, **changes):
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
    here = rules.truth(**{name: np.asarray(value, np.float32) for name, value in (values | changes).items()})
    return dataclasses.replace(here, touch=Touch(felt, felt, felt))


def test_every_term_of_a_tick(weighted):
    first = moment(weighted, object_position=weighted.reference + [0.0, 0.03, 0.04])
    reward, found = weighted.rewards(weighted.begun, first)
    terms = {
        "goal": 2.0 / (math.radians(60) + 0.1) / (1 + math.exp(400 * (0.05 - WEIGHTS.gate))),
        "bonus": 0.0,
        "spin": 3.0 * 0.6,
        "action": -0.5 * 0.6**2,
        "velocity": -0.1 * (4 + 16),
        "torque": -0.25 * (0.25 + 2.25),
        "drop": 0.0,
        "trap": -((0.04 / 0.022) ** 2),
    }
    known = {f"reward/{name}": value for name, value in terms.items()} | {
        "goals_per_minute": 0.0,
        "successes": 0.0,
        "paper_successes": 0.0,
        "time_at_last_success": 0.0,
        "angle_error": math.radians(60),
        "distance": 0.05,
        "axis": 0.0,
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
    _, fast = weighted.rewards(weighted.begun, moment(weighted, object_spin=[-4.0, 0.0, 0.0]))
    assert float(fast["reward/spin"]) == -3.0, "no more than 1 rad/s counts"


def test_the_means_are_over_the_ticks_of_the_episode(weighted):
    """The second tick: nothing moves, nothing touches, the cube leans by 0.3 rad and reaches its goal."""
    goal = weighted.update(weighted.begun, moment(weighted))
    zero = np.zeros(12)
    lean = quat_of(Rotation.from_euler("y", 0.2) * Rotation.from_euler("x", math.pi / 2))
    second = moment(
        weighted,
        joint_velocity=zero,
        action=zero,
        last_action=zero,
        finger_force=np.zeros((5, 3)),
        object_spin=[-0.2, 0, 0],
        object_quat=lean,
    )
    _, found = weighted.rewards(goal, second)
    assert float(found["reward/spin"]) == pytest.approx(-0.6)
    means = {"spin": 0.2, "joint_speed": 0.25, "action_rate": 0.025, "tilt": 0.1, "duty/1": 0.5, "duty/0": 0.0}
    counts = {"successes": 1, "paper_successes": 1, "time_at_last_success": 2 * PERIOD, "goals_per_minute": 30 / PERIOD}
    for name, value in (means | counts).items():
        assert float(found[name]) == pytest.approx(value, rel=1e-3, abs=1e-5), name
    pace = 0.5 * PERIOD / 2.0 * (1 - PERIOD / 2.0)  # below `bonus_speed`: the whole bonus
    assert float(found["reward/bonus"]) == pytest.approx(100.0) and pace < 0.1


def test_a_touch_is_recent_for_a_fifth_of_a_second(weighted):
    """The drop's own tick may be the one that touches."""
    goal = weighted.update(weighted.begun, moment(weighted))
    quiet = moment(weighted, finger_force=np.zeros((5, 3)))
    assert float(goal.since_touch) == 0.0
    for tick in range(1, 12):
        _, found = weighted.rewards(goal, quiet, dropped=True)
        recent = tick * PERIOD <= 0.2 + 1e-6
        assert (bool(found["pushed_out"]), bool(found["slipped"])) == (recent, not recent)
        goal = weighted.update(goal, quiet)
    _, found = weighted.rewards(goal, moment(weighted), dropped=True)
    assert bool(found["pushed_out"]) and float(found["reward/spin"]) == float(found["reward/goal"]) == 0.0
    _, found = weighted.rewards(goal, moment(weighted))
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
    two_pools = Rotate(RotateConfig(pool_size=8, trap=0.25), hand).evaluation_plan(12, np.zeros(16, int))[0]
    assert len(Rotate(RotateConfig(pool_size=8, trap=1.0), hand).evaluation_plan(4, np.zeros(8, int))[0]) == 4
    assert two_pools.tolist() == [*range(6), *range(8, 14)], "none of the trap"


class TestDrop:
    def test_tipped_over(self, rules):
        for degrees, lost in ((55, False), (59, True), (180, True)):
            tipped = Rotation.from_euler("y", degrees, degrees=True) * Rotation.from_euler("x", 1.0)
            here = rules.truth(object_quat=quat_of(tipped))
            np.testing.assert_allclose(rules.task._tilt(rules.begun, here), math.radians(degrees), atol=1e-3)
            assert bool(rules.dropped(rules.begun, here)) == lost
        assert not bool(rules.dropped(rules.begun, rules.truth(object_quat=turned(170))))

    def test_patience_ends_training_episodes_only(self, rules_of):
        rules = rules_of(RotateConfig(patience=5 * PERIOD))
        for goal, gives_up in ((rules.begun, True), (rules.waiting, False)):
            lost = []
            for tick in range(9):
                here = rules.truth(object_quat=turned(90 if tick == 2 else 30))
                goal = rules.update(goal, here)
                lost.append(bool(rules.dropped(goal, here)))
            # The goal of tick 2 starts the clock anew; the sixth tick after it is one too many.
            assert lost == [False] * 8 + [gives_up]

    def test_too_far_away_training_on_a_leash(self, rules, rules_of):
        free = rules_of(RotateConfig(drop_radius=1.0))
        for of, goal, limit in ((rules, rules.begun, 0.055), (rules, rules.waiting, 0.07), (free, free.begun, 0.07)):
            for distance, lost in ((limit - 0.001, False), (limit + 0.001, True)):
                here = of.truth(object_position=of.reference + [0, 0, distance])
                assert bool(of.dropped(goal, here)) == lost

    @pytest.mark.parametrize("turn", [(0, 0, 0), (0.5, 0.4, 0), (-0.3, 0.2, 0.6)])
    def test_on_the_palm_is_dropped_when_held_by_fingers(self, hand, rules_of, turn):
        """By its lowest corner."""
        rules, rotation = rules_of(RotateConfig(support="fingers")), Rotation.from_rotvec(turn)
        reach = float(rules.truth().object.size[0, 0]) * np.max(rotation.apply(CORNERS)[:, 0])
        for gap, lost in ((0.0005, True), (0.0015, False)):
            place = rules.reference * [0, 1, 1] + [palm_height(hand) + reach + gap, 0, 0]
            here = rules.truth(object_position=place, object_quat=quat_of(rotation))
            assert bool(rules.dropped(rules.begun, here)) == lost


def test_boxes_and_cylinders_have_the_inertia_that_mujoco_computes():
    config, kinds = any_object(), set()
    draw = jax.jit(lambda key: (object := sample_turned_object(key, config), solid_inertia(object)))
    for seed in range(12):
        object, inertia = draw(jax.random.key(seed))
        slot = int(np.argmax(object.active))
        kinds.add(kind := object.kinds[slot])
        mass, _, expected = integrate(object)
        np.testing.assert_allclose(np.diag(inertia), expected / mass, atol=1e-8)
        assert np.sum(object.active) == 1
        assert 0.9 * 0.0225 <= np.min(object.size[slot][:2]) <= np.max(object.size[slot][:2]) <= 1.1 * 0.0325
        height = lowest_point(object, np.array([1.0, 0, 0, 0]), np.zeros(3))
        np.testing.assert_allclose(-height, object.size[slot][0 if kind == "box" else 1], rtol=1e-5)
    assert kinds == {"box", "cylinder"}
    with pytest.raises(ConfigError, match="expected box or cylinder"):
        dataclasses.replace(config, objects=dataclasses.replace(config.objects, shapes=("sphere",)))
    with pytest.raises(ConfigError, match="palm's normal"):
        dataclasses.replace(clear_of_palm(), proportions=(0.9, 1.1))


class TestPool:
    def test_start_states_rest_where_they_should(self, hand, monkeypatch, tmp_path):
        monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))
        config = RotateConfig(pool_size=24)
        task = Rotate(config, hand)
        pool = task.make_pool(jax.random.key(0))
        assert pool.qpos.shape == (24, 19) and np.all(pool.qvel == 0)
        half = pool.object.size[:, 0, 0]
        turns = Rotation.from_quat(np.roll(pool.qpos[:, 15:19], -1, axis=1)).as_matrix()
        lowest = np.min((CORNERS @ turns.transpose(0, 2, 1))[..., 0], axis=1) * half
        gap = pool.qpos[:, 12] + lowest - palm_height(hand)
        # On the palm, which gives way where a finger presses from above.
        assert np.all(gap < 0.003) and np.all(gap > -0.006) and np.mean(np.abs(gap) < 0.001) > 0.6
        assert np.ptp(pool.object.friction) > 0.3
        # All but the last quarter stand level, turned either way and near the reference; those are stuck in the trap.
        place, free = pool.qpos[:, 12:15] - task.reference, np.arange(24) < 18
        pitch, heading = np.arctan2(-turns[:, 2, 0], turns[:, 0, 0]), np.arctan2(turns[:, 2, 1], turns[:, 1, 1])
        assert np.all(turns[free, 0, 0] > np.cos(0.35)) and np.abs(heading[free]).max() <= 0.75
        assert heading[free].min() < -0.4 and heading[free].max() > 0.4
        assert np.all(np.linalg.norm(place[free], axis=1) < 0.6 * config.turn.distance)
        assert np.all((pitch[~free] > 0.35) & (pitch[~free] < 0.9) & (place[~free, 2] > 0.017))
        assert np.all(np.linalg.norm(place[~free], axis=1) < config.drop_radius)
        # Each size has its share, though large cubes fit between the fingers in far fewer postures.
        assert np.all(np.histogram(2 * half, 3, config.edge)[0] > 4)
        monkeypatch.setattr(start, "_make", None)  # It is in the cache.
        jax.tree.map(np.testing.assert_array_equal, pool, task.make_pool(jax.random.key(0)))

    @pytest.mark.parametrize("axis", [(0.6, 0.0, -0.8), (0.0, 0.5, 0.0), (-1.0, 0.0, 0.0), (0.3, -0.5, 0.4)])
    def test_a_cube_stands_on_any_axis(self, axis):
        quat = upright(TurnSpec(axis=axis).unit_axis)
        np.testing.assert_allclose(
            Rotation.from_quat(np.roll(quat, -1)).apply([1.0, 0, 0]), np.asarray(axis) / np.linalg.norm(axis), atol=1e-6
        )
        assert upright(TurnSpec(axis=(0.5, 0.0, 0.0)).unit_axis) is None

    def test_a_cube_for_a_tilted_axis_stands_on_it_from_the_start(self):
        config = clear_of_palm()
        np.testing.assert_allclose(draw_object(jax.random.key(0), config).quat, [upright(config.turn.unit_axis)])
        assert draw_object(jax.random.key(0), RotateConfig()).quat is None

    def test_objects_settle_with_their_own_properties_and_what_diverges_is_no_start(self, hand, monkeypatch):
        monkeypatch.setattr(start, "_stays", lambda config, place, *_: np.ones(len(place), bool))
        task, rows = Rotate(any_object(), hand), np.array([0, 2, 5, 6])
        config, scene = task.config, start._scene(hand, task.config, task.gravity)
        draw = jax.jit(jax.vmap(lambda key: start._candidate(key, sample_turned_object(key, config), hand, config)))
        candidates = jax.device_get(draw(jax.random.split(jax.random.key(1), 8)))
        candidates["qpos"] = np.where(np.arange(8)[:, None] == 5, np.nan, candidates["qpos"])
        batch = Batch(scene.model, 8, 1)
        assert start._settle(batch, scene, config, candidates, rows, False)[0].tolist() == [0, 2, 6]
        object, body, pairs, model = candidates["object"], scene.object_body, scene.object_pairs, scene.model
        for name, at, value in (
            ("geom_size", scene.object_geoms, object.size),
            ("geom_quat", scene.object_geoms, object.quat),
            ("body_mass", body, object.mass),
            ("body_inertia", body, object.inertia),
            ("body_ipos", body, object.com),
        ):
            np.testing.assert_allclose(batch.expand(name)[rows][:, at], value[rows], rtol=1e-5, err_msg=name)
        ends = model.geom_bodyid[np.stack([model.pair_geom1[pairs], model.pair_geom2[pairs]])]
        tips = np.isin(ends, scene.tip_bodies).any(0)
        slide = np.where(tips, object.friction[:, None], object.link_friction[:, None])
        np.testing.assert_allclose(batch.expand("pair_friction")[rows][:, pairs, 0], slide[rows], rtol=1e-5)

    def test_candidates_lie_on_the_palm_or_tipped_under_the_middle_finger(self, hand):
        config, floor = Rotate(RotateConfig(), hand).config, palm_height(hand) + 0.001
        for key in jax.random.split(jax.random.key(2), 4):
            drawn = key, sample_turned_object(key, config), hand, config
            free, trap = jax.device_get([f(*drawn) for f in (start._candidate, start._trap_candidate)])
            assert lowest_point(drawn[1], free["qpos"][15:], free["qpos"][12:15]) == pytest.approx(floor, abs=1e-5)
            assert np.abs(free["qpos"][13:15] - config.reference[1:] - config.start_offset).max() <= 0.010
            assert np.flatnonzero(trap["joint_target"] - trap["qpos"][:12] > 0.05).tolist() == [6, 7]
            told = dataclasses.replace(config, turn=TurnSpec(axes=((0.0, -1.0, 0.0),)))  # the same draw, half as far
            quat = start._candidate(key, drawn[1], hand, told)["qpos"][15:]
            assert np.arctan2(quat[1], quat[0]) == pytest.approx(np.arctan2(*free["qpos"][[16, 15]]) / 2, abs=1e-5)

    def test_at_rest_is_neither_moving_nor_turning_where_it_belongs(self, hand):
        config = Rotate(RotateConfig(), hand).config
        place, motion = np.tile([*config.reference, 1.0, 0.0, 0.0, 0.0], (5, 1)), np.zeros((5, 6))
        motion[1, 0], motion[2, 4], place[3, 1], place[4, 3:] = 0.06, 1.1, place[3, 1] + 0.05, turned(25, (0, 1, 0))
        assert start._stays(config, place, motion, False).tolist() == [True, False, False, False, False]
        place[:, 2], place[:3, 3:] = place[:, 2] + 0.02, place[4, 3:]  # further toward the fingertips, tipped
        assert start._stays(config, place, motion, True).tolist() == [True, False, False, False, True]

    def test_objects_that_fingers_hold_begin_clear_of_the_palm(self, hand):
        cube = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), draw_object(jax.random.key(0), RotateConfig()))
        qpos = np.zeros((3, 19), np.float32)
        qpos[:, 15], qpos[:, 12] = 1.0, palm_height(hand) + cube.size[:, 0, 0] + np.array([0.0005, 0.0015, 0.02])
        rows = np.arange(3)
        for support, clear in (("fingers", [1, 2]), ("palm", [0, 1, 2])):
            assert start._clear_of_palm(hand, RotateConfig(support=support), cube, rows, qpos).tolist() == clear

    def test_another_start_is_another_pool(self, hand):
        key, config = jax.random.key(0), RotateConfig()
        changes = (
            *({"posture": (0.1,) * 12}, {"turn": TurnSpec(axis=(0.0, 1.0, 0.0))}, {"turn": TurnSpec(distance=0.02)}),
            {"turn": TurnSpec(axes=((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)))},
            *({"edge": (0.05, 0.055)}, {"support": "fingers"}, {"tilt": 0.1}, {"trap": 0.2}),
            *({"squeeze": (0.0, 0.1)}, {"pool_size": 64}),
        )
        names = {start._fingerprint(key, hand, RotateConfig(**change)) for change in ({}, *changes)}
        names.add(start._fingerprint(key, dataclasses.replace(hand, digest="another"), config))
        assert len(names) == len(changes) + 2
        same = dataclasses.replace(config, reward=RotateReward(bonus=1.0), episode_seconds=5.0)
        assert start._fingerprint(key, hand, same) in names


def test_fingertip_twist_is_c_mujocos(hand):
    rng, model = np.random.default_rng(0), mujoco.MjModel.from_xml_path(str(hand.model_path))
    joints, speed = np.float32(rng.uniform(0, 1, 12)), np.float32(rng.normal(size=12))
    data, places = mujoco.MjData(model), [model.joint(name) for name in hand.joint_names]
    data.qpos[[joint.qposadr[0] for joint in places]] = joints
    data.qvel[[joint.dofadr[0] for joint in places]] = speed
    mujoco.mj_forward(model, data)
    for finger, twist in enumerate(jax.jit(lambda q, v: tip_twist(hand, q, v))(joints, speed)):
        (site,) = np.flatnonzero(model.site_bodyid == model.body(hand.body_names[hand.tip_body[finger]]).id)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
        np.testing.assert_allclose(twist, np.roll(velocity, 3), atol=1e-5)


def test_hand_computed():
    n = 4
    zero = np.zeros(n)
    metrics = {
        "successes": np.array([0.0, 10, 20, 30]),
        "paper_successes": np.array([1.0, 11, 20, 30]),
        "time_at_last_success": np.array([0.0, 20, 30, 60]),
        "spin": np.full(n, np.pi),
        "joint_speed": np.full(n, 0.5),
        "action_rate": zero,
        "tilt": zero,
        "axis": np.array([0.0, 1, 0, 1]),
        "pushed_out": np.array([1.0, 0, 0, 0]),
        "slipped": np.array([0.0, 1, 0, 0]),
        "non_finite": zero,
        "duty/0": np.full(n, 0.2),
        "duty/1": zero,
        "duty/2": np.full(n, 0.05),
    }
    report = summarize(metrics, np.array([100, 1000, 4000, 4000]), 0.03, 4000)
    assert report["successes"]["mean"]["mean"] == 15
    assert report["successes"]["median"]["median"] == 15
    assert report["successes"]["sorted"] == [0, 10, 20, 30]
    assert report["without_success"]["mean"] == 0.25
    assert report["seconds_per_success"]["mean"] == pytest.approx((2 + 1.5 + 2) / 3)
    # 60 goals in 3 + 30 + 120 + 120 s, those after the last goal included.
    assert report["successes_per_minute"]["mean"] == pytest.approx(60 / (273 / 60))
    assert report["headline"]["successes per minute, time stuck included"]["value"] == pytest.approx(3600 / 273)
    assert report["seconds_to_fall"]["mean"] == pytest.approx((3 + 30 + 120 + 120) / 4)
    assert report["end"] == {"pushed_out": 1, "slipped": 1, "timeout": 2}
    assert report["rotations_per_minute"]["mean"] == pytest.approx(30)
    assert report["gait"]["fingertip_duty"] == pytest.approx([0.2, 0, 0.05])
    assert report["headline"]["fingertips at work (duty over 10 %)"] == 1
    assert [axis["successes"]["mean"]["mean"] for axis in report["axes"]] == [10, 20]
    assert [axis["kept_to_the_end"]["mean"] for axis in report["axes"]] == [0.5, 0.5]


def test_start_states_rest_on_the_rubber_of_the_skin(hand):
    configs = RotateConfig(), RotateConfig(skin=dataclasses.replace(RotateConfig().skin, margin=0.001))
    assert not np.array_equal(*(start._scene(hand, config, (9.81, 0.0, 0.0)).model.geom_size for config in configs))
