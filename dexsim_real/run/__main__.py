"""Runs a policy on the hand.

    python -m dexsim_real.run grasp --port /dev/serial/by-id/usb-FTDI_... --command 0.6

The policy is a file or the name of a shipped policy. Everything is compiled before the port is opened. The program
asks before the motors come on (`--yes` does not). They come on at the measured pose, and go off at the end of the
program, even after a failure.
"""

import contextlib
import sys
from collections.abc import Sequence

from dexsim.core import cli
from dexsim_real.control.controller import prepare_jax
from dexsim_real.core.errors import HandError
from dexsim_real.core.process import stopping
from dexsim_real.run import consent
from dexsim_real.run.options import RunArguments
from dexsim_real.run.session import Session
from dexsim_real.run.status import summary_table


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 1 when `Safety` or a failure ended the run or something is missing."""
    arguments = cli.parse(
        RunArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_real.run",
        description="Run a policy on the hand.",
    )
    if not (arguments.yes or arguments.motors_off):
        consent.check_terminal()
    inputs = {"policy": arguments.policy, "calibration": arguments.calibration, "TOML of the hand": arguments.hand}
    cli.check_apart({"--log": arguments.log, "--output": arguments.output}, inputs)
    if arguments.output:
        cli.check_writable(arguments.output)
    prepare_jax()
    cli.enable_caches()
    session = Session(arguments)
    reason, code = "", 0
    with stopping(leaving=argv is None):
        try:
            try:
                session.prepare()
                session.run()
            except HandError as error:
                reason, code = str(error), 1
                if not (session.started or session.safety.engaged):  # Nothing has moved.
                    raise
            except KeyboardInterrupt:
                reason, code = "Ctrl-C", 130
            except SystemExit as stop:
                code = stop.code if isinstance(stop.code, int) and stop.code > 128 else 1
                reason = f"signal {code - 128}" if code > 128 else f"a driver exits: {stop.code}"
            except BaseException as error:
                reason = f"failure: {error!r}"
                raise
            finally:
                session.close(reason)
        finally:  # Again: the one signal that interrupts may have come just before the line above.
            session.close(reason)
        if session.servo.driven:
            code = 1
        summary = session.summary()
        if code == 0 and summary["missing"]:
            code = 1
            _say("; ".join(summary["missing"]))
        elif code == 1:
            _say(session.end)
        if not arguments.quiet:
            session.view.console.print(summary_table(f"{session.controller.policy.task}: {session.end}", summary))
        if arguments.output:
            cli.write_json(arguments.output, summary)
    return code


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # The terminal may be gone, and the summary must still be written.
        print(f"error: {text}", file=sys.stderr)


if __name__ == "__main__":
    cli.run(main)
