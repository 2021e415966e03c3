"""What is drawn at every episode start: ranges, the nominal hand, curriculum, held-out hands."""

import copy
import dataclasses
import functools

import jax
import numpy as np
import pytest
from episodes import with_episode

from dexsim.randomization import Randomization, sample_hand
from dexsim.randomization_check.__main__ import conclude
from dexsim.randomization_check.effects import check

TIMES = dict(timestep=0.005, control_period=0.03)


@functools.cache
def draws(hand, config):
    """1,000 draws. Not jitted as a whole: a config is a constant, so each would be another compilation."""
    keys = jax.random.split(jax.random.key(0), 1000)
    return jax.vmap(lambda key: sample_hand(key, config, hand, **TIMES))(keys)


def quantities(hand, drawn):
    """Each drawn quantity as the config names its range, one row per draw."""
    motors = drawn.actuator
    return {
        "stiffness_factor": motors.stiffness / 3.0,
        "damping_factor": motors.damping / 0.1,
        "dead_band": motors.dead_band,
        "torque_factor": motors.stall_torque / hand.torque_limit,
        "speed_factor": motors.no_load_speed / hand.speed_limit,
        "efficiency": motors.efficiency,
        "ripple": motors.ripple,
        "ripple_count": motors.ripple_count,
        "coulomb_friction": motors.coulomb_friction / hand.torque_limit,
        "viscous_friction": motors.viscous_friction,
        "latency": drawn.latency[:, :1] * TIMES["timestep"],
        "sensing_latency": drawn.sensing_latency[:, None] * TIMES["control_period"],
        "encoder_bias": drawn.encoder_bias,
        "torque_gain": drawn.torque_gain,
        "taxel_gain": drawn.taxel_gain[..., 0],
        "gravity_tilt": drawn.tilt,
        "pad_thickness_delta": drawn.pad_thickness_delta[:, None],
    }


# No two alike, so that none can be taken for another.
EVEN = Randomization(latency_spread=(0.0, 0.0))  # so that the common latency shows
DISTINCT = Randomization(
    ripple=(0.05, 0.06),
    ripple_count=(300.0, 310.0),
    coulomb_friction=(0.2, 0.21),
    viscous_friction=(0.002, 0.003),
    latency_spread=(0.0, 0.0),
    stiffness_factor=(0.5, 0.7),
    damping_factor=(1.5, 1.9),
    dead_band=(0.03, 0.04),
    torque_factor=(0.75, 0.85),
    speed_factor=(1.1, 1.3),
    efficiency=(0.6, 0.65),
    latency=(0.01, 0.025),
    sensing_latency=(0.005, 0.01),
    encoder_bias=0.02,
    torque_gain=(1.3, 1.5),
    taxel_gain=(0.3, 0.4),
    gravity_tilt=0.5,
    pad_thickness_delta=(0.001, 0.002),
)


@pytest.mark.parametrize("config", [EVEN, DISTINCT], ids=["default", "distinct"])
def test_a_thousand_draws_fill_their_ranges_and_leave_none(hand, config):
    for name, values in quantities(hand, draws(hand, config)).items():
        span = getattr(config, name)
        low, high = span if isinstance(span, tuple) else (-span, span)
        values, width = np.asarray(values, float), high - low
        assert values.min() >= low - 1e-5 and values.max() <= high + 1e-5, name
        assert values.min() < low + 0.02 * width and values.max() > high - 0.02 * width, name
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.05 * width), name
        columns = values.reshape(len(values), -1)
        if columns.shape[1] > 1:  # joints and fingers are drawn apart
            correlation = np.corrcoef(columns.T) - np.eye(columns.shape[1])
            assert np.abs(correlation).max() < 0.15, name


def test_scale_shrinks_all_ranges_about_the_nominal_hand(hand):
    """The same key at half the scale lands half way to nominal."""
    nominal, half, full = (quantities(hand, draws(hand, Randomization(scale=s))) for s in (0.0, 0.5, 1.0))
    for name in full.keys() - {"ripple_count"}:  # it has no nominal value
        wanted = (np.asarray(full[name]) + np.asarray(nominal[name])) / 2
        np.testing.assert_allclose(half[name], wanted, atol=1e-5, err_msg=name)


def test_latency_is_in_substeps_and_reaches_its_bound(hand):
    latency = np.asarray(draws(hand, EVEN).latency)
    assert latency.min() < 0.05 and 3.95 < latency.max() <= 4.0
    assert np.all(latency == latency[:, :1])  # common to all joints
    fixed = draws(hand, Randomization(latency=(0.015, 0.015), latency_spread=(0.0, 0.0)))
    np.testing.assert_allclose(fixed.latency, 3.0, rtol=1e-6)


# --- curriculum ------------------------------------------------------------------------------------


def test_a_traced_scale_is_the_configured_one(hand):
    """The scale may come from the training state: 0 is exactly nominal, and none of it recompiles."""
    draw = jax.jit(lambda key, scale: sample_hand(key, Randomization(), hand, **TIMES, scale=scale))
    key = jax.random.key(5)
    for scale in (0.0, 0.5, 1.0):
        other = sample_hand(key, Randomization(scale=scale), hand, **TIMES)
        for ours, theirs in zip(jax.tree.leaves(draw(key, scale)), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-8)
    nominal = draw(key, 0.0)
    np.testing.assert_array_equal(nominal.actuator.stall_torque, hand.torque_limit)
    np.testing.assert_array_equal(nominal.actuator.stiffness, np.full(12, 3.0, np.float32))
    for zero in (nominal.latency, nominal.encoder_bias, nominal.actuator.coulomb_friction, nominal.actuator.ripple):
        np.testing.assert_array_equal(zero, 0)
    assert draw._cache_size() == 1


# --- held out ----------------------------------------------------------------------------------------


def test_held_out_hands_lie_outside_every_range(hand):
    config = dataclasses.replace(EVEN, extremes=1.0, beyond=0.4)
    found = quantities(hand, draws(hand, config))
    for name in found.keys() - {"ripple_count"}:
        values = np.asarray(found[name], float)
        span = getattr(config, name)
        low, high = span if isinstance(span, tuple) else (-span, span)
        nominal = 1.0 if name.endswith(("factor", "gain")) or name == "efficiency" else 0.0
        slack = 1e-6
        assert np.all((values <= low + slack) | (values >= high - slack)), name
        far = 1.4 * max(high - nominal, nominal - low) + slack
        assert np.all(np.abs(values - nominal) <= far), name
        if low < nominal < high:  # both ends are visited
            assert 0.3 < np.mean(values > high - slack) < 0.7, name
        # None at an end that is the nominal value itself.
        assert np.all(np.abs(values - nominal) > 1e-4), name


# --- extremes -----------------------------------------------------------------------------------------


def test_a_share_of_hands_stands_in_corners_and_the_others_do_not(hand):
    config = dataclasses.replace(EVEN, extremes=0.3)
    drawn = draws(hand, config)
    plain = draws(hand, EVEN)
    at_end = {}
    for name, values in quantities(hand, drawn).items():
        if name == "ripple_count":
            continue
        span = getattr(config, name)
        low, high = span if isinstance(span, tuple) else (-span, span)
        nominal = 1.0 if name.endswith(("factor", "gain")) or name == "efficiency" else 0.0
        ends = [end for end in (low, high) if end != nominal]
        values = np.asarray(values, float)
        near = np.min([np.abs(values - end) for end in ends], 0) < 1e-6 * max(1.0, abs(high))
        at_end[name] = near.all(1)
        assert near[at_end[name]].all()
        sides = [np.mean(np.abs(values[at_end[name]] - end) < 1e-5) for end in ends]
        assert min(sides) > (0.4 if len(ends) == 2 else 0.99), name
        # Elsewhere the draw is what it is without extremes.
        others = ~at_end["stiffness_factor"]
        np.testing.assert_array_equal(values[others], np.asarray(quantities(hand, plain)[name], float)[others])
    assert 0.25 < np.mean(at_end["stiffness_factor"]) < 0.35
    for name, rows in at_end.items():
        np.testing.assert_array_equal(rows, at_end["stiffness_factor"], err_msg=name)


# --- refusals ------------------------------------------------------------------------------------------


# --- the self-test -----------------------------------------------------------------------------------

# What each range must reach, by the names of the drive's parameters and of the compiled model's fields.
REACHES = {
    "stiffness_factor": "hand.actuator.stiffness",
    "damping_factor": "hand.actuator.damping",
    "dead_band": "hand.actuator.dead_band",
    "torque_factor": "hand.actuator.stall_torque",
    "speed_factor": "hand.actuator.no_load_speed",
    "efficiency": "hand.actuator.efficiency",
    "latency": "hand.latency",
    "latency_spread": "hand.latency",
    "ripple": "hand.actuator.ripple",
    "ripple_count": "hand.actuator.ripple_count",
    "coulomb_friction": "hand.actuator.coulomb_friction",
    "viscous_friction": "hand.actuator.viscous_friction",
    "sensing_latency": "hand.sensing_latency",
    "encoder_bias": "hand.actuator.encoder_bias",
    "torque_gain": "hand.torque_gain",
    "taxel_gain": "hand.taxel_gain",
    "gravity_tilt": "hand.tilt",
    "pad_thickness_delta": "hand.pad_thickness_delta",
    "mass": "body_mass",
    "inertia_scale": "body_inertia",
    "com_offset": "body_ipos",
    "friction": "pair_friction",
    "link_friction": "pair_friction",
    "sphere_radius": "geom_size",
    "box_half": "geom_size",
}
SENSED = ("sensing_latency", "torque_gain", "taxel_gain")  # in the readings, without effect on the motion


@pytest.fixture(scope="module")
def fresh(grasp_rollout):
    return grasp_rollout.reset(jax.random.key(21))


def test_every_range_reaches_the_model_and_the_motion(grasp_env, grasp_rollout, fresh):
    effects = check(grasp_env, grasp_rollout.step, fresh, key=jax.random.key(0), ticks=9)
    by_name = {effect.name.split(".")[-1]: effect for effect in effects}
    assert len(by_name) == len(effects) >= 30 and conclude(effects) == 0
    for name, leaf in REACHES.items():
        effect = by_name[name]
        assert leaf in effect.changed and not effect.off, name
        if name in SENSED:
            assert effect.joint == effect.object == 0 and effect.reading > 1e-3, name
        else:
            assert max(effect.joint, effect.object) > 1e-6, name


def test_a_lost_range_fails_the_check(grasp_env, grasp_rollout, fresh, capsys):
    """Viscous friction is lost between draw and physics; a ripple without width is off, and no error."""

    def ignores_friction(states, action):
        drawn = states.episode.hand
        calm = dataclasses.replace(drawn.actuator, viscous_friction=0 * drawn.actuator.viscous_friction)
        return grasp_rollout.step(with_episode(states, hand=dataclasses.replace(drawn, actuator=calm)), action)

    env = copy.copy(grasp_env)
    env.config = dataclasses.replace(env.config, randomization=Randomization(ripple=(0.0, 0.0)))
    names = [f"randomization.{name}" for name in ("viscous_friction", "speed_factor", "ripple")]
    lost, works, off = check(env, ignores_friction, fresh, key=jax.random.key(0), ticks=6, names=names)
    assert not lost.works and lost.changed == ("hand.actuator.viscous_friction",)
    assert works.works and not works.off and off.off and off.works
    assert conclude([lost, works, off]) == 2
    assert "no effect on model or motion: randomization.viscous_friction\n" in capsys.readouterr().err
