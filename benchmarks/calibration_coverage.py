"""Coverage of the 95 % intervals that calibration and identification report, against hidden truths.

    python benchmarks/calibration_coverage.py --trials 100 --seed 1000 --processes 2

One JSON line for each interval: trials, share that hold the truth, median half-width, mean error. The exit code is 1
if a share is below 90 %.

hand: `python -m dexsim_real.calibrate` on emulated hands in virtual time. Every trial has another hand, finger and
gauge; odd ones have parameters outside the ranges of training, even ones inside. `--logs FOLDER` keeps the recordings,
and fits those that are there instead of recording them again.
joint, sensor: `fit_joint` and `fit_finger` on virtual presses whose residuals belong together: every press has its own
gain and offset, and the noise is autocorrelated.
drives: `identify` on a joint of the model, with autocorrelated noise and a torque ripple that the model does not have.
"""

import argparse
import functools
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from workers import pool

GAUGE_ERROR = 0.005  # standard deviation of a gauge's scale
GRAM = 9.80665e-3  # N, resolution of a kitchen scale
_gauge: Any = None


def read_gauge() -> float:
    """What the gauge of the present trial shows, N."""
    return _gauge()


def record_hand(folder: Path, seed: int) -> tuple[Path, dict[str, Any]]:
    """Press one finger of an emulated hand; the log and the true values, from the folder if they are there."""
    global _gauge
    from rich.console import Console

    from dexsim import load_hand
    from dexsim_real.calibrate.__main__ import record
    from dexsim_real.calibrate.hand_loop import Operator
    from dexsim_real.calibrate.options import CalibrateArguments
    from dexsim_real.core.errors import HandError
    from dexsim_real.twin.press import PressBench, VirtualPort

    log, truth_file = folder / f"{seed}.log", folder / f"{seed}.json"
    if truth_file.exists():
        return log, json.loads(truth_file.read_text())
    log.unlink(missing_ok=True)
    hand = load_hand()
    plant = PressBench(hand, seed, kind=("inside", "outside")[seed % 2])
    scale = 1.0 + GAUGE_ERROR * np.random.default_rng([seed, 1]).standard_normal()
    _gauge = lambda: float(np.round(scale * plant.gauge() / GRAM) * GRAM)  # noqa: E731
    port, finger = VirtualPort(plant), hand.finger_names[seed // 2 % hand.num_fingers]
    arguments = CalibrateArguments(
        port="virtual",
        output=folder / f"{seed}.toml",
        log=log,
        yes=True,
        realtime=False,
        fingers=(finger,),
        sides=False,
        gauge=f"{__name__}:read_gauge",
    )
    truth = plant.truth() | {"seed": seed, "finger": finger, "kind": plant.kind, "failed": ""}
    try:
        record(
            arguments,
            hand,
            Operator(Console(file=io.StringIO()), assume_yes=True),
            port=port,
            clock=port.clock,
            sleep=port.sleep,
        )
    except HandError as error:
        truth["failed"] = str(error)
    truth_file.write_text(json.dumps(truth))
    return log, truth


def hand_rows(folder: Path, seed: int) -> list[tuple[str, float, float, float, float]]:
    """Record and fit one finger: name, value, interval and truth of everything that is reported."""
    from dexsim import load_hand
    from dexsim_real.calibrate.press_fit import fit
    from dexsim_real.calibrate.read import read_logs
    from dexsim_real.calibrate.report import torque_constant_intervals, torque_constants

    log, truth = record_hand(folder, seed)
    if truth["failed"]:
        print(f"{seed}: {truth['failed']}", file=sys.stderr)
        return []
    hand = load_hand()
    session, rows = read_logs([log], hand), []
    finger = truth["finger"]
    for source in ("gauge", "no gauge"):
        if source == "no gauge":
            for recording in session.recordings.values():
                recording.gauge = {}
        found = fit(session, hand)
        # The currents of this hand are negative when it closes.
        value, interval = -torque_constants(found.calibration), -torque_constant_intervals(found.calibration)
        for joint, name in enumerate(hand.joint_names):
            for way, label in enumerate(("loading", "unloading")):
                low, high = sorted(interval[way, joint])
                true = truth[f"{label}_nm_per_a"][joint]
                group = f"{finger} pad" if name in found.source else "joints taken from their class"
                for of in (group, f"all pads, {truth['kind']}") if name in found.source else (group,):
                    rows.append((f"Nm/A, {source}, {of}", value[way, joint], low, high, true))
        if source == "gauge":
            scale, true = found.sensors[finger].gain, 10.0 * truth["taxel_gain"][hand.finger_names.index(finger)]
            rows.append(("counts per newton", scale.value, scale.low, scale.high, true))
    return rows


def joint_rows(seed: int) -> list[tuple[str, float, float, float, float]]:
    """The lines of one joint from presses that differ."""
    from dexsim.calibration.joint import JointPress, fit_joint
    from dexsim.calibration.virtual_press import varied_presses

    rows = []
    for correlation in (0.0, 0.9, 0.98):
        rng = np.random.default_rng([seed, 2])
        found = fit_joint(JointPress(*varied_presses(rng, friction=0.01, correlation=correlation)), "A")
        for way, line, offset in (("loading", found.loading, 0.03), ("unloading", found.unloading, 0.01)):
            name = f"fit_joint, {way}, correlation {correlation:g}"
            rows.append((f"{name}, gain", line.gain, *line.gain_interval, 0.05))
            rows.append((f"{name}, offset", line.offset, *line.offset_interval, offset))
    return rows


def sensor_rows(seed: int) -> list[tuple[str, float, float, float, float]]:
    """The line and the threshold of one fingertip from presses that differ."""
    from dexsim.calibration.sensor import TaxelPress, fit_finger
    from dexsim.calibration.virtual_press import varied_presses

    rows = []
    for correlation in (0.0, 0.9):
        force, total = varied_presses(
            np.random.default_rng([seed, 3]),
            gain=9.0,
            offset=1.5,
            shift=1.0,
            noise=0.8,
            correlation=correlation,
            samples=160,
        )
        total = np.where(force < 0.3, 0.0, np.maximum(np.round(total), 0.0))
        found = fit_finger(TaxelPress(force=force, reading=total[:, None]))
        for name, truth in (("gain", 9.0), ("offset", 1.5), ("threshold", 0.3)):
            at = getattr(found, name)
            rows.append((f"fit_finger, correlation {correlation:g}, {name}", at.value, at.low, at.high, truth))
    return rows


def drive_rows(seed: int) -> list[tuple[str, float, float, float, float]]:
    """The smooth parameters of a drive, latency and other parameters known."""
    import jax.numpy as jnp
    from scipy.signal import lfilter

    from dexsim.identification.excitation import Excitation, joint_excitation
    from dexsim.identification.identify import FIT, identify
    from dexsim.identification.joint import JointLog, simulate, with_defaults

    rng, period, substeps, latency = np.random.default_rng([seed, 4]), 0.015, 3, 2
    known = {"no_load_speed": 12.0, "inertia": 0.0012}
    truth = {
        "stiffness": rng.uniform(2.0, 4.0),
        "damping": rng.uniform(0.06, 0.15),
        "coulomb_friction": rng.uniform(0.01, 0.03),
        "viscous_friction": rng.uniform(0.003, 0.01),
        "stall_torque": rng.uniform(0.35, 0.45),
    }
    signals = Excitation(
        period=period, chirp_seconds=2.0, chirp_parts=3, step_count=4, slow_speed=1.0, reversal_cycles=2, rest=0.3
    )
    target = joint_excitation(signals, 0.9, 0.8)
    values = with_defaults(truth | known, JointLog(period, target, target))
    timestep = jnp.float32(period / substeps)
    position, torque = simulate(values, jnp.asarray(target, jnp.float32), jnp.int32(latency), timestep, substeps)
    noise = lfilter([np.sqrt(1 - 0.9**2)], [1.0, -0.9], rng.standard_normal((2, len(target))))
    ripple = 1.0 + 0.02 * np.sin(rng.uniform(50, 200) * np.asarray(position) + rng.uniform(0, 2 * np.pi))
    log = JointLog(
        period, target, np.asarray(position) + 0.001 * noise[0], np.asarray(torque) * ripple + 0.01 * noise[1]
    )
    guess = known | {"stiffness": 3.5, "damping": 0.13, "stall_torque": 0.45}
    found = identify(log, guess, dead_band=None, substeps=substeps, latencies=(latency,))
    return [(f"identify, {name}", found.values[name], *found.intervals[name], truth[name]) for name in FIT]


def summary(rows: list[tuple[str, float, float, float, float]]) -> list[dict[str, Any]]:
    """For each name: intervals, share that holds the truth, median half-width and mean error in % of the truth."""
    table = []
    for name in dict.fromkeys(row[0] for row in rows):
        value, low, high, truth = np.array([row[1:] for row in rows if row[0] == name]).T
        table.append(
            {
                "interval": name,
                "count": len(value),
                "covered_pct": round(100 * float(np.mean((low <= truth) & (truth <= high))), 1),
                "half_width_pct": round(100 * float(np.median((high - low) / 2 / np.abs(truth))), 1),
                "mean_error_pct": round(100 * float(np.mean(value / truth - 1)), 2),
            }
        )
    return table


def main() -> int:
    """The command. Returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=f"of {', '.join(PARTS)}")
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1000, help="of the first trial")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--logs", type=Path, help="folder of recordings, kept; a temporary one if not given")
    options = parser.parse_args()
    if unknown := [part for part in options.parts if part not in PARTS]:
        parser.error(f"no part {unknown[0]!r}; choose from {', '.join(PARTS)}")
    for name in ("trials", "processes"):
        if getattr(options, name) < 1:  # Without a trial no interval misses.
            parser.error(f"--{name} {getattr(options, name)}: must be at least 1")
    seeds, rows = range(options.seed, options.seed + options.trials), []
    with (
        tempfile.TemporaryDirectory() as scratch,
        pool(options.processes) as workers,
    ):
        folder = options.logs or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for part in options.parts:
            trial = functools.partial(PARTS[part], folder) if part == "hand" else PARTS[part]
            for seed, found in zip(seeds, workers.map(trial, seeds), strict=True):
                print(f"{part} {seed}", file=sys.stderr, flush=True)
                rows += found
    table = summary(rows)
    for row in table:
        print(json.dumps(row, ensure_ascii=False))
    return int(any(row["covered_pct"] < LEAST for row in table))


PARTS = {"hand": hand_rows, "joint": joint_rows, "sensor": sensor_rows, "drives": drive_rows}
LEAST = 90.0
"""Per cent of the intervals that must hold the truth."""

if __name__ == "__main__":
    sys.exit(main())
