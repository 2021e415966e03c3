"""Runs over a driver of the user's own (`sdk:`): what goes wrong in it is said as it is."""

import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("serial")
from following_hand import arguments, summary

from dexsim_real.core.errors import HandError
from dexsim_real.run import __main__ as run
from dexsim_real.wire.frames import empty_state
from dexsim_real.wire.link import LinkCounts, Reply

pytestmark = pytest.mark.usefixtures("jax_as_it_is")
_TARED = 30  # exchanges of taring


class Driver:
    """Answers until its trouble begins."""

    def __init__(self, trouble, after):
        self.counts, self.trouble, self.after = LinkCounts(), trouble, after

    def connect(self):
        return "a hand of mine"

    def exchange(self, command):
        time.sleep(0.002)
        self.counts.sent += 1
        if self.counts.sent > self.after:
            return self.trouble()
        now = time.monotonic()
        return Reply(empty_state(), now, now, self.counts.sent, 1)

    def close(self):
        pass


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Runs the command over a driver."""

    def start(driver):
        monkeypatch.setitem(sys.modules, "my_sdk", SimpleNamespace(open_hand=lambda config: driver))
        return run.main(arguments(SimpleNamespace(port="sdk:my_sdk"), tmp_path))

    return start


def broken():
    raise RuntimeError("the SDK broke")


def misshapen():
    return Reply(np.zeros(12), 0.0, 0.0, 1, 1)


@pytest.mark.parametrize(("trouble", "says"), [(broken, "the SDK broke"), (misshapen, r"state of float64 \[12\]")])
def test_what_ends_the_exchanges_before_the_motors_come_on_is_told(start, trouble, says):
    """Not that the hand has stopped answering."""
    with pytest.raises(HandError, match=f"the exchange thread failed: .*{says}"):
        start(Driver(trouble, after=_TARED))


@pytest.mark.parametrize("code", ["no hand found", 0])
def test_a_driver_that_exits_is_no_signal_and_no_success(start, tmp_path, monkeypatch, capsys, code):
    driver = Driver(broken, after=0)
    monkeypatch.setattr(driver, "connect", lambda: sys.exit(code))
    assert start(driver) == 1
    assert capsys.readouterr().err == f"error: a driver exits: {code}\n" and summary(tmp_path)["motors_off"]
