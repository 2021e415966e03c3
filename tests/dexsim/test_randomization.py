"""What is drawn at every episode start: ranges, the nominal hand, curriculum, held-out hands."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.randomization import Randomization, sample_hand

TIMES = dict(timestep=0.005, control_period=0.03)


@functools.cache
def draws(hand, config):
    """1,000 draws. Not jitted as a whole: a config is a constant, so each would be another compilation."""
    keys = jax.random.split(jax.random.key(0), 1000)
    return jax.device_get(jax.vmap(lambda key: sample_hand(key, config, hand, **TIMES))(keys))


def quantities(hand, drawn):
    """Each drawn quantity as the config names its range, one row per draw."""
    motors = drawn.actuator
    same = "dead_band", "efficiency", "ripple", "ripple_count", "viscous_friction", "encoder_bias"
    return {name: getattr(motors, name) for name in same} | {
        "stiffness_factor": motors.stiffness / 3.0,
        "damping_factor": motors.damping / 0.1,
        "torque_factor": motors.stall_torque / hand.torque_limit,
        "speed_factor": motors.no_load_speed / hand.speed_limit,
        "coulomb_friction": motors.coulomb_friction / hand.torque_limit,
        "latency": drawn.latency[:, :1] * TIMES["timestep"],
        "sensing_latency": drawn.sensing_latency[:, None] * TIMES["control_period"],
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


# --- held out, and in corners ------------------------------------------------------------------------


def ranges_of(hand, config):
    """(name, draws, low, high, nominal) of all ranges but that of `ripple_count`, which has no nominal value."""
    for name, values in quantities(hand, draws(hand, config)).items():
        if name != "ripple_count":
            span = getattr(config, name)
            low, high = span if isinstance(span, tuple) else (-span, span)
            nominal = 1.0 if name.endswith(("factor", "gain")) or name == "efficiency" else 0.0
            yield name, np.asarray(values, float), low, high, nominal


def test_held_out_hands_lie_outside_every_range(hand):
    slack = 1e-6
    for name, values, low, high, nominal in ranges_of(hand, dataclasses.replace(EVEN, extremes=1.0, beyond=0.4)):
        assert np.all((values <= low + slack) | (values >= high - slack)), name
        far = 1.4 * max(high - nominal, nominal - low) + slack
        assert np.all(np.abs(values - nominal) <= far), name
        if low < nominal < high:  # both ends are visited
            assert 0.3 < np.mean(values > high - slack) < 0.7, name
        # None at an end that is the nominal value itself.
        assert np.all(np.abs(values - nominal) > 1e-4), name


def test_a_share_of_hands_stands_in_corners_and_the_others_do_not(hand):
    plain, corners = {name: values for name, values, *_ in ranges_of(hand, EVEN)}, None
    for name, values, low, high, nominal in ranges_of(hand, dataclasses.replace(EVEN, extremes=0.3)):
        ends = [end for end in (low, high) if end != nominal]
        near = np.min([np.abs(values - end) for end in ends], 0) < 1e-6 * max(1.0, abs(high))
        corners = near.all(1) if corners is None else corners
        np.testing.assert_array_equal(near.all(1), corners, err_msg=name)
        sides = [np.mean(np.abs(values[corners] - end) < 1e-5) for end in ends]
        assert min(sides) > (0.4 if len(ends) == 2 else 0.99), name
        # Elsewhere the draw is what it is without extremes.
        np.testing.assert_array_equal(values[~corners], plain[name][~corners])
    assert 0.25 < np.mean(corners) < 0.35


# --- what each value that is drawn reaches ------------------------------------------------------------

MOVING = """
hand.actuator.stiffness hand.actuator.damping hand.actuator.dead_band hand.actuator.stall_torque
hand.actuator.no_load_speed hand.actuator.efficiency hand.actuator.ripple hand.actuator.ripple_count
hand.actuator.ripple_phase hand.actuator.encoder_bias hand.actuator.coulomb_friction hand.actuator.viscous_friction
hand.latency hand.tilt hand.pad_thickness_delta object.mass object.inertia object.com object.friction
object.link_friction object.contact object.size
""".split()
# In a reading, without effect on the motion.
SENSED = {
    "hand.sensing_latency": "joint_position",
    "hand.torque_gain": "joint_torque",
    "hand.taxel_gain": "taxel_force",
    "imu.bias": "palm_gravity",
    "imu.drift": "object_quat",
    "imu.delay": "object_quat",
    **dict.fromkeys(
        (f"taxels.{name}" for name in "hysteresis memory crosstalk gain bias drift alive rate".split()), "taxel_force"
    ),
}


READINGS = ("joint_position", "joint_torque", "taxel_force", "object_position", "object_quat", "palm_gravity")


def leaf_name(path):
    return jax.tree_util.keystr(path, simple=True, separator=".")


def test_every_value_that_is_drawn_reaches_motion_or_readings(grasp_rollout):
    """Where a world has its neighbour's value, something differs after nine ticks."""
    states = grasp_rollout.reset(jax.random.key(21))
    actions = np.random.default_rng(4).uniform(-0.5, 1.5, (9, *states.joint_target.shape)).astype(np.float32)

    def run(episode):
        state, rows = dataclasses.replace(states, episode=episode), []
        for action in actions:
            state = grasp_rollout.step(state, action)
            rows.append([state.physics.qpos, *(getattr(state.readings, name) for name in READINGS)])
        return [np.stack(column) for column in zip(*rows, strict=True)]

    plain = run(states.episode)

    def show(*paths):
        """What differs with other values there, one in each fourth world: "motion", or names of readings."""
        world = np.arange(len(actions[0])) % 4

        def swap(place, leaf):
            own = np.array([*paths, *[""] * 4])[world] == leaf_name(place)
            return jnp.where(own.reshape(-1, *[1] * (leaf.ndim - 1)), jnp.roll(leaf, 1, 0), leaf)

        found = run(jax.tree_util.tree_map_with_path(swap, states.episode))
        apart = [np.abs(a - b).max(axis=(0, *range(2, a.ndim))) > 1e-6 for a, b in zip(plain, found, strict=True)]
        for k, path in enumerate(paths):
            changed = zip(("motion", *READINGS), (np.any(moved[world == k]) for moved in apart), strict=True)
            yield path, [name for name, moved in changed if moved]

    drawn = {leaf_name(path) for path, x in jax.tree_util.tree_leaves_with_path(states.episode) if np.any(x != x[:1])}
    # What belongs to a size, the phase of an IMU that is as fast as the control, and one of taxels, which shows late.
    silent = {"object.shape_index", "object.position", "object.active", "imu.phase", "taxels.phase"}
    assert drawn - silent == {*MOVING, *SENSED}
    contact = np.asarray(states.episode.object.contact)
    assert np.ptp(contact, axis=0).min() > 0, "stiffness or damping of the contact is not drawn"
    names = [*MOVING, *SENSED]
    for path, found in (each for k in range(0, len(names), 4) for each in show(*names[k : k + 4])):
        assert SENSED.get(path, "motion") in found and ("motion" in found) == (path in MOVING), path
