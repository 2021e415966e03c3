"""The emulated hand's physics for tests: ideal parameters, drives alone, a hand whose object is free."""

import mujoco
import numpy as np

from dexsim_real.twin.plant.drives import Drives
from dexsim_real.twin.plant.emulated_hand import EmulatedHand, Stage, put
from dexsim_real.twin.plant.parameters import sample_trial
from dexsim_real.wire.frames import Mode, command_block

QUIET = dict.fromkeys(("taxel_noise", "taxel_bias", "taxel_spread", "taxel_threshold", "taxel_drift"), 0.0)
IDEAL = {"efficiency": 1.0} | dict.fromkeys(
    "coulomb_friction viscous_friction no_load_current ripple encoder_bias latency latency_spread thermal".split(), 0.0
)


def motors(position, *, kp=100, torque_max=300, mode=Mode.POSITION):
    return command_block(np.broadcast_to(position, 12), kp=kp, ki=0, kd=0, torque_max=torque_max, mode=mode)


def drives(hand, **overrides):
    made = Drives(hand.torque_limit, hand.speed_limit)
    made.configure(sample_trial("grasp", np.random.default_rng(0), "nominal", IDEAL | overrides))
    return made


def world(hand, task="rotate", **overrides):
    return EmulatedHand(hand, task, 0, kind="nominal", overrides=QUIET | IDEAL | {"push_rate": 0.0} | overrides)


def free(plant, position, *, judged=False):
    """Let go of the object anywhere; unless judged, no referee calls that a drop."""
    plant.stage = Stage.FREE
    if not judged:
        plant._look = lambda: None
    put(plant._scene, plant._data, np.asarray(position, float), np.array((1.0, 0.0, 0.0, 0.0)))
    mujoco.mj_forward(plant._scene.model, plant._data)
