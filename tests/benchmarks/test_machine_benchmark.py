"""What a timing benchmark leaves out because the machine was away, against brute force."""

import importlib.util
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paths import ROOT

PATH = ROOT / "benchmarks" / "machine.py"


@pytest.fixture(scope="module")
def machine():
    spec = importlib.util.spec_from_file_location("machine_benchmark", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


THIEF = """
import os, time
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
time.sleep(0.1)
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(99))
end = time.monotonic() + 0.03
while time.monotonic() < end:
    pass
"""
"""A program that takes a core from the sentinel itself, for 30 ms."""

SPANS = st.lists(st.tuples(st.integers(0, 60), st.integers(0, 6)).map(lambda x: (x[0], x[0] + x[1])), max_size=8)


@given(spans=SPANS, asked=SPANS)
def test_union_and_overlaps(machine, spans, asked):
    union = machine.merged(spans)
    assert np.all(np.diff(union.ravel()) >= 0) and np.all(union[1:, 0] > union[:-1, 1])
    inside = lambda x, intervals: any(a <= x <= b for a, b in intervals)  # noqa: E731
    assert all(inside(x, union) == inside(x, spans) for x in np.arange(0, 70, 0.5))
    begin, end = (np.array([x[i] for x in asked], float) for i in (0, 1))
    expected = [any(a <= e and b >= s for a, b in spans) for s, e in asked]
    np.testing.assert_array_equal(machine.overlaps(begin, end, union), expected)


def test_a_loop_is_not_blamed_for_the_machine(machine):
    period = 0.01
    due = period * np.array([0, 1, 2, 5, 6, 7, 9, 10])  # two deadlines lost before 5, one before 9
    met = due + np.array([0, 1, 1, 8, 1, 1, 4, 1]) * 1e-4
    both = machine.own_timing(due, met, period, machine.merged([]))
    assert both["missed"] == 3 and both["count"] == 7 and both["left_out"] == 0 and both["max_ms"] == pytest.approx(0.8)
    own = machine.own_timing(due, met, period, machine.merged([(0.03, 0.045)]))
    assert own["missed"] == 1 and own["count"] == 6 and own["max_ms"] == pytest.approx(0.4)
    assert own["left_out"] == pytest.approx(1 / 7, abs=1e-4)
    late = met + np.array([0, 0, 62, 0, 0, 0, 0, 0]) * 1e-4  # woken late by the machine, which so cost what came after
    assert machine.own_timing(due, late, period, machine.merged([(0.0202, 0.0261)]))["missed"] == 1
    hand = np.array([0, 0, 0, 1, 0, 0, 1, 0])  # one of the two and the other one: the hand was slow to answer
    assert machine.own_timing(due, met, period, machine.merged([]), hand)["missed"] == 1


def test_a_busy_program_is_not_the_machine(machine):
    """The sentinels come before an ordinary program, however busy; and they see a core that was taken."""
    watch = machine.Away().__enter__()
    if not watch.allowed:
        pytest.skip("real-time priority is not allowed here")
    begin = time.monotonic()
    thief = subprocess.Popen([sys.executable, "-c", THIEF])
    while thief.poll() is None:
        pass
    stole = time.monotonic()
    watch.__exit__()
    assert any(0.02 < b - a < 0.2 and begin < a < stole for a, b in watch.intervals)
    assert watch.summary()["seconds"] < 0.8 * (stole - begin)  # not the busy program beside it
