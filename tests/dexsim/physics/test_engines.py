"""Engine `mjx` in a grip and in a slip against C MuJoCo, and its gradients through contacts.

`c` has grips of all shapes in `test_c_backend`, `cuda` in an emulated warp (`test_cuda_kernel`) and on a GPU
(`test_on_gpu`).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import DATA
from two_fingers import write

from dexsim.core.compilation import jit
from dexsim.hand.load import load_hand
from dexsim.objects.params import ObjectParams
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.physics import Physics

SIZE = np.float32([[0.02, 0.03, 0]])
POSE = jnp.array([0.003, 0.002, 0.008, 0, 0, 0.05, 1, 0, 0, 0])  # joint b is beyond its limit
SPEED = jnp.array([0.1, 0.07, 0.05, 0.02, 0.01, -0.03, 0.4, -0.2, 0.3])
OBJECT = ObjectParams(
    shape_index=jnp.int32(0),
    size=jnp.asarray(SIZE),
    position=jnp.zeros((1, 3)),
    active=jnp.ones(1, bool),
    mass=jnp.float32(0.1),
    inertia=jnp.array([5e-5, 5e-5, 2e-5]),
    com=jnp.zeros(3),
    friction=jnp.float32(0.0),
    link_friction=jnp.float32(0.0),
    contact=jnp.array([1700.0, 1.0]),
    kinds=("capsule",),
)
WEIGHT = jnp.asarray(np.random.default_rng(0).normal(size=15), jnp.float32)


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    """Two fingers around a capsule."""
    layout = "a,0,0,0,-.01,.025,0,-1,0,1e-5\nb,0,0,0,.01,.05,0,1,0,1e-5\n"
    return load_hand(write(tmp_path_factory.mktemp("two"), (DATA / "pinch.xml").read_text(), layout))


def outcome_on(hand, backend):
    """Velocities and fingertip forces [15] after a tick, by targets [2] of the joints, friction and mass."""
    physics = Physics(hand, ("capsule",), SIZE, PhysicsConfig(substeps=2), gravity=(9.81, 0, 0), backend=backend)

    def outcome(x):
        target = x[:2]

        def law(substep, position, velocity):
            return 2.0 * (target - position) - 0.05 * velocity

        held = dataclasses.replace(OBJECT, friction=x[2], mass=x[3])
        result = physics.advance(law, physics.fields(held), PhysicsState(POSE, SPEED, jnp.zeros(9)), jnp.zeros(3))
        return jnp.concatenate([result.state.qvel, result.finger_force.ravel()])

    return outcome


@pytest.fixture(scope="module")
def linearized(hand):
    """Outcome [15] and its change along a direction [4]: one compilation."""
    outcome = outcome_on(hand, "mjx")
    return jit(lambda x, way: jax.jvp(outcome, (x,), (way,)), once=True)


@pytest.fixture(scope="module", params=[0.9, 0.1], ids=["grip", "slip"])
def moment(request):
    """Targets, friction and mass [4]."""
    return np.float32([0.06, 0.08, request.param, 0.1])


def test_a_grip_and_a_slip_are_c_mujocos(hand, linearized, moment):
    expected, (found, _) = jax.jit(outcome_on(hand, "c"))(moment), linearized(moment, 0 * moment)
    assert np.abs(expected[9:]).max() > 0.5, "the object is not touched"
    np.testing.assert_allclose(found[:9], expected[:9], atol=5e-3)
    np.testing.assert_allclose(found[9:], expected[9:], atol=0.02)


def test_gradients_in_a_pinch_are_finite_differences(linearized, moment):
    for way in np.diag(np.float32([0.01, 0.01, 0.02, 0.002])):
        (ahead, _), (behind, _) = linearized(moment + way, way), linearized(moment - way, way)
        slope = WEIGHT @ linearized(moment, way)[1]
        np.testing.assert_allclose(slope, WEIGHT @ (ahead - behind) / 2, rtol=0.01, atol=1e-3 * way.max())
    _, slope = linearized(moment, np.float32([0, 0, 1, 0]))
    assert (abs(WEIGHT @ slope) > 1e-6) == (moment[2] < 0.5), "contacts feel friction where they slip"


@pytest.mark.slow
def test_reverse_mode_agrees_with_forward_mode(hand, linearized, moment):
    outcome = outcome_on(hand, "mjx")
    reverse = jit(lambda x: jax.vjp(outcome, x)[1](WEIGHT)[0], once=True)(moment)
    forward = [WEIGHT @ linearized(moment, way)[1] for way in np.eye(4, dtype=np.float32)]
    np.testing.assert_allclose(reverse, forward, rtol=1e-3, atol=1e-5)
