"""The joint drive against a plain-Python reference, and what is drawn of it at every episode start."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim import actuator
from dexsim.actuator import Actuator
from dexsim.errors import ConfigError
from dexsim.randomization import Randomization, sample

joint_torque = jax.jit(actuator.joint_torque)
drive = jax.jit(actuator.drive)


def reference(kp, kd, band, stall, top_speed, efficiency, target, target_velocity, position, velocity):
    """The four equations one joint at a time, in double precision."""
    error = target - position
    if -band < error < band:
        wanted = 0.0
    else:
        wanted = kp * error + kd * (target_velocity - velocity)
    share = math.fabs(velocity) / top_speed
    available = 0.0 if share >= 1.0 else stall * (1.0 - share)
    if math.fabs(wanted) > available:
        wanted = math.copysign(available, wanted)
    return efficiency * wanted


def random_drives(count, seed=0):
    rng = np.random.default_rng(seed)
    drives = Actuator(
        stiffness=rng.uniform(0.1, 10, count), damping=rng.uniform(0, 0.5, count),
        dead_band=rng.uniform(0, 0.05, count), stall_torque=rng.uniform(0.3, 1.2, count),
        no_load_speed=rng.uniform(8, 15, count), efficiency=rng.uniform(0.7, 1.0, count))
    state = (rng.uniform(-0.3, 0.3, count), rng.uniform(-1, 1, count), rng.uniform(-0.3, 0.3, count),
             rng.uniform(-20, 20, count) * rng.uniform(0, 1, count) ** 2)
    cast = lambda x: np.asarray(x, np.float32)  # noqa: E731
    return jax.tree.map(cast, drives), tuple(cast(x) for x in state)


def motor(**changes):
    values = dict(stiffness=3.0, damping=0.1, dead_band=0.0, stall_torque=1.1, no_load_speed=8.63, efficiency=1.0)
    return Actuator(**{name: jnp.float32(value) for name, value in {**values, **changes}.items()})


def test_ten_thousand_random_drives():
    drives, state = random_drives(10_000)
    ours = np.asarray(drive(drives, *state))
    leaves = [getattr(drives, f.name) for f in dataclasses.fields(drives)]
    wanted = np.array([reference(*map(float, row)) for row in zip(*leaves, *state, strict=True)])
    np.testing.assert_allclose(ours, wanted, rtol=1e-5, atol=1e-6)
    # All regimes occur: within the band, free, and held by the envelope on either side, beyond the no-load speed.
    limit = drives.stall_torque * np.maximum(1 - np.abs(state[3]) / drives.no_load_speed, 0)
    held = np.isclose(np.abs(wanted), drives.efficiency * limit, rtol=1e-6) & (limit > 0)
    regimes = [np.abs(state[0] - state[2]) < drives.dead_band, ~held & (wanted != 0), held & (wanted > 0),
               held & (wanted < 0), limit == 0]
    assert all(regime.sum() > 200 for regime in regimes)


@pytest.mark.parametrize("push", [1, -1])
@pytest.mark.parametrize("turn", [1, -1])
def test_four_quadrants(push, turn):
    """Driving and braking alike are held to tau_0 (1 - |qd| / qd_max), with the sign of what is asked for."""
    velocity = turn * 8.63 / 4
    torque = joint_torque(motor(), push * 10.0, 0.0, 0.0, velocity)
    assert float(torque) == pytest.approx(push * 1.1 * 0.75, rel=1e-6)


@pytest.mark.parametrize("velocity", [8.63, 8.64, 20.0, 1e6])
def test_no_torque_from_the_no_load_speed_on(velocity):
    for sign in (1, -1):
        assert float(joint_torque(motor(), 10.0, 0.0, 0.0, sign * velocity)) == 0
        assert float(joint_torque(motor(), -10.0, 0.0, 0.0, sign * velocity)) == 0


def test_the_edges_of_the_dead_band():
    """|error| < epsilon is dead, |error| = epsilon is not; on exact binary fractions."""
    sticky = motor(dead_band=0.125, damping=0.0)
    just_below = np.nextafter(np.float32(0.125), np.float32(0))
    for sign in (1, -1):
        assert float(joint_torque(sticky, sign * 0.125, 0.0, 0.0, 0.0)) == pytest.approx(sign * 0.375)
        assert float(joint_torque(sticky, sign * just_below, 0.0, 0.0, 0.0)) == 0
    # The whole PD law is cut off, damping too.
    assert float(joint_torque(motor(dead_band=0.125), 0.1, 0.0, 0.0, 3.0)) == 0
    # No band: nothing is cut off, not even at zero error.
    assert float(joint_torque(motor(), 0.0, 0.0, 0.0, 3.0)) == pytest.approx(-0.3)


def test_efficiency_comes_after_the_limit():
    assert float(joint_torque(motor(efficiency=0.5), 10.0, 0.0, 0.0, 0.0)) == pytest.approx(0.55)
    assert float(joint_torque(motor(efficiency=0.5), 0.1, 0.0, 0.0, 0.0)) == pytest.approx(0.15)


def test_target_velocity_enters_the_damping():
    assert float(joint_torque(motor(), 0.0, 2.0, 0.0, 0.5)) == pytest.approx(0.1 * 1.5)


def test_vmapped_drive_is_the_scalar_one():
    drives, state = random_drives(32, seed=1)
    together = np.asarray(drive(drives, *state))
    for row in range(32):
        alone = joint_torque(jax.tree.map(lambda x, row=row: x[row], drives), *(x[row] for x in state))
        assert float(alone) == together[row]


# --- latency -------------------------------------------------------------------------------------


def test_delay_is_exact_to_the_substep():
    previous, target = jnp.full(12, -1.0), jnp.arange(12.0)
    for latency in range(8):
        for substep in range(6):
            acts = actuator.delayed_target(jnp.int32(substep), jnp.int32(latency), previous, target)
            np.testing.assert_array_equal(acts, previous if substep < latency else target)


def test_delay_within_a_scan_of_substeps():
    """The sub-step at which the target starts to act, seen from inside a tick, for each environment of a batch."""
    def tick(latency):
        return jax.lax.scan(lambda carry, k: (carry, actuator.delayed_target(k, latency, jnp.zeros(2), jnp.ones(2))),
                            0, jnp.arange(6))[1]
    seen = jax.jit(jax.vmap(tick))(jnp.arange(7))
    np.testing.assert_array_equal(seen[..., 0].sum(1), [6, 5, 4, 3, 2, 1, 0])
    np.testing.assert_array_equal(np.argmax(seen[:6, :, 0], 1), np.arange(6))


# --- every parameter is a leaf -------------------------------------------------------------------


def test_six_parameters_are_six_leaves():
    drives, _ = random_drives(12)
    leaves = jax.tree.leaves(drives)
    assert len(leaves) == len(dataclasses.fields(Actuator)) == 6
    assert all(leaf.shape == (12,) for leaf in leaves)
    doubled = jax.tree.map(lambda x: 2 * x, drives)
    np.testing.assert_array_equal(doubled.efficiency, 2 * drives.efficiency)


def gradient(drive, *state):
    return jax.jit(jax.grad(actuator.joint_torque))(drive, *(jnp.float32(x) for x in state))


def test_gradients_where_the_motor_is_free():
    """tau = eta (kp e - kd qd): e = 0.1, qd = 1."""
    slope = gradient(motor(efficiency=0.9), 0.1, 0.0, 0.0, 1.0)
    assert float(slope.stiffness) == pytest.approx(0.9 * 0.1, rel=1e-5)
    assert float(slope.damping) == pytest.approx(-0.9, rel=1e-5)
    assert float(slope.efficiency) == pytest.approx(3 * 0.1 - 0.1, rel=1e-5)
    assert float(slope.stall_torque) == float(slope.no_load_speed) == float(slope.dead_band) == 0


def test_gradients_where_the_envelope_holds():
    """tau = eta tau_0 (1 - qd / qd_max): qd = 2."""
    slope = gradient(motor(efficiency=0.9), 2.0, 0.0, 0.0, 2.0)
    assert float(slope.stall_torque) == pytest.approx(0.9 * (1 - 2 / 8.63), rel=1e-5)
    assert float(slope.no_load_speed) == pytest.approx(0.9 * 1.1 * 2 / 8.63**2, rel=1e-5)
    assert float(slope.efficiency) == pytest.approx(1.1 * (1 - 2 / 8.63), rel=1e-5)
    assert float(slope.stiffness) == float(slope.damping) == 0


def test_gradients_are_finite_in_the_band_and_beyond_the_no_load_speed():
    for drives, state in ((motor(dead_band=0.1), (0.0, 0.0, 0.0, 0.0)), (motor(), (1.0, 0.0, 0.0, 9.0)),
                          (motor(), (1.0, 0.0, 0.0, 8.63))):
        assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient(drives, *state)))


# --- what is drawn at every episode start ----------------------------------------------------------

TIMES = dict(timestep=0.005, control_period=0.03)


@functools.cache
def draws(hand, config, seed=0):
    """1,000 draws. Not jitted as a whole: a config is a constant, so each would be another compilation."""
    keys = jax.random.split(jax.random.key(seed), 1000)
    return jax.vmap(lambda key: sample(key, config, hand, **TIMES))(keys)


def test_scale_zero_is_the_nominal_hand(hand):
    config = Randomization(scale=0.0)
    drawn = draws(hand, config)
    for row in range(4):
        one = jax.tree.map(lambda x, row=row: np.asarray(x[row]), drawn)
        np.testing.assert_array_equal(one.actuator.stiffness, np.full(12, 3.0, np.float32))
        np.testing.assert_array_equal(one.actuator.damping, np.full(12, 0.1, np.float32))
        np.testing.assert_array_equal(one.actuator.stall_torque, hand.torque_limit)
        np.testing.assert_array_equal(one.actuator.no_load_speed, hand.speed_limit)
        np.testing.assert_array_equal(one.actuator.efficiency, np.ones(12))
        np.testing.assert_array_equal(one.torque_gain, np.ones(12))
        np.testing.assert_array_equal(one.taxel_gain, np.ones((5, 1)))
        for zero in (one.actuator.dead_band, one.latency, one.sensing_latency, one.encoder_bias, one.tilt):
            np.testing.assert_array_equal(zero, 0)


def quantities(hand, drawn):
    """Each drawn quantity as the config names its range, one row per draw."""
    motors = drawn.actuator
    return {"stiffness_factor": motors.stiffness / 3.0, "damping_factor": motors.damping / 0.1,
            "dead_band": motors.dead_band, "torque_factor": motors.stall_torque / hand.torque_limit,
            "speed_factor": motors.no_load_speed / hand.speed_limit, "efficiency": motors.efficiency,
            "latency": drawn.latency[:, None] * TIMES["timestep"],
            "sensing_latency": drawn.sensing_latency[:, None] * TIMES["control_period"],
            "encoder_bias": drawn.encoder_bias, "torque_gain": drawn.torque_gain,
            "taxel_gain": drawn.taxel_gain[..., 0], "gravity_tilt": drawn.tilt}


# No two alike, so that none can be taken for another.
DISTINCT = Randomization(stiffness_factor=(0.5, 0.7), damping_factor=(1.5, 1.9), dead_band=(0.03, 0.04),
                         torque_factor=(0.75, 0.85), speed_factor=(1.1, 1.3), efficiency=(0.6, 0.65),
                         latency=(0.03, 0.06), sensing_latency=(0.005, 0.01), encoder_bias=0.02,
                         torque_gain=(1.3, 1.5), taxel_gain=(0.3, 0.4), gravity_tilt=0.5)


@pytest.mark.parametrize("config", [Randomization(), DISTINCT], ids=["default", "distinct"])
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


def test_quantities_are_drawn_apart_from_one_another(hand):
    columns = np.stack([np.asarray(v, float).reshape(1000, -1)[:, 0]
                        for v in quantities(hand, draws(hand, Randomization())).values()])
    assert np.abs(np.corrcoef(columns) - np.eye(len(columns))).max() < 0.15


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_scale_shrinks_all_ranges_about_the_nominal_hand(hand, seed):
    """The same key at half the scale lands half way to nominal."""
    nominal, half, full = (quantities(hand, draws(hand, Randomization(scale=s), seed)) for s in (0.0, 0.5, 1.0))
    for name in full.keys() - {"latency"}:  # a whole number of sub-steps
        wanted = (np.asarray(full[name]) + np.asarray(nominal[name])) / 2
        np.testing.assert_allclose(half[name], wanted, atol=1e-5, err_msg=name)


def test_latency_is_whole_substeps_and_reaches_its_bound(hand):
    latency = np.asarray(draws(hand, Randomization(latency=(0.0, 0.02))).latency)
    assert latency.dtype == np.int32 and set(latency) == {0, 1, 2, 3, 4}
    fixed = draws(hand, Randomization(latency=(0.015, 0.015)))
    np.testing.assert_array_equal(fixed.latency, 3)


def test_a_range_the_wrong_way_round_is_refused():
    with pytest.raises(ConfigError, match=r"Randomization\.efficiency = \(1, 0\.8\)"):
        Randomization(efficiency=(1.0, 0.8))
    with pytest.raises(ConfigError, match=r"Randomization\.latency = -0\.1 s: must be between 0 and 0\.2 s"):
        Randomization(latency=(-0.1, 0.01))


@pytest.mark.parametrize("name", ["stiffness_factor", "damping_factor", "torque_factor", "speed_factor", "efficiency",
                                  "torque_gain", "taxel_gain"])
def test_a_scale_that_would_turn_a_motor_round_is_refused(name):
    """A factor of 0.5 at scale 3 would be 1 - 1.5: a negative gain, torque or speed."""
    Randomization(**{name: (0.5, 1.0)})
    with pytest.raises(ConfigError, match=f"{name}.*scale"):
        Randomization(scale=3.0, **{name: (0.5, 1.0)})


def test_the_widest_scale_keeps_the_motors_the_right_way_round(hand):
    drawn = draws(hand, Randomization(scale=3.0))
    for name in ("stiffness", "damping", "stall_torque", "no_load_speed", "efficiency"):
        assert np.min(getattr(drawn.actuator, name)) > 0, name
    assert np.min(drawn.actuator.dead_band) >= 0 and np.min(drawn.latency) >= 0
    assert 0 <= np.min(drawn.sensing_latency) and np.max(drawn.sensing_latency) <= 1
