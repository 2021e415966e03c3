"""The environment as a whole: pure steps, episodes, readings, touch. One compiled grasp for all."""

import copy
import dataclasses
from types import SimpleNamespace

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import skin_law
from episodes import by_field, ground_truth, with_episode
from tiny_env import assert_same, leaves

from dexsim import observation
from dexsim.actuator.drive import delayed_target
from dexsim.env.evaluation import take_snapshot
from dexsim.env.motors import JointCommand
from dexsim.hand.kinematics import forward_kinematics
from dexsim.objects.config import SHAPES
from dexsim.physics.interface import PhysicsState

WORLDS = 8


def row(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


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


def test_same_inputs_same_outputs_and_worlds_do_not_mix(grasp_rollout, history):
    """A permuted batch gives permuted results, bit for bit."""
    state, action, following = history[6]
    assert_same(grasp_rollout.step(state, action), following)
    order = np.array([3, 1, 7, 0, 5, 2, 6, 4])
    assert_same(grasp_rollout.step(row(state, order), action[order]), row(following, order))


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
        state = with_episode(grasp_rollout.reset(jax.random.key(11)), object=starts.object)
        physics = PhysicsState(starts.qpos, starts.qvel, jnp.zeros((WORLDS, 18)))
        state = dataclasses.replace(state, physics=physics, joint_target=jnp.asarray(starts.qpos[:, :12]))
        for _ in range(8):
            state = grasp_rollout.step(state, np.tile(np.float32(np.arange(12) > 3), (WORLDS, 1)))
        action = actions(3)
        after = grasp_rollout.step(state, action)
        push = jax.vmap(lambda key, target: grasp_env.task.push(jax.random.split(key, 4)[1], target))(
            state.key, state.episode.object
        )

        # Torque readings: what the motors give at the end of the tick, over the stall torque.
        position, velocity = (np.asarray(x[:, :12], float) for x in (after.physics.qpos, after.physics.qvel))
        torque = plain_drive(
            c_scene.row(after.episode.hand.actuator, slice(None)), np.asarray(after.joint_target), position, velocity
        )
        np.testing.assert_allclose(np.asarray(after.joint_torque) * hand.torque_limit, torque, atol=2e-5)

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
            inertia_rate, armature = model.dof_M0[:12] / 0.006, model.dof_armature[:12].copy()
            down = np.array([1.0, -np.tan(tilt[1]), np.tan(tilt[0])])
            force = target.mass * 9.81 * (down / np.linalg.norm(down) - [1.0, 0, 0])
            data.xfrc_applied[model.body("object").id, :3] = force + np.asarray(push[world])
            for substep in range(config.physics.substeps):
                acting = new + np.clip(latency - substep, 0, 1) * (old - new)

                def motors(q, v, acting=acting, drive=drive, rate=inertia_rate):
                    torque = plain_drive(drive, acting, q, v)
                    return torque - plain_friction(drive, torque, v, rate)

                # The motors' damping acts at the middle of the step: half of its slope, by differences, is inertia.
                q, v, h = data.qpos[:12].copy(), data.qvel[:12].copy(), model.opt.timestep
                damping = np.maximum(motors(q, v - 1e-4) - motors(q, v + 1e-4), 0) / 2e-4
                data.qfrc_applied[:12] = motors(q, v)
                model.dof_armature[:12] = armature + 0.5 * h * damping
                mujoco.mj_step(model, data)
            felt = np.linalg.norm(c_scene.finger_force(model, data, hand), axis=-1)
            strong += np.sum(felt > 0.5)
            np.testing.assert_allclose(after.joint_target[world], new, atol=1e-6)
            np.testing.assert_allclose(after.physics.qpos[world], data.qpos, atol=4e-2)
            np.testing.assert_allclose(after.physics.qpos[world, 12:15], data.qpos[12:15], atol=1e-3)
            close += list(np.isclose(after.finger_force[world], felt, atol=0.5, rtol=0.15)[felt > 0.5])
        assert strong >= 5, "hardly a finger touches: the test tests nothing"
        assert np.mean(close) > 0.6

    def test_a_latency_of_more_than_a_tick_is_that_of_the_tick_before(self, grasp_env):
        """The targets that act in three sub-steps: the mean of two where the latency ends within one."""
        one, latency = jnp.ones(3), jnp.array([0.5, 3.0, 4.5])
        command = JointCommand(0 * one, target=3 * one, previous=2 * one, valid=one > 0, earlier=one)
        delay = grasp_env.motors._delay(SimpleNamespace(latency=latency), command)
        acting = [delayed_target(jnp.int32(substep), *delay) for substep in range(3)]
        np.testing.assert_allclose(acting, [[2.5, 2, 1], [3, 2, 1.5], [3, 2, 2]])

    def test_actions_are_clipped(self, grasp_rollout, history):
        state, _, _ = history[4]
        after = grasp_rollout.step(state, 3.0 * jnp.sign(actions(5)))
        np.testing.assert_array_equal(after.readings.last_action, after.action)
        assert_same(after, grasp_rollout.step(state, jnp.sign(actions(5))))
        assert np.abs(after.action).max() == 1.0 and np.abs(after.joint_target - state.joint_target).max() > 0.1


def plain_drive(drive, wanted, position, velocity):
    """The paper's four equations and the ripple; the loop sees the encoder."""
    error = wanted - (position + drive.encoder_bias)
    limit = drive.stall_torque * np.maximum(1 - np.abs(velocity) / drive.no_load_speed, 0)
    torque = drive.efficiency * np.clip(drive.stiffness * error - drive.damping * velocity, -limit, limit)
    torque = torque * (1 + drive.ripple * np.sin(drive.ripple_count * position + drive.ripple_phase))
    return np.where(np.abs(error) < drive.dead_band, 0.0, torque)


def plain_friction(drive, torque, velocity, inertia_rate):
    """What stops the joint within the sub-step, but no more than the friction; then b times the new speed."""
    momentum = inertia_rate * velocity + torque
    coulomb = np.minimum(np.abs(momentum), drive.coulomb_friction) * np.sign(momentum)
    return coulomb + drive.viscous_friction * (momentum - coulomb) / (inertia_rate + drive.viscous_friction)


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
        np.testing.assert_array_equal(after.metrics["reward/drop"], drop * np.asarray(after.terminated))

    def test_returns_add_up(self, history):
        total = np.zeros(WORLDS)
        for _, _, after in history:
            terms = [v for k, v in after.metrics.items() if k.startswith("reward/")]
            np.testing.assert_allclose(after.reward, np.sum(terms, axis=0), rtol=1e-5, atol=1e-6)
            total += np.asarray(after.reward)
            np.testing.assert_allclose(after.metrics["return"], total, rtol=1e-5, atol=1e-5)
        assert np.all(history[-1][2].metrics["length"] == len(history))

    def test_a_random_clock_is_uniform(self, grasp_env, history):
        state, limit = history[0][0], grasp_env.task.episode_ticks
        first = row(state, 0)
        draw = jax.jit(jax.vmap(lambda key: grasp_env.randomize_episode_time(first, key).tick))
        assert np.histogram(draw(jax.random.split(jax.random.key(6), 4000)), 4, (0, limit))[0].min() > 850

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
        for name in (".tick", ".length", ".episode_return", ".reward", ".metrics['non_finite']"):
            assert not np.any(ours[name][done]), name
        assert np.any(
            ours[".episode.hand.actuator.encoder_bias"][done] != before[".episode.hand.actuator.encoder_bias"][done]
        )
        np.testing.assert_array_equal(begun.joint_target[done], begun.physics.qpos[done, :12])
        # The object goes with its start.
        at = np.flatnonzero((np.asarray(grasp_env.pool.qpos) == ours[".physics.qpos"][0]).all(1))[0]
        np.testing.assert_array_equal(begun.episode.object.size[0], grasp_env.pool.object.size[at])

    def test_restarts_draw_at_the_states_scale_of_which_zero_is_nominal(self, hand, grasp_env, grasp_rollout, history):
        """Only what is done is drawn; sizes stay as the pool has them."""
        state, done = history[-1][2], np.arange(WORLDS) < 6
        begun = grasp_rollout.restart(dataclasses.replace(state, scale=jnp.zeros(WORLDS)), jnp.asarray(done))
        np.testing.assert_array_equal(begun.scale, 0.0)
        assert_same(begun.episode, state.episode, ~done)
        episode, objects = row(begun.episode, done), grasp_env.config.objects
        for value, nominal in (
            (episode.hand.actuator.stall_torque, hand.torque_limit),
            (episode.hand.actuator.encoder_bias, 0),
            (episode.hand.tilt, 0),
            (episode.imu.bias, 0),
            (episode.taxels["gain"], 1),
            (episode.taxels["bias"], 0),
            (episode.taxels["crosstalk"], 0),
            (episode.taxels["alive"], True),
            (episode.object.mass, np.mean(objects.mass)),
            (episode.object.friction, np.mean(objects.friction)),
            (episode.object.com, 0),
            (episode.object.contact[:, 0], np.mean(objects.stiffness)),
        ):
            np.testing.assert_array_equal(value, np.broadcast_to(np.float32(nominal), value.shape))
        assert len(np.unique(episode.object.contact[:, 1])) == 1
        box = np.flatnonzero(np.asarray(episode.object.shape_index) == SHAPES.index("box"))
        square = np.asarray(episode.object.size)[box, 0] ** 2
        inertia = np.mean(objects.mass) / 3 * (square.sum(-1, keepdims=True) - square)
        assert len(box) and np.ptp(inertia) > 0
        np.testing.assert_allclose(episode.object.inertia[box], inertia, rtol=1e-4)

    def test_an_object_is_held_until_it_is_let_go(self, grasp_env, grasp_rollout):
        """For 0.1 s, four ticks; then it falls freely."""
        state = grasp_rollout.reset(jax.random.key(3))
        aside, moving = state.physics.qpos.at[:, 13].add(1.0), state.physics.qvel.at[:, 12].set(0.1)
        state = dataclasses.replace(
            state,
            physics=dataclasses.replace(state.physics, qpos=aside, qvel=moving),
            goal=dataclasses.replace(state.goal, delay=jnp.full(WORLDS, 0.1, jnp.float32)),
        )
        heights, still = [], state.key
        for _ in range(7):  # the same chance in every tick: one without a push
            state = grasp_rollout.step(dataclasses.replace(state, key=still), jnp.zeros((WORLDS, 12)))
            heights.append(np.asarray(state.physics.qpos[:, 12]))
            assert (np.abs(state.physics.warmstart[:, 12]).max() < 1e-4) == (len(heights) <= 4), "weightless"
        np.testing.assert_array_equal(heights[:4], [heights[0]] * 4)
        steps = grasp_env.config.physics.substeps * np.arange(1, 4)  # semi-implicit Euler: n (n + 1) / 2 g h^2
        fall = 0.5 * 9.81 * steps * (steps + 1) * grasp_env.config.physics.timestep**2
        np.testing.assert_allclose(np.array(heights[4:]) - heights[3], np.tile(fall[:, None], WORLDS), rtol=0.02)


def test_the_contacts_springs_have_the_solvers_geometry_whatever_the_taxels_feel_by(grasp_env, history):
    after, other = history[-1][2], copy.copy(grasp_env)
    other.config = dataclasses.replace(grasp_env.config, touch_method="surface_points")
    other.touch_geometry = lambda object: dataclasses.replace(object.shape(), position=object.position + 0.001)  # 1 mm
    none = jnp.zeros((5, 3))
    feel = jax.jit(jax.vmap(lambda s: ground_truth(other, s.episode.object, s.physics, none, s.episode.hand)))
    found, own = feel(after), after.tip_stiffness
    np.testing.assert_allclose(found.tip_stiffness, own, rtol=1e-4)
    assert np.ptp(own) > 0.1 and np.any(found.touch.depth > 0)


def test_a_world_that_blows_up(grasp_rollout, history):
    """It terminates, shows sober numbers, and the others never notice.

    World 2 turns into NaN within the tick; world 5 gets motors that throw its joints to speeds that are finite,
    but not of this world; worlds 1 and 6 get an action that is not a number.
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
        with_episode(state, object=object, hand=dataclasses.replace(state.episode.hand, actuator=motors)),
        action.at[1, 0].set(jnp.nan).at[6].set(jnp.nan),
    )
    bad, good = np.array([1, 2, 5, 6]), np.array([0, 3, 4, 7])
    assert np.all(after.terminated[bad]) and not np.any(after.truncated[bad])
    assert np.all(after.metrics["non_finite"][bad[1:3]] == 1)
    assert_same(after, following, good)
    assert not np.any(after.metrics["non_finite"][good])
    assert_same(grasp_rollout.step(state, action), following)  # nothing of it is left in the engine
    assert np.all(np.abs(after.reward) < 100)
    for name in ("reward", "obs", "metrics", "physics", "episode_return"):
        for path, value in leaves(getattr(after, name)).items():
            assert np.all(np.isfinite(value)), (name, path)
    begun = grasp_rollout.restart(after, after.terminated)
    assert all(np.all(np.isfinite(value)) for value in leaves(begun).values())


class TestReadings:
    def test_the_observation_is_observe_of_the_readings(self, hand, grasp_env, history):
        after = history[-1][2]
        observe = lambda r: observation.observe(hand, r, observation.GRASP, grasp_env.config.observation)  # noqa: E731
        seen = jax.jit(jax.vmap(observe))(after.readings)
        np.testing.assert_allclose(after.obs["actor"], seen, rtol=1e-5, atol=1e-5)
        place = np.asarray(after.readings.object_position)
        np.testing.assert_array_equal(place[:, 1:], np.tile(np.float32(hand.grasp_centre[1:]), (WORLDS, 1)))
        assert np.ptp(place[:, 0]) > 0, "a camera measures the height alone"

    def test_a_film_shows_the_truth_and_no_goal_orientation_of_a_grasp(self, grasp_env, history):
        after = row(history[-1][2], 0)
        shown = take_snapshot(grasp_env, after)
        assert shown.goal_rotation is None and float(shown.seconds) == pytest.approx(12 * grasp_env.control_period)
        place = np.concatenate([shown.joint_position, shown.object_position])
        np.testing.assert_array_equal(place, after.physics.qpos[:15])

    def test_the_critic_sees_the_truth(self, hand, grasp_env, history):
        after = history[-1][2]
        fields = by_field(grasp_env.observation_layout["critic"], after.obs["critic"])
        np.testing.assert_allclose(fields["joint_position"], after.physics.qpos[:, :12], atol=1e-6)
        np.testing.assert_allclose(fields["object_position"], after.physics.qpos[:, 12:15], atol=1e-6)
        np.testing.assert_allclose(fields["object_velocity"], after.physics.qvel[:, 12:15], atol=1e-6)
        np.testing.assert_allclose(fields["joint_torque"], after.joint_torque, atol=1e-6)
        np.testing.assert_allclose(fields["contact_force"], after.taxel_force.sum(-1), rtol=1e-5, atol=1e-5)
        tips = jax.jit(jax.vmap(lambda q: forward_kinematics(hand, q).tip_position))(after.physics.qpos[:, :12])
        np.testing.assert_allclose(fields["fingertip_position"], tips.reshape(WORLDS, 15), atol=1e-6)
        np.testing.assert_allclose(fields["command"][:, 0], after.goal.command)
        # Taxels have the part of a finger's force that presses into the skin.
        felt, pressing = np.asarray(after.finger_force), np.asarray(after.taxel_force.sum(-1))
        touching = pressing > 0.1
        assert touching.sum() >= 5 and 0.8 < np.median(pressing[touching] / felt[touching]) < 0.9999
