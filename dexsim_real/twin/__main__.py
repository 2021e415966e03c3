"""Emulates a hand on a pseudo-terminal: the wire format of the real hand, and physics that no policy was trained on.

    python -m dexsim_real.twin --task rotate

It prints the command that runs a policy on it, and ends after its trials or with Ctrl-C.
"""

import dataclasses
import shlex
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from dexsim.calibration.maps import save_calibration
from dexsim.core import cli
from dexsim.hand.description import Hand
from dexsim.hand.load import load_hand
from dexsim_real.core.process import use_realtime
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.server import Twin, TwinArguments
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.twin.wire.firmware import SERIALS
from dexsim_real.wire.serial_hand import check_wire


def make_plant(arguments: TwinArguments, hand: Hand) -> EmulatedHand:
    """The physics for the options."""
    return EmulatedHand(
        hand,
        arguments.task,
        arguments.seed,
        trials=arguments.trials,
        kind=arguments.parameters,
        seconds=arguments.seconds,
        first=arguments.first,
        plant_model=arguments.plant_model,
    )


def runner_command(twin: Twin, calibration: Path) -> list[str]:
    """The command that runs the shipped policy of the task on an emulated hand."""
    arguments, words = twin.arguments, ["python", "-m", "dexsim_real.run", twin.arguments.task]
    words += ["--port", str(twin.line.terminal.name), "--calibration", str(calibration), "--yes"]
    if arguments.hand:
        words += ["--hand", arguments.hand]
    if twin.imu:
        words += ["--imu", str(twin.imu.terminal.name)]
    if twin.masks:
        words += ["--camera", f"unix:{twin.masks.path}"]
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
    with tempfile.TemporaryDirectory(prefix="dexsim-twin-") as temporary:
        folder = arguments.folder or Path(temporary)
        twin = Twin(arguments, make_plant(arguments, hand), folder, _show)
        before = {number: signal.signal(number, lambda *_: twin.stop()) for number in (signal.SIGTERM, signal.SIGINT)}
        calibration = Path(temporary) / "calibration.toml"  # for nominal motors, from which those of a trial deviate
        known = dataclasses.replace(ideal_calibration(hand), serial=SERIALS[hand.side], handedness=hand.side)
        save_calibration(calibration, known)
        try:
            _show(
                f"{arguments.task}: the emulated hand is at {twin.line.terminal.name}. Run a policy on it with\n"
                f"    {shlex.join(runner_command(twin, calibration))}"
            )
            if arguments.realtime and not use_realtime():
                twin.note("without real-time priority: expect jitter on a busy machine (docs/hardware.md)")
            twin.run()
        finally:
            twin.close()
            if arguments.output:
                cli.write_json(arguments.output, twin.report())
            for number, handler in before.items():
                signal.signal(number, handler)
    return 0


def _show(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    cli.run(main)
