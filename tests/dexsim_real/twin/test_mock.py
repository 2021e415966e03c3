"""Mocks of hands that are no XHand: the commands work on them."""

import json

import numpy as np
import pytest
from scripted_driver import DriverBench
from untrained import untrained

from dexsim import load_hand
from dexsim_real import replay, run
from dexsim_real.twin.mock import MockHand
from dexsim_real.twin.plant.emulated_hand import EmulatedHand

MOCK = "sdk:dexsim_real.twin.mock"


def bench_of(name):
    hand = load_hand(name)
    return DriverBench(hand, MockHand(EmulatedHand(hand, "grasp", kind="nominal")))


def test_an_object_that_is_let_go_over_the_hand_is_felt():
    bench = bench_of("leap_like")
    bench.engage()
    posture = np.array(bench.hand.grasp_posture)
    bench.run(1.5, posture)
    bench.run(1.2, posture + 0.6)
    assert bench.safety.sample.measured.finger_force.max() > 1.0 and not bench.safety.latched


@pytest.mark.usefixtures("jax_as_it_is", "virtual_time")
@pytest.mark.parametrize("name", ["leap_like", pytest.param("inspire_like", marks=pytest.mark.slow)])
def test_a_policy_runs_and_its_log_is_replayed_to_the_last_bit(name, tmp_path, capsys):
    policy, log = tmp_path / "policy.msgpack", tmp_path / "run.log"
    untrained(load_hand(name), policy)
    options = "--uncalibrated --fixed-object --yes --seconds 1.5 --approach 0.5 --quiet --no-realtime --no-guard"
    files = ["--log", str(log), "--output", str(tmp_path / "run.json")]
    run.main([str(policy), "--port", MOCK, *options.split(), *files])
    summary = json.loads((tmp_path / "run.json").read_text())
    assert summary["end"] == "time is over" and summary["motors_off"]
    assert replay.main([str(log), "--plot", str(tmp_path / "run.png")]) == 0
    assert "all observations agree to the last bit" in capsys.readouterr().out
