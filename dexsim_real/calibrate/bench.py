"""A hand on the bench: port, log and safety limits of a procedure, opened and closed together."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dexsim.calibration.maps import load_calibration
from dexsim.core import cli
from dexsim.core.config import to_dict
from dexsim.hand.kinematics import Hand
from dexsim_real.calibrate.hand_loop import HandLoop, Operator
from dexsim_real.calibrate.options import CalibrateArguments
from dexsim_real.control.motors_off import UNCONFIRMED
from dexsim_real.control.safety import Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogWriter
from dexsim_real.core.process import leave_realtime, use_realtime
from dexsim_real.sensors.hand import HandSensing
from dexsim_real.wire.identity import check_identity
from dexsim_real.wire.link import HandPort, greet
from dexsim_real.wire.serial_hand import open_port


class Workbench:
    """A hand with log and safety limits for one procedure. A context manager that ends with the motors off.

    Args:
      arguments: options of the command.
      hand: model of the hand.
      operator: is told what happens.
      meta: written to the log, with the configuration.
      port: replaces the port that the arguments name.
      clock, sleep: replace those of `time`, for simulated time.
    """

    def __init__(
        self,
        arguments: CalibrateArguments,
        hand: Hand,
        operator: Operator,
        meta: dict[str, Any],
        *,
        port: HandPort | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._operator, self._meta = operator, meta
        self._arguments = arguments
        sensing = HandSensing(hand, arguments.hardware)
        path = arguments.log or Path("runs/real") / time.strftime("calibrate-%Y%m%d-%H%M%S.log")
        if port is None:
            assert arguments.port is not None, "`CalibrateArguments` asks for it"
            port = open_port(arguments.port, arguments.link)
        self.log = LogWriter(path)
        self.safety = Safety(hand, arguments.safety, self._react)
        self.loop = HandLoop(port, sensing, self.safety, self.log, arguments.rate, clock=clock, sleep=sleep)

    def __enter__(self) -> "Workbench":
        try:
            # Only during the procedure: long computations in a real-time thread would starve the machine.
            if self._arguments.realtime:
                use_realtime()
            for line in greet(self.loop.port):
                self._say(line)
            identity, calibration = getattr(self.loop.port, "identity", None), self._arguments.calibration
            known = load_calibration(calibration, self.loop.sensing.hand) if calibration else None
            for note in check_identity(identity, self.loop.sensing.hand, known):
                self._say(note)
            self.log.add(
                Kind.META,
                {
                    "env_config": {},
                    "policy": "",
                    "calibration": "",
                    "serial": identity.serial_number if identity else "",
                    "handedness": identity.handedness if identity else "",
                    "hardware": to_dict(self._arguments.hardware),
                    "safety": to_dict(self._arguments.safety),
                    "check": to_dict(self._arguments.check),
                    "press": to_dict(self._arguments.press),
                    "rate": self._arguments.rate,
                    "clock": time.time(),
                    "environment": cli.environment_report(),
                    **self._meta,
                },
            )
        except BaseException:
            self.__exit__(*sys.exc_info())
            raise
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        try:
            self.loop.close()
        finally:
            end = "" if error is None else str(error) or kind.__name__
            if self.loop.driven:
                self._say(f"{UNCONFIRMED}: press the emergency stop")
            self.log.add(Kind.NOTE, f"end: {end or 'done'}")
            self.log.add(Kind.END, {"end": end})
            self.log.close()
            if self._arguments.realtime:
                leave_realtime()
        if error is None and self.loop.driven:
            raise HandError(f"{UNCONFIRMED}: press the emergency stop")
        if error is None and (self.log.dropped or self.log.failure):
            raise HandError(f"{self.log.dropped} log records are lost ({self.log.failure or 'the disk is too slow'})")

    def _react(self, text: str) -> None:
        self.log.add(Kind.NOTE, text)
        if text.startswith(("hold", "relax")) and self.safety.engaged:
            self._operator.tell(f"  {text}")

    def _say(self, text: str) -> None:
        self.log.add(Kind.NOTE, text)
        self._operator.tell(text)
