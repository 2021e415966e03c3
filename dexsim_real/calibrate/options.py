"""Options of `python -m dexsim_real.calibrate`: one dataclass that contains the options of every part."""

import dataclasses
from pathlib import Path

from dexsim.core import cli
from dexsim.core.config import Config, setting
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.core.errors import HandError
from dexsim_real.loop import LoopOptions


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressConfig(Config):
    """Forces and speeds of a press."""

    peak: float = setting(8.0, unit="N", low=1.0, high=20.0)
    """Peak force of a press, measured by the taxels; choose it above the forces of the task."""
    current: float = setting(1.4, unit="A", low=0.01, high=10.0)
    """Current of a joint above which the press ends before its peak force."""
    cycles: int = setting(4, unit="1", low=1, high=20)
    """Number of presses, each with rising and falling force. The first one finds the travel."""
    seconds: float = setting(6.0, unit="s", low=0.5, high=60.0)
    """Time from contact to peak force, and back. Long, so that the current shows force and friction only."""
    first_speed: float = setting(0.06, unit="rad/s", low=0.005, high=1.0)
    """Speed of the joint targets in the first press."""
    approach_speed: float = setting(0.15, unit="rad/s", low=0.01, high=2.0)
    """Speed of the joint targets until contact."""
    pause: float = setting(0.5, unit="s", low=0.1, high=10.0)
    """Pause before a measurement."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrateArguments(LoopOptions):
    """Options of `python -m dexsim_real.calibrate`."""

    port: str | None = None
    """Serial port of the XHand (names under /dev/serial/by-id are stable), or sdk:MODULE:FUNCTION for the driver of
    another hand (docs/bridge.md). None only with --from-log."""
    hand: str = ""
    """The TOML of a hand, or the name of a shipped one (`xhand_left`); empty for the right XHand."""
    output: Path | None = None
    """Output file; None for hand.toml, or hand.json with --identify."""
    force: bool = False
    """Overwrite an existing output file."""
    from_log: tuple[Path, ...] = ()
    """Fit logs of this command again, without a hand. A press in several logs is taken from the last that
    finished it."""
    identify: bool = False
    """Identify the drives instead: move each free joint, and fit stiffness, damping, friction and latency."""
    gauge: bool = False
    """Compare the taxels with a kitchen scale or force gauge, whose readings you type. Otherwise the taxels are the
    reference, as in the paper."""
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
    log: Path | None = None
    """Log file; None for a new file in runs/real."""
    realtime: bool = True
    """Request real-time priority; continue without it if not permitted."""
    press: PressConfig = setting(PressConfig())
    """Presses."""
    safety: SafetyConfig = setting(SafetyConfig(watchdog=0.3, stale=0.15, stall_current=1.8))
    """Safety limits. Presses hold still at currents that a run need not hold."""

    def __post_init__(self):
        super().__post_init__()
        if (self.port is None) == (not self.from_log):
            raise HandError("give --port for a hand, or --from-log FILE for a log of this command")
        if self.destination.exists() and not self.force:
            raise HandError(f"{self.destination} already exists: give another --output, or --force to overwrite it")
        outputs = {"--output": self.destination, "--plot": self.plot, "--log": self.log}
        inputs = {f"--from-log {path}": path for path in self.from_log}
        cli.check_no_overwrite(outputs, inputs | {"calibration": self.calibration})
        if self.gauge and self.yes:
            raise HandError("--gauge needs answers, but --yes asks nothing; remove one of them")
        # With another finger or joint than meant the wrong one would move.
        own = {"fingers": False, "gauge": False, "plot": False, "joints": True, "dead_band": True}
        for name, identify in own.items():
            if getattr(self, name) and identify != self.identify:
                raise HandError(f"--{name.replace('_', '-')} is {'only' if identify else 'not'} for --identify")
        if self.press.current >= self.safety.current:
            raise HandError(
                f"--press.current {self.press.current:g} A must be below --safety.current {self.safety.current:g} A"
            )
        if self.press.peak >= 0.9 * self.safety.finger_force:
            raise HandError(
                f"--press.peak {self.press.peak:g} N must be well below "
                f"--safety.finger-force {self.safety.finger_force:g} N"
            )

    @property
    def destination(self) -> Path:
        """Output file."""
        return self.output or Path("hand.json" if self.identify else "hand.toml")
