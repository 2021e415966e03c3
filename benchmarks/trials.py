"""Trials of a policy on the emulated hand in real time, as a user runs them: the paper's metrics.

    python benchmarks/trials.py --task rotate --trials 10
    python benchmarks/trials.py --task grasp --trials 25

For each trial a new `python -m dexsim_real.twin` provides one object, and the command that it prints,
`python -m dexsim_real.run ...`, controls it through RS485 frames, an IMU's bytes and a camera's masks. The metrics use
the true state of the emulated hand. Trial k of a seed is trial k of `benchmarks/zero_shot.py`, which computes it in
virtual time.
"""

import argparse
import contextlib
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

from zero_shot import COMMANDS, TARGETS, metrics, run_all, simulated, table

ROOT = Path(__file__).resolve().parent.parent
LIMITS = {"grasp": 8.0, "rotate": 120.0}  # s, the tasks' own
_START, _AFTER = 90.0, 60.0  # s to start a process; s after a trial's time limit


def start(words: list[str], **options: Any) -> subprocess.Popen:
    """Start Python with these arguments in the repository."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return subprocess.Popen(
        [sys.executable, *words], cwd=ROOT, env={**os.environ, "PYTHONPATH": path}, text=True, **options
    )


def twin_words(options: argparse.Namespace, number: int, folder: Path) -> list[str]:
    """Arguments of the emulated hand for a trial; commands and shapes as in `zero_shot.py`."""
    from dexsim_real.twin.plant.shapes import SHAPES

    words = [
        "-m",
        "dexsim_real.twin",
        "--task",
        options.task,
        "--seed",
        str(options.seed),
        "--parameters",
        options.parameters,
        "--first",
        str(number),
        "--trials",
        "1",
        "--link",
        str(folder / "hand"),
        "--output",
        str(folder / "twin.json"),
        *options.twin.split(),
    ]
    if options.task == "grasp":
        words += [
            "--mask-socket",
            str(folder / "masks"),
            "--command",
            f"{COMMANDS[number % len(COMMANDS)]:g}",
            "--shape",
            SHAPES[number // len(COMMANDS) % len(SHAPES)],
        ]
    else:
        words += ["--imu-link", str(folder / "imu")]
    words += ["--policy", options.policy] if options.policy else []
    words += ["--seconds", f"{options.seconds:g}"] if options.seconds else []
    return words + ([] if options.realtime else ["--no-realtime"])


def shown_command(twin: subprocess.Popen) -> list[str]:
    """Arguments of the runner, from the output of the emulated hand."""
    until = time.monotonic() + _START
    for line in twin.stdout:
        words = shlex.split(line) if "dexsim_real.run" in line else []
        if words:
            return words[words.index("-m") :]
        if time.monotonic() > until:
            break
    raise SystemExit(f"the emulated hand did not start (exit code {twin.poll()})")


def run_trial(options: argparse.Namespace, number: int, folder: Path) -> dict[str, Any]:
    """Run one trial: the referee's report, with statistics of the bridge as `bridge`."""
    began = time.monotonic()
    limit = options.seconds or LIMITS[options.task]
    with (folder / "twin.txt").open("w") as errors, (folder / "run.txt").open("w") as shown:
        twin = start(twin_words(options, number, folder), stdout=subprocess.PIPE, stderr=errors)
        runner = None
        try:
            words = [
                *shown_command(twin),
                "--seconds",
                f"{limit + _AFTER:g}",
                "--place",
                "1",
                "--quiet",
                "--log",
                str(folder / "run.log"),
                "--output",
                str(folder / "run.json"),
                *options.runner.split(),
                *([] if options.realtime else ["--no-realtime"]),
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


def line(report: dict[str, Any]) -> str:
    """One trial as a line of text."""
    result = (
        f"command {report['command']:.2f} {report['shape']:<11} fingers {report['finger_force']:6.2f} N"
        if report["task"] == "grasp"
        else f"{report['successes']:3d} successes ({report['paper_successes']} as the paper counts)"
    )
    bridge = report["bridge"]
    return (
        f"{report['trial']:4d}  {result}  {report['seconds']:7.2f} s  {report['end']}  ({report['wall']:.0f} s; "
        f"{bridge['unanswered']} of {bridge['exchanges']} exchanges unanswered, policy late p99 "
        f"{bridge['policy_jitter']['p99_ms']:.1f} ms, simulated time slipped {bridge['slipped_s']:.2f} s)"
    )


def idle_trials(options: argparse.Namespace, policy: str, count: int) -> list[dict[str, Any]]:
    """The trials of a hand that does nothing, in virtual time."""
    idle = {name: getattr(options, name) for name in ("task", "parameters", "seconds")}
    idle |= {"policy": policy, "seed": [options.seed], "safety": True, "set": {}, "idle": True}
    return run_all(idle, options.first + count, 1, show=False)[options.first :]


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=("grasp", "rotate"), required=True)
    parser.add_argument("--policy", help="policy file; by default the shipped policy of the task")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="number of the first trial")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--seconds", type=float, help="time limit of a trial in s; by default that of the task (8 or 120)"
    )
    parser.add_argument(
        "--parameters",
        choices=("outside", "inside", "nominal"),
        default="outside",
        help="parameters of hand and object: outside training's ranges, inside them, or nominal",
    )
    parser.add_argument("--twin", default="", help="more options of `dexsim_real.twin`, as one argument")
    parser.add_argument("--runner", default="", help="more options of `dexsim_real.run`, as one argument")
    parser.add_argument("--no-realtime", dest="realtime", action="store_false")
    parser.add_argument(
        "--no-baseline",
        dest="baseline",
        action="store_false",
        help="do not run the trials with an idle hand, too (in virtual time)",
    )
    parser.add_argument("--json", type=Path, help="JSON file for all results")
    return parser.parse_args()


def main() -> None:
    options = arguments()
    reports = []
    with contextlib.suppress(KeyboardInterrupt):  # Show the trials done so far.
        for number in range(options.first, options.first + options.trials):
            with tempfile.TemporaryDirectory(prefix="dexsim-trial-") as folder:
                reports.append(run_trial(options, number, Path(folder)))
            print(line(reports[-1]), file=sys.stderr, flush=True)
    if not reports:
        sys.exit(130)
    policy = options.policy or options.task
    here, there = metrics(options.task, policy, reports), simulated(options.task, policy)
    idle = metrics(options.task, policy, idle_trials(options, policy, len(reports))) if options.baseline else {}
    print(
        f"{options.task}: {len(reports)} trials in real time, parameters {options.parameters}, seed {options.seed}; "
        f"targets {TARGETS[options.task]}"
    )
    print(table(here, there, idle))
    if options.json:
        options.json.write_text(
            json.dumps(
                {
                    "options": {k: str(v) for k, v in vars(options).items()},
                    "metrics": here,
                    "simulation": there,
                    "do_nothing": idle,
                    "trials": reports,
                },
                indent=1,
            )
        )


if __name__ == "__main__":
    main()
