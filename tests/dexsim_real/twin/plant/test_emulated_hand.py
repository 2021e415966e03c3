"""The emulated hand's physics against closed forms, and its trials."""

import dataclasses
import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
from emulated_plant import IDEAL, QUIET, free, motors, world

from dexsim.randomization import tilted_down
from dexsim_real.twin.plant import scene
from dexsim_real.twin.plant.drives import PERIOD
from dexsim_real.twin.plant.emulated_hand import EmulatedHand, Stage, tilted
from dexsim_real.twin.plant.parameters import GRAVITY, TASKS, start_of
from dexsim_real.twin.plant.shapes import matrix
from dexsim_real.wire.frames import Mode

SKILLS = TASKS[:2]  # rotate_any shares all but its objects and its mount with rotate


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
    assert matrix(quat) @ felt == pytest.approx(-held.start.gravity, abs=1e-6)


@pytest.mark.parametrize("task", SKILLS)
def test_the_ends_of_trainings_tilts_are_those_of_a_mount(hand, task):
    """Pitch and roll on both sides, each in its own way; which sign is which says nothing."""
    down = start_of(hand, task).gravity
    for pitch, roll in ((0.1, 0.1), (0.1, 0.0), (0.0, 0.1)):
        angles = np.array([(a * pitch, b * roll) for a in (-1, 1) for b in (-1, 1)])
        trained = np.stack([tilted_down(down / GRAVITY, jnp.asarray(both)) for both in angles])
        mounted = np.stack([tilted(down, both) for both in angles]) / GRAVITY
        assert np.linalg.norm(mounted, axis=-1) == pytest.approx(1.0)
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
    _, normal = scene.tip_forces(scene.tip_contacts(plant._scene, plant._data), 5)
    assert normal == pytest.approx(shown[..., 2].sum(-1), rel=0.02, abs=0.01 * weight)
    assert np.count_nonzero(shown[..., 2].sum(-1) > 0.05 * weight) >= 2
    assert shown[0].sum() == 0 and shown[..., 2].min() >= 0


@pytest.mark.parametrize(("stiffness", "restitution"), [(1700.0, 0.08), (8000.0, 0.4)])
def test_contacts_are_springs_of_the_stiffness_and_bounce_asked_for(hand, stiffness, restitution):
    """A sphere that rests on the palm, then one that hits it at 0.3 m/s."""
    values = QUIET | IDEAL | {"palm_stiffness": stiffness, "restitution": restitution}
    plant = EmulatedHand(hand, "grasp", 0, kind="nominal", overrides=values, shape_name="sphere")
    surface, dof = plant._palm_face + plant.shape.parts[0].size[0], plant._scene.object_dof
    for gravity, speed, seconds in ((GRAVITY, 0.0, 1.0), (0.0, 0.3, 0.1)):
        plant._scene.model.opt.gravity[:] = (-gravity, 0.0, 0.0)
        free(plant, (surface, -0.002, 0.06))
        plant._data.qvel[dof] = -speed
        plant.advance(seconds)
        if gravity:
            depth = surface - plant._data.qpos[plant._scene.object_qpos]
            assert depth == pytest.approx(plant.parameters.mass * GRAVITY / stiffness, rel=1e-3)
    assert plant._data.qvel[dof] == pytest.approx(0.3 * restitution, rel=0.12)


def test_the_encoder_does_not_see_the_play_of_the_gear(hand):
    """A load on the links, to either side, moves them by the play and by the gear's elasticity."""
    play, load = np.linspace(0.005, 0.02, 12), 0.05
    plant = world(hand, gear_play=play, gear_stiffness=150.0, encoder_noise=0.0)
    plant._scene.model.opt.gravity[:] = 0.0
    free(plant, (0.5, 0.0, 0.0))  # out of the fingers' way
    plant.drive(motors(hand.rotate_posture))
    link, shown = [], []
    for way in (load, -load):
        plant._data.qfrc_applied[plant._scene.play_dof] = way
        plant.advance(0.6)
        link.append(plant.true_pose()[0])
        shown.append(plant.measure().joint_position)
    assert link[0] - link[1] == pytest.approx(play + 2 * load / 150.0, rel=0.02)
    assert shown[0] == pytest.approx(shown[1], abs=2e-4)


def test_currents_are_reported_in_milliamperes_positive_when_opening(hand):
    plant = world(hand, current_noise=0.0, current_gain=1.1)
    plant._scene.model.opt.gravity[:] = 0.0
    plant._data.qpos[plant._scene.drive_qpos] = hand.joint_lower
    plant.drive(motors(hand.joint_lower - 0.1))
    plant.advance(0.8)
    free = np.arange(12) != 3  # the index finger swings into the middle one
    expected = 1000 * 1.1 * 0.3 / hand.torque_limit
    assert plant.measure().current[free] == pytest.approx(expected[free], rel=0.05)


def test_readings_are_as_old_as_drawn(hand):
    """The hand's 10 ms, as 14.6 of 24.6 ms are the wire's; the camera's 30 ms. The skin is looked at every 10 ms."""
    quiet = dict.fromkeys(("encoder_noise", "current_noise", "camera_noise"), 0.0) | {"current_gain": 1.0}
    plant = world(hand, sensing_latency=0.0246, camera_delay=0.03, taxel_gain=1.0, **quiet)
    plant._skin.load = lambda *_: np.full((5, 120, 3), plant.time)
    free(plant, (0.5, 0.0, 0.0))
    plant.drive(motors(hand.rotate_posture))
    shown, true, seen, fallen, at = [], [], [], [], plant._scene.object_qpos
    for _ in range(80):
        plant.advance(PERIOD)
        now, data, scene = plant.measure(), plant._data, plant._scene
        true.append((data.qpos[scene.drive_qpos], data.qvel[scene.drive_dof], -1000.0 * plant._drives.current))
        fallen.append(data.qpos[at])
        shown.append((now.joint_position, now.joint_velocity, now.current))
        seen.append(plant.measure_object()[0][0])
        assert now.taxel_force == pytest.approx(0.01 * max(math.floor(100 * plant.time + 1e-6) - 1, 0), abs=1e-9)
    np.testing.assert_allclose(shown[40:], true[30:70], atol=1e-12)
    np.testing.assert_allclose(seen[40:], fallen[10:50], atol=1e-12)


def test_a_run_is_repeated_by_its_seed_and_by_no_other(hand):
    def run(seed, first=0):
        plant = EmulatedHand(hand, "grasp", seed, first=first, overrides={"reaction": 0.0})
        plant.drive(motors(hand.grasp_posture))
        plant.advance(1.2)
        plant.drive(motors(np.array(hand.grasp_posture) + 0.1))
        plant.advance(0.3)
        shown = plant.measure()
        return np.concatenate([np.ravel(getattr(shown, f.name)) for f in dataclasses.fields(shown)]), plant.results()

    (first, result), (again, same), (other, _), (later, _) = run(0), run(0), run(1), run(0, 3)
    assert result[0]["stage"] == "free"
    assert np.array_equal(first, again) and result == same
    assert not np.array_equal(first, other) and not np.array_equal(first, later)
    assert json.loads(json.dumps(result)) == result


def test_the_object_is_held_until_the_targets_move_on(hand):
    plant = EmulatedHand(hand, "rotate", 2, trials=1)
    posture = np.array(hand.rotate_posture)
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
    plant.drive(motors(posture, mode=Mode.PASSIVE))
    plant.advance(0.02)
    assert plant.stage is Stage.AWAY, "motors that go off take the object back"
    plant.drive(motors(posture))
    plant.advance(0.02)
    assert plant.stage is Stage.HOLD
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
