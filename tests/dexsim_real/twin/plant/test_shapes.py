"""Objects of the emulated hand against MuJoCo's geometry."""

import jax
import mujoco
import numpy as np
import pytest

from dexsim.hand.load import load_hand
from dexsim.registry import TASKS
from dexsim.tasks.rotate.start import sample_turned_object
from dexsim_real.twin.plant import scene, shapes
from dexsim_real.twin.plant.parameters import sample_trial, start_of
from dexsim_real.twin.plant.shapes import ObjectShape, Primitive


@pytest.mark.parametrize(
    "part",
    [
        Primitive("sphere", (0.03,)),
        Primitive("box", (0.02, 0.03, 0.025)),
        Primitive("cylinder", (0.02, 0.03), (0.01, 0.0, 0.0)),
        Primitive("capsule", (0.015, 0.02)),
        Primitive("cylinder", (0.02, 0.03), (0.0, 0.01, 0.0), (0.6, 0.0, 0.8, 0.0)),
        Primitive("box", (0.02, 0.03, 0.025), (0.0, 0.0, 0.01), (0.5, 0.1, 0.7, 0.5)),
    ],
)
def test_distances_agree_with_mujoco(part):
    spec = mujoco.MjSpec()
    scene.add_object(spec, ObjectShape("x", (part,)))
    points = np.random.default_rng(1).uniform(-0.06, 0.06, (200, 3))
    for point in points:  # the geoms before the object's
        spec.worldbody.add_geom(size=[1e-5, 0, 0], pos=point)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:3] = 0.0
    mujoco.mj_kinematics(model, data)
    ours = ObjectShape("x", (part,)).distance(points)
    theirs = np.array([mujoco.mj_geomDistance(model, data, 200, k, 1.0, np.zeros(6)) + 1e-5 for k in range(200)])
    outside = theirs > 1e-3
    assert ours[outside] == pytest.approx(theirs[outside], abs=1e-5)
    assert np.all((ours < 0) == (theirs < 0))
    along = np.array([0.6, 0.0, 0.8])
    fine = np.random.default_rng(0).uniform(-0.06, 0.06, (200_000, 3))
    inside = fine[ObjectShape("x", (part,)).distance(fine) < 0]
    assert ObjectShape("x", (part,)).reach(along) == pytest.approx((inside @ along).max(), abs=3e-3)


@pytest.mark.parametrize("task", ["rotate", "rotate_any", "rotate_clear"])
def test_faces_lie_in_the_frame_of_the_object_as_in_training(task):
    """The policy sees this frame: cubes that stood otherwise in it did not turn."""
    trained = sample_turned_object(jax.random.key(0), TASKS[task].config())
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(trained.kinds), 1)) if trained.quat is None else np.asarray(trained.quat)
    axis, parameters = start_of(load_hand(), task).axis, sample_trial(task, np.random.default_rng(0))
    for k in range(10):
        (part,) = shapes.sample_shape(parameters, np.random.default_rng(k), None, axis).parts
        assert part.quat == pytest.approx(quats[trained.kinds.index(part.kind)], abs=1e-6)
