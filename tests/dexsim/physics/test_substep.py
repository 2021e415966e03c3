"""The JAX backend's own contacts and solver, against C MuJoCo's geometry and the conditions of a minimum."""

import dataclasses
import functools
import itertools

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import GRAVITY
from mujoco import mjx
from scipy.spatial.transform import Rotation

from dexsim.objects.config import SLOTS, ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.model import build_model, tip_bodies
from dexsim.physics.physics import Physics
from dexsim.physics.solver import collide, newton
from dexsim.physics.solver.substep import _spring, find_stepper

SIZES = {"sphere": "0.02", "capsule": "0.012 0.02", "box": "0.02 0.015 0.03", "cylinder": "0.02 0.025"}


def scene(first, second):
    """Two geoms and their explicit pair; C MuJoCo's exact convex collisions."""
    size = {"plane": "1 1 1"} | SIZES
    joint = "" if first == "plane" else "<freejoint/>"
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>
      <body>{joint}<geom name="a" type="{first}" size="{size[first]}" contype="0" conaffinity="0"/></body>
      <body><freejoint/><geom name="b" type="{second}" size="{size[second]}" contype="0" conaffinity="0"/></body>
      </worldbody><contact><pair geom1="a" geom2="b"/></contact></mujoco>""")
    return model, mujoco.MjData(model)


@functools.lru_cache(maxsize=1)
def compiled_touch(model):
    return jax.jit(collide.find_collider(model).touch)


def candidates(model, data):
    gap, point, normal = compiled_touch(model)(
        *(jnp.asarray(x, jnp.float32) for x in (data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), model.geom_size))
    )
    return np.asarray(gap), np.asarray(point), np.asarray(normal)


@pytest.mark.parametrize("first, second", list(itertools.product(("sphere", "capsule"), SIZES)))
def test_clearances_are_those_of_c(first, second):
    """The nearest candidate is as far away, along the same normal, as C MuJoCo's own distance has it."""
    model, data = scene(first, second)
    rng, seen = np.random.default_rng(0), 0
    for _ in range(15):
        data.qpos[:] = rng.normal(size=model.nq)
        data.qpos[:3] = 0
        data.qpos[7:10] *= 0.06 / np.linalg.norm(data.qpos[7:10])
        mujoco.mj_kinematics(model, data)
        ends = np.zeros(6)
        wanted = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, ends)
        if wanted < 1e-3:
            continue
        seen += 1
        gap, point, normal = candidates(model, data)
        near = gap.argmin()
        assert gap[near] == pytest.approx(wanted, abs=2e-5)
        way = ends[3:] - ends[:3]
        np.testing.assert_allclose(normal[near], way / np.linalg.norm(way), atol=0.02)
        # Where the two are parallel, points slide along one another without a change of distance.
        assert abs(normal[near] @ (point[near] - ends.reshape(2, 3).mean(0))) < 2e-4
    assert seen >= 8


@pytest.mark.parametrize("second", SIZES)
def test_the_palms_plane(second):
    """Every contact of C MuJoCo's with a plane, at its depth and place."""
    model, data = scene("plane", second)
    rng = np.random.default_rng(1)
    for trial in range(15):
        data.qpos[:3] = 0, 0, 0.012
        data.qpos[3:] = rng.normal(size=4) if trial > 2 else np.eye(4)[trial]
        mujoco.mj_forward(model, data)
        gap, point, normal = candidates(model, data)
        assert data.ncon
        for one in data.contact:
            away = np.linalg.norm(point - one.pos, axis=-1) + np.abs(gap - one.dist)
            if second != "cylinder" or one.dist == data.contact.dist.min():
                assert away.min() < 1e-4, (trial, one.dist, one.pos)
        assert gap.min() == pytest.approx(data.contact.dist.min(), abs=1e-5)
        np.testing.assert_allclose(normal, np.broadcast_to([0, 0, 1], normal.shape), atol=1e-6)


@pytest.mark.parametrize("second", ["box", "cylinder"])
def test_a_capsule_that_lies_on_a_face(second):
    """Two contacts at the ends of the stretch above the face, as deep as the capsule lies; on its edge one."""
    model, data = scene("capsule", second)
    half = float(SIZES[second].split()[-1])
    data.qpos[:7] = 0, 0, half + 0.011, np.sqrt(0.5), 0, np.sqrt(0.5), 0
    data.qpos[7:] = 0, 0, 0, 1, 0, 0, 0
    mujoco.mj_kinematics(model, data)
    gap, point, normal = candidates(model, data)
    np.testing.assert_allclose(gap, -0.001, atol=1e-6)
    np.testing.assert_allclose(np.sort(point[:, 0]), [-0.02, 0.02], atol=1e-4)
    np.testing.assert_allclose(normal, [[0, 0, -1]] * 2, atol=1e-5)
    data.qpos[3:7] = np.cos(0.6), 0, np.sin(0.6), 0
    mujoco.mj_kinematics(model, data)
    assert np.sum(candidates(model, data)[0] < 0.0) == 1


def test_a_capsule_on_a_box():
    """Every contact of C MuJoCo's, at its depth and place: leaning, across edges, at corners and flat on a face."""
    model, data = scene("capsule", "box")
    rng, counts = np.random.default_rng(0), [0, 0, 0]
    for trial in range(700):
        data.qpos[:] = rng.normal(size=model.nq)
        data.qpos[:3] = 0
        data.qpos[7:10] *= rng.uniform(0.015, 0.045) / np.linalg.norm(data.qpos[7:10])
        if trial % 3 == 0:  # hardly leaning: where a second contact matters most
            data.qpos[3:7] = np.sqrt(0.5), *np.eye(3)[trial % 2] * np.sqrt(0.5)
            data.qpos[10:] = 1, *rng.normal(size=3) * 0.015
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        gap, point, normal = candidates(model, data)
        wanted = [c for c in data.contact if c.dist < 0]
        if wanted and min(c.dist for c in wanted) < -0.008:
            continue  # nothing sinks in as deep
        mine = gap < 0
        assert mine.sum() == len(wanted), (trial, gap, [c.dist for c in wanted])
        counts[len(wanted)] += 1
        for c in wanted:
            away = np.linalg.norm(point[mine] - c.pos, axis=-1) + np.abs(gap[mine] - c.dist)
            assert away.min() < 2e-5, (trial, c.dist, gap)
            np.testing.assert_allclose(normal[mine][away.argmin()], c.frame[:3], atol=2e-3)
    assert min(counts) > 40, counts


def test_gradients_go_through_a_capsule_on_a_box():
    """The depth's slope along a shift is minus its normal, also where the capsule is parallel to edges."""
    model, data = scene("capsule", "box")
    data.qpos[:7] = 0, 0, 0.041, np.sqrt(0.5), 0, np.sqrt(0.5), 0
    data.qpos[7:] = 0, 0, 0, 1, 0, 0, 0
    mujoco.mj_kinematics(model, data)
    position, rotation = jnp.asarray(data.geom_xpos, jnp.float32), jnp.asarray(data.geom_xmat.reshape(-1, 3, 3))
    touch = collide.find_collider(model).touch
    gap = lambda shift: touch(position.at[0].add(shift), rotation, jnp.asarray(model.geom_size))[0]  # noqa: E731
    slope = jax.jit(jax.jacrev(gap))(jnp.zeros(3))
    np.testing.assert_allclose(slope, [[0, 0, 1]] * 2, atol=1e-5)


PALM, CUBE = np.array([0.02, 0.0455, 0.0535]), np.array([0.0275, 0.0275, 0.0275])


@pytest.fixture(scope="module")
def boxes():
    """A palm and a cube; C MuJoCo's own contacts of boxes, not its convex ones."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option><flag nativeccd="disable"/></option><worldbody>
      <body><freejoint/><geom name="a" type="box" size="{" ".join(map(str, PALM))}" contype="0" conaffinity="0"/></body>
      <body><freejoint/><geom name="b" type="box" size="{" ".join(map(str, CUBE))}" contype="0" conaffinity="0"/></body>
      </worldbody><contact><pair geom1="a" geom2="b"/></contact></mujoco>""")
    touch = jax.jit(collide.find_collider(model).touch)

    def meet(place, turn, stand):
        """Contacts of C and ours: depths, points and normals of what overlaps; the palm stands anywhere."""
        data = mujoco.MjData(model)
        data.qpos[:3], data.qpos[3:7] = stand.apply([0.1, -0.2, 0.3]), np.roll(stand.as_quat(), 1)
        data.qpos[7:10] = stand.apply(np.array([0.1, -0.2, 0.3]) + place)
        data.qpos[10:] = np.roll((stand * turn).as_quat(), 1)
        mujoco.mj_forward(model, data)
        gap, point, normal = (
            np.asarray(x)
            for x in touch(
                *(
                    jnp.asarray(x, jnp.float32)
                    for x in (data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), model.geom_size)
                )
            )
        )
        mine = gap < 0
        frames = data.geom_xmat.reshape(2, 3, 3)
        found = data.contact.dist, data.contact.pos, data.contact.frame[:, :3]
        return found, (gap[mine], point[mine], normal[mine]), frames

    return meet


def test_a_cube_on_a_box(boxes):
    """Where C MuJoCo has a face's normal: as many contacts, as deep, at the same places, over the edges as well."""
    rng, counts = np.random.default_rng(0), []
    for trial in range(150):
        # Flat, turned, leaning a little or much; on the face, over one edge or two, or clear of all.
        lean = rng.normal(size=3) * [2.0, *[(0.0, 0.05, 0.5)[trial % 3]] * 2]
        place = [PALM[0] + CUBE[0] + rng.uniform(-0.003, 0.002), *rng.uniform(-1, 1, 2) * [0.075, 0.085]]
        stand = Rotation.random(random_state=trial) if trial % 2 else Rotation.identity()
        (depth, point, normal), (gap, mine, ours), frames = boxes(place, Rotation.from_rotvec(lean), stand)
        if not len(depth):
            assert not len(gap), trial
            continue
        along = np.abs(np.einsum("k,bkj->bj", normal[0], frames)).max()
        if along < 1 - 1e-10 or depth.min() > -1e-5:
            continue  # Two edges cross, or hardly touch.
        counts.append(len(depth))
        assert len(gap) == len(depth), trial
        for d, p in zip(depth, point, strict=True):
            assert (np.linalg.norm(mine - p, axis=-1) + np.abs(gap - d)).min() < 1e-4, (trial, d, p)
        np.testing.assert_allclose(ours, np.broadcast_to(normal[0], ours.shape), atol=1e-4)
    assert len(counts) > 40 and {1, 2, 3, 4, 5} <= set(counts), counts


def test_boxes_whose_edges_cross(boxes):
    """As C MuJoCo has it, or by faces which overlap hardly more."""
    rng, by_faces, by_edges = np.random.default_rng(1), 0, 0
    for trial in range(1500):
        turn = Rotation.from_rotvec(rng.normal(size=3) * [2.0, 0.5, 0.5])
        place = [PALM[0] + rng.uniform(1.2, 1.6) * CUBE[0], *rng.uniform(-1, 1, 2) * [0.06, 0.07]]
        (depth, point, normal), (gap, mine, ours), frames = boxes(place, turn, Rotation.identity())
        assert bool(len(depth)) == bool(len(gap)), trial
        if len(depth) != 1 or np.abs(np.einsum("k,bkj->bj", normal[0], frames)).max() > 1 - 1e-10:
            continue
        if np.abs(np.einsum("k,bkj->bj", ours[0], frames)).max() > 1 - 1e-5:
            if depth[0] > -0.001:  # Nothing sinks in deeper here.
                by_faces += 1
                assert depth[0] + 1e-4 > gap.min() > depth[0] - 0.0005, (trial, depth, gap)
                assert ours[gap.argmin()] @ normal[0] > 0.8
        else:
            by_edges += 1
            np.testing.assert_allclose(gap, depth, atol=1e-5)
            np.testing.assert_allclose(mine, point, atol=1e-4)
            np.testing.assert_allclose(ours, normal, atol=1e-3)
    assert by_edges > 50, (by_faces, by_edges)


def problem(rng, contacts=6, dofs=10):
    root = rng.normal(size=(dofs, dofs))
    weight = 10 ** rng.uniform(-1, 1, (contacts, 1)) * [1.0, 20.0, 20.0]
    friction = rng.uniform(0.3, 1.2, (contacts, 1))
    rows = newton.Rows(
        jacobian=rng.normal(size=(contacts, 3, dofs)),
        reference=rng.normal(size=(contacts, 3)) * [3, 0.3, 0.3],
        weight=weight,
        scale=friction * [20**-0.5, 1.0, 1.0],
        limit_side=rng.choice([-1.0, 1.0], dofs),
        limit_reference=rng.normal(size=dofs),
        limit_weight=rng.uniform(0, 1, dofs) * (rng.random(dofs) < 0.5),
    )
    args = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), rows)
    return rows, args, (root @ root.T + np.eye(dofs)).astype(np.float32), rng.normal(size=dofs).astype(np.float32)


def test_the_solver_ends_where_forces_balance():
    """M a = f + J' c + limits, with contact forces inside their cones."""
    solve = jax.jit(
        lambda rows, mass, force: newton.solve(rows, mass, force, jnp.zeros_like(force), iterations=30, line_search=10)
    )
    rng, sticking, sliding = np.random.default_rng(2), 0, 0
    for _ in range(20):
        rows, args, mass, force = problem(rng)
        found = np.asarray(solve(args, mass, force), float)
        press = np.asarray(newton.contact_force(args, jnp.asarray(found, jnp.float32)), float)
        limit = -rows.limit_weight * np.minimum(rows.limit_side * found - rows.limit_reference, 0) * rows.limit_side
        balance = mass @ found - force - np.einsum("civ,ci->v", rows.jacobian, press) - limit
        scale = np.abs(mass @ found).max() + np.abs(press).max()
        assert np.abs(balance).max() < 2e-3 * scale
        friction = rows.scale[:, 1]
        slide = np.linalg.norm(press[:, 1:], axis=-1)
        assert np.all(press[:, 0] >= -1e-5) and np.all(slide <= friction * press[:, 0] * 1.001 + 1e-5)
        miss = np.einsum("civ,v->ci", rows.jacobian, found) - rows.reference
        stuck = (press[:, 0] > 0) & (slide < 0.99 * friction * press[:, 0])
        np.testing.assert_allclose(press[stuck], (-rows.weight * miss)[stuck], rtol=1e-3, atol=1e-3)
        sticking, sliding = sticking + stuck.sum(), sliding + np.sum((press[:, 0] > 1e-3) & ~stuck)
    assert sticking > 10 and sliding > 10


def test_a_solved_start_stays():
    """The search along a step of no length keeps where it is, even to the last digit of float32."""
    _, args, mass, force = problem(np.random.default_rng(3))
    once = newton.solve(args, mass, force, jnp.zeros_like(force), iterations=20, line_search=6)
    again = newton.solve(args, mass, force, once, iterations=20, line_search=6)
    np.testing.assert_allclose(again, once, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_gradients_go_through_the_solver():
    """Reverse mode agrees with a difference quotient of the force."""
    _, args, mass, force = problem(np.random.default_rng(4))
    probe = lambda f: jnp.sum(newton.solve(args, mass, f, jnp.zeros_like(f), iterations=12, line_search=6))  # noqa: E731
    slope = jax.grad(probe)(jnp.asarray(force))
    step = 1e-2 * jnp.eye(len(force))[0]
    quotient = (probe(force + step) - probe(force - step)) / 2e-2
    assert slope[0] == pytest.approx(float(quotient), rel=0.05, abs=5e-3)


def test_other_cones_and_springs_are_left_to_mjx(hand):
    model = build_model(hand, SLOTS, ObjectConfig().largest, PhysicsConfig(), GRAVITY, "jax")
    tips = tip_bodies(model, hand)
    assert find_stepper(mjx, model, tips, max_contacts=20) is not None
    model.pair_dim[0] = 4
    assert find_stepper(mjx, model, tips, max_contacts=20) is None
    model.pair_dim[0] = 3
    for field in (model.pair_gap, model.pair_solreffriction):
        field[0] = 1e-3
        assert find_stepper(mjx, model, tips, max_contacts=20) is None
        field[0] = 0
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert find_stepper(mjx, model, tips, max_contacts=20) is None


@pytest.mark.slow
def test_mjx_step_agrees(hand, grasp_env):
    """Both ways through a sub-step, converged, with capsules in closing hands: one answer."""
    one = SLOTS.index("capsule")
    worlds, rng = 4, np.random.default_rng(5)
    starts = [c_scene.row(grasp_env.pool, i) for i in c_scene.rows_of(grasp_env.pool, "capsule")[:worlds]]
    begun = [c_scene.squeeze(hand, start, rng) for start in starts]
    qpos, qvel, warmstart, torque = (jnp.stack(x) for x in list(zip(*begun, strict=True))[1:])
    target = c_scene.stack([start.object for start in starts])
    alone = dataclasses.replace(
        target,
        kinds=("capsule",),
        **{name: getattr(target, name)[:, one : one + 1] for name in ("size", "position", "active")},
    )
    found = []
    for contacts in ("closed", "mjx"):
        physics = Physics(
            hand,
            ("capsule",),
            ObjectConfig().largest[one : one + 1],
            PhysicsConfig(substeps=1, contacts=contacts, **c_scene.CONVERGED),
            gravity=GRAVITY,
            backend="jax",
        )
        found.append(
            jax.jit(
                jax.vmap(
                    lambda target, state, torque, physics=physics: physics.advance(
                        lambda *_: torque, target, state, jnp.zeros(3)
                    )
                )
            )(alone, PhysicsState(qpos, qvel, warmstart), torque)
        )
    (ours, our_force), (theirs, force) = found
    assert np.sum(np.linalg.norm(force, axis=-1).max(-1) > 0.5) >= 3
    np.testing.assert_allclose(our_force, force, atol=0.02)
    np.testing.assert_allclose(ours.qvel, theirs.qvel, atol=5e-3)
    np.testing.assert_allclose(ours.qpos, theirs.qpos, atol=3e-5)


@pytest.mark.parametrize("power", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("middle", [0.3, 0.5])
def test_the_impedance_rises_as_in_the_documentation(middle, power):
    """From low to high over the width, through the mean share `middle` at depth `middle`, without a step."""
    low, high, width = 0.6, 0.95, 0.01
    share = jnp.array([0.0, middle - 1e-4, middle, middle + 1e-4, 0.5 + 0.5 * middle, 1.0, 2.0])
    solimp = jnp.broadcast_to(jnp.array([low, high, width, middle, power]), (len(share), 5))
    solref = jnp.broadcast_to(jnp.array([-100.0, -10.0]), (len(share), 2))
    impedance = np.asarray(_spring(solref, solimp, -share * width, 0.002)[2])
    deep = np.minimum(np.asarray(share), 1.0)
    wanted = np.where(
        deep < middle,
        deep**power / middle ** (power - 1),
        1 - (1 - deep) ** power / (1 - middle) ** (power - 1),
    )
    np.testing.assert_allclose(impedance, low + wanted * (high - low), rtol=1e-5)
    assert impedance[1] == pytest.approx(impedance[3], abs=1e-3)  # no step at the middle
