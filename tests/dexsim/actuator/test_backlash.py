"""Gear play: closed forms, C MuJoCo's two-joint recipe, and what the paper's dead-band misses."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dexsim.actuator.drive import Actuator, apply_friction, joint_torque
from dexsim.actuator.gear_play import GearPlay, Rotor, drive_beside, drive_with_play, gear_at, rotor_at, tooth_torque

ROTOR, LINK = 1e-3, 3e-4  # kg m^2


def motor(**changes):
    values = dict(stiffness=3.0, damping=0.05, dead_band=0.0, stall_torque=1.1, no_load_speed=8.63, efficiency=1.0)
    return Actuator(**{name: jnp.float32(value) for name, value in {**values, **changes}.items()})


def pushed(play, motor_torque, load, timestep, start=(0.0, 0.0, 0.0, 0.0)):
    """Rotor and link under given torques [T]: rows (theta, w, q, v)."""

    def body(state, torques):
        theta, w, q, v = state
        tau, outside = torques
        tooth = tooth_torque(play, Rotor(theta, w), tau, q, v, inertia=LINK, timestep=timestep, link_torque=outside)
        w = w + timestep * (tau - tooth) / play.rotor_inertia
        v = v + timestep * (tooth + outside) / LINK
        state = (theta + timestep * w, w, q + timestep * v, v)
        return state, jnp.stack(state)

    start = tuple(jnp.float32(x) for x in start)
    torques = (jnp.asarray(motor_torque, jnp.float32), jnp.asarray(load, jnp.float32))
    return np.asarray(jax.jit(lambda t: jax.lax.scan(body, start, t))(torques)[1])


def c_gear(gap, motor_torque, load, timestep):
    """The recipe of MuJoCo's documentation: a second, unactuated joint whose range is the gap."""
    stiff = f'solreflimit="{2.1 * timestep} 1" solimplimit="0.9999 0.9999 1e-6"'
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><compiler angle="radian"/>
      <option timestep="{timestep}" gravity="0 0 0" iterations="100" tolerance="1e-14"/>
      <worldbody><body><inertial mass="0.001" pos="0 0 0" diaginertia="{LINK} {LINK} {LINK}"/>
        <joint name="rotor" axis="0 0 1" armature="{ROTOR}"/>
        <joint name="play" axis="0 0 1" limited="true" range="{-gap / 2} {gap / 2}" {stiff}/>
      </body></worldbody></mujoco>""")
    data, rows = mujoco.MjData(model), []
    for tau, outside in zip(motor_torque, load, strict=True):
        # A load on the link turns both coordinates of the chain.
        data.qfrc_applied[:] = (tau + outside, outside)
        mujoco.mj_step(model, data)
        rows.append((data.qpos[0], data.qvel[0], data.qpos.sum(), data.qvel.sum()))
    return np.array(rows)


def test_the_link_rests_until_the_gap_is_crossed():
    """At constant torque the rotor covers half the gap in sqrt(gap J / tau); then both go as one."""
    gap, tau, dt = 0.04, 0.02, 1e-4
    rows = pushed(GearPlay(gap=gap, rotor_inertia=ROTOR, tooth_stiffness=5e4), np.full(4000, tau), np.zeros(4000), dt)
    contact = np.sqrt(gap * ROTOR / tau)
    before = int(contact / dt) - 2
    assert np.all(rows[:before, 2] == 0) and rows[before + 8, 2] > 0
    times = dt * np.arange(1, 4001)
    np.testing.assert_allclose(rows[:before, 0], 0.5 * tau / ROTOR * times[:before] * (times[:before] + dt), rtol=1e-3)
    # Inelastic: momentum is shared, then the sum of inertias is accelerated.
    shared = ROTOR * (tau / ROTOR * contact) / (ROTOR + LINK)
    late = times > contact + 0.02
    np.testing.assert_allclose(rows[late, 3], shared + tau / (ROTOR + LINK) * (times[late] - contact), rtol=0.01)
    np.testing.assert_allclose(rows[late, 0] - rows[late, 2], gap / 2, atol=2e-5)


def test_gear_play_is_c_mujocos():
    """Half a second of reversals under motor and load torques: rotor, link and the gap between."""
    dt, gap = 1e-4, 0.03
    times = dt * np.arange(5000)
    torque = 0.03 * np.sin(2 * np.pi * 6 * times) + 0.01 * np.sin(2 * np.pi * 17 * times)
    load = -0.004 * np.sign(np.sin(2 * np.pi * 3 * times))
    reference = c_gear(gap, torque, load, dt)
    ours = pushed(GearPlay(gap=gap, rotor_inertia=ROTOR, tooth_stiffness=2e5), torque, load, dt)
    assert np.ptp(reference[:, 0] - reference[:, 2]) > 0.95 * gap, "the gap is not crossed"
    crossings = np.sum(np.diff(np.sign(reference[:, 0] - reference[:, 2])) != 0)
    assert crossings >= 4
    np.testing.assert_allclose(ours[:, 0], reference[:, 0], atol=0.02 * np.ptp(reference[:, 0]))
    np.testing.assert_allclose(ours[:, 2], reference[:, 2], atol=0.02 * np.ptp(reference[:, 2]))
    np.testing.assert_allclose(ours[:, 0] - ours[:, 2], reference[:, 0] - reference[:, 2], atol=0.1 * gap)
    assert np.mean(np.abs((ours - reference)[:, 0] - (ours - reference)[:, 2])) < 0.01 * gap


@pytest.mark.parametrize("timestep", [1e-4, 5e-3])
@pytest.mark.parametrize("stiffness", [1.0, 500.0, 1e6])
def test_no_tooth_is_too_stiff_for_the_time_step(timestep, stiffness):
    """The rotor stays in its gap but for the give of the tooth, at any stiffness; nothing blows up."""
    steps = int(0.5 / timestep)
    torque = 0.1 * np.sign(np.sin(2 * np.pi * 8 * timestep * np.arange(steps)))
    rows = pushed(GearPlay(gap=0.02, rotor_inertia=ROTOR, tooth_stiffness=stiffness), torque, np.zeros(steps), timestep)
    give = 0.1 * LINK / (ROTOR + LINK) / stiffness
    assert np.all(np.isfinite(rows))
    # A soft tooth also gives to the shock, up to the kinetic energy of the slip.
    shock = np.sqrt(ROTOR * LINK / (ROTOR + LINK) / stiffness) * np.abs(rows[:, 1]).max()
    assert np.abs(rows[:, 0] - rows[:, 2]).max() <= 0.01 + give + shock + 1e-4


def test_no_gap_is_the_rigid_drive():
    """Gap 0: the motion of one joint that carries both inertias, within the give of the tooth."""
    dt, steps = 1e-3, 600
    target = jnp.asarray(0.5 * np.sign(np.sin(2 * np.pi * 2 * dt * np.arange(steps))), jnp.float32)
    play = GearPlay(gap=0.0, rotor_inertia=ROTOR, tooth_stiffness=1e5)

    def geared(state, wanted):
        rotor, q, v = state
        tau, rotor = drive_with_play(motor(), play, rotor, wanted, q, v, inertia=LINK, timestep=dt)
        v = v + dt * tau / LINK
        return (rotor, q + dt * v, v), q

    def rigid(state, wanted):
        q, v = state
        v = v + dt * joint_torque(motor(), wanted, 0.0, q, v) / (ROTOR + LINK)
        return (q + dt * v, v), q

    zero = jnp.zeros(())
    ours = jax.lax.scan(geared, (rotor_at(zero, zero), zero, zero), target)[1]
    reference = jax.lax.scan(rigid, (zero, zero), target)[1]
    np.testing.assert_allclose(ours, reference, atol=5e-3)


def follow(model, target, *, gap, timestep=1e-3, inertia=LINK + ROTOR, link_friction=0.004):
    """Link angles while the drive follows targets, with gear play or with the dead-band, and a
    link that rubs: (what the encoder reads, where the link is)."""
    drives = motor(dead_band=gap / 2 if model == "dead-band" else 0.0)
    rubbing = motor(coulomb_friction=link_friction)
    play = GearPlay(gap=gap, rotor_inertia=ROTOR)

    def body(state, wanted):
        rotor, q, v = state
        if model == "play":
            tau, rotor = drive_with_play(drives, play, rotor, wanted, q, v, inertia=LINK, timestep=timestep)
            own = LINK
        else:
            tau, own = joint_torque(drives, wanted, 0.0, q, v), inertia
        v = v + timestep / own * apply_friction(rubbing, tau, v, own / timestep)
        q = q + timestep * v
        return (rotor, q, v), (rotor.position if model == "play" else q, q)

    zero = jnp.zeros(())
    read, link = jax.lax.scan(body, (rotor_at(zero, zero), zero, zero), jnp.asarray(target, jnp.float32))[1]
    return np.asarray(read), np.asarray(link)


def test_what_the_dead_band_misses():
    """Slow triangles of +-0.2 rad. With gear play the link lags by the gap at each reversal and the
    encoder does not see it; with the dead-band the encoder sees all there is."""
    gap, times = 0.02, 1e-3 * np.arange(8000)
    target = 0.2 * (2 * np.abs(2 * ((times / 4 + 0.25) % 1) - 1) - 1)
    width = {}
    for model in ("play", "dead-band"):
        read, link = follow(model, target, gap=gap)
        up, down = np.gradient(target)[2000:] > 0, np.gradient(target)[2000:] < 0
        near = np.abs(target[2000:]) < 0.1
        unseen = (read - link)[2000:]
        width[model] = np.mean(unseen[up & near]) - np.mean(unseen[down & near])
        # The link's own error has the size of the gap in both models.
        lag = (target - link)[2000:]
        assert gap / 4 < np.mean(lag[up & near]) < 2 * gap
    assert width["play"] == pytest.approx(gap, rel=0.1)
    assert width["dead-band"] == 0.0


@pytest.mark.slow
def test_every_parameter_carries_a_gradient():
    def end(play):
        rotor, q, v = rotor_at(jnp.zeros(()), jnp.zeros(())), jnp.zeros(()), jnp.zeros(())
        for _ in range(20):
            tau, rotor = drive_with_play(motor(), play, rotor, jnp.float32(0.3), q, v, inertia=LINK, timestep=2e-3)
            v = v + 2e-3 * tau / LINK
            q = q + 2e-3 * v
        return q

    play = GearPlay(*(jnp.float32(x) for x in (0.01, ROTOR, 50.0, 0.1)))
    slope = jax.grad(end)(play)
    assert all(np.isfinite(leaf) and leaf != 0 for leaf in jax.tree.leaves(slope))
    assert float(slope.gap) < 0


# --- beside a physics engine ---------------------------------------------------------------------------

LIGHT = 1.5e-4  # kg m^2, a rotor
BESIDE = dict(timestep=0.006, steps=6)


def test_in_a_static_grip_the_tooth_carries_the_motors_torque():
    """A link that is held, by what the drive is never told: gap / 2 and torque / stiffness ahead of it."""
    play = GearPlay(gap=0.02, rotor_inertia=LIGHT, tooth_stiffness=200.0)
    gear, link = gear_at(jnp.float32(0.5), jnp.zeros(())), jnp.float32(0.5)
    advance = jax.jit(
        lambda gear: drive_beside(motor(), play, gear, jnp.float32(0.7), link, jnp.zeros(()), inertia=4e-4, **BESIDE)
    )
    for _ in range(300):
        torque, gear = advance(gear)
    expected = float(joint_torque(motor(), jnp.float32(0.7), 0.0, gear.rotor.position, 0.0))
    assert expected > 0.1
    assert float(torque) == pytest.approx(expected, rel=1e-3)
    assert float(gear.rotor.position) == pytest.approx(0.5 + 0.01 + expected / 200.0, abs=1e-4)


@pytest.mark.parametrize("inertia", [0.65, 1.0, 2.5, 25.0])
@pytest.mark.parametrize("stop", [None, 0.2])
def test_beside_an_engine_it_is_the_same_gear(stop, inertia):
    """Sub-steps of 6 ms, and only the link's motion to go by, against 0.1 ms and all torques known: reversals
    of +-0.3 rad under a weight, with or without a stop in the link's way. The link may be heavier than the
    drive believes (a finger that pushes an object)."""
    believed, gap, weight = 4e-4, 0.03, -0.05
    link = inertia * believed
    play = GearPlay(gap=gap, rotor_inertia=LIGHT, tooth_stiffness=200.0)

    def run(coarse):
        dt = 0.006 if coarse else 1e-4

        def body(carry, target):
            gear, q, v = carry
            stiff = 0.0 if stop is None else jnp.where(q > stop, 400.0, 0.0)
            rub = 0.02 + 1e-3 * stiff
            if coarse:
                tau, gear = drive_beside(motor(), play, gear, target, q, v, inertia=believed, **BESIDE)
            else:
                known = weight - rub * v - (0.0 if stop is None else stiff * (q - stop))
                tau, rotor = drive_with_play(
                    motor(), play, gear.rotor, target, q, v, inertia=link, timestep=dt, link_torque=known
                )
                gear = gear_at(*(rotor.position, rotor.velocity))
            pull = tau + weight - (0.0 if stop is None else stiff * (q - stop))
            v = (v + dt / link * pull) / (1 + dt / link * rub + dt**2 / link * stiff)  # as an engine's contact
            return (gear, q + dt * v, v), (gear.rotor.position, q + dt * v)

        times = dt * np.arange(int(1.8 / dt))
        target = jnp.asarray(0.3 * np.sign(np.sin(2 * np.pi * times / 0.9)), jnp.float32)
        zero = jnp.zeros(())
        track = np.stack(jax.lax.scan(body, (gear_at(zero, zero), zero, zero), target)[1])
        return track if coarse else track[:, 59::60]

    coarse, fine = run(True), run(False)
    error = coarse[:, : fine.shape[1]] - fine[:, : coarse.shape[1]]
    # It moves through 0.6 rad; a link of 25 times the inertia swings, and the drive does not know it.
    assert np.sqrt(np.mean(error**2)) < (0.016 if inertia < 5 else 0.045)
    assert np.ptp(fine[1]) > (0.45 if stop else 0.55)
    if inertia < 5:  # at rest before each reversal: the same place on the same tooth
        for end in (74, 149, 224, 298):
            np.testing.assert_allclose(error[:, end], 0.0, atol=2e-3)
        assert np.abs(coarse[0] - coarse[1]).max() < gap / 2 + 0.04


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_teeth_push_and_never_pull(way):
    """A rotor that leaves a tooth fast: its damping alone would hold the link back."""
    play = GearPlay(gap=0.02, rotor_inertia=1e-4, tooth_stiffness=500.0, tooth_damping=10.0)
    for slip, pushes in ((-10.0, False), (0.0, True)):
        rotor = Rotor(jnp.float32(0.1 * way), jnp.float32(slip * way))
        zero = jnp.float32(0.0)
        torque = float(tooth_torque(play, rotor, zero, zero, zero, inertia=1e-4, timestep=1e-4))
        assert torque * way > 0 if pushes else torque == 0
