"""The emulated hand: physics against closed forms, draws against training's ranges, referee against scripts."""

import ast
import dataclasses
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from paths import ROOT

import dexsim_real.twin.plant
from dexsim import load_hand
from dexsim.core.assets import asset_path
from dexsim.core.config import to_dict
from dexsim.randomization import tilted_down
from dexsim.registry import TASKS as TRAINED
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant import assistant, referee, scene, shapes
from dexsim_real.twin.plant.assistant import PLACES, POSTURES, REFERENCES, Assistant, Stage, find_place, put
from dexsim_real.twin.plant.drives import BACK_EMF, PERIOD, STALL_CURRENT, STIFFNESS, Drives, Heat
from dexsim_real.twin.plant.emulated_hand import GRAVITY, EmulatedHand, nominal_gravity, tilted_gravity
from dexsim_real.twin.plant.parameters import BANDS, FAR, NEAR, PUSHES, TASKS, bands, sample_trial
from dexsim_real.twin.plant.protocol import MotorCommands
from dexsim_real.twin.plant.referee import GoalCount, Referee
from dexsim_real.twin.plant.shapes import ObjectShape, Primitive, matrix, product, sample_shape, turn
from dexsim_real.wire.frames import Mode

QUIET = {"taxel_noise": 0.0, "taxel_bias": 0.0, "taxel_spread": 0.0, "taxel_threshold": 0.0}
IDEAL = {
    "coulomb_friction": 0.0,
    "viscous_friction": 0.0,
    "no_load_current": 0.0,
    "efficiency": 1.0,
    "ripple": 0.0,
    "encoder_bias": 0.0,
    "latency": 0.0,
    "latency_spread": 0.0,
    "thermal": 0.0,
}


@pytest.fixture(scope="module")
def hand():
    return load_hand()


def motors(position, *, kp=100.0, ki=0.0, kd=0.0, torque_max=300.0, mode=Mode.POSITION):
    def full(value):
        return np.broadcast_to(np.asarray(value, float), 12).copy()

    return MotorCommands(full(position), full(kp), full(ki), full(kd), full(torque_max), full(int(mode)))


def drives(hand, heat=None, **overrides):
    made = Drives(hand.torque_limit, hand.speed_limit, heat or Heat())
    made.configure(sample_trial("grasp", np.random.default_rng(0), "nominal", IDEAL | overrides))
    return made


# --- draws ---------------------------------------------------------------------------------------


def _lookup(config, path):
    if path == "objects.link_friction" and "link_friction" not in config["objects"]:
        path = "objects.friction"  # a policy from before the palm had one of its own
    for name in path.split("."):
        config = config[name]
    return config


@pytest.mark.parametrize("task", TASKS)
def test_bands_repeat_the_ranges_of_the_tasks_and_of_the_shipped_policies(task):
    header = json.loads(Path(asset_path(f"policies/{task}.json")).read_text())
    assert header["task"] == task
    from dexsim_ppo.policy import load_policy

    for config in (to_dict(TRAINED[task].config_class()), load_policy(task).env_config):
        for name, band in bands(task).items():
            trained = _lookup(config, band.origin)
            low, high = (
                trained
                if isinstance(trained, (tuple, list))
                else ((-trained, trained) if band.low < 0 else (trained, trained))
            )
            assert (band.low, band.high) == pytest.approx((low, high)), name
        assert PUSHES[task][1] == config["push_speed"]
        assert PUSHES[task][0] == pytest.approx(
            config["push_probability"] / config["physics"]["timestep"] / config["physics"]["substeps"]
        )
        assert POSTURES[task] == pytest.approx(config["posture"])
        assert referee.LOST[task] == config["drop_distance"]
        assert referee.LIMITS[task] == config["evaluation_seconds"]


def test_rules_and_places_are_those_of_the_tasks(hand):
    for task in TASKS:
        rules = TRAINED[task].task(TRAINED[task].config_class(), hand)
        assert REFERENCES[task] == pytest.approx(rules.reference)
        assert nominal_gravity(task) == pytest.approx(rules.gravity)
    config = rules.config
    assert (
        referee.GOAL_STEP,
        referee.GOAL_ANGLE,
        referee.GOAL_DISTANCE,
        referee.GOAL_SPIN,
        referee.TIPPED,
    ) == pytest.approx((config.goal_step, config.goal_angle, config.goal_distance, config.goal_spin, config.drop_tilt))


def test_a_cube_is_put_in_the_middle_of_trainings_starts(hand, monkeypatch, tmp_path):
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))
    entry = TRAINED["rotate"]
    rules = entry.task(dataclasses.replace(entry.config_class(), pool_size=64), hand)
    starts = rules.make_pool(jax.random.key(0)).qpos[:, 13:15]
    assert np.all(np.abs(starts.mean(0) - PLACES["rotate"]) < 0.6 * starts.std(0))


def test_the_fingers_leave_room_where_a_cube_is_put(hand):
    """Hands around which no cube fits are drawn anew, which must not choose among them."""
    for trial in range(30):
        rng = np.random.default_rng([7, trial])
        parameters = sample_trial("rotate", rng, "outside", {})
        shape = sample_shape(parameters, rng, None)
        built = scene.build_scene(hand, parameters, shape, tilted_gravity("rotate", parameters.gravity_tilt))
        assert find_place(built, parameters, shape, rng) is not None


@pytest.mark.parametrize("task", TASKS)
def test_every_value_lies_outside_its_range_and_near_it(task):
    sides = {name: set() for name in bands(task)}
    for seed in range(60):
        parameters = sample_trial(task, np.random.default_rng(seed))
        for name, band in bands(task).items():
            value, width = parameters.value[name], band.width or band.high - band.low
            assert np.all((value < band.low) | (value > band.high)), name
            assert np.all(value >= band.low - (FAR + 1e-9) * width), name
            assert np.all(value <= band.high + (FAR + 1e-9) * width), name
            beyond = np.maximum(band.low - value, value - band.high)
            assert np.all(beyond >= (NEAR - 1e-9) * width), name
            sides[name] |= set(np.atleast_1d(value > band.high).ravel().tolist())
    for name, band in bands(task).items():
        assert sides[name] == {"both": {True, False}, "high": {True}, "low": {False}}[band.sides], name


def test_inside_nominal_and_overrides():
    for task in TASKS:
        inside, nominal = (sample_trial(task, np.random.default_rng(3), kind) for kind in ("inside", "nominal"))
        for name, band in bands(task).items():
            assert np.all((inside.value[name] >= band.low) & (inside.value[name] <= band.high)), name
            assert np.all(nominal.value[name] == band.nominal), name
    fixed = sample_trial("grasp", np.random.default_rng(3), "outside", {"gear_play": 0.002, "rolling": 0.0})
    assert np.all(fixed.gear_play == 0.002) and fixed.rolling == 0.0
    assert np.array_equal(fixed.stiffness, sample_trial("grasp", np.random.default_rng(3)).stiffness)
    # One parameter outside, all others nominal: the very value that it has with all others outside.
    one = sample_trial("grasp", np.random.default_rng(3), "nominal", {"friction": "outside"})
    assert one.friction == fixed.friction and np.all(one.stiffness == 1.0)
    with pytest.raises(HandError, match="friction = 'outsid'"):
        sample_trial("grasp", np.random.default_rng(0), overrides={"friction": "outsid"})
    with pytest.raises(HandError, match="no parameter 'gaer_play'"):
        sample_trial("grasp", np.random.default_rng(0), overrides={"gaer_play": 1.0})
    with pytest.raises(HandError, match="tasks are"):
        sample_trial("juggle", np.random.default_rng(0))


def test_the_physics_shares_no_code_with_training():
    """Every module of the folder: of `dexsim` it takes the type of a hand's model alone, of JAX nothing."""
    folder = Path(dexsim_real.twin.plant.__file__).parent
    paths = sorted(folder.rglob("*.py"))
    ours = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths}
    assert "dexsim_real.twin.plant.emulated_hand" in ours and len(ours) > 10
    bridge = {"dexsim_real.wire.frames", "dexsim_real.core.errors", *ours}
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path.name}: relative import"
                found = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            for name in found:
                package = name.split(".")[0]
                assert package not in ("jax", "dexsim_ppo", "importlib"), f"{path.name} imports {name}"
                assert "mjx" not in name
                assert package != "dexsim" or name == "dexsim.hand.kinematics.Hand", f"{path.name}: {name}"
                if package == "dexsim_real":
                    assert name in bridge or name.rpartition(".")[0] in bridge, f"{path.name}: {name}"


# --- motors --------------------------------------------------------------------------------------


def test_a_step_follows_the_second_order_closed_form(hand):
    made, inertia, step = drives(hand), 2e-3, 0.05
    made.send(0.0, motors(step))
    angle, speed, fine = np.zeros(12), np.zeros(12), 20
    stiffness, damping = STIFFNESS * 100, BACK_EMF
    omega, zeta = math.sqrt(stiffness / inertia), damping / 2 / math.sqrt(stiffness * inertia)
    assert zeta < 1
    ring = omega * math.sqrt(1 - zeta**2)
    for k in range(300):
        time = k * PERIOD
        expected = step * (
            1 - math.exp(-zeta * omega * time) * (math.cos(ring * time) + zeta * omega / ring * math.sin(ring * time))
        )
        assert angle == pytest.approx(np.full(12, expected), abs=0.03 * step), k
        torque, friction = made.step(time, angle, speed)
        assert np.all(friction == 0)
        for _ in range(fine):
            speed = speed + PERIOD / fine * torque / inertia
            angle = angle + PERIOD / fine * speed
    assert angle == pytest.approx(np.full(12, step), abs=1e-3 * step)


def test_a_load_costs_a_steady_error_that_integral_action_removes(hand):
    for ki, rest in ((0.0, 0.2 / 3.0), (100.0, 0.0)):
        made, inertia = drives(hand), 2e-3
        made.send(0.0, motors(0.5, ki=1.0 * ki))
        angle, speed = np.zeros(12), np.zeros(12)
        for k in range(60000 if ki else 2000):
            torque, _ = made.step(k * PERIOD, angle, speed)
            speed = speed + PERIOD * (torque - 0.2) / inertia
            angle = angle + PERIOD * speed
        assert 0.5 - angle == pytest.approx(np.full(12, rest), abs=1e-3)


def test_current_at_a_static_torque_and_its_limits(hand):
    made = drives(hand)
    made.send(0.0, motors(0.1))
    torque, _ = made.step(0.0, np.zeros(12), np.zeros(12))
    assert torque == pytest.approx(np.full(12, 0.3))
    assert made.current == pytest.approx(0.3 / hand.torque_limit * STALL_CURRENT)
    # Stalled: the whole torque at 300, half of it at 150; none at the no-load speed, all of it when braking.
    for torque_max, speed, share in (
        (300, 0.0, 1.0),
        (150, 0.0, 0.5),
        (600, 0.0, 1.0),
        (600, 0.5, 0.5),
        (300, 1.0, 0.0),
        (300, -0.5, 1.0),
    ):
        made = drives(hand)
        made.send(0.0, motors(1.5 + 2 * (speed > 0), torque_max=torque_max))
        torque, _ = made.step(0.0, np.zeros(12), speed * hand.speed_limit)
        assert torque == pytest.approx(share * hand.torque_limit, abs=1e-6), (torque_max, speed)


def test_losses_depend_on_the_direction_of_power(hand):
    made = drives(hand, efficiency=0.8, coulomb_friction=0.02)
    made.send(0.0, motors(0.05))
    torque, friction = made.step(0.0, np.zeros(12), np.zeros(12))
    # What moves the load is 0.8 of the torque less the dry friction; what holds when driven back, 1.2 and more.
    assert torque - friction == pytest.approx(0.8 * 0.15 - 0.02 * hand.torque_limit)
    assert torque + friction == pytest.approx(1.2 * 0.15 + 0.02 * hand.torque_limit)


def test_commands_reach_each_board_after_its_own_delay(hand):
    made = drives(hand)
    made.delay = np.linspace(0.0, 0.011, 12)
    made.send(0.0, motors(0.0))
    made.send(0.005, motors(0.1))
    reached = np.full(12, np.nan)
    for k in range(30):
        torque, _ = made.step(k * PERIOD, np.zeros(12), np.zeros(12))
        new = np.isnan(reached) & (torque > 0.1)
        reached[new] = k * PERIOD
    assert reached == pytest.approx(0.005 + np.ceil(made.delay / PERIOD - 1e-6) * PERIOD, abs=1e-9)


def test_passive_motors_give_nothing(hand):
    made = drives(hand)
    made.send(0.0, motors(1.0, mode=Mode.PASSIVE))
    torque, _ = made.step(0.0, np.zeros(12), np.zeros(12))
    assert not torque.any() and not made.current.any()


def steady(heat, current):
    """Winding and case, degC, after a current A has flowed for ever: the loss grows with the winding's temperature."""
    power, path = current**2 * heat.resistance, heat.to_case + heat.to_air
    loss = power * (1 + heat.rise * (heat.air - heat.reference)) / (1 - power * heat.rise * path)
    return heat.air + loss * path, heat.air + loss * heat.to_air


def test_heat_settles_where_loss_and_flow_balance(hand):
    heat = Heat(winding=0.01, case=0.02)
    made = drives(hand, heat, thermal=1.0)
    made.send(0.0, motors(0.1 * hand.torque_limit))
    for k in range(4000):
        made.step(k * PERIOD, np.zeros(12), np.zeros(12))
    current = 0.3  # of 1 A: 0.1 rad per Nm of limit times 3 Nm/rad
    assert made.current == pytest.approx(np.full(12, current))
    loss = current**2 * heat.resistance * (1 + heat.rise * (made.winding - heat.reference))
    assert made.winding - made.case == pytest.approx(loss * heat.to_case, rel=1e-3)
    assert made.case - heat.air == pytest.approx(loss * heat.to_air, rel=1e-3)
    assert (made.winding[0], made.case[0]) == pytest.approx(steady(heat, current), abs=0.02)
    torque, _ = made.step(9.0, np.zeros(12), np.zeros(12))
    weaker = 1 - heat.weakening * (made.winding - heat.reference)
    assert torque == pytest.approx(0.3 * hand.torque_limit * weaker, rel=1e-3)


# --- the world -----------------------------------------------------------------------------------


def world(hand, task="rotate", **overrides):
    return EmulatedHand(hand, task, 0, kind="nominal", overrides=QUIET | IDEAL | {"push_rate": 0.0} | overrides)


def free(plant, position, quat=(1.0, 0.0, 0.0, 0.0), *, judged=False):
    """Let go of the object anywhere; unless judged, no referee calls that a drop."""
    plant._assistant.stage = Stage.FREE
    if not judged:
        plant._look = lambda: None
    put(plant._scene, plant._data, np.asarray(position, float), np.asarray(quat, float))
    mujoco.mj_forward(plant._scene.model, plant._data)


def test_free_fall(hand):
    plant = world(hand, "grasp")
    free(plant, (0.5, 0.0, 0.0))
    plant.advance(0.2)
    at = plant._scene.object_qpos
    fallen = plant._data.qpos[at : at + 3] - (0.5, 0.0, 0.0)
    assert fallen == pytest.approx([0.5 * GRAVITY * 0.2**2, 0.0, 0.0], abs=1e-3)
    # An accelerometer in free fall feels nothing; held, it feels the ground push back.
    assert plant.measure_object()[2] == pytest.approx(np.zeros(3), abs=1e-6)
    held = world(hand, "rotate", imu_noise=0.0)
    held.advance(0.05)
    _, quat, felt = held.measure_object()
    assert matrix(quat) @ felt == pytest.approx(-nominal_gravity("rotate"), abs=1e-6)


def test_tilt_turns_gravity_and_keeps_its_size():
    for task in TASKS:
        nominal, tilted = nominal_gravity(task), tilted_gravity(task, np.array([0.12, 0.0]))
        assert np.linalg.norm(tilted) == pytest.approx(GRAVITY)
        assert math.acos(nominal @ tilted / GRAVITY**2) == pytest.approx(0.12)


@pytest.mark.parametrize("task", TASKS)
def test_the_ends_of_trainings_tilts_are_those_of_a_mount(task):
    """Pitch and roll on both sides, each in its own way; which sign is which says nothing."""
    down = nominal_gravity(task) / GRAVITY
    for pitch, roll in ((0.1, 0.1), (0.1, 0.0), (0.0, 0.1)):
        angles = np.array([(a * pitch, b * roll) for a in (-1, 1) for b in (-1, 1)])
        trained = np.stack([tilted_down(down, jnp.asarray(both)) for both in angles])
        mounted = np.stack([tilted_gravity(task, both) for both in angles]) / GRAVITY
        apart = np.linalg.norm(trained[:, None] - mounted, axis=-1)
        assert np.all(apart.min(0) < 1e-3) and np.all(apart.min(1) < 1e-3)


def test_an_object_on_the_fingertips_weighs_what_it_weighs(hand):
    plant = world(hand, taxel_crosstalk=0.05)
    plant._scene.model.opt.gravity[:] = (-GRAVITY, 0.0, 0.0)
    plant.drive(motors(0.0, kp=400))
    plant._data.qpos[plant._scene.drive_qpos] = 0.0
    plant.advance(0.1)
    free(plant, (0.0215 + 0.0275, -0.006, 0.183))
    plant.advance(1.5)
    speed = np.linalg.norm(plant._data.qvel[plant._scene.object_dof :][:3])
    assert speed < 1e-3
    shown = plant.measure().taxel_force
    weight = float(plant.parameters.mass) * GRAVITY
    assert shown[..., 2].sum() == pytest.approx(weight, rel=0.05)
    plant._contacts()
    assert plant._pressing == pytest.approx(shown[..., 2].sum(-1), rel=0.02, abs=0.01 * weight)
    assert np.count_nonzero(shown[..., 2].sum(-1) > 0.05 * weight) >= 2
    assert shown[0].sum() == 0 and shown[..., 2].min() >= 0


@pytest.mark.parametrize("stiffness", [1700.0, 8000.0])
def test_contacts_are_springs_of_the_stiffness_and_bounce_asked_for(stiffness):
    def drop(speed, gravity):
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = scene.TIMESTEP, [0, 0, -gravity]
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.worldbody.add_geom(
            name="floor", type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 1, 0.1], pos=[0, 0, -0.1], contype=0, conaffinity=0
        )
        body = spec.worldbody.add_body(pos=[0, 0, 0.03])
        body.add_freejoint()
        body.add_geom(
            name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.03, 0, 0], mass=0.1, contype=0, conaffinity=0
        )
        spec.add_pair(geomname1="floor", geomname2="ball", condim=4)
        model = spec.compile()
        model.pair_solref[0], model.pair_solimp[0] = scene.spring(
            model.body_invweight0[:, 0].sum(), stiffness, scene.damping_of(0.08, stiffness, 0.1)
        )
        data = mujoco.MjData(model)
        data.qvel[2] = -speed
        mujoco.mj_step(model, data, 4000)
        return data

    assert drop(0.3, 0.0).qvel[2] / 0.3 == pytest.approx(0.08, rel=0.15)
    assert 0.03 - drop(0.0, GRAVITY).qpos[2] == pytest.approx(0.1 * GRAVITY / stiffness, rel=0.01)


def test_a_gear_with_play_loses_that_much_motion(hand, monkeypatch):
    play, load = 0.02, 0.05
    plant = world(hand, gear_play=play, gear_stiffness=150.0)
    plant._scene.model.opt.gravity[:] = 0.0
    free(plant, (0.5, 0.0, 0.0))  # out of the fingers' way
    posture = np.array(POSTURES["rotate"])
    plant._data.qpos[plant._scene.drive_qpos] = posture
    plant.drive(motors(posture))
    gap, rotor = [], []
    for way in (1.0, -1.0):
        # A torque on the link acts on both of its hinges.
        plant._data.qfrc_applied[plant._scene.play_dof] = way * load
        step = plant._drives.step
        with monkeypatch.context() as patch:
            patch.setattr(plant._drives, "step", lambda *a, way=way, step=step: (step(*a)[0] + way * load, 0.0))
            plant.advance(0.6)
        gap.append(plant._data.qpos[plant._scene.play_qpos].copy())
        rotor.append(plant._data.qpos[plant._scene.drive_qpos].copy())
    assert gap[0] - gap[1] == pytest.approx(np.full(12, play + 2 * load / 150.0), rel=0.05)
    assert rotor[0] - rotor[1] == pytest.approx(np.full(12, 2 * load / 3.0), rel=0.05)


def test_currents_are_reported_in_milliamperes_positive_when_opening(hand):
    plant = world(hand, current_noise=0.0, current_gain=1.1)
    plant._scene.model.opt.gravity[:] = 0.0
    plant._data.qpos[plant._scene.drive_qpos] = hand.joint_lower
    plant.drive(motors(hand.joint_lower - 0.1))
    plant.advance(0.8)
    assert plant.measure().current == pytest.approx(1000 * 1.1 * 0.3 / hand.torque_limit, rel=0.05)


def test_readings_are_as_old_as_drawn(hand):
    plant = world(hand, sensing_latency=0.0146 + 0.01, encoder_noise=0.0)
    plant.drive(motors(POSTURES["rotate"]))
    shown, true = [], []
    for _ in range(60):
        plant.advance(PERIOD)
        shown.append(plant.measure().joint_position[4])
        true.append(plant._data.qpos[plant._scene.drive_qpos[4]])
    assert shown[20:] == pytest.approx(true[10:50], abs=1e-12)
    assert true[-1] > true[10] + 0.01


def test_a_run_is_repeated_by_its_seed_and_by_no_other(hand):
    def run(seed, first=0):
        plant = EmulatedHand(hand, "grasp", seed, first=first)
        plant.drive(motors(POSTURES["grasp"]))
        plant.advance(1.2)
        plant.drive(motors(np.array(POSTURES["grasp"]) + 0.1))
        plant.advance(0.3)
        shown = plant.measure()
        return np.concatenate([np.ravel(getattr(shown, f.name)) for f in dataclasses.fields(shown)]), plant.results()

    (first, result), (again, same), (other, _), (later, _) = run(0), run(0), run(1), run(0, 3)
    assert result[0]["stage"] == "free"
    assert np.array_equal(first, again) and result == same
    assert not np.array_equal(first, other) and not np.array_equal(first, later)
    assert json.loads(json.dumps(result)) == result


# --- assistant and trials ------------------------------------------------------------------------


def test_the_object_is_held_until_the_targets_move_on(hand):
    plant = EmulatedHand(hand, "rotate", 2, trials=1)
    posture = np.array(POSTURES["rotate"])
    at = plant._scene.object_qpos
    plant.drive(motors(posture + 0.1))
    plant.advance(0.3)
    assert plant.stage is Stage.AWAY
    plant.drive(motors(posture))
    plant.advance(0.5)
    assert plant.stage is Stage.HOLD
    held = plant._data.qpos[at : at + 7].copy()
    plant.advance(1.0)
    assert plant._data.qpos[at : at + 7] == pytest.approx(held, abs=1e-4)
    plant.drive(motors(posture + 0.01))
    plant.advance(0.05)
    assert plant.stage is Stage.FREE
    # Thrown out of the hand: the trial is over, and there is no other.
    free(plant, (0.5, 0.0, 0.0), judged=True)
    plant.advance(0.05)
    (report,) = plant.results()
    assert report["end"].startswith("dropped") and report["fell"] and plant.trial == 1
    plant.advance(0.05)
    assert len(plant.results()) == 1


def test_motors_that_go_off_take_the_object_back(hand):
    helper, posture = Assistant("rotate"), np.array(POSTURES["rotate"])
    assert helper.watch(0.0, posture, posture, None) is Stage.HOLD
    assert helper.watch(0.1, None, posture, None) is Stage.AWAY
    assert helper.watch(0.2, posture, posture, None) is Stage.HOLD
    assert helper.watch(0.3, posture + 0.01, posture, None) is Stage.FREE


def test_a_runner_that_goes_on_is_served_after_a_while():
    helper, posture = Assistant("rotate", patience=5.0), np.array(POSTURES["rotate"]) + 0.2
    assert helper.watch(0.0, posture, posture, None) is Stage.AWAY
    assert not helper.wants_clearance(4.9) and helper.wants_clearance(5.1)
    assert helper.watch(5.1, posture, posture, False) is Stage.AWAY
    assert helper.watch(5.2, posture, posture, True) is Stage.HOLD
    assert helper.watch(5.5, posture, posture, None) is Stage.HOLD
    assert helper.watch(5.8, posture, posture, None) is Stage.FREE


def test_places_are_clear_of_the_hand(hand):
    for seed in range(12):
        plant = EmulatedHand(hand, "grasp", seed)
        data = mujoco.MjData(plant._scene.model)
        data.qpos[plant._scene.drive_qpos] = POSTURES["grasp"]
        assert assistant.clear(plant._scene, data, plant._place)
        up = matrix(plant._place.quat).T @ [-1.0, 0.0, 0.0]
        top = plant._place.position[0] - plant.shape.reach(up)
        assert top == pytest.approx(assistant.PALM_FACE + float(plant.parameters.gap))


# --- shapes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "part",
    [
        Primitive("sphere", (0.03,)),
        Primitive("box", (0.02, 0.03, 0.025)),
        Primitive("cylinder", (0.02, 0.03), (0.01, 0.0, 0.0)),
        Primitive("capsule", (0.015, 0.02)),
    ],
)
def test_distances_agree_with_mujoco(part):
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="part", type=scene._KINDS[part.kind], size=scene._three(part.size), pos=part.place)
    for k in range(200):
        spec.worldbody.add_geom(
            name=f"p{k}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[1e-5, 0, 0],
            pos=np.random.default_rng(k).uniform(-0.06, 0.06, 3),
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    points = data.geom_xpos[1:]
    ours = ObjectShape("x", (part,)).distance(points)
    theirs = np.array([mujoco.mj_geomDistance(model, data, 0, k + 1, 1.0, np.zeros(6)) + 1e-5 for k in range(200)])
    outside = theirs > 1e-3
    assert ours[outside] == pytest.approx(theirs[outside], abs=1e-5)
    assert np.all((ours < 0) == (theirs < 0))
    along = np.array([0.6, 0.0, 0.8])
    fine = np.random.default_rng(0).uniform(-0.06, 0.06, (200_000, 3))
    inside = fine[ObjectShape("x", (part,)).distance(fine) < 0]
    assert ObjectShape("x", (part,)).reach(along) == pytest.approx((inside @ along).max(), abs=2e-3)


def test_mass_properties_of_a_box():
    mass, centre, inertia = scene.mass_properties(ObjectShape("box", (Primitive("box", (0.02, 0.03, 0.04)),)), 0.3)
    assert mass == 0.3 and centre == pytest.approx(np.zeros(3))
    assert np.diag(inertia) == pytest.approx(
        [0.1 * (0.03**2 + 0.04**2), 0.1 * (0.02**2 + 0.04**2), 0.1 * (0.02**2 + 0.03**2)]
    )


# --- referee -------------------------------------------------------------------------------------


def spinning(rate, seconds, heading=0.05, fastest=2.0, step=0.01):
    count = GoalCount(fastest)
    for k in range(round(seconds / step) + 1):
        count.watch(k * step, turn((1, 0, 0), heading + rate * k * step), 0.0, rate)
    return count


def test_goals_of_a_steady_turn():
    count = spinning(1.0, 20.0)
    expected = [(k * math.pi / 2 - referee.GOAL_ANGLE) for k in range(1, 20) if k * math.pi / 2 - 0.3 <= 20.0]
    assert count.times == pytest.approx(expected, abs=0.011) and count.count == len(expected)
    assert count.angle == pytest.approx(20.0, abs=1e-6)
    assert spinning(-1.0, 1.0).count == 0
    # Too fast for the task, not for the paper.
    assert spinning(3.0, 10.0).count == 0 and spinning(3.0, 10.0, fastest=math.inf).count == 19


def test_a_goal_needs_the_whole_orientation_and_the_place():
    count = GoalCount(2.0)
    count.watch(0.0, turn((1, 0, 0), 0.0), 0.0, 0.0)
    quarter = turn((1, 0, 0), math.pi / 2)
    count.watch(0.1, quarter, 0.06, 0.0)
    count.watch(0.2, product(turn((0, 0, 1), 0.35), quarter), 0.0, 0.0)
    assert count.count == 0
    count.watch(0.3, product(turn((0, 0, 1), 0.25), quarter), 0.04, 0.0)
    assert count.count == 1


def watched(task, positions, *, seconds=None, tips=0.0, quat=(1.0, 0, 0, 0)):
    judge = Referee(task, seconds)
    force = np.zeros((5, 3))
    for k, position in enumerate(positions):
        force[:, 0] = tips(k) if callable(tips) else tips
        judge.watch(
            0.01,
            np.asarray(position, float),
            np.asarray(quat, float),
            np.zeros(3),
            force,
            np.zeros(5),
            np.full(12, 0.5),
        )
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
        force = np.zeros((5, 3))
        force[:, 1] = (9.0, 1.0, 2.0, 0.0, 3.0) if k >= 300 else 50.0
        judge.watch(0.01, place, np.array([1.0, 0, 0, 0]), np.zeros(3), force, 0.8 * force[:, 1], np.zeros(12))
    report = judge.report()
    assert report["held"] and report["force"] == pytest.approx([9.0, 1.0, 2.0, 0.0, 3.0])
    assert report["finger_force"] == pytest.approx(2.0) and report["total_force"] == pytest.approx(15.0)
    assert report["finger_pressing"] == pytest.approx(1.6)
    lost = watched("grasp", [place + (0.121, 0, 0)]).report()
    assert not lost["held"] and lost["end"].startswith("dropped")


def test_all_shapes_are_drawn():
    parameters = sample_trial("grasp", np.random.default_rng(0))
    drawn = {shapes.sample_shape(parameters, np.random.default_rng(k)).name for k in range(60)}
    assert drawn == set(shapes.SHAPES)
    assert len(BANDS) > 20
