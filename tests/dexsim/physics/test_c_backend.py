"""The C backend against closed forms and a second scene in C MuJoCo; its calls from XLA; rubber of any thickness."""

import dataclasses
import functools
import os
import signal
import subprocess
import sys

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import GRAVITY, row, rows_of, squeeze, stack
from paths import ROOT
from tiny_env import assert_same

from dexsim.objects.config import SHAPES, SLOTS, ObjectConfig
from dexsim.physics import c_backend, model as scene_model
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState, configured
from dexsim.physics.physics import Physics

WORLDS = 8


def make(hand, cover=0.003, **changes):
    config = PhysicsConfig(**changes)
    return Physics(hand, SLOTS, ObjectConfig().largest, config, gravity=GRAVITY, backend="c", pad_thickness=cover)


def hold(index, position, velocity):
    """Keeps the hand flat."""
    return -3.0 * position - 0.1 * velocity


@pytest.fixture(scope="module")
def physics(hand):
    return make(hand)


@pytest.fixture(scope="module")
def one_step(hand):
    """One sub-step of a batch under given torques, the solver converged."""
    physics = make(hand, substeps=1, iterations=50)
    return jax.jit(
        jax.vmap(lambda t, state, torque, push: physics.advance(lambda *_: torque, physics.fields(t), state, push))
    )


@pytest.fixture(scope="module")
def tick(physics):
    return jax.jit(jax.vmap(lambda target, state, push: physics.advance(hold, physics.fields(target), state, push)))


@pytest.fixture(scope="module")
def grips(hand, grasp_env):
    """(start, model, qpos, qvel, warm start, torque) of 8 squeezed hands of each shape."""
    rng = np.random.default_rng(0)
    starts = [row(grasp_env.pool, i) for shape in SHAPES for i in rows_of(grasp_env.pool, shape)[:WORLDS]]
    return [(start, *squeeze(hand, start, rng)) for start in starts]


def batch_of(grips):
    """Object, state and torque of some grips."""
    starts, _, qpos, qvel, warmstart, torque = zip(*grips, strict=True)
    state = PhysicsState(*(np.stack(x) for x in (qpos, qvel, warmstart)))
    return stack([start.object for start in starts]), state, np.stack(torque)


class TestForces:
    def test_a_sub_step_equals_one_of_a_scene_that_is_compiled_anew(self, hand, one_step, grips):
        """All shapes. The other scene has the object's true offsets, masses and primitives from the start."""
        target, state, torque = batch_of(grips)
        after, force = one_step(target, state, torque, jnp.zeros((len(grips), 3)))
        touched = 0
        for index, (start, _, *begun, applied) in enumerate(grips):
            data, expected = c_scene.step(hand, start.object, begun, applied, exact=True)
            touched += np.linalg.norm(expected, axis=-1).max() > 0.5
            np.testing.assert_allclose(force[index], expected, atol=2e-3 + 1e-4 * np.abs(expected).max())
            np.testing.assert_allclose(after.qvel[index], data.qvel, atol=1e-3)
            np.testing.assert_allclose(after.qpos[index], data.qpos, atol=1e-5)
        assert touched > len(grips) / 2, "hardly a world is in contact: the test tests nothing"

    def test_the_default_iterations_are_enough(self, hand, one_step, grips):
        """From a cold start."""
        physics = make(hand, substeps=1)
        step = jax.jit(
            jax.vmap(lambda t, s, torque: physics.advance(lambda *_: torque, physics.fields(t), s, jnp.zeros(3)))
        )
        target, state, torque = batch_of(grips)
        state = dataclasses.replace(state, warmstart=0 * state.warmstart)
        _, force = step(target, state, torque)
        _, expected = one_step(target, state, torque, jnp.zeros((len(grips), 3)))
        np.testing.assert_allclose(force, expected, atol=0.1)


def test_an_object_slides_on_the_palm_as_in_a_second_scene_and_as_coulomb_says(hand, tick, grips):
    """A box at 0.6 m/s over a level palm. What slows it is the friction times the impulse of the palm, which weight and
    bounce give; the fingertips' friction has no part in it."""
    friction, velocity = 0.3, np.zeros(18, np.float32)
    given = grips[WORLDS * SHAPES.index("box")][0].object
    box = dataclasses.replace(given, friction=np.float32(1.1), link_friction=np.float32(friction), com=0 * given.com)
    pose, velocity[13:15] = np.float32([0.02 + box.size[0, 0], -0.02, 0.09, 1, 0, 0, 0]), (0.36, -0.48)
    state = stack([PhysicsState(np.append(np.zeros(12, np.float32), pose), velocity, 0 * velocity)])
    model = c_scene.compile_scene(hand, box, **c_scene.CONVERGED)
    model.opt.gravity[:] = -model.opt.gravity
    data = c_scene.start(model, state.qpos[0], velocity)
    push = -2 * box.mass * np.float32([GRAVITY])  # The engine's scene has the palm above.
    for k in range(1, 10):
        data.qpos[:12] = data.qvel[:12] = 0
        mujoco.mj_step(model, data)
        if k % 3 == 0:
            state, _ = tick(stack([box]), state, push)
            np.testing.assert_allclose(state.qvel[0, 12:], data.qvel[12:], atol=1e-3)
    impulse = 9.81 * data.time + data.qvel[12]
    assert np.linalg.norm(state.qvel[0, 13:15]) == pytest.approx(0.6 - friction * impulse, abs=1e-3)


def test_batches_of_any_size_and_order_loops_and_scans_give_the_same_bits(physics, tick, grips):
    target, state, _ = batch_of(grips[:4])
    push = np.zeros((4, 3), np.float32)
    whole = jax.device_get(tick(target, state, push))
    for rows in (np.array([2]), np.array([3, 1, 0])):
        part = jax.tree.map(lambda x, rows=rows: x[rows], (target, state, push))
        assert_same(tick(*part), jax.tree.map(lambda x, rows=rows: x[rows], whole))
    one = jax.tree.map(lambda x: x[3], (target, state))
    single = jax.jit(lambda t, s: physics.advance(hold, physics.fields(t), s, jnp.zeros(3)))(*one)
    assert_same(single, jax.tree.map(lambda x: x[3], whole))
    square = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), (target, state, push))
    nested = jax.jit(jax.vmap(jax.vmap(lambda t, s, p: physics.advance(hold, physics.fields(t), s, p))))(*square)
    nested = jax.device_get(nested)
    assert_same(jax.tree.map(lambda x: x.reshape(4, *x.shape[2:]), nested), whole)
    scanned, _ = jax.jit(lambda s: jax.lax.scan(lambda s, _: (tick(target, s, push)[0], None), s, length=3))(state)
    for _ in range(3):
        state = tick(target, state, push)[0]
    assert_same(scanned, state)


class TestTrouble:
    def test_a_world_that_diverges_is_marked(self, tick, grips):
        target, state, _ = batch_of(grips[:4])
        state.qpos[1, 3], state.qvel[2, 14] = np.nan, 1e12
        force = np.asarray(tick(target, state, jnp.zeros((4, 3)))[1])
        assert np.isnan(force).any((1, 2)).tolist() == [False, True, True, False]

    def test_full_memory_is_an_error(self, hand, grips, monkeypatch):
        """MuJoCo drops contacts that do not fit, with a warning that no one sees; with less room its solver stops."""
        options = scene_model._set_options

        def cramped(spec, *given):
            options(spec, *given)
            spec.memory = 40_000

        monkeypatch.setattr(scene_model, "_set_options", cramped)
        target, state, _ = batch_of(grips)
        physics = make(hand)
        tick = jax.jit(jax.vmap(lambda t, s: physics.advance(hold, physics.fields(t), s, jnp.zeros(3))))
        with pytest.raises(jax.errors.JaxRuntimeError, match="<size memory"):
            jax.block_until_ready(tick(target, state))

    def test_a_forked_process_says_so(self, tick, grips, monkeypatch):
        given = (*batch_of(grips[:4])[:2], jnp.zeros((4, 3)))
        jax.block_until_ready(tick(*given))
        monkeypatch.setattr(c_backend.os, "getpid", lambda: -1)
        with pytest.raises(jax.errors.JaxRuntimeError, match="spawn"):
            jax.block_until_ready(tick(*given))


# --- calls from compiled programs, each in a process of its own: one core, Ctrl-C ---

PROGRAM = """
import os, jax, jax.numpy as jnp, dexsim
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
env = dexsim.make("grasp", backend="c")
state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))

@jax.jit
def ticks(state):
    def body(state, _):
        # Work for XLA's own threads between the calls.
        work = jnp.sum(jnp.sin(jnp.ones((300, 300)) @ jnp.ones((300, 300))))
        return jax.vmap(env.step)(state, jnp.zeros((64, 12)) + 0.0 * work), None
    return jax.lax.scan(body, state, length=10)[0]

flights = [state] * 4
for _ in range(3):
    flights = [ticks(state) for state in flights]
jax.block_until_ready(flights)
try:
    print("running", flush=True)  # From here on a signal must be caught.
    while True:
        state = ticks(state)
        jax.block_until_ready(state)
except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
    print("stopped", type(error).__name__, flush=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system cannot bind a process to cores")
def test_programs_in_flight_do_not_block_each_other_and_ctrl_c_ends_them():
    """With asynchronous dispatch, as many programs as fit wait for the host on one core."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT
    )
    assert process.stdout.readline() == "running\n"
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=300)
    assert out.startswith("stopped") and process.returncode == 0


# --- fingertips as thick as their episode has them, and fingers that do not pass through each other ---

THICK, THIN = 0.003, 0.001


@pytest.fixture(scope="module")
def scenes(hand):
    """{thickness compiled in: scene} on C MuJoCo."""
    return {cover: make(hand, cover) for cover in (THICK, THIN, 0.0)}


@pytest.fixture(scope="module")
def grip(grips):
    """(object, state, torque) of a squeezed box."""
    start, _, *state, torque = grips[WORLDS * SHAPES.index("box")]
    return start.object, PhysicsState(*map(jnp.asarray, state)), torque


@pytest.mark.parametrize(("change", "compiled"), [(THIN - THICK, THIN), (-THICK, 0.0), (-0.01, 0.0)])
def test_a_thickness_drawn_is_a_thickness_compiled(scenes, grip, change, compiled):
    """Less than no rubber is no rubber."""
    object, state, torque = grip

    @functools.cache
    def advance(cover):
        physics, motors = scenes[cover], lambda *_: jnp.asarray(torque)
        return jax.jit(lambda delta: physics.advance(motors, physics.fields(object, None, delta), state, jnp.zeros(3)))

    (drawn, force), (expected, pressed) = advance(THICK)(change), advance(compiled)(0.0)
    np.testing.assert_allclose(force, pressed, atol=2e-3)
    np.testing.assert_allclose(drawn.qpos, expected.qpos, atol=1e-5)
    plain = advance(THICK)(0.0)[1]
    assert np.abs(plain - force).max() > 0.5, "the rubber makes no difference: the test tests nothing"


def configure(physics, object, delta):
    return configured(physics.scene, physics.fields(object, None, delta))


def test_thick_rubber_is_not_beyond_the_broad_phase(scenes, grip):
    """C MuJoCo leaves out contacts of geoms whose bounding spheres are apart."""
    model, given = scenes[THIN].mj_model, jax.jit(lambda: configure(scenes[THIN], grip[0], THICK - THIN))()
    size, around = np.asarray(given["geom_size"]), np.asarray(given["geom_rbound"])
    tips = [g for g in range(model.ngeom) if "_pad" in model.geom(g).name and model.geom(g).name[-1].isdigit()]
    assert len(tips) == 6 * 3 and np.all(size[tips, 0] > model.geom_size[tips, 0] + 1e-3)
    np.testing.assert_allclose(around[tips], size[tips, 0], atol=1e-8)
