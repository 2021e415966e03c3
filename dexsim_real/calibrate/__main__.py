"""Calibrates a hand by pressing its fingertips on a pen that foam backs: currents to torques, taxel counts to newtons.

    python -m dexsim_real.calibrate --port /dev/serial/by-id/usb-FTDI_... --output hand.toml

The taxels are checked and tared with the motors off. Then each fingertip presses slowly, with rising and falling force.
With `--gauge` a kitchen scale or force gauge is the reference; otherwise the taxels are, as in the paper. The
output is written at the end, complete or not at all. `--from-log FILE` fits recorded presses again.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import load_hand
from dexsim.calibration.maps import Calibration, save_calibration, torque_constants
from dexsim.calibration.plot import plot_calibration
from dexsim.core import cli
from dexsim.hand.description import Hand
from dexsim_real.calibrate.bench import Bench, CalibrateArguments, Operator
from dexsim_real.calibrate.identify_drives import identify_hand
from dexsim_real.calibrate.press_fit import JointFit, fit, read_presses
from dexsim_real.calibrate.procedure import PressProcedure, placements
from dexsim_real.control.controller import prepare_jax
from dexsim_real.core.errors import HandError
from dexsim_real.core.process import stopping

_SPEED = 2.0  # rad/s, largest rate of change of the commands: no motion here needs to be fast


def record(arguments: CalibrateArguments, hand: Hand, operator: Operator, **bench: Any) -> Path:
    """Run the press procedure; returns its log. `bench` replaces port and clock (`Bench`).

    Raises HandError: the procedure failed; the motors are off.
    """
    plan = placements(hand, arguments.fingers, arguments.sides)
    slow = dataclasses.replace(arguments.safety, speed=min(arguments.safety.speed, _SPEED))
    arguments = dataclasses.replace(arguments, safety=slow)
    with stopping(), Bench(arguments, hand, operator, **bench) as work:
        procedure = PressProcedure(work)
        pressed = 0
        try:
            procedure.check()
            work.await_motors()
            for placement in plan:
                pressed += procedure.press(placement)
        except HandError as error:
            if not pressed:
                raise
            raise HandError(f"{error} ({pressed} presses are in {work.log.path}; fit them with --from-log)") from None
        finally:  # A signal that comes just before this line is followed by the close of the bench.
            work.close()
    return work.log.path


def fit_and_report(arguments: CalibrateArguments, hand: Hand, logs: Sequence[Path], operator: Operator) -> None:
    """Fit the presses, print the result, and write the files asked for, the calibration first.

    Raises DexsimError: the recordings are insufficient, or a file cannot be written.
    """
    calibration, joints = fit(*read_presses(logs, hand), hand)
    for line in (*table(calibration, joints, hand), *(f"note: {note}" for note in calibration.notes)):
        operator.tell(line)
    output = arguments.destination
    if output.exists() and not arguments.force:  # It may have been created meanwhile.
        logged = " ".join(map(str, logs))
        raise HandError(f"{output} already exists: --from-log {logged} fits these presses into another")
    save_calibration(output, calibration)
    operator.tell(f"calibration: {output}")
    if arguments.plot:
        real, sim = ({name: getattr(fitted, side) for name, fitted in joints.items()} for side in ("real", "sim"))
        plot_calibration(arguments.plot, calibration, real, sim)
        operator.tell(f"figure: {arguments.plot}")


def table(calibration: Calibration, joints: Mapping[str, JointFit], hand: Hand) -> list[str]:
    """Lines of a table with one row per joint. A cell has loading / unloading, or the worse of the two."""
    real, (constants, errors) = calibration.real, torque_constants(calibration)
    tip = dict(zip(hand.root_joint.tolist(), calibration.force_per_torque[0], strict=True))
    rows = [f"{'joint':15}{'pressed with':14}{'Nm / A':>15}{'95 %':>9}  R2     friction  max force  tip N / Nm"]
    for joint, name in enumerate(calibration.joint_names):
        loading, unloading = constants[:, joint]
        width = 100 * np.max(errors[:, joint] / np.abs(constants[:, joint]))
        pressed = joints[name].press if name in joints else "(others)"
        rows.append(
            f"{name:15}{pressed:14}{loading:+.3f} / {unloading:+.3f}"
            f"{width:7.1f} %  {np.min(real.r_squared[:, joint]):.3f}"
            f"{1e3 * real.friction[joint]:6.0f} mA{real.force_max[joint]:9.1f} N"
            f"{f'{tip[joint]:10.1f}' if tip.get(joint) else ''}"
        )
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    about = __doc__.splitlines()[0]
    arguments = cli.parse(CalibrateArguments, argv, prog="python -m dexsim_real.calibrate", description=about)
    for path in (arguments.destination, arguments.plot):
        if path:
            cli.check_writable(path)
    prepare_jax()
    cli.enable_caches()
    hand = load_hand(arguments.hand or None)
    operator = Operator(sys.stderr, assume_yes=arguments.yes)
    if arguments.identify:
        identify_hand(arguments, hand, operator)
    else:
        logs = arguments.from_log or (record(arguments, hand, operator),)
        fit_and_report(arguments, hand, logs, operator)
    return 0


if __name__ == "__main__":
    cli.run(main)
