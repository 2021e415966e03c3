"""From measurements to targets as in the simulation; silent sensors of the object; goals of the rotation task."""

import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from episodes import still_moment
from test_safety import CYCLE, MIDDLE, Bench

from dexsim.env.sensors import SensorSuite
from dexsim.errors import ConfigError
from dexsim.hand.load import load_hand
from dexsim.observation import layout
from dexsim.task_spec import TaskSpec, TurnSpec
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp
from dexsim.tasks.rotate.config import RotateConfig
from dexsim.tasks.rotate.task import Rotate, goal_quat
from dexsim_real.control.controller import Controller, PolicyLoop, Tick, TurnGoals
from dexsim_real.control.safety import Reaction
from dexsim_real.sensors.camera import ObjectEstimate, ObjectSensors
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.sensors.imu import IDENTITY, ImuReader, encode
from dexsim_real.wire import frames

NOWHERE = ObjectEstimate(np.zeros(3), np.zeros(3), IDENTITY)


class Acts:
    """What the controller needs of a policy, with a function in place of the network."""

    def __init__(self, task, hand, act):
        config = task.config
        self.function, self.task, self.spec = act, task.name, TaskSpec.of(task)
        self.control_rate = 1 / config.physics.control_period
        self.observation_layout = layout(hand, task.fields["actor"], config.observation)

    def initial_carry(self):
        return np.zeros(1, np.float32)

    def act(self, carry, observation):
        self.carry = carry
        return carry + 1, self.function(observation)


def random_state(rng, hand):
    """A state block with every number different and few taxels pressed."""
    block = frames.empty_state()
    block["joint"]["position"] = rng.uniform(hand.joint_lower, hand.joint_upper)
    block["joint"]["current"] = rng.integers(-900, 900, 12)
    block["tip"]["taxel"]["z"] = rng.integers(0, 60, (5, 120)) * (rng.random((5, 120)) < 0.1)
    return block


@pytest.mark.parametrize(("task_class", "config"), [(Grasp, GraspConfig()), (Rotate, RotateConfig())])
def test_one_frame_gives_the_same_observation_through_both_doors_bit_for_bit(hand, task_class, config):
    rng = np.random.default_rng(4)
    task = task_class(config, hand)
    controller = Controller(Acts(task, hand, lambda observation: rng.uniform(-1, 1, 12).astype(np.float32)), hand)
    sensing = HandSensing(hand, HardwareConfig())
    # The simulation's door: `SensorSuite.observe`, compiled by itself, on readings and some truth for the critic.
    sensors = SensorSuite(config, hand, task)

    truth = still_moment(hand, np.zeros(3))

    @jax.jit
    def door(readings, goal):
        return sensors.observe(readings, truth, task.goal_readings(goal))["actor"]

    goal = task.begin(jax.random.key(0), None)
    compiled = lambda: [function._cache_size() for function in (controller._observe, controller._move)]  # noqa: E731
    controller.warm()
    assert compiled() == [1, 1], "the first tick must not wait for a compiler"
    for _ in range(20):
        quats = rng.normal(size=(2, 4))
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        seen = ObjectEstimate(rng.normal(size=3), rng.normal(size=3), quats[0])
        data = random_state(rng, hand).tobytes()
        tick = controller.tick(sensing.measure(frames.decode(data)), seen, quats[1], 0.37)
        simulated = np.asarray(door(tick.readings, goal))
        assert simulated.dtype == tick.observation.dtype == np.float32
        assert simulated.tobytes() == tick.observation.tobytes()
        assert len(simulated) == (66 if task.name == "grasp" else 92)
    assert compiled() == [1, 1]


def test_an_action_that_is_not_finite_counts_as_none(hand):
    task = Grasp(GraspConfig(), hand)
    wrong = np.where(np.arange(12) == 7, np.nan, 0.5)
    answers = iter([0.0, 0.5, wrong, 3.0])  # The first is asked for when the controller is made.
    act = lambda observation: np.full(12, next(answers), np.float32)  # noqa: E731
    controller = Controller(Acts(task, hand, act), hand)
    middle = ((hand.joint_lower + hand.joint_upper) / 2).astype(np.float32)
    controller.start(middle)
    block = frames.empty_state()
    block["joint"]["position"] = middle
    measured = HandSensing(hand, HardwareConfig()).measure(block)
    first, second, third = (controller.tick(measured, NOWHERE, IDENTITY, 0.5) for _ in range(3))
    assert np.isnan(second.target).all() and not second.action.any()
    np.testing.assert_array_equal(third.readings.last_action, np.zeros(12))
    np.testing.assert_array_equal(third.action, np.ones(12))  # Clipped, as `Env.step` does.
    inside = np.abs(middle - hand.joint_upper) > 0.4
    np.testing.assert_allclose((third.target - first.target)[inside], 0.2, atol=1e-5)


def test_a_memory_is_carried_through_the_ticks_and_emptied_at_a_start_and_after_a_hold(hand):
    policy = Acts(Grasp(GraspConfig(), hand), hand, lambda observation: np.zeros(12, np.float32))
    controller, rng, carried = Controller(policy, hand), np.random.default_rng(0), []
    for number in range(9):
        measured = HandSensing(hand, HardwareConfig()).measure(random_state(rng, hand))
        if number in (3, 6):
            (controller.start if number == 3 else controller.resume)(measured.joint_position)
            np.testing.assert_array_equal(controller.target, measured.joint_position)
        controller.tick(measured, NOWHERE, IDENTITY, 0.5)
        carried.append(policy.carry.item())
    assert carried == [0, 1, 2] * 3


class Still:
    """What the loop needs of a controller, with a policy that stays where it is."""

    def __init__(self, hand):
        self.hand, self.period = hand, 3 * CYCLE
        self.spec = SimpleNamespace(turn=None, posture=None, reference=(0.0, 0.0, 0.1))

    def start(self, target):
        self.target = target

    resume = start

    def tick(self, measured, estimate, goal, command):
        return Tick(None, None, np.zeros(12), MIDDLE)


@pytest.mark.parametrize("silent", [False, True])
def test_a_silent_imu_is_held_within_a_third_of_a_second_then_relaxed(hand, silent):
    bench, imu = Bench(hand), ImuReader()
    objects = ObjectSensors(np.zeros(3), (0.0, 0.0, -9.81), None, imu)
    loop = PolicyLoop(Still(hand), bench.safety, objects, command=0.5, approach_seconds=0, place_seconds=0)
    imu.receive(bench.now, encode(0, IDENTITY))
    bench.engage()
    bench.cycle()
    while loop.approach(bench.now):
        bench.cycle()
    loop.begin()
    start, reactions = bench.now, []
    for k in range(round(3.0 / CYCLE)):
        if not (silent and bench.now > start + 1.0):
            imu.receive(bench.now, encode(k, IDENTITY))
        if k % 3 == 0 and not bench.safety.latched:
            assert loop.tick(bench.now) is not None
        reactions.append((bench.now - start, *bench.safety.last))
        bench.cycle()
    held = [(time, reason) for time, reaction, reason in reactions if reaction >= Reaction.HOLD]
    if silent:
        assert 1.3 <= held[0][0] < 1.4 and held[0][1] == "the IMU is silent"
        assert bench.safety.latched == "the IMU is silent for 1 s"
    else:
        assert not held and not bench.safety.latched


def test_the_approach_eases_from_the_pose_to_the_posture_in_its_time(hand):
    controller, targets = Still(hand), []
    controller.spec.posture = np.ones(12)
    safety = SimpleNamespace(commanded=np.zeros(12), set_target=lambda target, now: targets.append(target))
    objects = ObjectSensors(np.zeros(3), (0.0, 0.0, -9.81), None, None)
    loop = PolicyLoop(controller, safety, objects, command=0.5, approach_seconds=2.0, place_seconds=0.0)
    assert [loop.approach(5.0 + time) for time in (0.0, 0.5, 1.0, 1.5, 2.0)] == [True] * 4 + [False]
    controller.spec.posture = ()  # of a task that begins wherever the hand is
    assert loop.approach(6.5)
    np.testing.assert_allclose(targets, np.outer([0, 0.15625, 0.5, 0.84375, 0], np.ones(12)), rtol=1e-6)  # 3s^2 - 2s^3


# --- goals of the rotation task ----------------------------------------------------------------------

REFERENCE = (0.047, 0.024, 0.088)


def seen(angle, place=(0.048, 0.0, 0.085), sign=1):
    quat = np.array([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0])
    return ObjectEstimate(np.array(place), np.zeros(3), sign * quat)


@pytest.mark.parametrize("direction", [1, -1])
def test_goals_move_on_as_in_the_task(direction):
    turn = TurnSpec(step=direction * math.pi / 2)
    goals = TurnGoals(turn, REFERENCE)
    rate, period, turns = 0.8 * direction, 0.03, 0
    wanted = [np.asarray(goal_quat(number, np.asarray(turn.axis), turn.step)) for number in range(11)]
    for k in range(600):
        np.testing.assert_allclose(goals.quat, wanted[turns], atol=1e-5)
        angle = rate * period * k
        goals.update(period * k, seen(angle))
        # A goal is reached 0.3 rad before it.
        turns = max(turns, math.floor((abs(angle) + turn.angle - 1e-9) / abs(turn.step)))
        assert goals.successes == turns
    assert turns >= 8 and len(goals.times) == turns


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize(("rate", "sign", "counted"), [(6.0, 1, 0), (0.8, -1, 1)])
def test_a_goal_passed_at_speed_does_not_count_and_a_quaternion_of_the_other_sign_is_no_turn(way, rate, sign, counted):
    """Whichever way round. q and -q are one orientation; an IMU may give either, from one sample to the next."""
    goals = TurnGoals(TurnSpec(step=way * math.pi / 2, spin=2.0), REFERENCE)
    for k in range(100):
        goals.update(0.03 * k, seen(way * rate * 0.03 * k, sign=sign**k))
    assert goals.successes == counted


@pytest.mark.parametrize("side", ["xhand_right", "xhand_left"])
def test_a_told_axis_turns_as_in_training(hand, side):
    """On a left hand as its mirror image; an axis that the policy does not know is refused."""
    axes, trained, hand = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0)), hand, load_hand(side)
    config = RotateConfig(turn=TurnSpec(axes=axes))
    policy = Acts(Rotate(config, trained), trained, lambda observation: np.zeros(12, np.float32))
    task = Rotate(config, hand)
    for number, axis in enumerate(axes):
        goals = TurnGoals(Controller(policy, hand, axis).spec.turn, REFERENCE)
        plan = jax.tree.map(lambda leaf, number=number: leaf[number], task.evaluation_plan(2, np.zeros(2, int))[1])
        np.testing.assert_allclose(goals.quat, task.goal_readings(plan)[1], atol=1e-6)
    with pytest.raises(ConfigError, match="axis \\(0.0, 0.0, 1.0\\): the policy can be told"):
        Controller(policy, hand, (0.0, 0.0, 1.0))


@pytest.mark.parametrize(("off", "counts"), [(0.049, True), (0.051, False)])
def test_a_goal_counts_within_its_distance_at_the_time_of_the_orientation(off, counts):
    turn = TurnSpec(distance=0.05)
    goals = TurnGoals(turn, REFERENCE)
    place = np.asarray(REFERENCE) + [0.0, 0.6 * off, 0.8 * off]
    goals.update(7.5, seen(math.pi / 2, place=place))
    assert goals.successes == counts and goals.times == [7.5] * counts
