"""A policy slower than the watchdog's setting."""

import dataclasses

import pytest

from dexsim_ppo.policy import load_policy
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.run.options import RunArguments
from dexsim_real.run.session import Session


@pytest.mark.parametrize(("rate", "watchdog"), [(5.0, 0.5), (20.0, 0.3)])
def test_a_wish_stays_good_for_two_and_a_half_ticks_of_its_policy(tmp_path, rate, watchdog):
    """At 5 Hz every second cycle would hold otherwise. Where the setting is longer, the setting counts."""
    slow = tmp_path / "slow.msgpack"
    dataclasses.replace(load_policy("grasp"), control_rate=rate).save(slow)
    session = Session(
        RunArguments(
            policy=str(slow),
            port=str(tmp_path / "no-port"),
            uncalibrated=True,
            fixed_object=True,
            guard=False,
            realtime=False,
            log=tmp_path / "run.log",
            safety=SafetyConfig(watchdog=0.3),
        )
    )
    try:
        assert session.safety.config.watchdog == pytest.approx(watchdog)
    finally:
        session.log.close()
