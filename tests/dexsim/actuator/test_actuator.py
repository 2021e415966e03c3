"""The joint drive against a plain-Python reference, closed forms and C MuJoCo."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dexsim.actuator import drive as actuator
from dexsim.actuator.drive import Actuator, apply_friction

joint_torque = jax.jit(actuator.joint_torque)
at_limit = jax.jit(actuator.at_limit)


def reference(kp, kd, band, stall, top_speed, efficiency, target, target_velocity, position, velocity):
    """The four equations one joint at a time, in double precision: torque, what the loop asks for, and the limit."""
    error = target - position
    if -band < error < band:
        wanted = 0.0
    else:
        wanted = kp * error + kd * (target_velocity - velocity)
    share = math.fabs(velocity) / top_speed
    available = 0.0 if share >= 1.0 else stall * (1.0 - share)
    given = math.copysign(available, wanted) if math.fabs(wanted) > available else wanted
    return efficiency * given, wanted, available


def random_drives(count, seed=0):
    rng = np.random.default_rng(seed)
    drives = Actuator(
        stiffness=rng.uniform(0.1, 10, count),
        damping=rng.uniform(0, 0.5, count),
        dead_band=rng.uniform(0, 0.05, count),
        stall_torque=rng.uniform(0.3, 1.2, count),
        no_load_speed=rng.uniform(8, 15, count),
        efficiency=rng.uniform(0.7, 1.0, count),
    )
    state = (
        rng.uniform(-0.3, 0.3, count),
        rng.uniform(-1, 1, count),
        rng.uniform(-0.3, 0.3, count),
        rng.uniform(-20, 20, count) * rng.uniform(0, 1, count) ** 2,
    )
    cast = lambda x: np.asarray(x, np.float32)  # noqa: E731
    return jax.tree.map(cast, drives), tuple(cast(x) for x in state)


def motor(**changes):
    values = dict(stiffness=3.0, damping=0.1, dead_band=0.0, stall_torque=1.1, no_load_speed=8.63, efficiency=1.0)
    return Actuator(**{name: jnp.float32(value) for name, value in {**values, **changes}.items()})


def test_ten_thousand_random_drives():
    drives, state = random_drives(10_000)
    ours, limited = np.asarray(joint_torque(drives, *state)), np.asarray(at_limit(drives, *state))
    leaves = [getattr(drives, f.name) for f in dataclasses.fields(drives)[:6]]
    wanted, asked, limit = np.array([reference(*map(float, row)) for row in zip(*leaves, *state, strict=True)]).T
    np.testing.assert_allclose(ours, wanted, rtol=1e-5, atol=1e-6)
    sure = np.abs(np.abs(asked) - limit) > 1e-5
    np.testing.assert_array_equal(limited[sure], np.abs(asked[sure]) > limit[sure])
    # All regimes occur: within the band, free, and held by the envelope on either side, beyond the no-load speed.
    regimes = [asked == 0, ~limited & (asked != 0), limited & (wanted > 0), limited & (wanted < 0), limit == 0]
    assert all(regime.sum() > 200 for regime in regimes)


def test_the_edges_of_the_dead_band():
    """|error| < epsilon is dead, |error| = epsilon is not; without a band nothing is, not even at zero error."""
    sticky = motor(dead_band=0.125, damping=0.0)
    for sign in (1, -1):
        assert float(joint_torque(sticky, sign * 0.125, 0.0, 0.0, 0.0)) == pytest.approx(sign * 0.375)
    assert float(joint_torque(motor(), 0.0, 0.0, 0.0, 3.0)) == pytest.approx(-0.3)


def slide(torque, *, coulomb=0.0, viscous=0.0, inertia=1e-3, timestep=1e-3, velocity=0.0, steps=1000):
    """Velocities of a joint with nothing but friction, semi-implicit as the physics."""
    rubbing = motor(coulomb_friction=coulomb, viscous_friction=viscous)
    wanted = jnp.broadcast_to(jnp.asarray(torque, jnp.float32), (steps,))

    def body(speed, tau):
        net = apply_friction(rubbing, tau, speed, inertia / timestep)
        speed = speed + timestep / inertia * net
        return speed, speed

    return np.asarray(jax.lax.scan(body, jnp.float32(velocity), wanted)[1])


def c_hinge(coulomb, viscous, torque, timestep=5e-4):
    """Angles and speeds of a hinge with frictionloss and damping in C MuJoCo."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option timestep="{timestep}" integrator="Euler" gravity="0 0 0" iterations="100" tolerance="1e-12"/>
      <worldbody><body><joint type="hinge" axis="0 0 1" armature="0.001" frictionloss="{coulomb}" damping="{viscous}"
        solreffriction="{2.1 * timestep} 1" solimpfriction="0.9999 0.9999 0.001"/>
      <inertial mass="0.001" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>""")
    data, track = mujoco.MjData(model), []
    for tau in torque:
        data.qfrc_applied[0] = tau
        mujoco.mj_step(model, data)
        track.append((data.qpos[0], data.qvel[0]))
    return np.array(track)


@pytest.mark.parametrize(("coulomb", "viscous"), [(0.02, 0.0), (0.0, 0.01), (0.02, 0.005)])
def test_friction_is_c_mujocos(coulomb, viscous):
    """A second of a torque that pushes, holds still below the friction, and reverses."""
    times = 5e-4 * np.arange(2000)
    torque = 0.05 * np.sin(2 * np.pi * 2.3 * times) * (1 + 0.4 * np.sin(2 * np.pi * 0.7 * times))
    reference = c_hinge(coulomb, viscous, torque)
    speed = slide(torque, coulomb=coulomb, viscous=viscous, timestep=5e-4, steps=2000)
    assert np.max(np.abs(reference[:, 1])) > 2
    np.testing.assert_allclose(speed, reference[:, 1], atol=0.01)
    np.testing.assert_allclose(np.cumsum(speed) * 5e-4, reference[:, 0], atol=2e-3)
    if coulomb:
        assert np.mean(speed == 0) > 0.02
