"""The emulated hand's physics against closed forms, and its trials."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from emulated_plant import free, motors, world

from dexsim.randomization import tilted_down
from dexsim_real.twin.plant import scene
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
