"""Options of `python -m dexsim_real.calibrate`, one dataclass with those of every part within."""

import dataclasses
from pathlib import Path

from dexsim.core.config import setting, validate
from dexsim_real.control.safety import SafetyConfig
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HardwareConfig
from dexsim_real.wire.link import LinkConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressConfig:
    """How a fingertip is pressed."""

    peak: float = setting(8.0, unit="N", low=1.0, high=20.0)
    """Force at which a press turns round, by the taxels; the forces of the task should lie below."""
    current: float = setting(1.4, unit="A", low=0.01, high=10.0)
    """Current of a joint at which it turns round earlier."""
    touch: float = setting(0.4, unit="N", low=0.05, high=5.0)
    """Force that counts as contact."""
    cycles: int = setting(4, unit="1", low=1, high=20)
    """Presses, up and down; the one before them, which finds out how far to go, counts as well."""
    seconds: float = setting(6.0, unit="s", low=0.5, high=60.0)
    """From contact to peak, and back: slow, so that nothing but force and friction is in the current."""
    first_speed: float = setting(0.06, unit="rad/s", low=0.005, high=1.0)
    """Of the targets in the first press."""
    approach_speed: float = setting(0.15, unit="rad/s", low=0.01, high=2.0)
    """Of the targets until contact."""
    clearance: float = setting(0.2, unit="rad", low=0.02, high=0.6)
    """How far before its posture a joint waits for what it shall press on."""
    travel: float = setting(0.8, unit="rad", low=0.05, high=1.5)
    """How far past the contact a target goes at most."""
    pause: float = setting(0.5, unit="s", low=0.1, high=10.0)
    """Rest before a measurement."""

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """When a tactile sensor is sound."""

    seconds: float = setting(2.0, unit="s", low=0.3, high=60.0)
    """Length of the reading at rest."""
    noise: float = setting(3.0, unit="count", low=0.1, high=50.0)
    """Standard deviation at rest above which a taxel is noisy."""
    drift: float = setting(15.0, unit="count", low=1.0, high=1000.0)
    """Change of a fingertip's sum at rest that only a touch makes."""
    release: float = setting(20.0, unit="count", low=1.0, high=1000.0)
    """How far a fingertip's sum may lie below zero after a press: further, and it was zeroed under load."""
    neighbours: float = setting(3.0, unit="count", low=1.0, high=200.0)
    """Mean reading of a taxel's neighbours at which it must read as well, or else it is dead."""

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
    """Overwrite the output if it is there."""
    from_log: tuple[Path, ...] = ()
    """Fit logs of this command again, without a hand; of a press in several of them the last counts."""
    identify: bool = False
    """Move the free joints one after the other, and fit stiffness, damping, friction and latency instead."""
    gauge: str | None = None
    """Compare the taxels with a gauge: `ask` to type the readings of a kitchen scale or force gauge, or MODULE:FUNCTION
    for a function that returns newtons. None: the taxels are the reference, as in the paper."""
    levels: int = setting(6, unit="1", low=5, high=30)
    """Forces at which the gauge is read, on the way up and on the way down."""
    fingers: tuple[str, ...] = ()
    """Which fingers; all by default. Joints left out take the mean of those with the same torque limit."""
    sides: bool = True
    """Also press thumb and index with their sides, which is what loads the joints that spread them."""
    yes: bool = False
    """Ask nothing: whatever the fingers press on is in its place."""
    serial: str = ""
    """Serial number or name of the hand, for the file."""
    calibration: Path | None = None
    """With --identify: calibration file of this hand; None leaves torques unknown."""
    joints: tuple[str, ...] = ()
    """With --identify: which joints; all by default."""
    dead_band: bool = False
    """With --identify: search for the drives' dead-band as well, which takes minutes a joint."""
    plot: Path | None = None
    """Image file for the figure (.png, .pdf or .svg); None draws no figure."""
    report: Path | None = None
    """JSON file for all results; None writes no file."""
    log: Path | None = None
    """Log file; None for a new file in runs/real."""
    rate: float = setting(83.0, unit="Hz", low=20.0, high=1000.0)
    """Exchanges with the hand per second."""
    realtime: bool = True
    """Ask for real-time priority; without the right to it the procedure goes on without."""
    press: PressConfig = setting(PressConfig())
    """Forces and speeds."""
    check: CheckConfig = setting(CheckConfig())
    """Health of the taxels."""
    link: LinkConfig = setting(LinkConfig())
    """The serial line."""
    hardware: HardwareConfig = setting(HardwareConfig())
    """Signs, scales and gains."""
    safety: SafetyConfig = setting(SafetyConfig(watchdog=0.3, stale=0.15))
    """Limits."""

    def __post_init__(self):
        validate(self)
        if (self.port is None) == (not self.from_log):
            raise HandError("give --port for a hand, or --from-log FILE for a log of this command")
        if self.destination.exists() and not self.force:
            raise HandError(f"{self.destination} is there already: give another --output, or --force to overwrite it")
        if self.press.current >= self.safety.current:
            raise HandError(
                f"--press.current {self.press.current:g} A must be below --safety.current {self.safety.current:g} A"
            )
        if self.press.peak >= 0.9 * self.safety.finger_force:
            raise HandError(
                f"--press.peak {self.press.peak:g} N must be well below --safety.finger-force "
                f"{self.safety.finger_force:g} N"
            )

    @property
    def destination(self) -> Path:
        """The file to write."""
        return self.output or Path("hand.json" if self.identify else "hand.toml")
