"""The environment as a whole: pure steps, episodes, readings, touch. One compiled grasp for all."""

import dataclasses
import re

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import skin_law
from episodes import with_episode
from palm_touch import feel

import dexsim
from dexsim import observation
from dexsim.control import Control
from dexsim.core.compilation import jit
from dexsim.core.errors import ConfigError
from dexsim.env.config import EnvConfig
from dexsim.env.evaluation import evaluation_of
from dexsim.geometry import rotations
from dexsim.hand.kinematics import forward_kinematics, taxel_positions
from dexsim.objects.config import SHAPES, SLOTS, ObjectConfig
from dexsim.physics.interface import PhysicsState
from dexsim.randomization import Randomization
from dexsim.sensing.config import Sensing
from dexsim.sensing.taxels import TaxelSensor
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import COMMANDS
from dexsim.touch.reduce import reduce_touch

WORLDS = 8


def row(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def leaves(tree):
    """All leaves by path, keys as their data."""
    return {
        jax.tree_util.keystr(path): np.asarray(
            jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        )
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
    }


def assert_same(first, second, rows=slice(None)):
    ours, theirs = leaves(first), leaves(second)
    assert ours.keys() == theirs.keys()
    for path in ours:
        np.testing.assert_array_equal(ours[path][rows], theirs[path][rows], err_msg=path)


def placed(rollout, seed, qpos, qvel, object, joint_target=None):
    """A reset batch with its hands and objects put elsewhere."""
    state = rollout.reset(jax.random.key(seed))
    qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
    sensor_input = dataclasses.replace(
        state.sensor_input, joint_position=qpos[:, :12], object_position=qpos[:, 12:15], object_quat=qpos[:, 15:]
    )
    state = with_episode(
        state, object=jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), object, state.episode.object)
    )
    return dataclasses.replace(
        state,
        physics=PhysicsState(qpos, qvel, jnp.zeros((WORLDS, 18))),
        sensor_input=sensor_input,
        joint_target=qpos[:, :12] if joint_target is None else jnp.asarray(joint_target, jnp.float32),
    )


def actions(seed, scale=1.0):
    return jnp.asarray(np.random.default_rng(seed).uniform(-scale, scale, (WORLDS, 12)), jnp.float32)


@pytest.fixture(scope="module")
def history(grasp_rollout):
    """12 ticks of random actions from a reset, fingers mostly closing: [(state, action, next)]."""
    state, ticks = grasp_rollout.reset(jax.random.key(7)), []
    for tick in range(12):
        action = actions(tick).at[:, 4:].add(0.5)
        following = grasp_rollout.step(state, action)
        ticks.append((state, action, following))
        state = following
    return ticks


class TestPure:
    def test_same_inputs_same_outputs(self, grasp_rollout, history):
        for state, action, following in history[::4]:
            assert_same(grasp_rollout.step(state, action), following)

    def test_worlds_do_not_mix(self, grasp_rollout, history):
        """A permuted batch gives permuted results, bit for bit."""
        order = np.array([3, 1, 7, 0, 5, 2, 6, 4])
        state, action, following = history[6]
        assert_same(grasp_rollout.step(row(state, order), action[order]), row(following, order))

    @pytest.mark.parametrize("shape", [(), (5,), (13,), (1, 12)])
    def test_an_action_of_another_shape_is_refused(self, grasp_env, history, shape):
        with pytest.raises(ConfigError, match=rf"action: expected shape \(12,\), got {re.escape(str(shape))}$"):
            grasp_env.step(row(history[0][0], 0), np.zeros(shape, np.float32))

    def test_reset_depends_on_the_key_alone(self, grasp_rollout):
        first, again, other = (grasp_rollout.reset(jax.random.key(seed)) for seed in (1, 1, 2))
        assert_same(first, again)
        assert not np.array_equal(first.physics.qpos, other.physics.qpos)
        assert not np.array_equal(first.episode.hand.encoder_bias, other.episode.hand.encoder_bias)
        assert len(np.unique(first.episode.hand.encoder_bias[:, 0])) == WORLDS

    def test_keys_advance(self, history):
        data = [np.asarray(jax.random.key_data(state.key)) for state, _, _ in history]
        assert len(np.unique(np.concatenate(data), axis=0)) == WORLDS * len(history)

    def test_a_batch_is_a_loop(self, grasp_env, history):
        """`vmap` of the step against one world at a time; float32 in another order of fusion."""
        single = jax.jit(grasp_env.step)
        equal = []
        for tick in (0, 9):
            state, action, following = history[tick]
            for world in range(WORLDS):
                alone, batch = leaves(single(row(state, world), action[world])), leaves(following)
                # Accelerations of hundreds of rad/s^2, to a thousandth of the largest; positions to 50 micrometres.
                fast = 1e-3 * max(100.0, np.abs(alone[".physics.warmstart"]).max())
                bounds = {".physics.warmstart": (2e-3, fast), ".physics.qpos": (1e-7, 5e-5)}
                close = {
                    path: np.allclose(value, batch[path][world], *bounds.get(path, (2e-3, 5e-3)))
                    for path, value in alone.items()
                }
                equal.append(all(close.values()))
                np.testing.assert_array_equal(alone[".key"], batch[".key"][world])
                np.testing.assert_allclose(alone[".physics.qpos"], batch[".physics.qpos"][world], atol=5e-3)
        # A solver stopped after so many iterations passes rounding on where it has not converged: the one
        # world in some hundreds where a contact has not settled between sticking and sliding.
        assert np.mean(equal) >= 0.8, equal

    def test_dtypes_are_stable(self, history):
        """A step's output goes into the next step as it is: a `scan` over steps needs that."""
        state, _, following = history[0]
        kinds = [
            jax.tree.map(lambda x: (x.shape, x.dtype, getattr(x, "weak_type", False)), tree)
            for tree in (state, following)
        ]
        assert kinds[0] == kinds[1]

    def test_everything_is_finite(self, history):
        for path, value in leaves(history[-1][2]).items():
            assert np.all(np.isfinite(value)), path


class TestTick:
    def test_a_tick_equals_c_mujoco(self, hand, grasp_env, grasp_rollout):
        """Targets, latency, drive, push, tilt and contact of one tick, written down again.

        Spheres and capsules, on whose contacts the engines agree; C solves to the end. The shipped
        three iterations leave light links up to 25 mrad away after five sub-steps of closing, and
        single forces by newtons.
        """
        pool, config = grasp_env.pool, grasp_env.config
        rows = np.concatenate([c_scene.rows_of(pool, shape)[:4] for shape in ("sphere", "capsule")])
        starts = c_scene.row(pool, rows)
        state = placed(grasp_rollout, 11, starts.qpos, starts.qvel, starts.object)
        for _ in range(8):
            state = grasp_rollout.step(state, jnp.ones((WORLDS, 12)) * (np.arange(12) > 3))
        action = actions(3)
        after = grasp_rollout.step(state, action)
        push = jax.vmap(lambda key, target: grasp_env.task.push(jax.random.split(key, 4)[1], target))(
            state.key, state.episode.object
        )

        strong, close = 0, []
        cover = c_scene.COVER + np.asarray(state.episode.hand.pad_thickness_delta)
        skin = np.asarray(skin_law(hand, config.skin)(state.physics.qpos, state.episode.object, cover))
        for world in range(WORLDS):
            target = c_scene.row(state.episode.object, world)
            model = c_scene.compile_scene(hand, target, cover=cover[world], **c_scene.CONVERGED)
            data = c_scene.start(
                model,
                *(np.asarray(x[world]) for x in (state.physics.qpos, state.physics.qvel, state.physics.warmstart)),
            )
            c_scene.follow_skin(model, data, hand, target, skin[world])
            old = np.asarray(state.joint_target[world], np.float64)
            q = data.qpos[:12].copy()
            new = old + config.control.step * np.clip(np.asarray(action[world]), -1, 1)
            new = np.clip(new, q - config.control.reach, q + config.control.reach)
            new = np.clip(new, hand.joint_lower, hand.joint_upper)
            drawn = c_scene.row(state.episode.hand, world)
            drive, latency, tilt = drawn.actuator, drawn.latency, drawn.tilt
            inertia_rate = model.dof_M0[:12] / model.opt.timestep
            down = np.array([1.0, -np.tan(tilt[1]), np.tan(tilt[0])])
            force = target.mass * 9.81 * (down / np.linalg.norm(down) - [1.0, 0, 0])
            data.xfrc_applied[model.body("object").id, :3] = force + np.asarray(push[world])
            for substep in range(config.physics.substeps):
                wanted = np.where(substep < latency, old, new)
                torque = plain_drive(drive, wanted, data.qpos[:12], data.qvel[:12])
                data.qfrc_applied[:12] = torque - plain_friction(drive, torque, data.qvel[:12], inertia_rate)
                mujoco.mj_step(model, data)
            felt = np.linalg.norm(c_scene.finger_force(model, data, hand), axis=-1)
            strong += np.sum(felt > 0.5)
            np.testing.assert_allclose(after.joint_target[world], new, atol=1e-6)
            np.testing.assert_allclose(after.physics.qpos[world], data.qpos, atol=4e-2)
            np.testing.assert_allclose(after.physics.qpos[world, 12:15], data.qpos[12:15], atol=1e-3)
            close += list(np.isclose(after.finger_force[world], felt, atol=0.5, rtol=0.15)[felt > 0.5])
        assert strong >= 5, "hardly a finger touches: the test tests nothing"
        assert np.mean(close) > 0.6

    def test_torque_readings_are_the_drives(self, hand, history):
        """The torque that the motors would give at the end of the tick, over the stall torque."""
        _, _, after = history[5]
        for world in range(WORLDS):
            torque = plain_drive(
                c_scene.row(after.episode.hand.actuator, world),
                np.asarray(after.joint_target[world]),
                np.asarray(after.physics.qpos[world, :12]),
                np.asarray(after.physics.qvel[world, :12]),
            )
            np.testing.assert_allclose(after.sensor_input.joint_torque[world] * hand.torque_limit, torque, atol=2e-5)

    @pytest.mark.parametrize("factor", [1.0, 3.0])
    def test_actions_are_clipped(self, grasp_rollout, history, factor):
        state, _, _ = history[4]
        action = factor * jnp.sign(actions(5))
        after = grasp_rollout.step(state, action)
        assert_same(after, grasp_rollout.step(state, jnp.sign(actions(5))))
        assert np.abs(after.action).max() == 1.0
        moved = np.asarray(after.joint_target - state.joint_target)
        measured = np.asarray(state.physics.qpos[:, :12])
        assert np.all(np.abs(np.asarray(after.joint_target) - measured) <= 0.5 + 1e-6)
        assert np.abs(moved).max() > 0.1


def plain_drive(drive, wanted, position, velocity):
    """The paper's four equations and the ripple, joint by joint; the loop sees the encoder."""
    torque = np.zeros(12)
    for j in range(12):
        error = wanted[j] - (position[j] + drive.encoder_bias[j])
        if abs(error) < drive.dead_band[j]:
            continue
        limit = drive.stall_torque[j] * max(1 - abs(velocity[j]) / drive.no_load_speed[j], 0)
        command = drive.stiffness[j] * error - drive.damping[j] * velocity[j]
        torque[j] = drive.efficiency[j] * min(max(command, -limit), limit)
        torque[j] *= 1 + drive.ripple[j] * np.sin(drive.ripple_count[j] * position[j] + drive.ripple_phase[j])
    return torque


def plain_friction(drive, torque, velocity, inertia_rate):
    """What stops the joint within the sub-step, but no more than the friction; then b times the new speed."""
    lost = np.zeros(12)
    for j in range(12):
        momentum = inertia_rate[j] * velocity[j] + torque[j]
        coulomb = min(abs(momentum), drive.coulomb_friction[j]) * np.sign(momentum)
        speed = (momentum - coulomb) / (inertia_rate[j] + drive.viscous_friction[j])
        lost[j] = coulomb + drive.viscous_friction[j] * speed
    return lost


class TestEpisodes:
    def test_time_limit(self, grasp_env, grasp_rollout):
        """Truncated at the limit; lost on the same tick: terminated, and never both."""
        limit = grasp_env.task.episode_ticks
        state = grasp_rollout.reset(jax.random.key(3))
        tick = jnp.array([limit - 2, limit - 1, limit - 1, limit, 0, 0, limit - 2, limit - 1])
        away = np.zeros((WORLDS, 19), np.float32)
        away[[2, 4, 6, 7], 12] = 0.5  # far below the hand
        physics = dataclasses.replace(state.physics, qpos=state.physics.qpos + away)
        state = dataclasses.replace(state, tick=tick.astype(jnp.int32), physics=physics)
        after = grasp_rollout.step(state, jnp.zeros((WORLDS, 12)))
        assert after.truncated.tolist() == [False, True, False, True, False, False, False, False]
        assert after.terminated.tolist() == [False, False, True, False, True, False, True, True]
        assert after.tick.tolist() == (tick + 1).tolist()
        assert np.all(after.length == 1)
        drop = grasp_env.config.reward.drop
        np.testing.assert_array_equal(after.metrics["reward/drop"], drop * after.terminated)

    def test_returns_add_up(self, history):
        total = np.zeros(WORLDS)
        for _, _, after in history:
            terms = [v for k, v in after.metrics.items() if k.startswith("reward/")]
            np.testing.assert_allclose(after.reward, np.sum(terms, axis=0), rtol=1e-5, atol=1e-6)
            total += np.asarray(after.reward)
            np.testing.assert_allclose(after.metrics["return"], total, rtol=1e-5, atol=1e-5)
        assert np.all(history[-1][2].metrics["length"] == len(history))
        assert np.all(history[-1][2].length == len(history))

    def test_restart_touches_only_what_is_done(self, grasp_env, grasp_rollout, history):
        state = history[-1][2]
        done = np.array([True, False, False, True, False, True, False, False])
        begun = grasp_rollout.restart(state, jnp.asarray(done))
        ours, before = leaves(begun), leaves(state)
        for path, value in ours.items():
            if path != ".key":  # every world's key moves on
                np.testing.assert_array_equal(value[~done], before[path][~done], err_msg=path)
        assert np.all(np.any(ours[".key"] != before[".key"], axis=-1))
        pool = {tuple(q) for q in np.asarray(grasp_env.pool.qpos)}
        assert all(tuple(q) in pool for q in ours[".physics.qpos"][done])
        for name in ("tick", "length", "episode_return", "reward"):
            assert not np.any(ours["." + name][done]), name
        assert np.any(
            ours[".episode.hand.actuator.encoder_bias"][done] != before[".episode.hand.actuator.encoder_bias"][done]
        )
        np.testing.assert_array_equal(begun.joint_target[done], begun.physics.qpos[done, :12])
        # The object goes with its start.
        at = np.flatnonzero((np.asarray(grasp_env.pool.qpos) == ours[".physics.qpos"][0]).all(1))[0]
        np.testing.assert_array_equal(begun.episode.object.size[0], grasp_env.pool.object.size[at])

    def test_restarts_differ(self, grasp_rollout, history):
        state, everyone = history[-1][2], jnp.ones(WORLDS, bool)
        first = grasp_rollout.restart(state, everyone)
        second = grasp_rollout.restart(first, everyone)
        biases = [np.asarray(begun.episode.hand.encoder_bias) for begun in (first, second)]
        assert np.all(np.any(biases[0] != biases[1], axis=-1))

    def test_stagger(self, grasp_env, history):
        state = history[0][0]
        keys = jax.random.split(jax.random.key(5), WORLDS)
        spread = jax.vmap(grasp_env.randomize_episode_time)(state, keys)
        limit = grasp_env.task.episode_ticks
        assert len(np.unique(spread.tick)) >= 6
        assert np.all((spread.tick >= 0) & (spread.tick < limit))
        assert_same(dataclasses.replace(spread, tick=state.tick), state)
        many = jax.vmap(lambda key: grasp_env.randomize_episode_time(row(state, 0), key).tick)(
            jax.random.split(jax.random.key(6), 4000)
        )
        assert np.histogram(many, 4, (0, limit))[0].min() > 850

    def test_evaluation_starts(self, grasp_env):
        """Commands and shapes as planned, never changing; starts from a pool that is not training's."""
        protocol = evaluation_of(grasp_env)
        starts = jit(protocol.evaluation_starts, once=True)(protocol.evaluation_plan(50, 0))
        assert np.all(np.asarray(starts.goal.fixed))
        np.testing.assert_allclose(starts.goal.command, np.tile(np.float32(COMMANDS), 10))
        assert np.bincount(starts.episode.object.shape_index).tolist() == [10] * 5
        rows = {tuple(q) for q in np.asarray(grasp_env.pool.qpos)}
        assert not any(tuple(q) in rows for q in np.asarray(starts.physics.qpos))


class TestTrouble:
    def test_a_world_that_blows_up(self, grasp_rollout, history):
        """It terminates, shows sober numbers, and the others never notice.

        World 2 turns into NaN within the tick; world 5 gets motors that throw its joints to
        speeds that are finite, but not of this world.
        """
        state, action, following = history[3]
        object = dataclasses.replace(state.episode.object, mass=state.episode.object.mass.at[2].set(jnp.nan))
        motors = dataclasses.replace(
            state.episode.hand.actuator,
            **{
                name: getattr(state.episode.hand.actuator, name).at[5].set(value)
                for name, value in (("stiffness", 1e3), ("stall_torque", 1e3), ("no_load_speed", 1e30))
            },
        )
        after = grasp_rollout.step(
            with_episode(state, object=object, hand=dataclasses.replace(state.episode.hand, actuator=motors)), action
        )
        bad, good = np.array([2, 5]), np.array([0, 1, 3, 4, 6, 7])
        assert np.all(after.terminated[bad]) and not np.any(after.truncated[bad])
        assert np.all(after.metrics["non_finite"][bad] == 1)
        assert_same(after, following, good)
        assert not np.any(after.metrics["non_finite"][good])
        assert np.all(np.abs(after.reward) < 100)
        for name in ("reward", "obs", "metrics", "physics"):
            for path, value in leaves(getattr(after, name)).items():
                assert np.all(np.isfinite(value)), (name, path)
        begun = grasp_rollout.restart(after, after.terminated)
        assert all(np.all(np.isfinite(value)) for value in leaves(begun).values())

    def test_an_action_that_is_not_a_number(self, grasp_rollout, history):
        """A broken policy must not poison rewards: such a world ends like one that blows up."""
        state, action, following = history[3]
        after = grasp_rollout.step(state, action.at[1, 0].set(jnp.nan).at[6].set(jnp.nan))
        bad, good = np.array([1, 6]), np.array([0, 2, 3, 4, 5, 7])
        assert np.all(after.terminated[bad])
        assert_same(after, following, good)
        for name in ("reward", "obs", "metrics", "episode_return"):
            for path, value in leaves(getattr(after, name)).items():
                assert np.all(np.isfinite(value)), (name, path)

    @pytest.mark.parametrize(
        "make, message",
        [
            (
                lambda: Control(last_action_encoding="torque"),
                "last_action_encoding = 'torque': choose from",
            ),
            (lambda: Control(step=5.0), "Control.step = 5 rad: must be between 0.001 and 1 rad"),
            (lambda: Sensing(joint_noise=-1.0), "Sensing.joint_noise = -1 rad"),
            (lambda: EnvConfig(pool_size=0), "EnvConfig.pool_size|pool_size = 0"),
            (lambda: Randomization(latency=(0.02, 0.01)), "Randomization.latency"),
        ],
    )
    def test_configurations_out_of_range(self, make, message):
        with pytest.raises(ConfigError, match=message):
            config = make()
            if isinstance(config, EnvConfig):  # checked by the task's own config
                GraspConfig(pool_size=config.pool_size)


class TestReadings:
    def test_the_observation_is_observe_of_the_readings(self, hand, grasp_env, history):
        after = history[-1][2]
        seen = jax.vmap(
            lambda readings: observation.observe(hand, readings, observation.GRASP, grasp_env.config.observation)
        )(after.readings)
        np.testing.assert_allclose(after.obs["actor"], seen, rtol=1e-5, atol=1e-5)
        assert after.obs["actor"].shape == (WORLDS, 66)
        sizes = {name: sum(field.size for field in fields) for name, fields in grasp_env.observation_layout.items()}
        assert sizes == {"actor": 66, "critic": 66}

    def test_the_critic_sees_the_truth(self, hand, grasp_env, history):
        after = history[-1][2]
        critic, at = np.asarray(after.obs["critic"]), 0
        fields = {}
        for field in grasp_env.observation_layout["critic"]:
            fields[field.name] = critic[:, at : at + field.size]
            at += field.size
        np.testing.assert_allclose(fields["joint_position"], after.physics.qpos[:, :12], atol=1e-6)
        np.testing.assert_allclose(fields["object_position"], after.physics.qpos[:, 12:15], atol=1e-6)
        np.testing.assert_allclose(fields["object_velocity"], after.physics.qvel[:, 12:15], atol=1e-6)
        np.testing.assert_allclose(fields["joint_torque"], after.sensor_input.joint_torque, atol=1e-6)
        np.testing.assert_allclose(
            fields["contact_force"], after.sensor_input.taxel_force.sum(-1), rtol=1e-5, atol=1e-5
        )
        tips = jax.vmap(lambda q: forward_kinematics(hand, q).tip_position)(after.physics.qpos[:, :12])
        np.testing.assert_allclose(fields["fingertip_position"], tips.reshape(WORLDS, 15), atol=1e-6)
        np.testing.assert_allclose(fields["command"][:, 0], after.goal.command)

    def test_readings_carry_the_action_that_led_to_them(self, history):
        for _, action, after in history:
            np.testing.assert_array_equal(after.readings.last_action, np.clip(action, -1, 1))

    def test_readings_are_as_old_as_the_latency_says(self, history):
        """Angles lie `age` of the way back to the last tick: a regression finds each world's age.

        Joints turn by some 0.1 rad a tick; noise of 3 mrad over 12 x 12 samples leaves 0.01.
        """
        old, new, read = (
            np.stack(x)
            for x in zip(
                *(
                    (
                        before.sensor_input.joint_position,
                        after.sensor_input.joint_position,
                        after.readings.joint_position - after.episode.hand.encoder_bias,
                    )
                    for before, after in ((s, f) for s, _, f in history)
                ),
                strict=True,
            )
        )
        change = old - new
        age = np.sum((read - new) * change, axis=(0, 2)) / np.sum(change**2, axis=(0, 2))
        wanted = np.asarray(history[0][0].episode.hand.sensing_latency)
        assert np.ptp(wanted) > 0.2
        np.testing.assert_allclose(age, wanted, atol=0.03)

    def test_noise_has_the_size_that_is_configured(self, grasp_env, history):
        sensing, errors, places = grasp_env.config.sensing, [], []
        for before, _, after in history:
            age = np.asarray(after.episode.hand.sensing_latency)[:, None]
            for name, into in (("joint_position", errors), ("object_position", places)):
                mixed = (1 - age) * np.asarray(getattr(after.sensor_input, name)) + age * np.asarray(
                    getattr(before.sensor_input, name)
                )
                into.append(np.asarray(getattr(after.readings, name)) - mixed)
        bias = np.asarray(history[0][0].episode.hand.encoder_bias)
        errors = np.stack(errors) - bias
        assert np.std(errors) == pytest.approx(sensing.joint_noise, rel=0.1)
        assert abs(np.mean(errors)) < sensing.joint_noise / 5
        # Only the height is measured; the rest is the reference.
        places = np.stack(places)[..., 0]
        assert np.std(places) == pytest.approx(sensing.object_noise, rel=0.25)
        reference = np.array(grasp_env.task.reference)[1:]
        np.testing.assert_allclose(
            history[-1][2].readings.object_position[:, 1:], np.broadcast_to(reference, (WORLDS, 2))
        )

    def test_the_velocity_estimate_is_filtered_differences(self, grasp_env, history):
        weight, period = grasp_env.config.sensing.velocity_filter, grasp_env.control_period
        for before, _, after in history:
            step = (after.readings.object_position - before.readings.object_position) / period
            wanted = before.readings.object_velocity + weight * (step - before.readings.object_velocity)
            np.testing.assert_allclose(after.readings.object_velocity, wanted, atol=1e-4)

    def test_a_quiet_hand_reads_the_truth(self):
        """Without noise, draws and counts the readings are the state itself."""
        sensing = Sensing(
            joint_noise=0.0,
            joint_resolution=0.0,
            torque_noise=0.0,
            object_noise=0.0,
            object_axes=(True, True, True),
            taxel=TaxelSensor(noise=0.0, threshold=0.0, resolution=0.0),
        )
        env = dexsim.make(
            "grasp",
            GraspConfig(
                sensing=sensing,
                randomization=Randomization(scale=0.0),
                pool_size=4,
                objects=ObjectConfig(shapes=("sphere",)),
            ),
            backend="jax",
        )
        state = jit(env.reset, once=True)(jax.random.key(0))
        np.testing.assert_array_equal(state.readings.joint_position, state.physics.qpos[:12])
        np.testing.assert_array_equal(state.readings.object_position, state.physics.qpos[12:15])
        np.testing.assert_array_equal(state.readings.taxel_force, np.zeros((5, 120)))
        # A pressed moment goes through the same door.
        force = jnp.zeros((5, 120)).at[2, 40:44].set(jnp.array([0.013, 0.4, 1.26, 0.02]))
        pressed = dataclasses.replace(state.sensor_input, taxel_force=force, joint_torque=jnp.linspace(-1, 1, 12))
        readings, _ = env.senses.read(
            jax.random.key(1), state.episode, pressed, env.task.goal_readings(state.goal), jnp.zeros(12)
        )
        np.testing.assert_array_equal(readings.taxel_force, force)
        np.testing.assert_array_equal(readings.joint_torque, pressed.joint_torque)


@pytest.fixture(scope="module")
def grips(hand, grasp_env, grasp_rollout):
    """Grasps of every shape at random strength: {shape: [8-world states, how many count]}.

    C MuJoCo closes each hand without weight, then holds at three random grips; from there the
    environment goes on for 8 ticks, so that the forces are the library's own.
    """
    rng, found = np.random.default_rng(0), {}
    for shape in SHAPES:
        held = []
        for pool_row in c_scene.rows_of(grasp_env.pool, shape):
            start = c_scene.row(grasp_env.pool, pool_row)
            exact = bool(start.object.active[SLOTS.index("cylinder")])
            model = c_scene.compile_scene(hand, start.object, exact=exact)
            data = c_scene.start(model, start.qpos, 0 * start.qvel)
            close = rng.uniform(0.5, 1.0, 12) * (np.arange(12) > 3)
            close[1:3] = rng.uniform(0.3, 1.0, 2)
            for level in range(3):
                grip = rng.uniform(0.05, 0.45)  # rad ahead of the joint, at 3 Nm/rad
                for tick in range(25):
                    weight = 0 if level == 0 and tick < 20 else 9.81
                    model.opt.gravity[:] = weight, 0, 0
                    share = min(tick / 10, 1) if level == 0 else 1
                    here = data.qpos[:12].copy()
                    wanted = np.clip(start.qpos[:12] + share * close, here - grip, here + grip)
                    for _ in range(6):
                        torque = 3 * (wanted - data.qpos[:12]) - 0.1 * data.qvel[:12]
                        data.qfrc_applied[:12] = np.clip(torque, -hand.torque_limit, hand.torque_limit)
                        mujoco.mj_step(model, data)
                if np.linalg.norm(data.qpos[12:15] - grasp_env.task.reference) < 0.1:
                    held.append((pool_row, data.qpos.copy(), data.qvel.copy(), wanted))
        found[shape] = []
        for begin in range(0, len(held), WORLDS):
            part = held[begin : begin + WORLDS]
            rows, *values = zip(*(part * WORLDS)[:WORLDS], strict=True)
            qpos, qvel, wanted = (np.stack(value) for value in values)
            target = c_scene.row(grasp_env.pool.object, list(rows))
            state = placed(grasp_rollout, begin, qpos, qvel, target, wanted)
            for _ in range(8):
                state = grasp_rollout.step(state, jnp.zeros((WORLDS, 12)))
            found[shape].append((state, len(part)))
    return found


def skin_pairs(hand, env, states):
    """(force by the solver, force by the skin's law) [2, n, 5] N on every finger."""
    law = skin_law(hand, env.config.skin)
    pairs = []
    for state, count in states:
        usable = ~np.asarray(state.terminated) & (np.arange(WORLDS) < count)
        felt = law(state.physics.qpos, state.episode.object, c_scene.COVER + state.episode.hand.pad_thickness_delta)
        pairs.append(np.stack([np.asarray(state.finger_force), np.asarray(felt)])[:, usable])
    return np.concatenate(pairs, 1)


class TestSkinLaw:
    """The skin's law alone, before it is tied to the solver's total."""

    @pytest.mark.parametrize("shape", SHAPES)
    def test_it_follows_the_force_of_the_jax_backend(self, hand, grasp_env, grips, shape):
        """Few grips, of the whole environment: see `test_skin_law` for many of them."""
        pairs = skin_pairs(hand, grasp_env, grips[shape])
        force, felt = pairs[:, pairs[0] > 0.01]
        assert force.size > 40 and np.ptp(force) > 5
        r, r_sum = np.corrcoef(force, felt)[0, 1], np.corrcoef(*pairs.sum(-1))[0, 1]
        print(f"{shape}: r = {r:.3f} of {force.size} fingers, {r_sum:.3f} of {pairs.shape[1]} hands")
        assert r >= 0.9, f"{shape}: {r:.3f}"


class TestTouch:
    def test_taxels_share_what_presses_of_the_solvers_force(self, grips):
        """Sum over a finger's taxels = its force less friction, or nothing where the link touches off them.

        Coulomb: what is left, sideways, is at most friction times what presses. The taxels' normals are
        not the contact's own, hence the slack.
        """
        pressed, total, friction = [], [], []
        for after, count in [batch for shape in SHAPES for batch in grips[shape]]:
            felt = np.asarray(after.sensor_input.taxel_force.sum(-1))[:count]
            force = np.asarray(after.finger_force)[:count]
            use = felt > 0.1
            pressed, total = [*pressed, *felt[use]], [*total, *force[use]]
            friction += [*np.broadcast_to(np.asarray(after.episode.object.friction)[:count, None], force.shape)[use]]
        pressed, total, friction = np.array(pressed), np.array(total), np.array(friction)
        assert len(pressed) > 150
        assert np.all(pressed <= total * (1 + 1e-4))
        assert np.median(pressed / total) < 0.98, "friction is in the taxels' sum"
        sideways = np.sqrt(np.maximum(total**2 - pressed**2, 0)) / (friction * pressed)
        assert np.quantile(sideways, 0.98) < 1.4 and sideways.max() < 3

    def test_a_plate_at_rest_on_the_fingertips_weighs_m_g(self, hand, grasp_env, grasp_rollout):
        """Fingers bent to a fist, a plate inside it on four tips, 0.3 to 1 kg: sum F = m g.

        The plate is carried by nothing else (see c_scene). Soft contacts let it creep by mm/s.
        """
        mass = np.linspace(0.3, 1.0, WORLDS)
        half = np.array([0.006, 0.036, 0.011])
        speck = np.full(3, 1e-4)
        inertia = mass[:, None] / 3 * (np.sum(half**2) - half**2)
        target = dataclasses.replace(
            grasp_rollout.reset(jax.random.key(0)).episode.object,
            shape_index=np.full(WORLDS, SHAPES.index("box")),
            size=np.tile(np.stack([half, speck, speck]), (WORLDS, 1, 1)),
            position=np.zeros((WORLDS, 3, 3)),
            active=np.tile([True, False, False], (WORLDS, 1)),
            mass=mass,
            inertia=inertia,
            com=np.zeros((WORLDS, 3)),
            friction=np.full(WORLDS, 0.9),
            contact=np.tile([1700.0, 2.0], (WORLDS, 1)),
        )
        fist = np.array([0, 0, 0, 0, *[1.57] * 8])
        qpos = np.tile([*fist, 0.039, -0.005, 0.0795, 1, 0, 0, 0], (WORLDS, 1))
        state = placed(grasp_rollout, 0, qpos, np.zeros((WORLDS, 18)), target)
        level = dataclasses.replace(state.episode.hand, tilt=jnp.zeros((WORLDS, 2)))
        state, still = with_episode(state, hand=level), state.key
        for _ in range(40):  # the same chance in every tick: one without a push
            state = grasp_rollout.step(dataclasses.replace(state, key=still), jnp.zeros((WORLDS, 12)))
        assert np.all(np.linalg.norm(state.physics.qvel[:, 12:15], axis=1) < 0.015), "still moving"
        names = set()
        for world in range(WORLDS):
            model = c_scene.compile_scene(hand, c_scene.row(target, world))
            data = c_scene.start(model, state.physics.qpos[world], state.physics.qvel[world])
            mujoco.mj_forward(model, data)
            names |= {model.geom(c.geom[0]).name for c in data.contact}
        pads = {"index_pad", "mid_pad", "ring_pad", "pinky_pad"}
        assert {name.rpartition("/")[0] for name in names} == pads, names

        weight = mass * 9.81
        np.testing.assert_allclose(np.sum(state.finger_force, -1), weight, rtol=0.05)
        np.testing.assert_allclose(np.sum(state.sensor_input.taxel_force, (-1, -2)), weight, rtol=0.05)
        assert np.all(np.asarray(state.finger_force)[:, 0] == 0)
        assert np.all(np.asarray(state.finger_force)[:, 1:] > 0.05 * weight[:, None])

    @pytest.mark.parametrize("shape", SHAPES)
    def test_the_gradient_of_touch(self, hand, grasp_env, grips, shape):
        """d(skin force)/d(object pose) against central differences, in float64."""
        after = grips[shape][0][0]
        total = np.asarray(after.sensor_input.taxel_force.sum((-1, -2)))
        worlds = np.argsort(total)[-2:]
        assert np.all(total[worlds] > 0.5)
        area, skin = jnp.asarray(hand.taxel_area), grasp_env.config.skin

        def force(taxels, shape, place, pose):
            position, turn = pose[:3], pose[3:]
            angle = jnp.sqrt(jnp.sum(turn**2) + 1e-24)
            rotation = rotations.compose(
                rotations.axis_angle_to_matrix(turn / angle, angle), rotations.quat_to_matrix(place[3:])
            )
            touch = feel(taxels, area, shape, place[:3] + position, rotation, jnp.ones(5), skin)
            return jnp.sum(touch.skin_force)

        with c_scene.double_precision():
            both = jax.jit(jax.value_and_grad(force, argnums=3))
            taxels_at = jax.jit(lambda joints: taxel_positions(hand, forward_kinematics(hand, joints)))
            for world in worlds:
                joints = jnp.asarray(np.asarray(after.physics.qpos[world, :12], np.float64))
                taxels = taxels_at(joints)
                target = jax.tree.map(
                    lambda x: jnp.asarray(x, jnp.float64) if x.dtype == np.float32 else jnp.asarray(x),
                    c_scene.row(after.episode.object, world),
                )
                shape = target.shape()
                place = np.asarray(after.physics.qpos[world, 12:], np.float64)
                place[3:] /= np.linalg.norm(place[3:])
                pose, step = np.full(6, 1e-6), 1e-8
                _, gradient = both(taxels, shape, place, pose)
                numeric = [
                    (
                        both(taxels, shape, place, pose + step * axis)[0]
                        - both(taxels, shape, place, pose - step * axis)[0]
                    )
                    / (2 * step)
                    for axis in np.eye(6)
                ]
                assert np.all(np.isfinite(gradient))
                assert np.linalg.norm(gradient[:3]) > 100  # N/m
                np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max())

    def test_gradients_through_the_whole_batch_are_finite(self, hand, grasp_env, grips):
        after = grips["composition"][0][0]

        def total(position, world):
            taxels = taxel_positions(hand, forward_kinematics(hand, world.physics.qpos[:12]))
            touch = feel(
                taxels,
                jnp.asarray(hand.taxel_area),
                world.episode.object.shape(),
                position,
                rotations.quat_to_matrix(world.physics.qpos[15:]),
                world.finger_force,
                grasp_env.config.skin,
            )
            force, centre = reduce_touch(touch.force, taxels)
            return jnp.sum(force) + jnp.sum(centre)

        gradient = jax.jit(jax.vmap(jax.grad(total)))(after.physics.qpos[:, 12:15], after)
        assert np.all(np.isfinite(gradient)) and np.any(gradient != 0)


def test_nothing_was_compiled_twice(grasp_rollout, history):
    """The last test here: resets, steps and restarts above shared one program each."""
    state = grasp_rollout.restart(history[-1][2], jnp.ones(WORLDS, bool))
    state = grasp_rollout.step(grasp_rollout.step(state, actions(0)), actions(1))
    grasp_rollout.restart(state, state.truncated)
    grasp_rollout.reset(jax.random.key(9))
    for name in ("reset", "step", "restart"):
        assert getattr(grasp_rollout, name)._cache_size() == 1, name
