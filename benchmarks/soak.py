"""Soak test: the bridge on an emulated hand with every fault, and runners that are killed. One JSON line for each.

    python benchmarks/soak.py --minutes 30 --kills 50

Soak: `python -m dexsim_real.run` repeatedly on `python -m dexsim_real.twin` with all faults injected. It passes if
nothing crashes, no command exceeds its limits as judged by the true joint angles, the bridge is safe within 0.1 s of
losing the hand or of the time that an alarm of the hand may last, every run ends with the motors off, and the host's
counters match the injected faults (up to the number of `hiccups` of the machine). Kills: runners end by SIGKILL at
random times. It passes if every log opens and replays, and the guard process has turned the motors off within 0.5 s:
the emulated hand has no watchdog unless `--twin "--firmware.watchdog 0.08"` asks for it. The exit code is 1 if anything
fails.
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
RATES = {
    "flip": 0.01,
    "drop": 0.01,
    "duplicate": 0.01,
    "late": 0.002,
    "stall": 0.002,
    "disconnect": 0.0007,
    "heat": 0.0002,
    "stuck": 0.0003,
    "angle": 0.001,
    "warm": 0.00005,
    "error": 0.00005,
    "off": 0.00005,
    "jam": 0.00005,
    "refuse": 0.00005,
}
"""Probability of each fault per exchange, at 83 exchanges per second."""
GATED = """
import sys
from dexsim_real.run import __main__ as run, session
prepare = session.Session.prepare
def gated(self):
    print("ready", flush=True)
    sys.stdin.readline()
    prepare(self)
session.Session.prepare = gated
run.cli.run(lambda _: run.main(sys.argv[1:]))
"""
"""The command of the runner, with a wait before it opens the port."""


def start(*words: str, **options) -> subprocess.Popen:
    """Start Python with these arguments in the repository."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return subprocess.Popen([sys.executable, *words], cwd=ROOT, env={**os.environ, "PYTHONPATH": path}, **options)


def resident(pid: int) -> float:
    """Memory of a process in MiB."""
    with contextlib.suppress(OSError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    return float("nan")


def stolen() -> float:
    """Seconds so far in which the hypervisor ran others on this virtual machine's processors."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


class TwinProcess:
    """An emulated hand in its own process, with its ports in a folder."""

    def __init__(self, folder: Path, options: argparse.Namespace, *words: str):
        self.folder = folder
        self.port, self.masks, self._report = folder / "hand", folder / "masks", folder / "twin.json"
        self._shown = (folder / "twin.txt").open("w")
        self.process = start(
            "-m",
            "dexsim_real.twin",
            "--task",
            "grasp",
            "--trials",
            "100000",
            "--seed",
            str(options.seed),
            "--link",
            str(self.port),
            "--mask-socket",
            str(self.masks),
            "--output",
            str(self._report),
            *options.twin.split(),
            *([] if options.realtime else ["--no-realtime"]),
            *words,
            stdout=self._shown,
            stderr=subprocess.STDOUT,
        )
        until = time.monotonic() + 60
        while not self.masks.exists():
            if self.process.poll() is not None or time.monotonic() > until:
                raise SystemExit(f"the emulated hand did not start: {(folder / 'twin.txt').read_text()}")
            time.sleep(0.05)

    def stop(self) -> dict:
        """End the process and return its report."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(20)
        self._shown.close()
        return json.loads(self._report.read_text())


def runner_words(twin: TwinProcess, options: argparse.Namespace, log: Path, seconds: float) -> list[str]:
    """Arguments of the runner."""
    return [
        "grasp",
        "--port",
        str(twin.port),
        "--camera",
        f"unix:{twin.masks}",
        "--safety.stale-object",  # Between two trials the object is out of sight, which would end the run.
        "60",
        "--uncalibrated",
        "--yes",
        "--quiet",
        "--link.settle",
        "0.1",
        "--approach",
        "1",
        "--seconds",
        f"{seconds:g}",
        "--log",
        str(log),
        *options.runner.split(),
        *([] if options.realtime else ["--no-realtime"]),
    ]


def report_line(row: dict, checks: dict[str, bool]) -> bool:
    """Print a measurement with its failed checks; returns whether none failed."""
    failed = [name for name, sound in checks.items() if not sound]
    print(json.dumps({**row, "ok": not failed, "failed": failed}), flush=True)
    return not failed


# --- soak ----------------------------------------------------------------------------------------


def soak(options: argparse.Namespace) -> bool:
    """Run with every fault for the given time; returns whether all checks passed."""
    import soak_checks

    runs, memory, twin_memory = [], [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rates = [word for kind, rate in RATES.items() for word in (f"--faults.{kind}", f"{options.scale * rate:g}")]
        twin = TwinProcess(folder, options, *rates, "--faults.stuck-count", "2", "4")
        begun, begun_stolen = time.monotonic(), stolen()
        while (left := options.minutes * 60 - (time.monotonic() - begun)) > 1:
            log = folder / f"{len(runs)}.log"
            process = start(
                "-m",
                "dexsim_real.run",
                *runner_words(twin, options, log, min(left, options.run_seconds)),
                stderr=subprocess.PIPE,
            )
            largest = 0.0
            while process.poll() is None:
                time.sleep(0.5)
                largest = max(largest, np.nan_to_num(resident(process.pid)))
            runs.append(
                {
                    "code": process.returncode,
                    "stderr": process.stderr.read().decode(),
                    **soak_checks.inspect(log, options.safe),
                }
            )
            memory.append(largest)
            twin_memory.append(resident(twin.process.pid))
            log.unlink()
        seconds, report = time.monotonic() - begun, twin.stop()
    host = sum((Counter(run["link"]) for run in runs), Counter())
    both, alarms = soak_checks.agreement(host, report), soak_checks.alarm_reactions(report)
    slowest = max((late for _, late in alarms), default=0.0)
    holds = [delay for run in runs for delay in run["holds"]]
    watchdog, commands = report["watchdog"], report["commands"]
    checks = {
        "no crash": all(run["code"] in (0, 1, 2) and "Traceback" not in run["stderr"] for run in runs),
        "every run ended as expected": all(
            run["end"].startswith(soak_checks.EXPECTED) or run["code"] == 2 for run in runs
        ),
        "no log damaged": not any(run["damaged"] for run in runs),
        "commands within limits": commands["checked"] > 0 and not commands["outside_limits"],
        "host safe in time": max(holds, default=0.0) <= options.safe,
        "motors off after every run": not soak_checks.on_at_end(report),
        "hand safe in time": not watchdog["limit_s"] or watchdog["longest_s"] <= options.safe,
        "motors off in time after an alarm": slowest <= options.safe,
        "stuck taxels seen": all(run["stuck"](report["stuck"]) for run in runs[-1:]),
        # When the machine delays the hand, an answer may be late without a fault.
        **{f"counters: {name}": abs(found - made) <= report["hiccups"] for name, (found, made) in both.items()},
    }
    return report_line(
        {
            "measure": "soak",
            "minutes": round(seconds / 60, 2),
            "runs": len(runs),
            "ends": dict(Counter(run["end"] for run in runs)),
            "injected": report["faults"]["injected"],
            "host": dict(host),
            "host_against_injected": both,
            "exchanges": report["line"].get("requests", 0),
            "commands": commands["checked"],
            "outside_limits": commands["outside_limits"],
            "first": commands["first"][:3],
            "wrong_measurements": sum(run["implausible"] for run in runs),
            "hand_lost_host": len(watchdog["trips"]),
            "hand_safe_ms": round(1e3 * watchdog["longest_s"], 1),
            "host_lost_hand": len(holds),
            "host_safe_ms": round(1e3 * max(holds, default=0.0), 1),
            "alarms": dict(Counter(kind for kind, _ in alarms)),
            "alarm_late_ms": round(1e3 * slowest, 1),
            "slowest_exchange_ms": report["slowest_exchange_ms"],
            "hiccups": report["hiccups"],
            "stolen_s": round(stolen() - begun_stolen, 2),
            "physics": report["physics"],
            "runner_mib": [round(m, 1) for m in memory],
            "twin_mib": [round(m, 1) for m in twin_memory],
            "errors": [run["stderr"][-300:] for run in runs if run["code"] == 2][:5],
            "load": os.getloadavg()[0],
            "cores": len(os.sched_getaffinity(0)),
        },
        checks,
    )


# --- kills ---------------------------------------------------------------------------------------


def kills(options: argparse.Namespace) -> bool:
    """Kill runners at random times; returns whether all checks passed."""
    import soak_checks

    rng, deaths, logs = np.random.default_rng(options.seed), [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        twin = TwinProcess(folder, options)

        def prepare(number: int) -> tuple[subprocess.Popen, Path]:
            log = folder / f"{number}.log"
            words = runner_words(twin, options, log, 3600)
            return start(
                "-c", GATED, *words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            ), log

        waiting = prepare(0)
        for number in range(options.kills):
            process, log = waiting
            if process.stdout.readline() != b"ready\n":
                raise SystemExit("a runner did not start")
            waiting = prepare(number + 1) if number + 1 < options.kills else None
            process.stdin.write(b"\n")
            process.stdin.flush()
            time.sleep(rng.uniform(0.0, options.life))
            deaths.append(time.monotonic())
            process.send_signal(signal.SIGKILL)
            process.wait()
            logs.append(log)
            time.sleep(2 * options.guard)
        report = twin.stop()
        rows = [soak_checks.autopsy(log, death) for log, death in zip(logs, deaths, strict=True)]
    off = [soak_checks.motors_off(report, death, death + 2 * options.guard) for death in deaths]
    running = [delay for delay in off if delay is not None]
    lost, commands = [row["lost"] for row in rows], report["commands"]
    checks = {
        "every log opened": all(row["opened"] for row in rows),
        "every log replayed": all(row["same"] for row in rows),
        "less than a second of log lost": max(lost) < 1.0,
        "motors off in time": max(running, default=0.0) <= options.guard,
        "commands within limits": not commands["outside_limits"],
    }
    return report_line(
        {
            "measure": "kills",
            "kills": len(deaths),
            "with_motors_on": len(running),
            "watchdog_s": report["watchdog"]["limit_s"],
            "hand_off_ms": {
                "mean": round(1e3 * float(np.mean(running or [0])), 1),
                "max": round(1e3 * max(running, default=0.0), 1),
            },
            "log_lost_ms": {"median": round(1e3 * float(np.median(lost)), 1), "max": round(1e3 * max(lost), 1)},
            "ticks_replayed": sum(row["ticks"] for row in rows),
            "torn_bytes": sum(row["damaged"] for row in rows),
            "commands": commands["checked"],
            "outside_limits": commands["outside_limits"],
            "first": commands["first"][:3],
            "load": os.getloadavg()[0],
            "cores": len(os.sched_getaffinity(0)),
        },
        checks,
    )


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=3.0, help="duration of the soak; 0: none")
    parser.add_argument("--kills", type=int, default=50, help="number of runners to kill; 0: none")
    parser.add_argument("--run-seconds", type=float, default=60.0, help="longest run of the soak in s")
    parser.add_argument("--life", type=float, default=6.0, help="longest life in s of a runner that is killed")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the probabilities of all faults")
    parser.add_argument("--safe", type=float, default=0.1, help="time in s within which a lost partner must be noticed")
    parser.add_argument("--guard", type=float, default=0.5, help="time in s within which the guard must act")
    parser.add_argument("--seed", type=int, default=0, help="of the faults and the kills")
    parser.add_argument("--no-realtime", dest="realtime", action="store_false")
    parser.add_argument("--twin", default="", help="more options of the emulated hand")
    parser.add_argument("--runner", default="", help="more options of the runner")
    options = parser.parse_args(argv)
    sys.path.insert(0, str(ROOT))
    from dexsim_real.control.controller import prepare_jax

    prepare_jax()
    passed = [soak(options)] if options.minutes > 0 else []
    passed += [kills(options)] if options.kills > 0 else []
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
