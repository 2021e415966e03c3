"""The skin's law alone, before it is tied to the solver's total, against the solver's force.

The springs of a fingertip follow the skin by the tick (`contact.follow_skin`), with one stiffness for
the finger. What is left between the two: the tick's delay, friction, which the solver's force has and
the law not, forces of one finger that point apart, and dents in which the springs are as soft or stiff as
they may be.

In C MuJoCo, over 60 hands a shape: 15 objects, each closed
on without weight and then held at four random strengths, up to 25 N on a finger (commands ask for 2-7 N).
"""

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dexsim.objects.config import SHAPES, SLOTS
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp
from dexsim.touch.skin import Skin

CENTRE = (0.055, -0.005, 0.090)  # m, where grasps of the shipped hand have the object

OBJECTS, LEVELS = 15, 4


def hold(hand, start, rng, law):
    """[(qpos, force on the fingers [5] N)] of the levels at which it held."""
    exact = bool(start.object.active[SLOTS.index("cylinder")])
    model = c_scene.compile_scene(hand, start.object, exact=exact, iterations=20, line_search=30)
    model.opt.timestep = 0.006  # s; the motors below are explicit, and chatter at the 10 ms of implicit ones
    data = c_scene.start(model, start.qpos, 0 * start.qvel)
    known = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], start.object)
    close = rng.uniform(0.5, 1.0, 12) * (np.arange(12) > 3)
    close[1:3] = rng.uniform(0.3, 1.0, 2)
    found = []
    for level in range(LEVELS):
        grip = rng.uniform(0.05, 0.45)  # rad ahead of the joint, at 3 Nm/rad
        for tick in range(33):
            model.opt.gravity[:] = (0 if level == 0 and tick < 20 else 9.81), 0, 0
            if tick < 25:  # then the target stays
                share = min(tick / 10, 1) if level == 0 else 1
                here = data.qpos[:12].copy()
                wanted = np.clip(start.qpos[:12] + share * close, here - grip, here + grip)
            felt = law(data.qpos[None].astype(np.float32), known)
            c_scene.follow_skin(model, data, hand, start.object, np.asarray(felt)[0])
            for _ in range(5):
                torque = 3 * (wanted - data.qpos[:12]) - 0.1 * data.qvel[:12]
                data.qfrc_applied[:12] = np.clip(torque, -hand.torque_limit, hand.torque_limit)
                mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        if np.linalg.norm(data.qpos[12:15] - CENTRE) < 0.1:
            found.append((data.qpos.copy(), np.linalg.norm(c_scene.finger_force(model, data, hand), axis=-1)))
    return found


@pytest.fixture(scope="module")
def grips(hand):
    """By shape: the force by the solver and by the skin's law [2, n, 5] N."""
    pool = Grasp(GraspConfig(pool_size=OBJECTS * len(SHAPES)), hand).make_pool(jax.random.key(11))
    law, rng, found = c_scene.skin_law(hand, Skin()), np.random.default_rng(5), {}
    for shape in SHAPES:
        rows, held = [], []
        for row in c_scene.rows_of(pool, shape):
            levels = hold(hand, c_scene.row(pool, row), rng, law)
            held += levels
            rows += [row] * len(levels)
        qpos, force = (np.stack(x) for x in zip(*held, strict=True))
        felt = law(jnp.asarray(qpos, jnp.float32), c_scene.row(pool.object, np.array(rows)))
        found[shape] = np.stack([force, np.asarray(felt)])
    return found


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_it_follows_the_solvers_force(grips, shape):
    force, felt = grips[shape][:, grips[shape][0] > 0.01]  # of the touching fingers
    assert force.size > 150 and np.ptp(force) > 10
    assert np.corrcoef(force, felt)[0, 1] >= 0.9


@pytest.mark.slow
def test_no_finger_presses_unfelt(grips):
    """A fingertip that presses with half a newton or more compresses taxels (98 of 100)."""
    force, felt = np.concatenate([grips[shape].reshape(2, -1) for shape in SHAPES], axis=1)
    assert np.mean(felt[force > 0.5] == 0) < 0.02
