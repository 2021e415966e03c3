"""Physics on the JAX backend against C MuJoCo, and the guard against what it would drop."""

import dataclasses
import shutil
import types
from types import SimpleNamespace
from typing import NamedTuple

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import CONVERGED, GRAVITY, row, rows_of, squeeze, stack
from mujoco import mjx

from dexsim.core import compilation
from dexsim.core.errors import AssetError, ConfigError
from dexsim.hand.load import load_hand
from dexsim.objects.config import SHAPES, SLOTS, ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.guard import check_model
from dexsim.physics.interface import PhysicsState
from dexsim.physics.model import build_model
from dexsim.physics.physics import Physics, choose_backend
from dexsim.physics.warp_backend import constraint_rows

WORLDS = 8
# rad/s, by joint and object. Where index and middle finger lie along each other, C MuJoCo has one contact; here, one at
# each end of the stretch turns the index finger.
SWING = np.where(np.arange(18) == 3, 2e-2, 5e-3)


class Steps(NamedTuple):
    """The same sub-step in both engines, over worlds [W]."""

    velocity: np.ndarray  # [W, J + 6] JAX
    position: np.ndarray
    force: np.ndarray  # [W, F, 3]
    c_velocity: np.ndarray
    c_position: np.ndarray
    c_force: np.ndarray


@pytest.fixture(scope="module")
def contact_steps(hand, grasp_env, physics_advance):
    """By shape: a sub-step from 8 squeezed states, most of them in contact."""
    rng, found = np.random.default_rng(0), {}
    for shape in SHAPES:
        starts = [row(grasp_env.pool, i) for i in rows_of(grasp_env.pool, shape)[:WORLDS]]
        begun = [squeeze(hand, start, rng) for start in starts]
        qpos, qvel, warmstart, torque = (jnp.stack(x) for x in list(zip(*begun, strict=True))[1:])
        after, force = physics_advance(
            stack([s.object for s in starts]), PhysicsState(qpos, qvel, warmstart), torque, jnp.zeros((WORLDS, 3))
        )
        c_rows = []
        for _, (model, *state, applied) in zip(starts, begun, strict=True):
            data = c_scene.start(model, *state)
            data.qfrc_applied[:12] = applied
            mujoco.mj_step(model, data)
            c_rows.append((data.qvel, data.qpos, c_scene.finger_force(model, data, hand)))
        found[shape] = Steps(
            np.asarray(after.qvel),
            np.asarray(after.qpos),
            np.asarray(force),
            *(np.stack(x) for x in zip(*c_rows, strict=True)),
        )
    return found


def error(found):
    """Largest force error in a world, N, and the largest finger force there, N."""
    strength = np.linalg.norm(found.c_force, axis=-1).max(-1)
    return np.abs(found.force - found.c_force).max((1, 2)), strength


class TestAgainstC:
    @pytest.mark.parametrize("shape", SHAPES)
    def test_a_sub_step_in_contact(self, contact_steps, shape):
        """Contacts with all shapes and the palm's plane are where C MuJoCo has them.

        What is left is float32: contact depths of 1e-7 m under springs of some 1e4 N/m move
        forces by 1e-3 N, and velocities of 1e-5 kg m^2 links by 1e-3.
        """
        found = contact_steps[shape]
        wrong, strength = error(found)
        assert np.sum(strength > 0.5) >= 5, "hardly a world is in contact: the test tests nothing"
        assert np.all(wrong < 0.01 + 2e-3 * strength), (wrong, strength)
        apart = np.abs(found.velocity - found.c_velocity).max(0)
        assert np.all(apart < SWING), apart
        assert np.all(np.abs(found.position - found.c_position).max(0) < 0.006 * np.append(SWING, 5e-3))

    def test_every_shape_on_the_palm(self, hand, grasp_env, physics_advance):
        """Pressed against the palm's plane, whose contacts have one answer for every primitive."""
        starts = [row(grasp_env.pool, rows_of(grasp_env.pool, shape)[i]) for shape in SHAPES for i in (0, 1)]
        begun, references = [], []
        for start in starts:
            model = c_scene.compile_scene(hand, start.object, gravity=(-9.81, 0, 0), **CONVERGED)
            data = c_scene.start(model, start.qpos, 0 * start.qvel)
            data.qpos[:12], data.qpos[12] = 0, data.qpos[12] + 0.001
            for _ in range(60):
                data.qpos[:12] = data.qvel[:12] = 0
                mujoco.mj_step(model, data)
            assert {model.geom(c.geom[0]).name for c in data.contact} == {"palm_face"}
            model.opt.gravity[:] = GRAVITY
            push = np.float32(start.object.mass * np.array([-19.62, 1.0, -2.0]))
            state = [np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart)]
            data = c_scene.start(model, *state)
            data.xfrc_applied[model.body("object").id, :3] = push
            mujoco.mj_step(model, data)
            begun.append((*state, push))
            references.append((data.qpos.copy(), data.qvel.copy()))
        for part in (slice(0, WORLDS), slice(len(starts) - WORLDS, None)):
            qpos, qvel, warmstart, push = (jnp.stack(x) for x in zip(*begun[part], strict=True))
            after, force = physics_advance(
                stack([s.object for s in starts[part]]),
                PhysicsState(qpos, qvel, warmstart),
                jnp.zeros((WORLDS, 12)),
                push,
            )
            c_position, c_velocity = (np.stack(x) for x in zip(*references[part], strict=True))
            # Spin is the worst: contacts of 2 N at 3 cm turn a body of 1e-5 kg m^2.
            np.testing.assert_allclose(after.qvel[:, 12:15], c_velocity[:, 12:15], atol=1e-4)
            np.testing.assert_allclose(after.qvel[:, 15:], c_velocity[:, 15:], atol=5e-3)
            np.testing.assert_allclose(after.qpos, c_position, atol=3e-5)
            assert not np.any(force)

    def test_free_motion(self, hand, grasp_env, physics_advance):
        """1.5 s without contact: fingers under changing torques, the object on its way.

        300 sub-steps of float32 (6e-8 a step, against numbers below 10) add up to some 1e-5.
        """
        starts = [row(grasp_env.pool, rows_of(grasp_env.pool, shape)[0]) for shape in SHAPES]
        starts += starts[: WORLDS - len(starts)]
        rng = np.random.default_rng(1)
        middle = (hand.joint_lower + hand.joint_upper) / 2
        middle[:4] = 0.2, 0.0, 0.3, 0.12  # thumb and index finger clear of the others
        qpos = np.stack([s.qpos for s in starts])
        qpos[:, :12] = middle
        qpos[:, 12:15] = 3.0, -0.2, 0.5
        qvel = rng.normal(size=(WORLDS, 18)).astype(np.float32)
        models = [c_scene.compile_scene(hand, s.object, **CONVERGED) for s in starts]
        datas = [c_scene.start(m, q, v) for m, q, v in zip(models, qpos, qvel, strict=True)]
        target = stack([s.object for s in starts])
        state = PhysicsState(jnp.asarray(qpos), jnp.asarray(qvel), jnp.zeros((WORLDS, 18)))
        for step in range(300):
            swing = 0.2 * np.sin(0.03 * step + np.arange(12) + np.arange(WORLDS)[:, None])
            torque = np.float32(0.3 * (middle + swing - np.asarray(state.qpos[:, :12])))
            state, force = physics_advance(target, state, jnp.asarray(torque), jnp.zeros((WORLDS, 3)))
            for model, data, tau in zip(models, datas, torque, strict=True):
                data.qfrc_applied[:12] = tau
                mujoco.mj_step(model, data)
                assert data.ncon == 0
        assert np.ptp([d.qpos[:12] for d in datas], axis=0).max() > 1e-3  # they did move apart
        np.testing.assert_allclose(state.qpos[:, :12], [d.qpos[:12] for d in datas], atol=1e-5)
        np.testing.assert_allclose(state.qpos[:, 12:15], [d.qpos[12:15] for d in datas], rtol=1e-5)
        np.testing.assert_allclose(state.qpos[:, 15:], [d.qpos[15:] for d in datas], atol=1e-4)
        assert not np.any(force), "nothing touches, yet a finger feels a force"

    def test_a_push_is_momentum(self, grasp_env, physics_advance):
        """F dt = m dv at the centre of mass, whatever turns about it."""
        starts = [row(grasp_env.pool, i) for i in range(0, 80, 10)]
        qpos = np.stack([s.qpos for s in starts])
        qpos[:, 12] = 1.0
        state = PhysicsState(jnp.asarray(qpos), jnp.zeros((WORLDS, 18)), jnp.zeros((WORLDS, 18)))
        target = stack([s.object for s in starts])
        target = dataclasses.replace(target, com=jnp.zeros((WORLDS, 3)))
        push = np.float32(np.random.default_rng(2).normal(size=(WORLDS, 3)))
        after, _ = physics_advance(target, state, jnp.zeros((WORLDS, 12)), jnp.asarray(push))
        wanted = PhysicsConfig().timestep * (push / np.asarray(target.mass)[:, None] + np.array(GRAVITY))
        np.testing.assert_allclose(after.qvel[:, 12:15], wanted, rtol=1e-5, atol=1e-6)

    def test_forces_point_outwards(self, contact_steps):
        """A squeezed finger is pushed open: the object's force has the sign that C gives it."""
        for shape in SHAPES:
            found = contact_steps[shape]
            touching = np.linalg.norm(found.c_force, axis=-1) > 0.5
            ours, theirs = found.force[touching], found.c_force[touching]
            cosine = np.sum(ours * theirs, -1) / np.linalg.norm(theirs, axis=-1)
            cosine /= np.maximum(np.linalg.norm(ours, axis=-1), 1e-9)
            assert np.mean(cosine > 0.75) > 0.8, (shape, cosine)

    def test_the_decoding_of_contact_forces(self, hand):
        """Rows of the solver to forces on fingers, on contacts that C MuJoCo solved."""
        config = PhysicsConfig(**CONVERGED)
        physics = Physics(hand, SLOTS, ObjectConfig().largest, config, gravity=GRAVITY, backend="jax")
        model, data = pressed_template(hand, physics.mj_model)
        contacts = [c for c in data.contact if c.geom[1] in physics.scene.object_geoms]
        assert len(contacts) >= 4
        wanted = np.zeros((5, 3))
        tips = {model.body(hand.body_names[b]).id: f for f, b in enumerate(hand.tip_body)}
        for index, contact in enumerate(data.contact):
            finger = tips.get(int(model.geom_bodyid[contact.geom[0]]))
            if finger is None or contact.geom[1] not in physics.scene.object_geoms:
                continue
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, wrench)
            wanted[finger] -= contact.frame.reshape(3, 3).T @ wrench[:3]
        assert np.linalg.norm(wanted, axis=-1).max() > 1.0

        def decode(flip):
            """`flip` turns every contact round: the object first, the link second."""
            geom = np.array([c.geom for c in data.contact])
            frame = np.array([c.frame.reshape(3, 3) for c in data.contact])
            if flip:
                geom, frame = geom[:, ::-1], -frame
            column = {
                name: np.array([getattr(c, name) for c in data.contact])
                for name in ("dim", "efc_address", "friction", "dist", "includemargin")
            }
            contact = SimpleNamespace(**column, geom=geom, frame=jnp.asarray(frame))
            impl = SimpleNamespace(contact=contact, efc_force=jnp.asarray(data.efc_force))
            return np.asarray(physics.engine.finger_force(SimpleNamespace(_impl=impl)))

        np.testing.assert_allclose(decode(flip=False), wanted, atol=1e-4)
        np.testing.assert_allclose(decode(flip=True), wanted, atol=1e-4)

    def test_the_sensors_of_the_warp_scene(self, hand):
        """The other backend's reader: minus the net-force sensors is the force on the fingers."""
        model = build_model(hand, SLOTS, ObjectConfig().largest, PhysicsConfig(), GRAVITY, "warp")
        model, data = pressed_template(hand, model)
        force = c_scene.finger_force(model, data, hand)
        assert np.linalg.norm(force, axis=-1).max() > 1.0
        np.testing.assert_allclose(-data.sensordata.reshape(5, 3), force, atol=1e-6)


def pressed_template(hand, model):
    """Fingers that press on the template object (all its primitives at once), which is held."""
    data = mujoco.MjData(model)
    place = 0.055, -0.005, 0.09, 1, 0, 0, 0
    for _ in range(200):
        data.qpos[12:], data.qvel[12:] = place, 0
        data.qfrc_applied[:12] = 0.3 * hand.torque_limit
        mujoco.mj_step(model, data)
    data.qpos[12:], data.qvel[12:] = place, 0
    mujoco.mj_forward(model, data)
    return model, data


class TestConstruction:
    def test_backends(self, monkeypatch):
        assert choose_backend("jax") == "jax"
        with pytest.raises(ConfigError, match="'metal'.*auto, jax, cuda, warp, c"):
            choose_backend("metal")
        monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
        assert choose_backend("auto") == choose_backend("c") == "c"
        with pytest.raises(ConfigError, match=r"'cuda' needs an NVIDIA GPU.*pip install .*\[cuda\]"):
            choose_backend("cuda")
        monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
        assert choose_backend("auto") == "jax"
        monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        for runtime, chosen in (("rocm 60300", "jax"), ("cuda 13000", "cuda")):
            device = types.SimpleNamespace(client=types.SimpleNamespace(platform_version=runtime))
            monkeypatch.setattr(jax, "devices", lambda device=device: [device])
            assert choose_backend("auto") == chosen
        with pytest.raises(ConfigError, match=r"needs the extra: pip install .*\[warp\]"):
            choose_backend("warp")
        monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
        assert choose_backend("warp") == "warp"
        with pytest.raises(ConfigError, match="JAX_PLATFORMS=cpu"):
            choose_backend("c")
        monkeypatch.setattr(compilation, "_on_gpu", {})
        assert compilation.make_deterministic()
        assert choose_backend("auto") == choose_backend("cuda") == "cuda" and choose_backend("jax") == "jax"
        with pytest.raises(ConfigError, match="'warp' does not repeat.*choose cuda, or leave out --deterministic"):
            choose_backend("warp")

    @pytest.mark.parametrize(
        "field, value, message",
        [
            ("timestep", 0.5, "0.5 s: must be between 0.0001 and 0.02 s"),
            ("substeps", 0, "substeps = 0"),
            ("substeps", 200, "0.006 s times substeps = 200 is a control tick of 1.2 s: must be from 0.001 to 1 s"),
            ("timestep", 1e-4, "a control tick of 0.0005 s"),
            ("contacts", "warp", "choose from closed, mjx"),
        ],
    )
    def test_configuration(self, field, value, message):
        with pytest.raises(ConfigError, match=message):
            PhysicsConfig(**{field: value})

    def test_the_control_period(self):
        assert PhysicsConfig(timestep=0.004, substeps=5).control_period == pytest.approx(0.02)

    def test_a_model_without_named_contact_geoms(self, hand, tmp_path):
        shutil.copytree(hand.model_path.parent, tmp_path, dirs_exist_ok=True)
        path = tmp_path / hand.model_path.name
        path.write_text(path.read_text().replace('name="ring_link1" class', "class"))
        with pytest.raises(AssetError, match=f"{path}.*needs a name"):
            Physics(
                load_hand(tmp_path / "xhand_right.toml"),
                SLOTS,
                ObjectConfig().largest,
                PhysicsConfig(),
                gravity=GRAVITY,
                backend="jax",
            )

    def test_a_model_that_needs_what_the_backend_drops(self, hand, tmp_path):
        text = hand.model_path.read_text().replace("<worldbody>", "<option density='1.2'/><worldbody>")
        broken = dataclasses.replace(hand, model_path=tmp_path / "hand.xml")
        broken.model_path.write_text(text)
        with pytest.raises(AssetError, match="hand.xml: backend jax cannot simulate: fluid forces"):
            Physics(broken, SLOTS, ObjectConfig().largest, PhysicsConfig(), gravity=GRAVITY, backend="jax")

    def test_what_mjx_itself_refuses(self, hand, monkeypatch):
        def refuse(model, **_):
            raise NotImplementedError("no such joint")

        monkeypatch.setattr(mjx, "put_model", refuse)
        with pytest.raises(AssetError, match="backend jax: no such joint"):
            Physics(hand, SLOTS, ObjectConfig().largest, PhysicsConfig(), gravity=GRAVITY, backend="jax")

    def test_warps_buffers_hold_the_worst_grip(self, hand, grasp_env):
        """Hands that squeeze as hard as they can need less than the rows that are allocated."""
        allocated = constraint_rows(PhysicsConfig(), hand)
        rng, rows, contacts = np.random.default_rng(3), [], []
        for shape in SHAPES:
            for index in rows_of(grasp_env.pool, shape)[:6]:
                model, qpos, qvel, warmstart, _ = squeeze(hand, row(grasp_env.pool, index), rng)
                data = c_scene.start(model, qpos, qvel, warmstart)
                mujoco.mj_forward(model, data)
                rows.append(data.nefc)
                contacts.append(data.ncon)
        assert max(rows) > 30
        assert max(rows) <= 0.8 * allocated, (max(rows), allocated)
        assert np.mean(contacts) <= 0.8 * PhysicsConfig().max_contacts, np.mean(contacts)


@pytest.mark.parametrize("second", ["box", "capsule", "cylinder", "ellipsoid", "sphere"])
@pytest.mark.parametrize("first", ["box", "capsule", "cylinder", "ellipsoid", "sphere"])
def test_the_guards_list_of_collisions_is_mjxs_own(first, second):
    """What MJX refuses is refused by name, and nothing else is."""
    body = """<body pos="{x} 0 0"><freejoint/><geom name="{x}" type="{kind}" size=".1 .1 .1" mass="1"
              contype="0" conaffinity="0"/></body>"""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{body.format(x=0, kind=first)}{body.format(x=1, kind=second)}
            </worldbody><contact><pair geom1="0" geom2="1"/></contact></mujoco>"""
    )
    try:
        mjx.put_model(model, impl="jax")
    except NotImplementedError:
        with pytest.raises(AssetError, match=f"collision ({first}-{second}|{second}-{first})"):
            check_model(model, "jax")
    else:
        check_model(model, "jax")
