"""Options of `python -m dexsim_real.run`, one dataclass with those of every part within."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from dexsim.core.config import setting, validate
from dexsim_real.control.safety import SafetyConfig
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import CameraConfig
from dexsim_real.sensors.hand import HardwareConfig
from dexsim_real.sensors.imu import UPRIGHT_X
from dexsim_real.wire.link import LinkConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunArguments:
    """Options of `python -m dexsim_real.run`."""

    policy: Annotated[str, tyro.conf.Positional]
    """A policy file, or the name of a shipped one ("grasp")."""
    port: str
    """Serial port of the hand (a name under /dev/serial/by-id stays the same), or sdk:MODULE:FUNCTION."""
    command: float = setting(0.5, unit="1", low=0.0, high=1.0)
    """Grip command in [0, 1]."""
    seconds: float = setting(30.0, unit="s", low=0.1, high=86400.0)
    """Length of the run, after the approach."""
    motors_off: bool = False
    """Read, compute and show everything, but leave the motors off."""
    calibration: Path | None = None
    """Calibration file of this hand; None only with --uncalibrated."""
    uncalibrated: bool = False
    """Run without a calibration, on guessed scales (`--hardware.current-scale`, `--hardware.force-per-count`)."""
    imu: str | None = None
    """Serial port of the IMU in the object; None if the policy needs no IMU."""
    imu_mount: tuple[float, float, float, float] = setting(UPRIGHT_X, unit="1", low=-1.0, high=1.0)
    """Orientation (w, x, y, z) of the IMU in the object; by default its z lies along the object's x."""
    camera: str | None = None
    """Source of the object's masks: camera number, video file, unix:PATH or MODULE:FUNCTION. None if the policy needs
    no camera."""
    fixed_object: bool = False
    """Run without a camera: the object is taken to stay where it belongs."""
    zero: bool = True
    """Zero the taxels first; refused while a fingertip touches something."""
    rate: float = setting(83.0, unit="Hz", low=1.0, high=1000.0)
    """Exchanges with the hand per second, moved by up to 1 % so that the policy, which keeps its own rate,
    computes while an answer is under way."""
    approach: float = setting(2.0, unit="s", low=0.0, high=60.0)
    """Time to move from the measured pose to the task's start posture; 0 stays there."""
    place: float = setting(0.0, unit="s", low=0.0, high=600.0)
    """Pause in the start posture, to put the object into the hand: squarely, if the IMU is used."""
    log: Path | None = None
    """Log file; None for a new file in runs/real."""
    output: Path | None = None
    """JSON file for the summary; None writes no file."""
    realtime: bool = True
    """Ask for real-time priority; without the right to it the run goes on without."""
    quiet: bool = False
    """No live view."""
    link: LinkConfig = setting(LinkConfig())
    """The serial line."""
    hardware: HardwareConfig = setting(HardwareConfig())
    """Signs, scales and gains."""
    safety: SafetyConfig = setting(SafetyConfig())
    """Limits."""
    optics: CameraConfig = setting(CameraConfig())
    """The camera: where it is, and the object's colour."""

    def __post_init__(self):
        validate(self)
        if self.calibration is None and not self.uncalibrated:
            raise HandError("give --calibration FILE, or --uncalibrated to run on guessed scales")
        if self.calibration is not None and self.uncalibrated:
            raise HandError("give --calibration or --uncalibrated, not both")
