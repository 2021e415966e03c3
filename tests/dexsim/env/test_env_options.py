"""What an environment does beyond its defaults: imperfect taxels, added observations, scales."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from episodes import ground_truth
from simple_physics import SimplePhysics

import dexsim
from dexsim import observation
from dexsim.core.compilation import jit
from dexsim.core.errors import ConfigError
from dexsim.hand.kinematics import forward_kinematics, taxel_normals
from dexsim.objects.config import ObjectConfig
from dexsim.observation import ObservationConfig
from dexsim.randomization import Randomization
from dexsim.randomization_check.effects import check
from dexsim.sensing.config import Sensing
from dexsim.sensing.imu import ImuConfig
from dexsim.sensing.taxels import TaxelSensor
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo.train import parse_arguments

WORLDS = 4
QUIET_TAXELS = TaxelSensor(noise=0.0, threshold=0.0, resolution=0.0, saturation=1000.0)
POOR_TAXELS = TaxelSensor(
    hysteresis=(0.0, 0.3),
    crosstalk=(0.0, 0.1),
    gain=(0.85, 1.15),
    bias=(-0.03, 0.03),
    drift=(0.0, 0.005),
    dead=(0.0, 0.05),
)
QUIET = Sensing(
    joint_noise=0.0,
    joint_resolution=0.0,
    torque_noise=0.0,
    object_noise=0.0,
    orientation=ImuConfig(noise=0.0, bias=0.0, drift=0.0, delay=(0.0, 0.0)),
    taxel=QUIET_TAXELS,
)


@pytest.fixture(scope="module")
def make():
    """An environment over simple physics, quiet and nominal but for what is asked for."""
    patch = pytest.MonkeyPatch()
    patch.setattr("dexsim.env.env.Physics", SimplePhysics)

    def build(sensing=QUIET, randomization=None, observation=None):
        return dexsim.make(
            "grasp",
            GraspConfig(
                sensing=sensing,
                randomization=randomization or Randomization(scale=0.0),
                pool_size=4,
                observation=observation or ObservationConfig(),
                objects=ObjectConfig(shapes=("sphere",)),
            ),
            backend="c",
        )

    yield build
    patch.undo()


@pytest.fixture(scope="module")
def busy(make):
    """All of it at once, compiled once: the environment, states from a reset and 40 ticks on, and a restart."""
    env = make(dataclasses.replace(QUIET, taxel=dataclasses.replace(QUIET_TAXELS, gain=(0.5, 1.5))), Randomization())
    history = [jit(lambda key: jax.vmap(env.reset)(jax.random.split(key, WORLDS)), once=True)(jax.random.key(0))]
    step, rng = jit(jax.vmap(env.step), once=True), np.random.default_rng(0)
    for _ in range(40):
        history.append(step(history[-1], jnp.asarray(rng.uniform(-1, 1, (WORLDS, 12)), jnp.float32)))
    begun = jit(jax.vmap(env.restart), once=True)(history[-1], jnp.array([True, False, True, False]))
    return env, history, begun


def press(seed, scale=2.0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(scale * rng.random((5, 120)) * (rng.random((5, 120)) < 0.3), jnp.float32)


def reads(env, state, forces, key=None):
    """Readings of taxel forces tick by tick, and the state with the memory after them."""
    seen = []
    for tick, force in enumerate(forces):
        pressed = dataclasses.replace(state.sensor_input, taxel_force=force)
        before = dataclasses.replace(state, sensor_input=pressed)
        tick_key = jax.random.fold_in(jax.random.key(9) if key is None else key, tick)
        goal = env.task.goal_readings(state.goal)
        readings, memory = env.senses.read(tick_key, state.episode, pressed, goal, jnp.zeros(12), before)
        state = dataclasses.replace(state, taxel_memory=memory, readings=readings)
        seen.append(np.asarray(readings.taxel_force))
    return seen, state


@pytest.mark.slow
def test_a_tilted_hand_pulls_the_object_aside_and_leaves_the_orientation_alone(make):
    """The bridge aligns the IMU to a known pose of the object, so that a mount that leans is no error of the IMU."""
    env = make(Sensing(orientation=ImuConfig(bias=0.0)), Randomization(gravity_tilt=0.1))
    draw = jax.jit(lambda key: env.reset(key).episode)
    for key in jax.random.split(jax.random.key(0), 4):
        episode = draw(key)
        push = np.asarray(env.sampler.tilt_force(episode)) / float(episode.object.mass)
        pitch, roll = np.asarray(episode.hand.tilt, np.float64)
        down = np.array([1.0, -np.tan(roll), np.tan(pitch)])
        np.testing.assert_allclose(push, 9.81 * (down / np.linalg.norm(down) - [1.0, 0.0, 0.0]), atol=1e-5)
        true_up = -(np.array([9.81, 0.0, 0.0]) + push)
        assert 0.005 < np.arccos(-true_up[0] / np.linalg.norm(true_up)) < 0.15
        assert not np.any(np.asarray(episode.imu.bias))


@pytest.mark.slow
def test_taxels_feel_no_friction(make):
    """The default skin shares out what presses into it: the rest of the finger's force is along it."""
    env = make()
    state = env.reset(jax.random.key(1))
    force = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)), jnp.float32)
    qpos = state.physics.qpos
    pose = forward_kinematics(env.hand, qpos[:12])
    # The object where the first finger's pad is.
    at = pose.body_position[env.hand.tip_body[1]]
    physics = dataclasses.replace(state.physics, qpos=qpos.at[12:15].set(at))
    truth = ground_truth(env, state.episode.object, physics, force)
    felt, normals = np.asarray(truth.touch.force[1]), np.asarray(taxel_normals(env.hand, pose))[1]
    skin = np.asarray(truth.touch.skin_force[1])
    inward = -(skin[:, None] * normals).sum(0)
    inward /= np.linalg.norm(inward)
    assert felt.sum() == pytest.approx(max(float(force[1] @ inward), 0.0), abs=1e-4)
    assert felt.sum() < np.linalg.norm(force[1])


class TestTaxels:
    def sensing(self, **effects):
        return dataclasses.replace(QUIET, taxel=dataclasses.replace(QUIET_TAXELS, **effects))

    def test_off_by_default_and_then_not_there(self, make):
        state = jax.eval_shape(make(Sensing()).reset, jax.random.key(0))
        assert not jax.tree.leaves((state.taxel_memory, state.episode.taxels))

    @pytest.mark.slow
    def test_gains_are_drawn_anew_for_an_episode_and_stay_in_it(self, busy):
        env, (state, *_, last), begun = busy
        gain = np.asarray(state.episode.taxels.gain)
        assert gain.shape == (WORLDS, 5, 120) and 0.5 <= gain.min() < 0.55 and 1.45 < gain.max() <= 1.5
        assert np.abs(np.corrcoef(gain.reshape(WORLDS, -1)) - np.eye(WORLDS)).max() < 0.2
        np.testing.assert_array_equal(last.episode.taxels.gain, gain)
        same = np.all(np.asarray(begun.episode.taxels.gain) == gain, (1, 2))
        assert same.tolist() == [False, True, False, True]
        force, one = press(0), jax.tree.map(lambda x: x[1], last)
        np.testing.assert_allclose(reads(env, one, [force])[0][0], force * gain[1], rtol=1e-6)

    @pytest.mark.slow
    def test_creep_is_remembered_from_tick_to_tick(self, make):
        """A step of force comes in by 1 - a exp(-t / tau); the memory is in the state."""
        env = make(self.sensing(hysteresis=(0.4, 0.4), hysteresis_time=(0.1, 0.1)))
        state = env.reset(jax.random.key(0))
        assert float(jnp.abs(state.taxel_memory.late).max()) == 0
        force = press(1)
        seen, state = reads(env, state, [force] * 6)
        memory = np.exp(-env.control_period / 0.1)
        for tick, reading in enumerate(seen, start=1):
            np.testing.assert_allclose(reading, force * (1 - 0.4 * memory**tick), rtol=1e-4, atol=1e-6)
        assert np.asarray(state.taxel_memory.late).max() > 0.5

    def test_a_slow_array_repeats_itself(self, make):
        """At 8 Hz under 33 Hz control four or five ticks see each sample."""
        env = make(self.sensing(rate=(8.0, 8.0)))
        forces = [press(2, 1.0 + tick) for tick in range(34)]
        seen, _ = reads(env, env.reset(jax.random.key(0)), forces)
        values = [float(s.max()) for s in seen]
        runs = np.diff(np.flatnonzero(np.diff(values, prepend=-1.0)))
        assert set(runs[1:].tolist()) <= {4, 5} and len(runs) >= 6  # the first is cut by the array's own clock

    @pytest.mark.slow
    def test_crosstalk_drift_and_counts(self, make):
        still = [jnp.zeros((5, 120)).at[:, 65].set(2.0)] * 40
        env = make(self.sensing(crosstalk=(0.2, 0.2)))
        spread = reads(env, env.reset(jax.random.key(0)), still[:1])[0][0]
        np.testing.assert_allclose(spread.sum(-1), 2.0, rtol=1e-5)
        np.testing.assert_allclose(spread[:, 65], 1.6, rtol=1e-5)
        assert np.all((spread > 0).sum(-1) == 5)
        env = make(self.sensing(drift=(0.5, 0.5)))
        still = [jnp.full((5, 120), 5.0)] * 40
        drifting = np.stack(reads(env, env.reset(jax.random.key(0)), still)[0])
        # A walk: the deviation grows with the square root of time.
        for ticks in (4, 36):
            expected = 0.5 * np.sqrt(ticks * env.control_period)
            assert np.std(drifting[ticks - 1] - still[0]) == pytest.approx(expected, rel=0.15)
        env = make(self.sensing(resolution=0.1, saturation=25.5))
        counted = reads(env, env.reset(jax.random.key(0)), [20 * press(3)])[0][0]
        np.testing.assert_allclose(counted, np.clip(np.round(20 * press(3) / 0.1), 0, 255) * 0.1, atol=1e-5)
        assert counted.max() == pytest.approx(25.5)


class TestObservation:
    def test_an_actor_cannot_see_what_nothing_measures(self, make):
        with pytest.raises(ConfigError, match="ObservationConfig.add = 'object_spin': no sensor measures it"):
            make(observation=ObservationConfig(add=("object_spin",)))

    def test_added_fields_stand_behind_the_tasks_own_once(self, hand):
        config = ObservationConfig(leave_out=("contact_force",), add=("joint_torque", "last_action", "last_action"))
        names = [field.name for field in observation.layout(hand, observation.GRASP, config)]
        assert names == [*(n for n in observation.GRASP if n != "contact_force"), "last_action"]


@pytest.fixture(scope="module")
def drawn(make):
    """An environment and 64 resets at three scales."""
    env = make(dataclasses.replace(QUIET, taxel=POOR_TAXELS, orientation=ImuConfig()), Randomization())
    draw = jit(lambda key, scale: jax.vmap(lambda k: env.reset(k, scale))(jax.random.split(key, 64)), once=True)
    return env, {scale: draw(jax.random.key(0), jnp.float32(scale)) for scale in (0.0, 0.5, 1.0)}


class TestScale:
    """A width of the ranges that is part of the state: 0 is nominal exactly, for hand, sensors and object."""

    def test_zero_is_nominal(self, drawn, hand):
        env, states = drawn
        state, objects = states[0.0], env.config.objects
        for value, nominal in (
            (state.episode.hand.actuator.stall_torque, hand.torque_limit),
            (state.episode.hand.encoder_bias, 0),
            (state.episode.hand.tilt, 0),
            (state.episode.imu.bias, 0),
            (state.episode.taxels.gain, 1),
            (state.episode.taxels.bias, 0),
            (state.episode.taxels.crosstalk, 0),
            (state.episode.taxels.alive, True),
            (state.episode.object.mass, np.mean(objects.mass)),
            (state.episode.object.friction, np.mean(objects.friction)),
            (state.episode.object.com, 0),
            (state.episode.object.contact[:, 0], np.mean(objects.stiffness)),
        ):
            np.testing.assert_array_equal(value, np.broadcast_to(np.float32(nominal), value.shape))
        assert len(np.unique(state.episode.object.contact[:, 1])) == 1
        radius = np.asarray(state.episode.object.size[:, 1, 0])
        assert len(np.unique(radius)) > 1  # sizes stay as the pool has them
        ball = np.mean(objects.mass) * 0.4 * radius**2
        # A sphere is a capsule with a straight part of 0.2 mm.
        np.testing.assert_allclose(state.episode.object.inertia, np.repeat(ball[:, None], 3, 1), rtol=0.01)

    def test_one_is_as_without_a_scale(self, drawn):
        env, states = drawn
        plain = jit(jax.vmap(env.reset), once=True)(jax.random.split(jax.random.key(0), 64))
        for name in ("mass", "inertia", "com", "friction", "contact"):
            np.testing.assert_allclose(
                getattr(states[1.0].episode.object, name),
                getattr(plain.episode.object, name),
                rtol=1e-4,
                atol=1e-7,
                err_msg=name,
            )

    def test_half_is_half_way(self, drawn):
        _, states = drawn
        for name in ("mass", "com", "friction", "contact"):
            low, half, high = (np.asarray(getattr(states[scale].episode.object, name)) for scale in (0.0, 0.5, 1.0))
            np.testing.assert_allclose(half, (low + high) / 2, rtol=1e-4, atol=1e-6, err_msg=name)
        low, half, high = (np.asarray(states[scale].episode.hand.encoder_bias) for scale in (0.0, 0.5, 1.0))
        np.testing.assert_allclose(half, (low + high) / 2, atol=1e-7)

    def test_restarts_draw_at_the_states_scale(self, drawn):
        env, states = drawn
        state = jax.vmap(env.set_randomization_scale, (0, None))(states[1.0], jnp.float32(0.0))
        np.testing.assert_array_equal(state.episode.hand.encoder_bias, states[1.0].episode.hand.encoder_bias)
        begun = jit(jax.vmap(env.restart), once=True)(state, jnp.arange(64) < 32)
        assert np.all(np.asarray(begun.episode.hand.encoder_bias)[:32] == 0) and np.all(np.asarray(begun.scale) == 0)
        np.testing.assert_array_equal(begun.episode.hand.encoder_bias[32:], state.episode.hand.encoder_bias[32:])
        np.testing.assert_array_equal(begun.episode.object.mass[:32], np.float32(np.mean(env.config.objects.mass)))

    def test_without_one_there_is_none(self, make):
        assert jax.eval_shape(make().reset, jax.random.key(0)).scale is None


def test_all_of_it_is_reached_from_the_command_line():
    arguments, _ = parse_arguments(
        [
            "--task",
            "grasp",
            "--env.sensing.taxel.hysteresis",
            "0.1",
            "0.2",
            "--env.sensing.taxel.drift",
            "0",
            "0.01",
            "--env.sensing.taxel.crosstalk",
            "0",
            "0.1",
            "--env.sensing.taxel.rate",
            "8",
            "20",
            "--env.observation.add-critic",
            "object_spin",
        ]
    )
    taxel = arguments.env.sensing.taxel
    assert (taxel.hysteresis, taxel.drift, taxel.gain) == ((0.1, 0.2), (0.0, 0.01), None)
    assert taxel.crosstalk == (0.0, 0.1) and taxel.rate == (8.0, 20.0)
    assert arguments.env.observation.add_critic == ("object_spin",)


@pytest.mark.slow
def test_the_self_test_finds_every_range_of_taxels(make):
    env = make(Sensing(taxel=dataclasses.replace(POOR_TAXELS, rate=(8.0, 20.0), resolution=0.0)))
    states = jit(lambda key: jax.vmap(env.reset)(jax.random.split(key, WORLDS)), once=True)(jax.random.key(0))
    names = (
        "hysteresis",
        "hysteresis_time",
        "crosstalk",
        "gain",
        "bias",
        "drift",
        "dead",
        "rate",
    )
    effects = check(
        env,
        jax.jit(jax.vmap(env.step)),
        states,
        key=jax.random.key(1),
        ticks=10,
        names=[f"TaxelSensor.{name}" for name in names],
    )
    for name, effect in zip(names, effects, strict=True):
        leaf = {"hysteresis_time": "memory", "dead": "alive"}.get(name, name)
        assert effect.changed == (leaf,) and effect.found and effect.which == "taxel_force" and effect.joint == 0


@pytest.mark.slow
def test_everything_at_once_on_the_real_physics():
    """A hand that grips and shakes, then holds still, with poor taxels: sober numbers."""
    config = GraspConfig(pool_size=80, sensing=Sensing(taxel=dataclasses.replace(POOR_TAXELS, rate=(10.0, 30.0))))
    env = dexsim.make("grasp", config, backend="c")
    state = jax.jit(lambda key: jax.vmap(env.reset)(jax.random.split(key, 8)))(jax.random.key(0))
    step, restart = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.restart))
    rng, gripped = np.random.default_rng(0), 0
    for tick in range(60):
        action = np.clip(rng.uniform(-1, 1, (8, 12)) + 0.6 * (np.arange(12) > 3), -1, 1) * (tick < 30)
        state = step(state, jnp.asarray(action, jnp.float32))
        assert not np.any(state.metrics["non_finite"])
        gripped += np.sum(np.asarray(state.finger_force) > 1)
        assert np.all(np.isfinite(state.obs["actor"])) and state.obs["actor"].shape == (8, 66)
        state = restart(state, state.terminated | state.truncated)
    assert gripped > 100
