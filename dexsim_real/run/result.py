"""A whole run as one call, for programs and notebooks; `python -m dexsim_real.run` is the same call."""

import dataclasses
from pathlib import Path
from typing import Any

from dexsim.core import cli
from dexsim_real.control.controller import prepare_jax
from dexsim_real.core.errors import HandError
from dexsim_real.core.process import stopping
from dexsim_real.run.options import RunArguments
from dexsim_real.run.session import Session, check_terminal


@dataclasses.dataclass(frozen=True)
class RunResult:
    """How a run ended, and what it measured."""

    end: str  # why: "time is over", a safety reaction, a signal, or what failed
    code: int  # 0 for a whole run, 1 if something ended it or is missing, 128 + n after signal n
    problem: str  # what ended it early, or what it lacks; empty for a whole run, and after a signal
    log: Path  # of all frames and ticks, for `python -m dexsim_real.replay`
    summary: dict[str, Any]
    """Statistics: seconds, forces in N, successes, jitter, link, cycles by safety reason. If `motors_off` is false, the
    hand has not confirmed that they are: press the emergency stop. `missing` lists what is no success."""


def run_policy(
    policy: str | Path, port: str, calibration: str | Path | None = None, *, seconds: float = 30.0, **options: Any
) -> RunResult:
    """Run a policy on a hand: connect, tare, approach, policy, motors off. Asks before the motors come on.

        result = dexsim_real.run_policy("grasp", "/dev/ttyUSB0", "hand.toml", seconds=10, command=0.6, camera="0")

    Args:
      policy: file, or name of a shipped policy.
      port: serial port of the hand, or sdk:MODULE:FUNCTION.
      calibration: file of this hand; None for default scales.
      seconds: duration after the approach.
      options: further fields of `RunArguments`; `yes=True` asks nothing.

    Raises:
      HandError: the hand or a sensor cannot be reached, or nobody said yes; nothing has moved.
      DexsimError: the policy, the calibration or an option cannot be used.
    """
    file = None if calibration is None else Path(calibration)
    arguments = RunArguments(
        policy=str(policy), port=port, calibration=file, uncalibrated=file is None, seconds=seconds, **options
    )
    with stopping():
        return execute(arguments)


def execute(arguments: RunArguments) -> RunResult:
    """Run with these options, within `stopping`; see `run_policy`."""
    if not (arguments.yes or arguments.motors_off):
        check_terminal()
    prepare_jax()
    cli.enable_caches()
    session = Session(arguments)
    reason, code = "", 0
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
    summary = session.summary()
    code = code if summary["motors_off"] else 1
    problem = session.end if code == 1 else "; ".join(summary["missing"]) if code == 0 else ""
    return RunResult(session.end, 1 if problem else code, problem, session.log.path, summary)
