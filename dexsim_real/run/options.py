"""Options of `python -m dexsim_real.run`."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import tyro

from dexsim.core.config import setting
from dexsim_real.core.errors import HandError
from dexsim_real.loop import LoopOptions
from dexsim_real.sensors.camera import CameraConfig
from dexsim_real.sensors.imu import UPRIGHT_X


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunArguments(LoopOptions):
    """Options of `python -m dexsim_real.run`."""

    policy: Annotated[str, tyro.conf.Positional]
    """Policy file, or name of a shipped policy ("grasp")."""
    port: str
    """Serial port of the XHand (names under /dev/serial/by-id are stable), or sdk:MODULE:FUNCTION for the driver of
    another hand (docs/bridge.md)."""
    hand: str = ""
    """The TOML of a hand of your own, where it is not in the place that the policy's file names."""
    command: float = setting(0.5, unit="1", low=0.0, high=1.0)
    """Grip command in [0, 1]."""
    seconds: float = setting(30.0, unit="s", low=0.1, high=86400.0)
    """Duration of the run, after the approach."""
    motors_off: bool = False
    """Measure, compute and display everything with the motors off."""
    yes: bool = False
    """Do not ask before the motors come on (for scripts and the emulated hand)."""
    calibration: Path | None = None
    """Calibration file of this hand; None only with --uncalibrated."""
    uncalibrated: bool = False
    """Run without a calibration, on default scales (`--hardware.current-scale`, `--hardware.force-per-count`)."""
    imu: str | None = None
    """Serial port of the IMU in the object; None if the policy needs no IMU."""
    imu_mount: tuple[float, float, float, float] = setting(UPRIGHT_X, unit="1", low=-1.0, high=1.0)
    """Orientation (w, x, y, z) of the IMU in the object; by default its z is along the object's x."""
    camera: str | None = None
    """Source of the object's masks: camera number, video file, unix:PATH or MODULE:FUNCTION. None if the policy needs
    no camera."""
    fixed_object: bool = False
    """Run without a camera: assume that the object stays at its nominal position."""
    guard: bool = True
    """Start a second process that turns the motors off when this one dies or freezes."""
    approach: float = setting(2.0, unit="s", low=0.0, high=60.0)
    """Time to move from the measured pose to the task's start posture; 0 stays at the measured pose."""
    place: float = setting(0.0, unit="s", low=0.0, high=600.0)
    """Time in the start posture to put the object into the hand, aligned with the palm if the IMU is used."""
    log: Path | None = None
    """Log file; None for a new file in runs/real."""
    output: Path | None = None
    """JSON file for the summary; None writes no file."""
    realtime: bool = True
    """Request real-time priority; continue without it if not permitted."""
    quiet: bool = False
    """Hide the live status."""
    optics: CameraConfig = setting(CameraConfig())
    """Pose of the camera, and colour of the object."""

    def __post_init__(self):
        super().__post_init__()
        if math.hypot(*self.imu_mount) < 1e-3:
            raise HandError(f"--imu-mount {' '.join(f'{v:g}' for v in self.imu_mount)}: is no orientation (w, x, y, z)")
        if (self.calibration is None) != self.uncalibrated:
            raise HandError("give either --calibration FILE, or --uncalibrated to run on default scales")
