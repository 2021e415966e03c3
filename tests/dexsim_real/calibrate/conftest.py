"""What tests of the calibration share."""

import pytest
from calibrating import arguments, operator, plates, record
from press_bench import BenchHand

from dexsim_real.calibrate.__main__ import fit_and_report


@pytest.fixture(scope="session")
def session(hand, tmp_path_factory):
    """The index pressed with pad and side: bench, arguments, log, what the terminal showed."""
    folder = tmp_path_factory.mktemp("press")
    bench = BenchHand(hand, plates(hand, "index pad", "index side"), dead=((1, 52), (1, 110)))
    options, who = arguments(folder), operator()
    log = record(bench, hand, options, who)
    fit_and_report(options, hand, [log], who)
    return bench, options, log, who.out.getvalue()
