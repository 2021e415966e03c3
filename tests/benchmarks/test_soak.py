"""The soak test, shortened, and its evaluation of events."""

import importlib
import json

import numpy as np
import pytest
from paths import ROOT

pytest.importorskip("serial")


@pytest.fixture
def soak(monkeypatch):
    # The flags that other tests compile with stay as they are.
    monkeypatch.setattr("dexsim_real.control.controller.prepare_jax", lambda: None)
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("soak")


PATIENT = [
    "--no-realtime",
    "--safe",
    "1",
    "--runner",
    "--link.margin 0.2 --safety.stale 0.6 --safety.watchdog 0.5",
    "--twin",
    "--faults.late-seconds 0.4 0.5 --faults.stall-seconds 0.1 0.3 --firmware.watchdog 0.5 "
    "--limits.start 0.2 --limits.reach 1.2 --limits.slack 0.02",
]
"""For a machine that has other things to do: the bridge may act on older news, and commands arrive closer together."""


@pytest.mark.slow
def test_a_short_soak(soak, capsys):
    code = soak.main(["--minutes", "0.14", "--kills", "0", "--scale", "4", *PATIENT])
    row = json.loads(capsys.readouterr().out)
    assert code == 0, (row["failed"], row["first"], row)
    assert row["runs"] >= 1 and row["commands"] > 100 and sum(row["injected"].values()) > 5


@pytest.mark.slow
def test_two_runners_die(soak, capsys):
    code = soak.main(["--minutes", "0", "--kills", "2", "--life", "4", "--seed", "1", *PATIENT])
    row = json.loads(capsys.readouterr().out)
    assert code == 0, (row["failed"], row["first"], row)
    assert row["kills"] == 2 and row["commands"] > 50


@pytest.mark.parametrize(
    "events, wanted",
    [
        ([(1, "motors on"), (5, "fault heat: joint 4, 60 K"), (5.03, "motors off")], [("heat", 0.03)]),
        ([(1, "motors on"), (5, "fault jam: joint 4"), (8.04, "motors off")], [("jam", 0.04)]),
        ([(1, "motors on"), (5, "fault refuse: number 6,"), (6.1, "motors off")], [("refuse: number 6", 0.05)]),
        ([(1, "motors on"), (5, "fault refuse: number 28,"), (6, "motors off")], [("refuse", 1.0)]),
        ([(1, "motors on"), (4.5, "fault stall: 0.4 s"), (5, "fault off: all joints"), (6, "motors off")], []),
        ([(1, "motors on"), (5, "fault error: tip"), (5.1, "fault disconnect: 1 s"), (7, "motors off")], []),
        ([(1, "motors on"), (2, "motors off"), (5, "fault warm: palm"), (7, "motors on"), (8, "motors off")], []),
    ],
)
def test_how_late_the_motors_went_off_after_an_alarm(soak, events, wanted):
    found = importlib.import_module("soak_checks").alarm_reactions({"events": events})
    assert [kind for kind, _ in found] == [kind for kind, _ in wanted]
    np.testing.assert_allclose([late for _, late in found], [late for _, late in wanted], atol=1e-9)


@pytest.mark.parametrize(
    "events, wanted",
    [
        ([(1.0, "motors on"), (5.07, "watchdog: no exchange for 80 ms, motors off")], 0.07),
        ([(1.0, "motors on"), (5.01, "this machine is too slow"), (5.07, "watchdog: late, motors off")], 0.07),
        ([(5.02, "motors on"), (5.09, "watchdog: late, motors off"), (6.0, "motors on")], 0.09),
        ([(1.0, "motors on"), (2.0, "motors off"), (6.0, "motors on")], None),
        ([(1.0, "motors on"), (5.3, "watchdog: late, motors off")], np.inf),
        ([(1.0, "motors on")], np.inf),
    ],
)
def test_when_the_motors_were_off(soak, events, wanted):
    """A runner dies at 5 s, and 0.2 s later the next one may begin."""
    found = importlib.import_module("soak_checks").motors_off({"events": events}, 5.0, 5.2)
    assert found == (wanted if wanted is None else pytest.approx(wanted))
