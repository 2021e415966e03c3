"""Options of `python -m dexsim_real.calibrate`: one dataclass that contains the options of every part."""

import dataclasses
import os
from pathlib import Path

from dexsim.core.config import setting, validate
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HardwareConfig
from dexsim_real.wire.link import LinkConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressConfig:
    """Forces and speeds of a press."""

    peak: float = setting(8.0, unit="N", low=1.0, high=20.0)
    """Peak force of a press, measured by the taxels; choose it above the forces of the task."""
    current: float = setting(1.4, unit="A", low=0.01, high=10.0)
    """Current of a joint above which the press ends before its peak force."""
    touch: float = setting(0.4, unit="N", low=0.05, high=5.0)
    """Force above which a fingertip counts as touching."""
    cycles: int = setting(4, unit="1", low=1, high=20)
    """Number of presses, each with rising and falling force. The first one finds the travel."""
    seconds: float = setting(6.0, unit="s", low=0.5, high=60.0)
    """Time from contact to peak force, and back. Long, so that the current shows force and friction only."""
    first_speed: float = setting(0.06, unit="rad/s", low=0.005, high=1.0)
    """Speed of the joint targets in the first press."""
    approach_speed: float = setting(0.15, unit="rad/s", low=0.01, high=2.0)
    """Speed of the joint targets until contact."""
    clearance: float = setting(0.2, unit="rad", low=0.02, high=0.6)
    """Distance of the start of a press from the posture of contact."""
    travel: float = setting(0.8, unit="rad", low=0.05, high=1.5)
    """Largest travel of a joint target past contact."""
    pause: float = setting(0.5, unit="s", low=0.1, high=10.0)
    """Pause before a measurement."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """Thresholds of the checks of the tactile sensors."""

    seconds: float = setting(2.0, unit="s", low=0.3, high=60.0)
    """Duration of the recording at rest."""
    noise: float = setting(3.0, unit="count", low=0.1, high=50.0)
    """Standard deviation at rest above which a taxel counts as noisy."""
    drift: float = setting(15.0, unit="count", low=1.0, high=1000.0)
    """Change of a fingertip's sum at rest above which it counts as touched."""
    release: float = setting(20.0, unit="count", low=1.0, high=1000.0)
    """Largest negative sum of a fingertip after a press; a larger one means that it was tared under load."""
    neighbours: float = setting(3.0, unit="count", low=1.0, high=200.0)
    """Mean count of a taxel's neighbours above which a taxel without counts is dead."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrateArguments:
    """Options of `python -m dexsim_real.calibrate`."""

    port: str | None = None
    """Serial port of the hand (names under /dev/serial/by-id are stable), or sdk:MODULE:FUNCTION. None only with
    --from-log."""
    output: Path | None = None
    """Output file; None for hand.toml, or hand.json with --identify."""
    force: bool = False
    """Overwrite an existing output file or report."""
    from_log: tuple[Path, ...] = ()
    """Fit logs of this command again, without a hand. A press in several logs is taken from the last that
    finished it."""
    identify: bool = False
    """Identify the drives instead: move each free joint, and fit stiffness, damping, friction and latency."""
    gauge: str | None = None
    """Compare the taxels with a gauge: `ask` to type the readings of a kitchen scale or force gauge, or MODULE:FUNCTION
    for a function that returns newtons. None: the taxels are the reference, as in the paper."""
    levels: int = setting(6, unit="1", low=5, high=30)
    """Number of forces at which the gauge is read, both rising and falling."""
    fingers: tuple[str, ...] = ()
    """Fingers to press; all by default. The other joints get the mean of those with the same torque limit."""
    sides: bool = True
    """Also press with the sides of thumb and index finger, to load the joints that spread them."""
    yes: bool = False
    """Ask nothing: assume that the fingers always have something to press on."""
    calibration: Path | None = None
    """With --identify: calibration file of this hand; None leaves torques unknown."""
    joints: tuple[str, ...] = ()
    """With --identify: joints to move; all by default."""
    dead_band: bool = False
    """With --identify: also fit the dead band of the drives, which takes minutes per joint."""
    plot: Path | None = None
    """Image file for the figure (.png, .pdf or .svg); None draws no figure."""
    report: Path | None = None
    """JSON file for all results; None writes no file."""
    log: Path | None = None
    """Log file; None for a new file in runs/real."""
    rate: float = setting(83.0, unit="Hz", low=20.0, high=1000.0)
    """Exchanges with the hand per second."""
    realtime: bool = True
    """Request real-time priority; continue without it if not permitted."""
    press: PressConfig = setting(PressConfig())
    """Presses."""
    check: CheckConfig = setting(CheckConfig())
    """Checks of the tactile sensors."""
    link: LinkConfig = setting(LinkConfig())
    """The serial line."""
    hardware: HardwareConfig = setting(HardwareConfig())
    """Signs, scales and gains of the hand."""
    safety: SafetyConfig = setting(SafetyConfig(watchdog=0.3, stale=0.15, stall_current=1.8))
    """Safety limits. Presses hold still at currents that a run need not hold."""

    def __post_init__(self):
        validate(self)
        if (self.port is None) == (not self.from_log):
            raise HandError("give --port for a hand, or --from-log FILE for a log of this command")
        for option, path in (("--output", self.destination), ("--report", self.report)):
            if path and path.exists() and not self.force:
                raise HandError(f"{path} already exists: give another {option}, or --force to overwrite it")
        self._check_distinct()
        self._check_purpose()
        if self.plot and self.plot.suffix.lower() not in (".png", ".pdf", ".svg"):
            raise HandError(f"--plot {self.plot}: give a file that ends in .png, .pdf or .svg")
        if self.press.current >= self.safety.current:
            raise HandError(
                f"--press.current {self.press.current:g} A must be below --safety.current {self.safety.current:g} A"
            )
        if self.press.peak >= 0.9 * self.safety.finger_force:
            raise HandError(
                f"--press.peak {self.press.peak:g} N must be well below --safety.finger-force "
                f"{self.safety.finger_force:g} N"
            )

    def _check_distinct(self) -> None:
        """Check that no file is written over another one of the same command, nor over one that is read."""
        written = (
            ("--output", self.destination),
            ("--report", self.report),
            ("--plot", self.plot),
            ("--log", self.log),
        )
        used = {os.path.realpath(path): "--from-log" for path in self.from_log}
        used |= {os.path.realpath(self.calibration): "--calibration"} if self.calibration else {}
        for option, path in written:
            if path and (other := used.setdefault(os.path.realpath(path), option)) != option:
                raise HandError(f"{path} is given for both {other} and {option}: give each its own file")

    def _check_purpose(self) -> None:
        """Check that no option is left aside: with another finger or joint than meant the wrong one would move."""
        presses = {"--fingers": self.fingers, "--gauge": self.gauge, "--plot": self.plot, "--report": self.report}
        drives = {"--joints": self.joints, "--dead-band": self.dead_band}
        for option, value in (presses if self.identify else drives).items():
            if value:
                raise HandError(f"{option} {'is for presses: not with' if self.identify else 'needs'} --identify")

    @property
    def destination(self) -> Path:
        """Output file."""
        return self.output or Path("hand.json" if self.identify else "hand.toml")
