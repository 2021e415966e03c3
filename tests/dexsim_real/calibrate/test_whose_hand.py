"""A calibration names the hand that it was made on, and is made of one hand only."""

import dataclasses

import pytest
from calibrating import arguments, operator
from press_bench import BenchHand

from dexsim.calibration.maps import save_calibration
from dexsim_real.calibrate.bench import Workbench
from dexsim_real.calibrate.read import read_logs
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import LogError
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.wire.identity import Identity


def visit(hand, folder, name, identity, **options):
    """The log of a visit to a hand, without a press."""
    bench, options = BenchHand(hand, []), arguments(folder, log=folder / name, **options)
    bench.identity = identity
    with Workbench(options, hand, operator(), {"task": "calibrate"}, port=bench, clock=bench.clock, sleep=bench.sleep):
        pass
    return options.log


def test_a_hand_that_does_not_tell_leaves_both_empty_and_logs_of_two_hands_do_not_mix(hand, tmp_path):
    paths = [
        visit(hand, tmp_path, f"{k}.log", identity)
        for k, identity in enumerate((None, Identity("2R32A", "right"), Identity("2R32B", "right")))
    ]
    silent, told = (read_logs([path], hand) for path in paths[:2])
    assert (silent.serial, silent.handedness) == ("", "") and (told.serial, told.handedness) == ("2R32A", "right")
    with pytest.raises(LogError, match="is of hand '2R32B', the logs before of hand '2R32A'"):
        read_logs(paths[1:], hand)


def test_a_hand_of_the_other_side_or_of_another_calibration_is_refused(hand, tmp_path):
    with pytest.raises(HandError, match="this is a left hand"):
        visit(hand, tmp_path, "a.log", Identity("2L32A", "left"))
    save_calibration(tmp_path / "known.toml", dataclasses.replace(ideal_calibration(hand), serial="2R32B"))
    with pytest.raises(HandError, match="this is hand 2R32A, the calibration is of hand 2R32B"):
        visit(hand, tmp_path, "b.log", Identity("2R32A", "right"), calibration=tmp_path / "known.toml", identify=True)
