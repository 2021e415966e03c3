"""The emulated drives against closed forms."""

import math

import numpy as np
import pytest
from emulated_plant import drives, motors

from dexsim_real.twin.plant import drives as constants
from dexsim_real.twin.plant.drives import BACK_EMF, PERIOD, STALL_CURRENT, STIFFNESS
from dexsim_real.wire.frames import Mode


def test_a_step_follows_the_second_order_closed_form(hand):
    made, inertia, step = drives(hand), 2e-3, 0.05
    made.send(0.0, motors(step))
    angle, speed, fine = np.zeros(12), np.zeros(12), 20
    stiffness, damping = STIFFNESS * 100, BACK_EMF
    omega, zeta = math.sqrt(stiffness / inertia), damping / 2 / math.sqrt(stiffness * inertia)
    assert zeta < 1
    ring = omega * math.sqrt(1 - zeta**2)
    for k in range(300):
        time = k * PERIOD
        expected = step * (
            1 - math.exp(-zeta * omega * time) * (math.cos(ring * time) + zeta * omega / ring * math.sin(ring * time))
        )
        assert angle == pytest.approx(np.full(12, expected), abs=0.03 * step), k
        torque, friction = made.step(time, angle, speed)
        assert np.all(friction == 0)
        for _ in range(fine):
            speed = speed + PERIOD / fine * torque / inertia
            angle = angle + PERIOD / fine * speed
    assert angle == pytest.approx(np.full(12, step), abs=1e-3 * step)


def test_current_at_a_static_torque_and_its_limits(hand):
    made = drives(hand)
    made.send(0.0, motors(0.1))
    torque, _ = made.step(0.0, np.zeros(12), np.zeros(12))
    assert torque == pytest.approx(np.full(12, 0.3))
    assert made.current == pytest.approx(0.3 / hand.torque_limit * STALL_CURRENT) and not made.at_limit().any()
    # Stalled: the whole torque at 300, half of it at 150; none at the no-load speed, all of it when braking.
    for torque_max, speed, share in (
        (300, 0.0, 1.0),
        (150, 0.0, 0.5),
        (600, 0.0, 1.0),
        (600, 0.5, 0.5),
        (300, 1.0, 0.0),
        (300, -0.5, 1.0),
    ):
        made = drives(hand)
        made.send(0.0, motors(1.5 + 2 * (speed > 0), torque_max=torque_max))
        torque, _ = made.step(0.0, np.zeros(12), speed * hand.speed_limit)
        assert torque == pytest.approx(share * hand.torque_limit, abs=1e-6), (torque_max, speed)
        assert made.at_limit().all()
    made.send(0.0, motors(-np.where(np.arange(12) % 2, 1.0, 0.01)))  # 3 Nm and 0.03 Nm; they stall at 1.1 and 0.4 Nm
    made.step(0.0, np.zeros(12), np.zeros(12))
    np.testing.assert_array_equal(made.at_limit(), np.arange(12) % 2 == 1)
    made.send(0.0, motors(1.0, mode=Mode.PASSIVE))
    assert not made.step(0.0, np.zeros(12), np.zeros(12))[0].any() and not made.at_limit().any()


def test_losses_depend_on_the_direction_of_power(hand):
    made = drives(hand, efficiency=0.8, coulomb_friction=0.02)
    made.send(0.0, motors(0.05))
    torque, friction = made.step(0.0, np.zeros(12), np.zeros(12))
    # What moves the load is 0.8 of the torque less the dry friction; what holds when driven back, 1.2 and more.
    assert torque - friction == pytest.approx(0.8 * 0.15 - 0.02 * hand.torque_limit)
    assert torque + friction == pytest.approx(1.2 * 0.15 + 0.02 * hand.torque_limit)


def test_commands_reach_each_board_after_its_own_delay(hand):
    made = drives(hand)
    made.delay = np.linspace(0.0, 0.011, 12)
    made.send(0.0, motors(0.0))
    made.send(0.005, motors(0.1))
    reached = np.full(12, np.nan)
    for k in range(30):
        torque, _ = made.step(k * PERIOD, np.zeros(12), np.zeros(12))
        new = np.isnan(reached) & (torque > 0.1)
        reached[new] = k * PERIOD
    assert reached == pytest.approx(0.005 + np.ceil(made.delay / PERIOD - 1e-6) * PERIOD, abs=1e-9)


def test_heat_settles_where_loss_and_flow_balance(hand, monkeypatch):
    monkeypatch.setattr(constants, "WINDING", 0.01)
    monkeypatch.setattr(constants, "CASE", 0.02)
    made = drives(hand, thermal=1.0)
    made.send(0.0, motors(0.1 * hand.torque_limit))
    for k in range(4000):
        torque, _ = made.step(k * PERIOD, np.zeros(12), np.zeros(12))
    loss = 0.3**2 * 6.0 * (1 + 0.0039 * (made.winding - 25.0))  # 3 Nm/rad: 0.3 of 1 A; copper
    assert made.winding - made.case == pytest.approx(8.0 * loss, rel=1e-3)
    assert made.case == pytest.approx(26.0 + 14.0 * loss, rel=1e-3)
    assert torque == pytest.approx(0.3 * hand.torque_limit * (1 - 0.001 * (made.winding - 25.0)), rel=1e-3)
