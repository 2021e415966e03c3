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
from dexsim_real.core.process import stopping
from dexsim_real.run.session import RunArguments, execute
from dexsim_real.run.status import show_summary


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 1 when `Safety` or a failure ended the run or something is missing."""
    arguments = cli.parse(
        RunArguments,
        argv,
        prog="python -m dexsim_real.run",
        description="Run a policy on the hand.",
    )
    inputs = {"policy": arguments.policy, "calibration": arguments.calibration, "TOML of the hand": arguments.hand}
    cli.check_no_overwrite({"--log": arguments.log, "--output": arguments.output}, inputs)
    if arguments.output:
        cli.check_writable(arguments.output)
    with stopping(leaving=argv is None):
        result = execute(arguments)
        if result.problem:
            with contextlib.suppress(OSError):  # The terminal may be gone, and the summary must still be written.
                print(f"error: {result.problem}", file=sys.stderr)
        if not arguments.quiet:
            show_summary(f"{arguments.policy}: {result.end}", result.summary)
        if arguments.output:
            cli.write_json(arguments.output, result.summary)
    return result.code


if __name__ == "__main__":
    cli.run(main)
