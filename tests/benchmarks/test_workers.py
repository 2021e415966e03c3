"""Processes for trials end with the one that started them, however that ends."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from paths import ROOT

SCRIPT = """
import os, time
from workers import pool

def work(number):
    print(os.getpid(), flush=True)
    time.sleep(600)

if __name__ == "__main__":
    with pool(2) as workers:
        list(workers.map(work, range(2)))
"""


def alive(pid):
    """Whether a process runs; one that has ended may be left for a container's first process to collect."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("end", ["kill", "terminate"])
def test_workers_end_with_their_parent(end, tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "benchmarks")},
        stdout=subprocess.PIPE,
        text=True,
    )
    workers = [int(parent.stdout.readline()) for _ in range(2)]
    assert len(set(workers)) == 2 and all(map(alive, workers))
    getattr(parent, end)()
    parent.wait(10)
    until = time.monotonic() + 10
    while any(map(alive, workers)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(alive, workers))
    parent.communicate()
