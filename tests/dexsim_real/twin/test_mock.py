"""Mocks of hands that are no XHand: the commands work on them."""

import json

import numpy as np
import pytest
from calibrating import arguments, operator
from untrained import untrained

from dexsim import load_hand
from dexsim_real import replay
from dexsim_real.calibrate import __main__ as calibrate
from dexsim_real.calibrate.identify_drives import identify_hand
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.core.errors import HandError
from dexsim_real.loop import ExchangeLoop
from dexsim_real.run import __main__ as run
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.twin.mock import MockHand
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.wire.driver import WITHOUT, DriverPort
from dexsim_real.wire.link import LinkConfig

MOCK = "sdk:dexsim_real.twin.mock"


class Bench:
    """A mock, its port and the exchange loop, in their own time."""

    def __init__(self, name, measures=WITHOUT):
        self.hand, self.time = load_hand(name), 0.0
        clock = lambda: self.time  # noqa: E731
        self.driver = MockHand(EmulatedHand(self.hand, "grasp", kind="nominal"), measures, clock)
        self.port = DriverPort(self.driver, self.hand, LinkConfig(), clock=clock)
        self.safety = Safety(self.hand, SafetyConfig())
        sensing = HandSensing(self.hand, HardwareConfig())
        self.loop = ExchangeLoop(self.port, sensing, self.safety, 83.0, clock=clock, sleep=self.sleep)
        self.port.connect()
        self.loop.tare()

    def sleep(self, seconds):
        self.time += seconds

    def run(self, seconds, target=None):
        until = self.time + seconds
        while self.time < until:
            if target is not None:
                self.safety.set_target(target, self.time)
            self.loop.cycle()
            self.loop.pace.wait()

    @property
    def on(self):
        return bool(self.driver.motors["mode"].all())

    def engage(self):
        self.loop.engage()
        self.run(0.05)
        assert self.on


def test_an_object_that_is_let_go_over_the_hand_is_felt():
    bench = Bench("leap_like")
    bench.engage()
    posture = np.array(bench.hand.grasp_posture)
    bench.run(3.0, posture)
    bench.run(2.0, posture + 0.6)
    assert bench.safety.sample.measured.finger_force.max() > 1.0 and not bench.safety.latched


@pytest.mark.usefixtures("jax_as_it_is")
@pytest.mark.parametrize("name", ["leap_like", pytest.param("inspire_like", marks=pytest.mark.slow)])
def test_a_policy_runs_and_its_log_is_replayed_to_the_last_bit(name, tmp_path, capsys):
    policy, log = tmp_path / "policy.msgpack", tmp_path / "run.log"
    untrained(load_hand(name), policy)
    options = "--uncalibrated --fixed-object --yes --seconds 1.5 --approach 0.5 --quiet --no-realtime --no-guard"
    options += " --safety.stale 1 --safety.watchdog 2"  # This machine may be busy.
    files = ["--log", str(log), "--output", str(tmp_path / "run.json")]
    run.main([str(policy), "--port", MOCK, *options.split(), *files])
    summary = json.loads((tmp_path / "run.json").read_text())
    assert summary["end"] == "time is over" and summary["motors_off"]
    assert replay.main([str(log), "--plot", str(tmp_path / "run.png")]) == 0
    assert "all observations agree to the last bit" in capsys.readouterr().out


@pytest.mark.slow
def test_a_joint_of_another_hand_is_identified(tmp_path):
    """One that moves two hinges, by its angles alone."""
    bench = Bench("inspire_like", measures=())
    options = arguments(tmp_path, identify=True, joints=("index",), output=tmp_path / "hand.json")
    where = {"port": bench.port, "clock": lambda: bench.time, "sleep": bench.sleep}
    (result,) = identify_hand(options, bench.hand, operator(), **where)
    assert result.joint == "index" and result.rmse < 0.02


def test_presses_need_taxels_and_currents(tmp_path):
    bench = Bench("leap_like", measures=["currents"])
    with pytest.raises(HandError, match="presses need taxels and currents, and the hand has no taxels: --identify"):
        calibrate.record(arguments(tmp_path, port=None, from_log=(tmp_path,)), bench.hand, operator(), port=bench.port)
