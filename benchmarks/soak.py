"""The bridge on an emulated hand that fails in every way, and runners that are killed: one JSON line for each.

    python benchmarks/soak.py --minutes 30 --kills 50

Soak: `python -m dexsim_real.run`, again and again, against `python -m dexsim_real.twin` with every fault injected.
Asked is that nothing crashes, that no command leaves its limits, that both ends are in a safe state within 0.1 s of
losing each other, and that the host's counters are what was injected (give or take the `hiccups` of the machine, of
which a quiet one has none). Kills: runners die by SIGKILL at random moments;
every log opens and replays, and the hand is off within 0.1 s. Exit code 1 if anything fails.
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
from collections.abc import Iterator
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
}
"""Shares of all exchanges, of which there are 83 a second."""
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
"""The runner's command, but that it waits before it opens the port."""


def start(*words: str, **options) -> subprocess.Popen:
    """Python with these words, in the repository."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return subprocess.Popen([sys.executable, *words], cwd=ROOT, env={**os.environ, "PYTHONPATH": path}, **options)


def resident(pid: int) -> float:
    """Memory of a process, MiB."""
    with contextlib.suppress(OSError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    return float("nan")


def stolen() -> float:
    """Seconds that a virtual machine's processors were given to others so far."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


class TwinProcess:
    """An emulated hand of its own process, with its ports in a folder."""

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
        """Its report."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(20)
        self._shown.close()
        return json.loads(self._report.read_text())


def runner_words(twin: TwinProcess, options: argparse.Namespace, log: Path, seconds: float) -> list[str]:
    """Options of the runner."""
    return [
        "grasp",
        "--port",
        str(twin.port),
        "--camera",
        f"unix:{twin.masks}",
        "--uncalibrated",
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
    """Print a measurement with what failed of it."""
    failed = [name for name, sound in checks.items() if not sound]
    print(json.dumps({**row, "ok": not failed, "failed": failed}), flush=True)
    return not failed


# --- soak ----------------------------------------------------------------------------------------


def soak(options: argparse.Namespace) -> bool:
    """Runs with every fault, until the time is over; whether all was as it should be."""
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
                {"code": process.returncode, "stderr": process.stderr.read().decode(), **inspect(log, options.safe)}
            )
            memory.append(largest)
            twin_memory.append(resident(twin.process.pid))
            log.unlink()
        seconds, report = time.monotonic() - begun, twin.stop()
    host = sum((Counter(run["link"]) for run in runs), Counter())
    both, heat = agreement(host, report), heat_reactions(report)
    holds = [delay for run in runs for delay in run["holds"]]
    watchdog, commands = report["watchdog"], report["commands"]
    checks = {
        "no crash": all(run["code"] in (0, 1, 2) and "Traceback" not in run["stderr"] for run in runs),
        "every run that began ended as it should": all(
            run["end"] == "time is over" or run["end"].startswith("stopped: too hot") or run["code"] == 2
            for run in runs
        ),
        "logs whole": not any(run["damaged"] for run in runs),
        "commands within limits": commands["checked"] > 0 and not commands["outside_limits"],
        "host safe in time": max(holds, default=0.0) <= options.safe,
        "hand safe in time": watchdog["longest_s"] <= options.safe,
        "hot motors off in time": max(heat, default=0.0) <= options.safe,
        "stuck taxels seen": all(run["stuck"](report["stuck"]) for run in runs[-1:]),
        # Where the machine itself held the hand up, an answer may have been late without any fault.
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
            "hand_lost_host": len(watchdog["trips"]),
            "hand_safe_ms": round(1e3 * watchdog["longest_s"], 1),
            "host_lost_hand": len(holds),
            "host_safe_ms": round(1e3 * max(holds, default=0.0), 1),
            "hot": len(heat),
            "hot_off_ms": round(1e3 * max(heat, default=0.0), 1),
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


def inspect(path: Path, safe: float) -> dict:
    """What a log tells: counters at the end, and how soon each loss of the hand was noticed."""
    from dexsim_real.core.log import Kind, LogReader
    from dexsim_real.wire import frames

    reader, link, end, state = LogReader(path), {}, "no end", None
    states, sent, notes = [], [], []
    for record in reader:
        if record.kind == Kind.RECEIVED and record.content[1][4] == frames.Command.EXCHANGE:
            states.append(record.time)
            state = record.content[1]
        elif record.kind == Kind.SENT and record.content[1][4] == frames.Command.EXCHANGE:
            if frames.decode_command(record.content[1][7:-2])["mode"][0] != frames.Mode.PASSIVE:
                sent.append(record.time)
        elif record.kind == Kind.NOTE and record.content.startswith(("clip", "hold", "relax", "in command")):
            notes.append((record.time, record.content.startswith(("hold: no measurement", "relax"))))
        elif record.kind == Kind.END:
            link, end = record.content["link"], record.content["end"]

    def stuck(taxels: list) -> bool:
        seen = frames.decode_state(state[7:-2])["tip"]["taxel"]["z"]
        return all(seen[tip, taxel] == count for tip, taxel, count in taxels)

    return {
        "link": link,
        "end": end.split(":")[0] + (": " + end.split(":")[1].strip() if "stopped" in end else ""),
        "damaged": reader.damaged,
        "holds": list(reactions(states, sent, notes, safe)),
        "stuck": stuck,
    }


def reactions(states: list[float], sent: list[float], notes: list[tuple[float, bool]], safe: float) -> Iterator[float]:
    """For each silence longer than allowed: how old the news was, s, when the last command before the hold was sent.

    `notes` are the bridge's changes: when, and whether it then held or relaxed for want of news. A bridge that the
    machine itself has stopped sends nothing, and that is safe.
    """
    for before, after in zip(states, states[1:], strict=False):
        if after - before <= safe or not sent or not sent[0] <= before <= sent[-1]:
            continue
        later = [(when, holds) for when, holds in notes if before < when <= after]
        held = [holds for when, holds in notes if when <= before][-1:] == [True] and not later
        alarm = before if held else min((when for when, holds in later if holds), default=after)
        yield max((when - before for when in sent if before < when < alarm), default=0.0)


def heat_reactions(report: dict) -> list[float]:
    """Seconds from a motor getting hot until the motors were off, for those that were on."""
    on, hot, found = False, None, []
    for when, text in report["events"]:
        if text.startswith("joint") and text.endswith("hotter") and on and hot is None:
            hot = when
        elif text == "motors on":
            on = True
        elif text.startswith(("motors off", "watchdog")):
            found += [when - hot] if hot is not None else []
            on, hot = False, None
    return found


def agreement(host: Counter, report: dict) -> dict[str, tuple[int, int]]:
    """The host's counters beside what was injected, by name."""
    line, made, expected = Counter(report["line"]), Counter(report["faults"]["injected"]), report["faults"]["expected"]
    damaged_requests = sum(made[f"{kind} request"] for kind in ("flip", "drop", "duplicate"))
    return {
        "corrupt": (host["corrupt"], expected["corrupt"]),
        "lost": (host["lost"], expected["lost"]),
        # What the hand never answered, and what came too late.
        "silent": (host["silent"], damaged_requests + line["ignored"] + host["late"]),
        "answered": (host["answered"] + host["refused"] + host["late"], line["answers"]),
        "sent": (host["sent"], line["requests"]),
        "each has one end": (host["sent"], sum(host[k] for k in ("answered", "corrupt", "silent", "refused", "lost"))),
    }


# --- kills ---------------------------------------------------------------------------------------


def kills(options: argparse.Namespace) -> bool:
    """Runners that die at random moments; whether every log opened and the hand was off in time."""
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
            time.sleep(2 * options.safe)
        report = twin.stop()
        rows = [autopsy(log, death) for log, death in zip(logs, deaths, strict=True)]
    off = [motors_off(report, death, death + 2 * options.safe) for death in deaths]
    running = [delay for delay in off if delay is not None]
    lost, commands = [row["lost"] for row in rows], report["commands"]
    checks = {
        "every log opened": all(row["opened"] for row in rows),
        "every log replayed": all(row["same"] for row in rows),
        "logs up to the last second": max(lost) < 1.0,
        "hand off by its own watchdog in time": max(running, default=0.0) <= options.safe,
        "commands within limits": not commands["outside_limits"],
    }
    return report_line(
        {
            "measure": "kills",
            "kills": len(deaths),
            "with_motors_on": len(running),
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


def autopsy(path: Path, death: float) -> dict:
    """A dead runner's log: whether it opens and replays, and seconds between its last record and the end."""
    from dexsim_real.core.log import Kind, LogError, LogReader
    from dexsim_real.replay.replay import replay

    try:
        reader = LogReader(path)
        records = list(reader)
    except LogError:
        return {"opened": False, "same": False, "lost": float("inf"), "damaged": 0, "ticks": 0}
    row = {
        "opened": True,
        "same": True,
        "damaged": reader.damaged,
        "ticks": 0,
        # Exchanges are recorded from the handshake on: before that there is nothing to lose.
        "lost": death - records[-1].time if any(record.kind == Kind.RECEIVED for record in records) else 0.0,
    }
    if any(record.kind == Kind.META for record in records):
        again = replay(path).report
        row |= {"ticks": again["ticks"], "same": again["observations_same"] == again["readings_same"] == again["ticks"]}
    return row


def motors_off(report: dict, death: float, until: float) -> float | None:
    """Seconds from a death until the motors were off; None where they were off already, infinity if not by `until`.

    A request on the wire at the moment of death may still switch them on.
    """
    on = False
    for when, text in report["events"]:
        if when >= until:
            break
        if text == "motors on":
            on = True
        elif text.startswith(("motors off", "watchdog")):
            if on and when >= death:
                return when - death
            on = False
    return float("inf") if on else None


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=3.0, help="length of the soak; 0: none")
    parser.add_argument("--kills", type=int, default=50, help="runners to kill; 0: none")
    parser.add_argument("--run-seconds", type=float, default=60.0, help="longest run of the soak")
    parser.add_argument("--life", type=float, default=6.0, help="longest life s of a runner that is killed")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the rates of all faults")
    parser.add_argument("--safe", type=float, default=0.1, help="s, by when a lost partner must have been noticed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-realtime", dest="realtime", action="store_false")
    parser.add_argument("--twin", default="", help="more options of the emulated hand")
    parser.add_argument("--runner", default="", help="more options of the runner")
    options = parser.parse_args(argv)
    sys.path.insert(0, str(ROOT))
    from dexsim_real.control.controller import prepare_jax

    prepare_jax()
    sound = [soak(options)] if options.minutes > 0 else []
    sound += [kills(options)] if options.kills > 0 else []
    return 0 if all(sound) else 1


if __name__ == "__main__":
    sys.exit(main())
