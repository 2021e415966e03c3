"""Trials on the emulated hand in real time, as a user runs them (`zero_shot.py --real-time`).

For each trial a new `python -m dexsim_real.twin` provides one object, and the command that it prints,
`python -m dexsim_real.run ...`, controls it through RS485 frames, an IMU's bytes and a camera's masks. The metrics use
the true state of the emulated hand. Trial k of a seed is trial k in virtual time.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
LIMITS = {"grasp": 8.0, "rotate": 120.0}  # s, the tasks' own
_START, _AFTER = 90.0, 60.0  # s to start a process; s after a trial's time limit


def start(words: list[str], **options: Any) -> subprocess.Popen:
    """Start Python with these arguments in the present folder, which a policy's or a plant model's path is of."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return subprocess.Popen([sys.executable, *words], env={**os.environ, "PYTHONPATH": path}, text=True, **options)


def twin_words(options: dict[str, Any], seed: int, number: int, command: float, shape: str, folder: Path) -> list[str]:
    """Arguments of the emulated hand for a trial."""
    words = [
        "-m",
        "dexsim_real.twin",
        "--task",
        options["task"],
        "--seed",
        str(seed),
        "--parameters",
        options["parameters"],
        "--first",
        str(number),
        "--trials",
        "1",
        "--link",
        str(folder / "hand"),
        "--output",
        str(folder / "twin.json"),
        *options["twin"].split(),
    ]
    if options["task"] == "grasp":
        words += ["--mask-socket", str(folder / "masks"), "--command", f"{command:g}", "--shape", shape]
    else:
        words += ["--imu-link", str(folder / "imu")]
    words += ["--policy", options["policy"]]
    words += ["--seconds", f"{options['seconds']:g}"] if options["seconds"] else []
    words += ["--plant-model", options["plant_model"]] if options["plant_model"] else []
    return words


def shown_command(twin: subprocess.Popen, errors: Path) -> list[str]:
    """Arguments of the runner, from the output of the emulated hand."""
    until = time.monotonic() + _START
    for line in twin.stdout:
        words = shlex.split(line) if "dexsim_real.run" in line else []
        if words:
            return words[words.index("-m") :]
        if time.monotonic() > until:
            break
    raise SystemExit(f"the emulated hand did not start (exit code {twin.poll()}): {errors.read_text().strip()[-500:]}")


def real_trial(options: dict[str, Any], seed: int, number: int, command: float, shape: str) -> dict[str, Any]:
    """Run one trial: the referee's report, with statistics of the bridge as `bridge`."""
    with tempfile.TemporaryDirectory(prefix="dexsim-trial-") as folder:
        return _run(options, twin_words(options, seed, number, command, shape, Path(folder)), Path(folder))


def _run(options: dict[str, Any], words_of_twin: list[str], folder: Path) -> dict[str, Any]:
    began = time.monotonic()
    limit = options["seconds"] or LIMITS[options["task"]]
    with (folder / "twin.txt").open("w") as errors, (folder / "run.txt").open("w") as shown:
        twin = start(words_of_twin, stdout=subprocess.PIPE, stderr=errors)
        runner = None
        try:
            words = [
                *shown_command(twin, folder / "twin.txt"),
                "--seconds",
                f"{limit + _AFTER:g}",
                "--place",
                "1",
                "--quiet",
                "--log",
                str(folder / "run.log"),
                "--output",
                str(folder / "run.json"),
                *(
                    word
                    for name, value in options["limit"].items()
                    for word in (f"--safety.{name.replace('_', '-')}", f"{value:g}")
                ),
                *options["runner"].split(),
            ]
            runner = start(words, stdout=shown, stderr=subprocess.STDOUT)
            until = time.monotonic() + _START + limit + _AFTER
            # The emulated hand ends with its trial; a runner that ends earlier has failed.
            while twin.poll() is None and runner.poll() is None and time.monotonic() < until:
                time.sleep(0.05)
        finally:
            for process, number_of in ((runner, signal.SIGINT), (twin, signal.SIGTERM)):
                if process is not None:
                    _end(process, number_of)
    return _collect(folder, runner.returncode, time.monotonic() - began)


def _end(process: subprocess.Popen, number: int) -> None:
    if process.poll() is None:
        process.send_signal(number)
    try:
        process.communicate(timeout=30)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _collect(folder: Path, code: int, wall: float) -> dict[str, Any]:
    if not (folder / "twin.json").exists() or not (folder / "run.json").exists():
        raise SystemExit(f"no results: the runner ended with {code}: {(folder / 'run.txt').read_text()[-500:]}")
    twin, bridge = (json.loads((folder / name).read_text()) for name in ("twin.json", "run.json"))
    link = bridge["link"]
    return twin["trials"][0] | {
        "wall": round(wall, 1),
        "bridge": {
            "exit": code,
            "end": bridge["end"],
            "measured_successes": bridge.get("successes"),
            "exchanges": link["sent"],
            "unanswered": link["sent"] - link["answered"],
            "safety": bridge["safety"],
            "policy_jitter": bridge["policy_jitter"],
            "round_trip": bridge["round_trip"],
            "outside_limits": twin["commands"]["outside_limits"],
            "slipped_s": twin["physics"]["slipped_s"],
        },
    }
