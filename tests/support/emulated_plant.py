"""The emulated hand's physics for tests: ideal parameters, drives alone, a hand whose object is free."""

import mujoco
import numpy as np

from dexsim_real.twin.plant.assistant import Stage, put
from dexsim_real.twin.plant.drives import Drives, Heat
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.parameters import sample_trial
from dexsim_real.twin.plant.protocol import MotorCommands
from dexsim_real.wire.frames import Mode

QUIET = {"taxel_noise": 0.0, "taxel_bias": 0.0, "taxel_spread": 0.0, "taxel_threshold": 0.0, "taxel_drift": 0.0}

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


def motors(position, *, kp=100.0, ki=0.0, kd=0.0, torque_max=300.0, mode=Mode.POSITION):
    def full(value):
        return np.broadcast_to(np.asarray(value, float), 12).copy()

    return MotorCommands(full(position), full(kp), full(ki), full(kd), full(torque_max), full(int(mode)))


def drives(hand, heat=None, **overrides):
    made = Drives(hand.torque_limit, hand.speed_limit, heat or Heat())
    made.configure(sample_trial("grasp", np.random.default_rng(0), "nominal", IDEAL | overrides))
    return made


def world(hand, task="rotate", **overrides):
    return EmulatedHand(hand, task, 0, kind="nominal", overrides=QUIET | IDEAL | {"push_rate": 0.0} | overrides)


def free(plant, position, quat=(1.0, 0.0, 0.0, 0.0), *, judged=False):
    """Let go of the object anywhere; unless judged, no referee calls that a drop."""
    plant._assistant.stage = Stage.FREE
    if not judged:
        plant._look = lambda: None
    put(plant._scene, plant._data, np.asarray(position, float), np.asarray(quat, float))
    mujoco.mj_forward(plant._scene.model, plant._data)
