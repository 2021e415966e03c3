"""The coverage benchmark counts right."""

import sys

import pytest
from paths import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))
import calibration_coverage


def test_coverage_is_counted_for_each_interval():
    rows = [("a", 2.0, 1.5, 2.5, 2.4), ("b", -1.0, -1.1, -0.9, -1.0), ("a", 3.0, 2.8, 3.2, 2.5)]
    found, other = calibration_coverage.summary(rows)
    assert (found["interval"], found["count"], found["covered_pct"]) == ("a", 2, 50.0)
    assert found["half_width_pct"] == round(100 * (0.5 / 2.4 + 0.2 / 2.5) / 2, 1)
    assert found["mean_error_pct"] == round(100 * ((2.0 / 2.4 - 1) + (3.0 / 2.5 - 1)) / 2, 2)
    assert other["covered_pct"] == 100.0 and other["mean_error_pct"] == 0.0


def test_a_gauge_that_reads_nothing_of_the_truth_fails(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(calibration_coverage, "PARTS", {"joint": missing})
    monkeypatch.setattr(calibration_coverage, "pool", Serial)
    monkeypatch.setattr(sys, "argv", ["calibration_coverage", "joint", "--trials", "10"])
    assert calibration_coverage.main() == 1
    assert '"covered_pct": 80.0' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("joints", "error: no part 'joints'; choose from hand, joint, sensor, drives"),
        ("joint --trials 0", "error: --trials 0: must be at least 1"),
        ("joint --processes 0", "error: --processes 0: must be at least 1"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(capsys, monkeypatch, words, says):
    monkeypatch.setattr(sys, "argv", ["calibration_coverage", *words.split()])
    with pytest.raises(SystemExit) as stop:
        calibration_coverage.main()
    assert stop.value.code == 2 and capsys.readouterr().err.strip().endswith(says)


def missing(seed):
    """Two trials of ten miss."""
    return [("gain", 1.0, 0.9, 1.1, 2.0 if seed % 5 == 0 else 1.0)]


class Serial:
    """The pool of processes, without processes."""

    def __init__(self, *_):
        self.map = map

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass
