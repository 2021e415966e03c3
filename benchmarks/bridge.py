"""Timing of the bridge with a scripted hand on a pseudo-terminal: one JSON line per measurement.

    python benchmarks/bridge.py --seconds 600

The hand is a separate process that answers 9.6 ms after each request, like the real one over RS485. Two measurements:
the whole command as a user runs it (exchanges at 83 Hz, the policy at its own rate, log and safety on), and observation
and policy alone. `--twin` uses the emulated hand with its physics and object sensors, `--port` an existing hand. `own`
is the timing without the cycles in which the machine took a core from all programs (`machine`).
"""

import argparse
import array
import collections
import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
import threading
import time
import tty
from pathlib import Path

import numpy as np

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parent.parent)}
EXCHANGE = 0.0096  # s, mean and median of the round trip, measured on a hand


def peer() -> None:
    """A scripted hand that follows its targets; prints its port, and serves until its input closes."""
    from dexsim_real.core.process import use_realtime
    from dexsim_real.wire import frames
    from dexsim_real.wire.frames import Command, Frame, Mode, Parser

    use_realtime()  # Hardware waits for no scheduler.
    master, slave = os.openpty()
    tty.setraw(slave)
    print(os.ttyname(slave), flush=True)
    parser, state = Parser(frames.HOST_REQUESTS), frames.empty_state()
    state["joint"]["position"] = 0.3 * (np.arange(12) != 3)
    while True:
        ready, _, _ = select.select([master, sys.stdin], [], [])
        if sys.stdin in ready:
            return
        due = time.monotonic() + EXCHANGE
        for frame in parser.feed(os.read(master, 4096)):
            if frame.command == Command.VERSION:
                time.sleep(0.0002)  # The bridge rejects an answer that arrives sooner than its bytes take.
                os.write(master, Frame(0x80, frames.HOST, Command.VERSION, b"bench").encode())
            elif frame.command == Command.EXCHANGE:
                command, joint = frames.decode_command(frame.data), state["joint"]
                on = command["mode"] == Mode.POSITION
                joint["position"] += np.where(on, (command["position"] - joint["position"]) / 3, 0)
                state["tip"]["taxel"]["z"][:, 30:40] = np.random.default_rng().integers(0, 30, (5, 10))
                reply = Frame(0x80, frames.HOST, Command.EXCHANGE, state.tobytes()).encode()
                time.sleep(max(due - time.monotonic(), 0.0))
                while reply:
                    reply = reply[os.write(master, reply) :]


@contextlib.contextmanager
def scripted_hand():
    """Run a scripted hand in its own process; options of the runner for it."""
    process = subprocess.Popen(
        [sys.executable, __file__, "--peer"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT
    )
    try:
        yield ["--port", process.stdout.readline().decode().strip(), "--fixed-object"]
    finally:
        process.stdin.close()
        process.wait(5)


@contextlib.contextmanager
def emulated_hand(task: str, folder: Path):
    """Run `python -m dexsim_real.twin`; options of the runner for it."""
    port, imu, masks = (folder / name for name in ("hand", "imu", "masks"))
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "dexsim_real.twin",
            "--task",
            task,
            "--trials",
            "100000",
            "--link",
            str(port),
            "--imu-link",
            str(imu),
            "--mask-socket",
            str(masks),
        ],
        stdout=subprocess.PIPE,
        env=ENVIRONMENT,
    )
    try:
        process.stdout.readline()
        threading.Thread(target=process.stdout.read, daemon=True).start()
        yield ["--port", str(port), *(["--imu", str(imu)] if task == "rotate" else ["--camera", f"unix:{masks}"])]
    finally:
        process.terminate()
        process.wait(10)


def resident() -> float:
    """Memory of this process in MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def own_loops(ticks: dict, waited: dict, intervals: np.ndarray) -> dict[str, dict]:
    """Timing of the two loops in the cycles in which the machine let them run.

    Args:
      ticks: by loop, deadlines in s and when they were met, alternating.
      waited: by loop, deadlines missed because of the hand before each cycle; none for the policy loop.
      intervals: [N, 2] s in which the machine ran no program.
    """
    from machine import own_timing

    own = {}
    # Without the first second; shorter loops belong to the start.
    for pace, times in sorted(ticks.items(), key=lambda x: len(x[1]))[-2:]:
        first, (due, met) = round(1 / pace.period), np.reshape(times, (-1, 2)).T
        # The count is reset after the start.
        known = np.array([*waited[pace], 0][: len(due) + 1] if pace in waited else np.zeros(len(due) + 1), int)
        own["exchange_loop" if pace in waited else "policy_loop"] = own_timing(
            due[first:], met[first:], pace.period, intervals, np.maximum(np.diff(known), 0)[first:]
        )
    return own


def measure_run(options: argparse.Namespace, hand: list[str], folder: Path) -> dict:
    """A whole run of the command: its summary, timing and memory."""
    from machine import Away

    from dexsim_real.control import servo
    from dexsim_real.core.timing import Pace
    from dexsim_real.run import __main__ as run

    memory, done, wait, cycle = [], threading.Event(), Pace.wait, servo.Servo._cycle
    ticks, waited = (collections.defaultdict(lambda: array.array("d")) for _ in range(2))  # 8 bytes a number

    def watch() -> None:
        while not done.wait(options.seconds / 20):
            memory.append(resident())

    def noted(pace: Pace) -> None:
        wait(pace)
        ticks[pace].extend((pace.next - pace.period, time.monotonic()))

    def counted(loop: servo.Servo) -> float:
        waited[loop.pace].append(loop.waited)
        return cycle(loop)

    arguments = [
        options.policy,
        *hand,
        "--uncalibrated",
        "--yes",
        "--link.settle",
        "0.1",
        "--quiet",
        "--seconds",
        str(options.seconds),
        "--approach",
        "1",
        "--log",
        str(folder / "bridge.log"),
        "--output",
        str(folder / "bridge.json"),
    ]
    threading.Thread(target=watch, daemon=True).start()
    Pace.wait, servo.Servo._cycle = noted, counted
    start = time.process_time()
    with Away() as away:
        code = run.main(arguments)
    used = time.process_time() - start
    done.set()
    Pace.wait, servo.Servo._cycle = wait, cycle
    summary = json.loads((folder / "bridge.json").read_text())
    exchanges, link = summary["exchange_jitter"], summary["link"]
    return {
        "exit": code,
        "seconds": summary["seconds"],
        "policy_loop": summary["policy_jitter"],
        "exchange_loop": exchanges,
        "round_trip": summary["round_trip"],
        "tick": summary["policy_compute"],
        "own": own_loops(ticks, waited, away.intervals),
        "machine_away": away.summary(),
        "missed_by_us": exchanges["missed"] - summary["missed_for_the_hand"],
        "missed_for_the_hand": summary["missed_for_the_hand"],
        "unanswered": link["sent"] - link["answered"],
        "holds": summary["safety"],
        "memory_mib": [round(m, 1) for m in memory[2::4]],
        "cpu_share": round(used / summary["seconds"], 3),
        "log_mib": round((folder / "bridge.log").stat().st_size / 2**20, 1),
        "log_dropped": summary["log_dropped"],
    }


def measure_compute(policy: str, ticks: int) -> dict:
    """Observation and policy alone, from readings to action, and the whole tick from a state block."""
    from dexsim import load_hand
    from dexsim_ppo.policy import load_policy
    from dexsim_real.control.controller import IDENTITY, Controller
    from dexsim_real.core.process import leave_realtime, use_realtime
    from dexsim_real.sensors.hand import HandSensing, HardwareConfig
    from dexsim_real.sensors.readings import ObjectEstimate
    from dexsim_real.wire import frames

    hand = load_hand()
    controller, sensing = Controller(load_policy(policy), hand), HandSensing(hand, HardwareConfig())
    controller.warm()
    rng = np.random.default_rng(0)
    seen = ObjectEstimate(np.zeros(3), np.zeros(3), IDENTITY)
    both, whole = [], []
    realtime = use_realtime()  # Like the command.
    for _ in range(ticks):
        state = frames.empty_state()
        state["joint"]["position"] = rng.uniform(hand.joint_lower, hand.joint_upper)
        state["tip"]["taxel"]["z"] = rng.integers(0, 30, (5, 120))
        start = time.perf_counter()
        tick = controller.tick(sensing.measure(state), seen, IDENTITY, 0.5)
        middle = time.perf_counter()
        np.asarray(controller.policy.act(controller.carry, np.asarray(controller._observe(tick.readings)))[1])
        both.append(time.perf_counter() - middle)
        whole.append(middle - start)
    leave_realtime()
    return {
        name: {f"p{q}_ms": round(1e3 * float(np.percentile(times, q)), 4) for q in (50, 99)}
        for name, times in (("observe_and_policy", both), ("whole_tick", whole))
    } | {"ticks": ticks, "realtime": realtime}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="grasp", help="policy file, or name of a shipped policy")
    parser.add_argument("--port", help="port of an existing hand")
    parser.add_argument("--twin", choices=("grasp", "rotate"), help="use the emulated hand, for a policy of this task")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of the run")
    parser.add_argument("--ticks", type=int, default=5000, help="ticks of observation and policy alone")
    parser.add_argument("--peer", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.peer:
        peer()
        return
    from dexsim_real.control.controller import prepare_jax

    prepare_jax()
    common = {
        "policy": options.policy,
        "hand": options.port or options.twin or "scripted",
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
    }
    print(json.dumps({"measure": "compute", **measure_compute(options.policy, options.ticks), **common}), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        hand = (
            contextlib.nullcontext(["--port", options.port, "--fixed-object"])
            if options.port
            else emulated_hand(options.twin, Path(folder))
            if options.twin
            else scripted_hand()
        )
        with hand as words:
            row = measure_run(options, words, Path(folder))
        print(json.dumps({"measure": "run", **row, **common, "load": os.getloadavg()[0]}), flush=True)


if __name__ == "__main__":
    main()
