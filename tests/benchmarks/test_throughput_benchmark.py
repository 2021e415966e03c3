"""`benchmarks/throughput.py`: medians of repeats in turn, and the efficiency of several devices."""

import importlib

from paths import ROOT


def test_medians_and_efficiency(monkeypatch):
    """Two devices that take half as long again as one for twice the steps are 67 % efficient."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    throughput = importlib.import_module("throughput")
    clock = iter([0.0, 9.0, 0.0, 9.0, 0.0, 2.0, 0.0, 3.0, 0.0, 2.0, 0.0, 3.0, 0.0, 4.0, 0.0, 7.0])
    monkeypatch.setattr(throughput.time, "perf_counter", lambda: next(clock))
    cases = [({"devices": 1}, lambda: 0, 100), ({"devices": 2}, lambda: 0, 200)]
    one, two = throughput.measure(cases, repeats=3)
    assert one == {"devices": 1, "env_steps_per_s": 50, "spread": 1.0, "efficiency": 1.0}
    assert two["env_steps_per_s"] == 67 and two["efficiency"] == 0.67
