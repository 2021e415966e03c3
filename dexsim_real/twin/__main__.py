"""Emulates a hand on a pseudo-terminal: the wire format of the real hand, and physics that no policy was trained on.

    python -m dexsim_real.twin --task rotate

It prints the command that runs a policy on it, and ends after its trials or with Ctrl-C.
"""

import dataclasses
import queue
import shlex
import signal
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dexsim.core import cli
from dexsim.hand.kinematics import Hand
from dexsim.hand.load import load_hand
from dexsim_real.core.errors import HandError
from dexsim_real.core.process import use_realtime
from dexsim_real.sensors.camera import CameraConfig
from dexsim_real.sensors.hand import check_wire
from dexsim_real.twin.options import TwinArguments
from dexsim_real.twin.plant.protocol import Plant
from dexsim_real.twin.server import Twin
from dexsim_real.twin.wire.firmware import FirmwareConfig


def make_plant(arguments: TwinArguments, hand: Hand) -> Plant:
    """The physics for the options."""
    if arguments.press:
        from dexsim_real.twin.press import PressBench

        return PressBench(hand, arguments.seed, kind=arguments.parameters)
    from dexsim_real.twin.plant.foreign.hand import hand_of

    return hand_of(
        arguments.plant_model,
        hand,
        arguments.task,
        arguments.seed,
        trials=arguments.trials,
        kind=arguments.parameters,
        seconds=arguments.seconds,
        command=arguments.command,
        first=arguments.first,
        shape=None if arguments.shape == "any" else arguments.shape,
    )


def check_policy(name: str, task: str, hand: str) -> None:
    """Check that a policy fits the task, the hand (its TOML) and the mount of the emulated hand.

    Raises:
      HandError: it does not.
      ConfigError: it is of another hand.
    """
    from dexsim_ppo.policy import load_policy
    from dexsim_real.twin.plant.mount import nominal_gravity

    policy = load_policy(name)
    policy.find_hand(hand)
    if policy.task != task:
        raise HandError(f"{name} is a policy of the task {policy.task!r}; give --task {policy.task}")
    if policy.spec is None:
        raise HandError(f"{name} is of an environment that is not of this library")
    trained, mounted = policy.spec.gravity, nominal_gravity(task)
    if np.abs(np.asarray(trained) - mounted).max() > 0.01:
        raise HandError(
            f"{name} was trained with gravity {np.round(trained, 2).tolist()} m/s^2 in the palm frame, the emulated "
            f"hand has {np.round(mounted, 2).tolist()}; use a policy that was trained with this mount"
        )


def write_calibration(path: Path, hand: Hand, board: FirmwareConfig) -> Path:
    """Write the calibration of an emulated hand with nominal motors, from which the motors of each trial deviate."""
    from dexsim.calibration.maps import save_calibration
    from dexsim_real.twin.virtual import ideal_calibration

    side = board.handedness if board.serial_number else ""
    save_calibration(path, dataclasses.replace(ideal_calibration(hand), serial=board.serial_number, handedness=side))
    return path


def runner_command(twin: Twin, calibration: Path | None) -> list[str]:
    """The command that runs a policy on an emulated hand."""
    arguments, line, board = twin.arguments, twin.arguments.line, twin.arguments.firmware
    words = [
        "python",
        "-m",
        "dexsim_real.run",
        arguments.policy or arguments.task,
        "--port",
        str(twin.line.terminal.name),
        *(["--calibration", str(calibration)] if calibration else ["--uncalibrated"]),
        "--yes",
        *(["--hand", arguments.hand] if arguments.hand else []),
    ]
    if arguments.command is not None:
        words += ["--command", f"{arguments.command:g}"]
    if twin.imu:
        words += ["--imu", str(twin.imu.terminal.name)]
        if arguments.object.imu_mount != type(arguments.object)().imu_mount:
            words += ["--imu-mount", *(f"{v:g}" for v in arguments.object.imu_mount)]
    if twin.masks and arguments.task == "grasp":
        words += ["--camera", f"unix:{twin.masks.path}"]
        # Between two trials the object is out of sight for up to 20 s, which would end the run.
        words += ["--safety.stale-object", "60"] if arguments.trials > 1 else []
        for name in ("focal", "centre", "position", "forward", "down"):
            value = getattr(arguments.object.optics, name)
            if value != getattr(CameraConfig(), name):
                words += [f"--optics.{name}", *(f"{v:g}" for v in value)]
    words += ["--link.baud", str(line.baud)] if line.baud != type(line)().baud else []
    words += ["--link.hand-id", str(board.hand_id)] if board.hand_id else []
    return words


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code, 0."""
    arguments = cli.parse(
        TwinArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_real.twin",
        description="Emulate a hand on a pseudo-terminal.",
    )
    if arguments.output:
        cli.check_writable(arguments.output)
    hand = load_hand(arguments.hand or None)
    check_wire(hand)
    if arguments.policy:
        check_policy(arguments.policy, arguments.task, arguments.hand)
    lines: queue.SimpleQueue = queue.SimpleQueue()
    with tempfile.TemporaryDirectory(prefix="dexsim-twin-") as folder:
        twin = Twin(arguments, hand, make_plant(arguments, hand), Path(folder), lines.put)
        before = {number: signal.signal(number, lambda *_: twin.stop()) for number in (signal.SIGTERM, signal.SIGINT)}
        calibration = arguments.calibration or (
            None if arguments.press else write_calibration(Path(folder) / "calibration.toml", hand, arguments.firmware)
        )
        printer = threading.Thread(target=_print, args=(lines,), name="print", daemon=True)
        printer.start()
        try:
            lines.put(
                f"{arguments.task}: the emulated hand is at {twin.line.terminal.name}. Run a policy on it with\n"
                f"    {shlex.join(runner_command(twin, calibration))}"
            )
            if arguments.realtime and not use_realtime():
                twin.note("without real-time priority: expect jitter on a busy machine (docs/hardware.md)")
            twin.run()
        finally:
            lines.put(None)
            printer.join(2.0)
            twin.close()
            if arguments.output:
                cli.write_json(arguments.output, twin.report())
            for number, handler in before.items():
                signal.signal(number, handler)
    return 0


def _print(lines: queue.SimpleQueue) -> None:
    """Print lines in a background thread, so that the terminal never blocks the hand's port."""
    for text in iter(lines.get, None):
        print(text, flush=True)


if __name__ == "__main__":
    cli.run(main)
