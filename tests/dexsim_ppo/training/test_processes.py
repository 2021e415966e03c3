"""What several processes say when one of them ends. See `test_devices.py` for whole trainings."""

import subprocess
import sys

import pytest
from paths import ROOT

SCRIPT = """
import os, sys
from dexsim_ppo.training.processes import last_words
try:
    with last_words("error: resume with ..."):
        {end}
finally:
    print("finally", flush=True)
"""


@pytest.mark.parametrize("end, said", [("os.abort()", True), ("pass", False), ("raise SystemExit(3)", False)])
def test_only_a_process_that_is_ended_has_its_last_line_said(end, said):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(end=end)],
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert ("error: resume with ..." in done.stderr.splitlines()) == said
    assert ("finally" in done.stdout) != said
